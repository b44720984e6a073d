//! A description in one line of JSON, which is also YAML in flow style.

use core::fmt::{self, Display, Formatter, Write};

use super::{ComponentDescription, Field, GoalRule, Storage};

/// A text in JSON's quotes, without characters that YAML does not allow there.
pub(super) struct Quoted<'a>(pub &'a str);

impl Display for Quoted<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_char('"')?;
        for c in self.0.chars() {
            match c {
                '"' | '\\' => write!(f, "\\{c}")?,
                ..' '
                | '\x7f'..='\u{9f}'
                | '\u{2028}'
                | '\u{2029}'
                | '\u{feff}'
                | '\u{fffe}'
                | '\u{ffff}' => write!(f, "\\u{:04x}", u32::from(c))?,
                _ => f.write_char(c)?,
            }
        }
        f.write_char('"')
    }
}

/// Writes items with commas between them.
pub(super) fn list<T>(
    f: &mut Formatter<'_>,
    items: &[T],
    mut put: impl FnMut(&mut Formatter<'_>, &T) -> fmt::Result,
) -> fmt::Result {
    for (place, item) in items.iter().enumerate() {
        f.write_str(if place == 0 { "" } else { ", " })?;
        put(f, item)?;
    }
    Ok(())
}

/// Texts as a JSON list.
pub(super) struct Texts<'a, T>(pub &'a [T]);

impl<T: AsRef<str>> Display for Texts<'_, T> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_char('[')?;
        list(f, self.0, |f, text| write!(f, "{}", Quoted(text.as_ref())))?;
        f.write_char(']')
    }
}

/// Writes a pair behind others, if its value is there. JSON has no infinite numbers, so an infinite bound is left out.
pub(super) fn bound(f: &mut Formatter<'_>, key: &str, value: Option<f64>) -> fmt::Result {
    match value.filter(|value| value.is_finite()) {
        Some(value) => write!(f, ", \"{key}\": {value}"),
        None => Ok(()),
    }
}

fn text(f: &mut Formatter<'_>, key: &str, value: Option<&str>) -> fmt::Result {
    match value {
        Some(value) => write!(f, ", \"{key}\": {}", Quoted(value)),
        None => Ok(()),
    }
}

struct Json<'a, T>(&'a T);

impl<S: Storage> ComponentDescription<S> {
    /// The description in one line of JSON, which is also YAML in flow style. Leaves out what it does not
    /// say.
    pub fn json(&self) -> impl Display + '_ {
        Json(self)
    }
}

impl<S: Storage> Display for Json<'_, ComponentDescription<S>> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let it = self.0;
        f.write_str("{\"goal\": {")?;
        goal(f, &it.goal)?;
        f.write_char('}')?;
        text(f, "about", it.about.as_ref().map(AsRef::as_ref))?;
        for (key, texts) in [("examples", &it.examples), ("streams", &it.streams)] {
            if !texts.as_ref().is_empty() {
                write!(f, ", \"{key}\": {}", Texts(texts.as_ref()))?;
            }
        }
        text(f, "result", it.result.as_ref().map(AsRef::as_ref))?;
        if !it.can_abort {
            f.write_str(", \"abort\": false")?;
        }
        if let Some(usually) = it.usually_ms {
            write!(f, ", \"usually_ms\": {usually}")?;
        }
        f.write_char('}')
    }
}

/// The pairs of a goal.
fn goal<S: Storage>(f: &mut Formatter<'_>, it: &GoalRule<S>) -> fmt::Result {
    match it {
        GoalRule::Any => f.write_str("\"type\": \"any\""),
        GoalRule::Nothing => f.write_str("\"type\": \"nothing\""),
        GoalRule::Text { longest } => {
            f.write_str("\"type\": \"text\"")?;
            match longest {
                Some(longest) => write!(f, ", \"longest\": {longest}"),
                None => Ok(()),
            }
        }
        GoalRule::Number {
            whole,
            least,
            most,
            step,
            unit,
        } => {
            let kind = if *whole { "whole" } else { "number" };
            write!(f, "\"type\": \"{kind}\"")?;
            bound(f, "least", *least)?;
            bound(f, "most", *most)?;
            bound(f, "step", *step)?;
            text(f, "unit", unit.as_ref().map(AsRef::as_ref))
        }
        GoalRule::Bool => f.write_str("\"type\": \"truth\""),
        GoalRule::OneOf(words) => write!(f, "\"one-of\": {}", Texts(words.as_ref())),
        GoalRule::ListOf(item) => {
            f.write_str("\"list-of\": {")?;
            goal(f, item.as_ref())?;
            f.write_char('}')
        }
        GoalRule::Fields(fields) => {
            f.write_str("\"fields\": [")?;
            list(f, fields.as_ref(), field)?;
            f.write_char(']')
        }
    }
}

fn field<S: Storage>(f: &mut Formatter<'_>, it: &Field<S>) -> fmt::Result {
    write!(f, "{{\"name\": {}, ", Quoted(it.name.as_ref()))?;
    goal(f, &it.rule)?;
    if it.optional {
        f.write_str(", \"optional\": true")?;
    }
    text(f, "default", it.default.as_ref().map(AsRef::as_ref))?;
    f.write_char('}')
}
