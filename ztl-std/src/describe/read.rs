//! Reads descriptions: leniently from the answers of servers and from files, strictly from authors.

use std::sync::Arc;

use serde_json::{Map, Value};

use super::{CheckGoal, ComponentDescription, GoalField, GoalRule, GoalValue, described};

/// Most levels of a goal.
pub const MAX_DEPTH: usize = 8;
/// Longest description of a component, in bytes of JSON.
pub const MAX_LENGTH: usize = 64 << 10;

/// Reads the description of a component. Skips unknown keys and values of another type; a goal of an
/// unknown kind, or of more than [`MAX_DEPTH`] levels, may be anything. `None` for what is not a mapping, or
/// is longer than [`MAX_LENGTH`].
#[must_use]
pub fn component(value: &Value) -> Option<ComponentDescription> {
    let keys = value.as_object()?;
    if serde_json::to_string(value).ok()?.len() > MAX_LENGTH {
        return None;
    }
    let mut read = described(keys.get("goal").map_or(GoalRule::Any, |it| goal(it, 0)));
    read.about = text(keys, "about");
    read.result = text(keys, "result");
    read.examples = texts(keys.get("examples"));
    read.streams = texts(keys.get("streams"));
    read.can_abort = keys.get("abort").and_then(Value::as_bool).unwrap_or(true);
    let usually = keys.get("usually_ms").and_then(Value::as_u64);
    read.usually_ms = usually.and_then(|ms| u32::try_from(ms).ok());
    Some(read)
}

/// Reads the description of a component as its author writes it: in JSON, or as a goal in YAML's flow style. Unlike
/// [`component`], it accepts nothing that it does not understand.
///
/// ```
/// use ztl_std::describe::parse;
///
/// let turns = parse("{goal: {least: -90, most: 90, type: number, unit: deg}, about: turns the head}").unwrap();
/// assert_eq!(turns.goal.to_string(), "a number from -90 to 90 deg");
/// assert!(parse("{goal: {type: numbr}}").unwrap_err().starts_with("goal.type: "));
/// ```
///
/// # Errors
/// What is wrong, and where.
pub fn parse(text: &str) -> Result<ComponentDescription, String> {
    let value: Value = match serde_json::from_str(text) {
        Ok(value) => value,
        Err(_) => {
            let value = GoalValue::parse(text).map_err(|error| error.to_string())?;
            serde_json::to_value(&value).map_err(|error| error.to_string())?
        }
    };
    let read = component(&value).ok_or_else(|| {
        format!("a description is a mapping such as {{goal: {{type: number}}}}, of at most {MAX_LENGTH} bytes")
    })?;
    let written = serde_json::from_str(&read.json().to_string()).unwrap_or_default();
    if let Some(path) = lost(&value, &written) {
        let path = path.join(".");
        return Err(format!(
            "{path}: not understood; docs/protocol.md [11.7] has the keys and their values, and a text that looks \
             like a number or a word of YAML needs quotes"
        ));
    }
    for example in read.examples.iter() {
        let fits = read.goal.check(example, false);
        fits.map_err(|why| format!("examples: {why}"))?;
    }
    Ok(read)
}

/// Where a value has something that was not read.
fn lost(given: &Value, read: &Value) -> Option<Vec<String>> {
    let within = |key: String, given: &Value, read: Option<&Value>| {
        let mut path = match read {
            Some(read) => lost(given, read)?,
            // What a description leaves out.
            None if key == "optional" && given == &Value::Bool(false) => return None,
            None if key == "abort" && given == &Value::Bool(true) => return None,
            None => Vec::new(),
        };
        path.insert(0, key);
        Some(path)
    };
    match (given, read) {
        (Value::Object(given), Value::Object(read)) => given
            .iter()
            .find_map(|(key, value)| within(key.clone(), value, read.get(key))),
        (Value::Array(given), Value::Array(read)) => given
            .iter()
            .enumerate()
            .find_map(|(place, value)| within(place.to_string(), value, read.get(place))),
        (Value::Number(given), Value::Number(read)) if given.as_f64() == read.as_f64() => None,
        (given, read) => (given != read).then(Vec::new),
    }
}

fn text(keys: &Map<String, Value>, key: &str) -> Option<Arc<str>> {
    keys.get(key)?.as_str().map(Arc::from)
}

fn texts(value: Option<&Value>) -> Arc<[Arc<str>]> {
    let all = value.and_then(Value::as_array).into_iter().flatten();
    all.filter_map(|text| text.as_str().map(Arc::from))
        .collect()
}

