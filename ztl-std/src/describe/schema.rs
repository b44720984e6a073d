//! Descriptions from types, by their JSON Schema.

use std::fmt;
use std::sync::Arc;

use schemars::{JsonSchema, SchemaGenerator};
use serde_json::{Map, Value};

use super::read::MAX_DEPTH;
use super::{ComponentDescription, GoalField, GoalRule, GoalValue, described};

/// What a schema may say beside its rules.
const ANNOTATIONS: [&str; 11] = [
    "$comment",
    "$defs",
    "$schema",
    "default",
    "deprecated",
    "description",
    "examples",
    "format",
    "readOnly",
    "title",
    "writeOnly",
];

/// Why a schema does not fit into a description.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SchemaError {
    at: String,
    why: String,
}

impl fmt::Display for SchemaError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.at, self.why)
    }
}

impl std::error::Error for SchemaError {}

/// The description of a component whose goals are values of a type: the first line of its doc comment, and its examples.
/// `x-unit` and `x-step` give a number its unit and step. The fields of a struct are in the order of the type if all are
/// required, or if the program turns on the feature `preserve_order` of `serde_json`; otherwise by name. The order matters for
/// goals that list the fields without their names.
///
/// ```
/// use schemars::JsonSchema;
/// use serde::Deserialize;
/// use ztl_std::describe::of_type;
///
/// /// Turns the head
/// #[derive(Deserialize, JsonSchema)]
/// # #[expect(dead_code, reason = "only described")]
/// struct Turn {
///     #[schemars(range(min = -90, max = 90), extend("x-unit" = "deg"))]
///     pan: f64,
///     #[serde(default)]
///     speed: Speed,
/// }
///
/// #[derive(Default, Deserialize, JsonSchema, serde::Serialize)]
/// #[serde(rename_all = "lowercase")]
/// enum Speed {
///     #[default]
///     Slow,
///     Fast,
/// }
///
/// let turn = of_type::<Turn>()?;
/// assert_eq!(turn.about.as_deref(), Some("Turns the head"));
/// assert_eq!(turn.goal.to_string(), "{pan: a number from -90 to 90 deg, speed: slow or fast}");
///
/// /// Goes there
/// #[derive(JsonSchema)]
/// # #[expect(dead_code, reason = "only described")]
/// struct Go {
///     place: [f64; 2],
/// }
/// let wrong = of_type::<Go>().unwrap_err();
/// assert_eq!(
///     wrong.to_string(),
///     "goal.place: 'maxItems' cannot be described; describe the component by hand, or change the type"
/// );
/// # Ok::<(), ztl_std::describe::SchemaError>(())
/// ```
///
/// # Errors
/// Where the type has a rule that descriptions do not have.
pub fn of_type<T: JsonSchema>() -> Result<ComponentDescription, SchemaError> {
    of_schema(
        SchemaGenerator::default()
            .into_root_schema_for::<T>()
            .as_value(),
    )
}

/// The same from a JSON Schema.
///
/// # Errors
/// As [`of_type`].
pub fn of_schema(schema: &Value) -> Result<ComponentDescription, SchemaError> {
    let goal = Reader { root: schema }.rule(schema, "goal", 0)?;
    let about = schema.get("description").and_then(Value::as_str);
    let about = about.and_then(|about| about.lines().next());
    let examples = schema.get("examples").and_then(Value::as_array);
    let examples = examples.into_iter().flatten();
    Ok(ComponentDescription {
        about: about.map(Arc::from),
        examples: examples.filter_map(text_of).collect(),
        ..described(goal)
    })
}

/// A value as a goal.
fn text_of(value: &Value) -> Option<Arc<str>> {
    let value: GoalValue = serde_json::from_value(value.clone()).ok()?;
    Some(value.to_text().ok()?.into())
}

struct Reader<'s> {
    /// The schema that `$ref` refers to.
    root: &'s Value,
}

