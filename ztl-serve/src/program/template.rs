//! Arguments of programs, with placeholders for the goal.

use ztl_std::describe::{GoalRule, GoalValue};
use ztl_yaml::closest;

use crate::call::Call;

/// An argument with placeholders: `--speed={goal.speed}`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Template(Vec<Part>);

#[derive(Debug, Clone, PartialEq, Eq)]
enum Part {
    Text(String),
    /// The goal, or the part of it at this path.
    Goal(Vec<String>),
    /// A field of what a robot has answered to the task's request.
    Answer(Vec<String>),
    Handler,
    Component,
    Id,
    Scope,
}

const KNOWN: [&str; 6] = ["goal", "goal.x", "handler", "component", "id", "scope"];

impl Part {
    /// Whether a client may choose any text for it. `wild`: clients choose handler or component.
    fn is_open(&self, rule: &GoalRule, wild: bool) -> bool {
        match self {
            Self::Goal(path) => !rule.part(path).is_some_and(GoalRule::is_closed),
            Self::Handler | Self::Component => wild,
            Self::Text(_) | Self::Answer(_) | Self::Id | Self::Scope => false,
        }
    }
}

impl Template {
    /// Parses an argument. Only a single word in braces is a placeholder; other braces are text.
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let template = Self::parse_with_answer(text)?;
        match template.uses_answer() {
            true => Err(
                "'{answer}' is known only after the answer: in abort, progress and event of http"
                    .to_owned(),
            ),
            false => Ok(template),
        }
    }

    /// As [`parse`](Self::parse), where `{answer.x}` is known, too.
    pub(crate) fn parse_with_answer(text: &str) -> Result<Self, String> {
        let mut parts = Vec::new();
        let mut plain = String::new();
        let mut rest = text;
        while let Some(start) = rest.find('{') {
            let (before, from) = rest.split_at(start);
            plain.push_str(before);
            let inner = from.get(1..).unwrap_or_default();
            let word = inner.split_once('}').map(|(word, _)| word);
            let Some(word) = word.filter(|word| is_word(word)) else {
                plain.push('{');
                rest = inner;
                continue;
            };
            if !plain.is_empty() {
                parts.push(Part::Text(std::mem::take(&mut plain)));
            }
            parts.push(part(word)?);
            rest = inner.get(word.len() + 1..).unwrap_or_default();
        }
        plain.push_str(rest);
        if !plain.is_empty() || parts.is_empty() {
            parts.push(Part::Text(plain));
        }
        Ok(Self(parts))
    }

    /// An argument without placeholders.
    pub(crate) fn fixed(text: &str) -> Self {
        Self(vec![Part::Text(text.to_owned())])
    }

    /// Whether it has no placeholders.
    pub(crate) fn is_fixed(&self) -> bool {
        matches!(self.0.as_slice(), [Part::Text(_)])
    }

    /// The path of the goal, if it is that placeholder alone: empty for `{goal}`.
    pub(crate) fn goal_alone(&self) -> Option<&[String]> {
        match self.0.as_slice() {
            [Part::Goal(path)] => Some(path),
            _ => None,
        }
    }

    /// The path of the answer, if it is that placeholder alone.
    pub(crate) fn answer_alone(&self) -> Option<&[String]> {
        match self.0.as_slice() {
            [Part::Answer(path)] => Some(path),
            _ => None,
        }
    }

    /// Whether it uses fields of the answer.
    pub(crate) fn uses_answer(&self) -> bool {
        let mut parts = self.0.iter();
        parts.any(|part| matches!(part, Part::Answer(_)))
    }

    /// Whether it differs from task to task of the same goal.
    #[cfg(feature = "http")]
    pub(crate) fn names_task(&self) -> bool {
        let mut parts = self.0.iter();
        parts.any(|part| matches!(part, Part::Answer(_) | Part::Id))
    }

    /// The parts of the goal that it uses.
    pub(crate) fn goal_paths(&self) -> impl Iterator<Item = &[String]> {
        self.0.iter().filter_map(|part| match part {
            Part::Goal(path) => Some(path.as_slice()),
            _ => None,
        })
    }

    /// Whether it uses parts of the goal.
    pub(crate) fn has_fields(&self) -> bool {
        let mut parts = self.0.iter();
        parts.any(|part| matches!(part, Part::Goal(path) if !path.is_empty()))
    }

    /// A part of the goal that it uses and that no goal of this rule has.
    pub(crate) fn lacks(&self, rule: &GoalRule) -> Option<String> {
        self.0.iter().find_map(|part| match part {
            Part::Goal(path) if rule.part(path).is_none() => Some(path.join(".")),
            _ => None,
        })
    }

    /// The text at its beginning.
    pub(crate) fn beginning(&self) -> &str {
        match self.0.first() {
            Some(Part::Text(text)) => text,
            _ => "",
        }
    }

    /// Whether a client can put any text into it.
    pub(crate) fn takes_text(&self, rule: &GoalRule, wild: bool) -> bool {
        self.0.iter().any(|part| part.is_open(rule, wild))
    }

    /// Whether a client can choose its beginning: with a `-`, a program would take it for an option.
    pub(crate) fn is_open(&self, rule: &GoalRule, wild: bool) -> bool {
        let first = self.0.first();
        first.is_some_and(|part| part.is_open(rule, wild))
    }

    /// It with `x` for each placeholder.
    #[cfg(feature = "http")]
    pub(crate) fn sample(&self) -> String {
        let parts = self.0.iter().map(|part| match part {
            Part::Text(text) => text,
            _ => "x",
        });
        parts.collect()
    }

    /// The argument for a task.
    pub(crate) fn fill(&self, call: &Call) -> Result<String, String> {
        self.fill_with(call, |value| Ok(value.to_owned()))
    }

    /// The same, with each placeholder's value passed through `encode`.
    pub(crate) fn fill_with(
        &self,
        call: &Call,
        encode: impl Fn(&str) -> Result<String, String>,
    ) -> Result<String, String> {
        let mut filled = String::new();
        for part in &self.0 {
            let value = match part {
                Part::Text(text) => {
                    filled.push_str(text);
                    continue;
                }
                Part::Goal(path) if path.is_empty() => call.goal.text.clone(),
                Part::Goal(path) => field(call, path).ok_or_else(|| {
                    let path = path.join(".");
                    format!(
                        "the goal has no '{path}'; this task needs a goal with that field or item"
                    )
                })?,
                Part::Answer(path) => answer_part(call, path)?
                    .to_text()
                    .map_err(|error| error.to_string())?,
                Part::Handler => call.handler.clone(),
                Part::Component => call.component.clone(),
                Part::Id => call.id.to_string(),
                Part::Scope => call.scope.clone(),
            };
            filled.push_str(&encode(&value)?);
        }
        Ok(filled)
    }
}