fn goal(value: &Value, depth: usize) -> GoalRule {
    let Some(keys) = value.as_object().filter(|_| depth < MAX_DEPTH) else {
        return GoalRule::Any;
    };
    if let Some(words) = keys.get("one-of") {
        let words = texts(Some(words));
        // Without a word, no goal would fit.
        return if words.is_empty() {
            GoalRule::Any
        } else {
            GoalRule::OneOf(words)
        };
    }
    if let Some(item) = keys.get("list-of") {
        return GoalRule::ListOf(Arc::new(goal(item, depth + 1)));
    }
    if let Some(fields) = keys.get("fields").and_then(Value::as_array) {
        let field = |value: &Value| {
            let keys = value.as_object()?;
            Some(GoalField {
                name: text(keys, "name")?,
                rule: goal(value, depth + 1),
                optional: keys.get("optional").and_then(Value::as_bool) == Some(true),
                default: text(keys, "default"),
            })
        };
        let read: Option<Arc<[GoalField]>> = fields.iter().map(field).collect();
        return read.map_or(GoalRule::Any, GoalRule::Fields);
    }
    let number = |key| keys.get(key).and_then(Value::as_f64);
    match keys.get("type").and_then(Value::as_str) {
        Some("nothing") => GoalRule::Nothing,
        Some("truth") => GoalRule::Bool,
        Some("text") => GoalRule::Text {
            longest: keys
                .get("longest")
                .and_then(Value::as_u64)
                .and_then(|longest| usize::try_from(longest).ok()),
        },
        Some(kind @ ("number" | "whole")) => GoalRule::Number {
            whole: kind == "whole",
            least: number("least"),
            most: number("most"),
            step: number("step"),
            unit: text(keys, "unit"),
        },
        _ => GoalRule::Any,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(json: &str) -> Option<ComponentDescription> {
        component(&serde_json::from_str(json).expect("JSON"))
    }

    #[test]
    fn what_is_written_is_read_again() {
        for json in [
            r#"{"goal": {"type": "any"}}"#,
            r#"{"goal": {"type": "nothing"}, "abort": false}"#,
            r#"{"goal": {"type": "text", "longest": 3}, "about": "says \"it\"", "examples": ["a", "ü\u0007"]}"#,
            r#"{"goal": {"type": "whole", "least": -1, "most": 2.5, "step": 1, "unit": "mm"}, "usually_ms": 1500}"#,
            r#"{"goal": {"one-of": ["left", "right"]}, "streams": ["/pose"], "result": "where it is"}"#,
            r#"{"goal": {"list-of": {"fields": [{"name": "z", "type": "truth", "optional": true, "default": "yes"}, {"name": "b", "type": "number"}]}}}"#,
        ] {
            let read = read(json).expect("a description");
            assert_eq!(read.json().to_string(), json);
        }
    }

    #[test]
    fn authors_learn_what_is_wrong_and_where() {
        for (text, place) in [
            ("{goal: {type: number, leest: 3}}", "goal.leest: "),
            ("{goal: {type: number, least: three}}", "goal.least: "),
            ("{goal: {one-of: [left, 7]}}", "goal.one-of.1: "),
            (
                "{goal: {list-of: {fields: [{name: x, type: numbr}]}}}",
                "goal.list-of.fields.0.type: ",
            ),
            ("{goal: number}", "goal: "),
            ("{about: 7}", "about: "),
            (
                "{goal: {one-of: [left, right]}, examples: [up]}",
                "examples: the goal 'up' is not left or right",
            ),
            ("{goal: [}", "expected"),
            ("[]", "a description is a mapping"),
        ] {
            let wrong = parse(text).expect_err(text);
            assert!(wrong.contains(place), "{text}: {wrong}");
        }
        for text in [
            "{goal: {one-of: [left, right]}, examples: [left], abort: true, streams: [/pose]}",
            "{goal: {fields: [{name: x, type: whole, least: 1.0, optional: false}]}, usually_ms: 20}",
            r#"{"goal": {"list-of": {"list-of": {"list-of": {"list-of": {"list-of": {"type": "truth"}}}}}}}"#,
            "{}",
        ] {
            parse(text).expect(text);
        }
    }

    #[test]
    fn what_is_unknown_or_too_deep_or_of_another_type_may_be_anything() {
        for json in [
            r#"{"goal": {"type": "colour", "hue": 7}, "later": {"a": [1]}}"#,
            r#"{"goal": [], "about": 7, "examples": "x", "abort": "no", "usually_ms": -1}"#,
            r#"{"goal": {"one-of": [1, {}]}}"#,
            "{}",
        ] {
            let read = read(json).expect("a description");
            assert_eq!(read.json().to_string(), r#"{"goal": {"type": "any"}}"#);
        }
        let deep = "{\"list-of\": ".repeat(50) + "{}" + &"}".repeat(50);
        let read_deep = read(&format!("{{\"goal\": {deep}}}")).expect("a description");
        let levels = read_deep.json().to_string().matches("list-of").count();
        assert_eq!(levels, MAX_DEPTH);
        let long = format!("{{\"about\": \"{}\"}}", "x".repeat(MAX_LENGTH));
        assert!(read(&long).is_none());
        assert!(read("[]").is_none());
    }
}