impl Reader<'_> {
    fn rule(&self, schema: &Value, at: &str, depth: usize) -> Result<GoalRule, SchemaError> {
        let wrong = |why: String| SchemaError {
            at: at.to_owned(),
            why: format!("{why}; describe the component by hand, or change the type"),
        };
        if depth == MAX_DEPTH {
            return Err(wrong(format!("a goal has at most {MAX_DEPTH} levels")));
        }
        let keys = match schema {
            Value::Bool(true) => return Ok(GoalRule::Any),
            Value::Object(keys) => keys,
            _ => return Err(wrong("no goal fits".to_owned())),
        };
        let allow = |allowed: &[&str]| {
            let other = keys.keys().find(|key| {
                let key = key.as_str();
                !allowed.contains(&key) && !ANNOTATIONS.contains(&key) && !key.starts_with("x-")
            });
            let other = other.map(|key| wrong(format!("'{key}' cannot be described")));
            other.map_or(Ok(()), Err)
        };
        if let Some(name) = keys.get("$ref").and_then(Value::as_str) {
            allow(&["$ref"])?;
            let named = name
                .strip_prefix('#')
                .and_then(|path| self.root.pointer(path));
            let named = named.ok_or_else(|| wrong(format!("there is no '{name}'")))?;
            // A level, so that a type within itself has an end.
            return self.rule(named, at, depth + 1);
        }
        let number = |key: &str| keys.get(key).and_then(Value::as_f64);
        if let Some(words) = keys.get("enum").and_then(Value::as_array) {
            allow(&["enum", "type"])?;
            return words_of(words).ok_or_else(|| wrong("an 'enum' is of texts".to_owned()));
        }
        if let Some(word) = keys.get("const") {
            allow(&["const", "type"])?;
            let word = words_of(std::slice::from_ref(word));
            return word.ok_or_else(|| wrong("a 'const' is a text".to_owned()));
        }
        for key in ["oneOf", "anyOf"] {
            let Some(variants) = keys.get(key).and_then(Value::as_array) else {
                continue;
            };
            allow(&[key])?;
            let mut all = Vec::new();
            for variant in variants {
                match self.rule(variant, at, depth)? {
                    GoalRule::OneOf(words) => all.extend(words.iter().cloned()),
                    _ => {
                        let why =
                            "one of several types cannot be described, only one of several words";
                        return Err(wrong(why.to_owned()));
                    }
                }
            }
            return Ok(GoalRule::OneOf(all.into()));
        }
        let Some(kind) = keys.get("type") else {
            allow(&[])?;
            return Ok(GoalRule::Any);
        };
        match kind.as_str() {
            Some("string") => {
                allow(&["type", "maxLength"])?;
                let longest = keys.get("maxLength").and_then(Value::as_u64);
                Ok(GoalRule::Text {
                    longest: longest.and_then(|longest| usize::try_from(longest).ok()),
                })
            }
            Some(kind @ ("number" | "integer")) => {
                allow(&["type", "minimum", "maximum"])?;
                let unit = keys.get("x-unit").and_then(Value::as_str);
                Ok(GoalRule::Number {
                    whole: kind == "integer",
                    least: number("minimum"),
                    most: number("maximum"),
                    step: number("x-step"),
                    unit: unit.map(Arc::from),
                })
            }
            Some("boolean") => {
                allow(&["type"])?;
                Ok(GoalRule::Bool)
            }
            Some("null") => {
                allow(&["type"])?;
                Ok(GoalRule::Nothing)
            }
            Some("array") => {
                allow(&["type", "items"])?;
                let item = keys.get("items").unwrap_or(&Value::Bool(true));
                let item = self.rule(item, &format!("{at}.items"), depth + 1)?;
                Ok(GoalRule::ListOf(Arc::new(item)))
            }
            Some("object") => {
                let closed = keys.get("additionalProperties") == Some(&Value::Bool(false));
                let more = if closed {
                    "additionalProperties"
                } else {
                    "type"
                };
                allow(&["type", "properties", "required", more])?;
                self.fields(keys, at, depth)
            }
            _ => Err(wrong(format!("the type {kind} cannot be described"))),
        }
    }

    fn fields(
        &self,
        keys: &Map<String, Value>,
        at: &str,
        depth: usize,
    ) -> Result<GoalRule, SchemaError> {
        let required = keys.get("required").and_then(Value::as_array);
        let is_required = |name: &str| {
            required.is_some_and(|required| required.iter().any(|it| it.as_str() == Some(name)))
        };
        let mut fields = Vec::new();
        let properties = keys.get("properties").and_then(Value::as_object);
        for (name, schema) in properties.into_iter().flatten() {
            let some = without_null(schema);
            let at = format!("{at}.{name}");
            let rule = self.rule(some.as_ref().unwrap_or(schema), &at, depth + 1)?;
            let default = schema.get("default").filter(|value| !value.is_null());
            fields.push(GoalField {
                name: Arc::from(name.as_str()),
                rule,
                optional: some.is_some() || !is_required(name),
                default: default.and_then(text_of),
            });
        }
        if let Some(required) = required.filter(|required| required.len() == fields.len()) {
            let place = |name: &str| required.iter().position(|it| it.as_str() == Some(name));
            fields.sort_by_key(|field| place(&field.name));
        }
        Ok(GoalRule::Fields(fields.into()))
    }
}