fn field(call: &Call, path: &[String]) -> Option<String> {
    let fields = call.goal.fields.as_ref()?;
    let value = path.iter().try_fold(fields, |value, key| value.part(key))?;
    value.to_text().ok()
}

/// A field of the answer.
///
/// # Errors
/// The answer has none.
pub(crate) fn answer_part<'c>(call: &'c Call, path: &[String]) -> Result<&'c GoalValue, String> {
    let answer = call.answer.as_ref();
    let part = answer.and_then(|value| path.iter().try_fold(value, |value, key| value.part(key)));
    part.ok_or_else(|| format!("the answer has no '{}'", path.join(".")))
}

fn is_word(word: &str) -> bool {
    let fits = |c: char| c.is_alphanumeric() || matches!(c, '_' | '.' | '-');
    !word.is_empty() && word.chars().all(fits)
}

fn part(word: &str) -> Result<Part, String> {
    let (name, path) = match word.split_once('.') {
        Some((name, path)) => (name, path.split('.').map(str::to_owned).collect()),
        None => (word, Vec::new()),
    };
    match (name, path.as_slice()) {
        ("goal", path) if path.iter().all(|key| !key.is_empty()) => Ok(Part::Goal(path.to_vec())),
        ("answer", path) if path.iter().all(|key| !key.is_empty()) => {
            Ok(Part::Answer(path.to_vec()))
        }
        ("handler", []) => Ok(Part::Handler),
        ("component", []) => Ok(Part::Component),
        ("id", []) => Ok(Part::Id),
        ("scope", []) => Ok(Part::Scope),
        _ => {
            let help = match closest(name, KNOWN) {
                Some(known) => format!("did you mean '{{{known}}}'?"),
                None => format!("there are: {{{}}}", KNOWN.join("}, {")),
            };
            Err(format!("unknown placeholder '{{{word}}}'; {help}"))
        }
    }
}