/// The rule for one of several values that JSON Schema lists: all texts, or nothing.
fn words_of(values: &[Value]) -> Option<GoalRule> {
    let is_nothing = |value: &Value| value.is_null() || value.as_str() == Some("");
    if !values.is_empty() && values.iter().all(is_nothing) {
        return Some(GoalRule::Nothing);
    }
    let words = values.iter().map(|value| value.as_str().map(Arc::from));
    words.collect::<Option<_>>().map(GoalRule::OneOf)
}

/// The schema of an `Option` without its `null`; `None` for other types.
fn without_null(schema: &Value) -> Option<Value> {
    let is_null = |value: &Value| {
        value.as_str() == Some("null") || value.get("type").and_then(Value::as_str) == Some("null")
    };
    let (key, all) = ["type", "anyOf"]
        .into_iter()
        .find_map(|key| Some((key, schema.get(key)?.as_array()?)))?;
    let mut others = all.iter().filter(|value| !is_null(value));
    let (Some(other), None, 2) = (others.next(), others.next(), all.len()) else {
        return None;
    };
    if key == "anyOf" {
        return Some(other.clone());
    }
    let mut some = schema.clone();
    some.as_object_mut()?.insert(key.to_owned(), other.clone());
    Some(some)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::describe::CheckGoal;

    fn goal(json: &str) -> Result<String, String> {
        let schema: Value = serde_json::from_str(json).expect("JSON");
        let read = of_schema(&schema).map_err(|wrong| wrong.to_string())?;
        Ok(read.json().to_string())
    }

    #[derive(JsonSchema)]
    #[schemars(deny_unknown_fields)]
    #[expect(dead_code, reason = "only described")]
    struct Pose {
        z: Place,
        names: Option<Vec<String>>,
        side: Option<Side>,
    }

    #[derive(JsonSchema)]
    #[expect(dead_code, reason = "only described")]
    struct Place {
        z: f64,
        a: u8,
    }

    #[derive(JsonSchema)]
    #[expect(dead_code, reason = "only described")]
    enum Side {
        /// Of the robot.
        Left,
        Right,
    }

    #[test]
    fn a_type_is_described_with_its_fields() {
        let pose = of_type::<Pose>().expect("a description");
        let expected = r#"{"goal": {"fields": [{"name": "names", "list-of": {"type": "text"}, "optional": true}, {"name": "side", "one-of": ["Right", "Left"], "optional": true}, {"name": "z", "fields": [{"name": "z", "type": "number"}, {"name": "a", "type": "whole", "least": 0, "most": 255}]}]}}"#;
        assert_eq!(pose.json().to_string(), expected);
        assert!(pose.goal.check("{z: [1, 2]}", false).is_ok());
        assert!(pose.goal.check("{z: {z: 1, a: 256}}", false).is_err());
    }

    #[test]
    fn what_descriptions_do_not_have_is_an_error_with_its_place() {
        for (schema, wrong) in [
            (r#"{"type": "string", "pattern": "^a"}"#, "goal: 'pattern' "),
            (
                r#"{"type": "number", "exclusiveMinimum": 0}"#,
                "goal: 'exclusiveMinimum' ",
            ),
            (
                r#"{"type": "object", "properties": {"x": {"type": "object", "additionalProperties": {"type": "number"}}}}"#,
                "goal.x: 'additionalProperties' ",
            ),
            (
                r#"{"anyOf": [{"type": "number"}, {"type": "string"}]}"#,
                "goal: one of several types ",
            ),
            (r#"{"type": ["number", "null"]}"#, "goal: the type "),
            (
                r##"{"$ref": "#/$defs/a", "$defs": {"a": {"type": "array", "items": {"$ref": "#/$defs/a"}}}}"##,
                "a goal has at most 8 levels",
            ),
            (
                r##"{"$ref": "#/$defs/b"}"##,
                "goal: there is no '#/$defs/b'",
            ),
            (r#"{"enum": [1, 2]}"#, "goal: an 'enum' is of texts"),
            ("false", "goal: no goal fits"),
        ] {
            let said = goal(schema).expect_err(schema);
            assert!(said.contains(wrong), "{schema}: {said}");
        }
        for (schema, is) in [
            ("true", r#"{"goal": {"type": "any"}}"#),
            (
                r#"{"enum": [null, ""], "description": "stops\nnow", "examples": [null]}"#,
                r#"{"goal": {"type": "nothing"}, "about": "stops", "examples": ["None"]}"#,
            ),
            (
                r#"{"oneOf": [{"const": "a"}, {"type": "string", "enum": ["b"]}]}"#,
                r#"{"goal": {"one-of": ["a", "b"]}}"#,
            ),
        ] {
            assert_eq!(goal(schema).as_deref(), Ok(is), "{schema}");
        }
    }
}