#[cfg(test)]
mod tests {
    use ztl_core::TaskId;

    use super::*;
    use ztl_std::describe::CheckedGoal;

    fn call(goal: &str) -> Call {
        Call {
            id: TaskId::new(7).expect("an id"),
            scope: "/robot".to_owned(),
            handler: "arm".to_owned(),
            component: "hand".to_owned(),
            goal: CheckedGoal {
                text: goal.to_owned(),
                fields: GoalValue::parse(goal).ok(),
            },
            answer: None,
        }
    }

    #[test]
    fn only_a_single_word_in_braces_is_a_placeholder() {
        let call = call("{x: 1, p: ['a b', 2.0]}");
        for (template, filled) in [
            ("plain", "plain"),
            ("", ""),
            ("{id}", "7"),
            ("--to={handler}/{component}@{scope}", "--to=arm/hand@/robot"),
            ("{linear: {x: {goal.x}}}", "{linear: {x: 1}}"),
            ("{goal.p.0}!", "a b!"),
            ("{goal.p}", "['a b', 2.0]"),
            ("{print $1} { {", "{print $1} { {"),
            ("{}", "{}"),
            ("data: '{goal}'", "data: '{x: 1, p: ['a b', 2.0]}'"),
        ] {
            let parsed = Template::parse(template).expect(template);
            assert_eq!(parsed.fill(&call).as_deref(), Ok(filled), "{template}");
        }
        let lacking = Template::parse("{goal.y}").expect("a template");
        assert_eq!(
            lacking.fill(&call),
            Err("the goal has no 'y'; this task needs a goal with that field or item".to_owned())
        );
    }

    #[test]
    fn an_unknown_placeholder_is_a_mistake() {
        let said = |text| Template::parse(text).expect_err(text);
        assert_eq!(
            said("x{gaol}"),
            "unknown placeholder '{gaol}'; did you mean '{goal}'?"
        );
        assert!(
            said("{1}")
                .ends_with("there are: {goal}, {goal.x}, {handler}, {component}, {id}, {scope}")
        );
        for text in ["{id.x}", "{goal.}", "{goal..x}"] {
            said(text);
        }
    }

    #[test]
    fn a_client_chooses_the_beginning_of_open_arguments() {
        let open =
            |text: &str, rule: &GoalRule| Template::parse(text).expect(text).is_open(rule, false);
        let number = GoalRule::Number {
            whole: false,
            least: None,
            most: None,
            step: None,
            unit: None,
        };
        assert!(open("{goal}", &GoalRule::Any));
        assert!(open("{goal.x}", &GoalRule::Any));
        assert!(open("{goal}", &GoalRule::Text { longest: Some(9) }));
        for (text, rule) in [
            ("{goal}", &number),
            ("--x={goal}", &GoalRule::Any),
            ("{id}", &GoalRule::Any),
            ("{handler}", &GoalRule::Any),
        ] {
            assert!(!open(text, rule), "{text}");
        }
        assert!(
            Template::parse("{handler}")
                .expect("it")
                .is_open(&GoalRule::Any, true)
        );
    }
}
