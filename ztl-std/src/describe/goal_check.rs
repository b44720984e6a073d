//! Checks goals against their rule, before anything starts.

use ztl_core::goal;

use super::{GoalRule, GoalValue};

/// A goal that was checked.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CheckedGoal {
    /// The text that programs get. Numbers are in plain form: `0x1F` becomes `31`.
    pub text: String,
    /// The parsed goal, if its fields are needed.
    pub fields: Option<GoalValue>,
}

/// A rule that goals are checked against.
pub trait CheckGoal {
    /// Parses and checks a goal. `needs_fields` has it parsed even if the rule does not.
    ///
    /// # Errors
    /// What is wrong, and what the goal should be.
    fn check(&self, text: &str, needs_fields: bool) -> Result<CheckedGoal, String>;

    /// The value that programs get, if it fits the rule.
    fn fit(&self, value: GoalValue) -> Option<GoalValue>;
}

impl CheckGoal for GoalRule {
    fn check(&self, text: &str, needs_fields: bool) -> Result<CheckedGoal, String> {
        let wrong = || format!("the goal '{}' is not {self}", shown(text));
        let plain = |value: GoalValue| value.to_text().map_err(|_| wrong());
        let goal = match self {
            Self::Any | Self::Nothing | Self::Text { .. } | Self::OneOf(_) => {
                self.fit(GoalValue::Text(text.to_owned()))
                    .ok_or_else(wrong)?;
                text.to_owned()
            }
            Self::Number { .. } | Self::Bool => {
                let value = self
                    .fit(GoalValue::Text(text.to_owned()))
                    .ok_or_else(wrong)?;
                plain(value)?
            }
            Self::Fields(_) | Self::ListOf(_) => {
                let value = GoalValue::parse(text);
                let value = value.map_err(|error| format!("{}: {error}", wrong()))?;
                let value = match self {
                    Self::Fields(_) => fitting(self, value, text)?,
                    _ => self.fit(value).ok_or_else(wrong)?,
                };
                return Ok(CheckedGoal {
                    text: text.to_owned(),
                    fields: Some(value),
                });
            }
        };
        let no_fields = |error| {
            let text = shown(text);
            format!("the goal '{text}' has no fields, as {{x: 1}} has: {error}")
        };
        let fields = needs_fields.then(|| GoalValue::parse(text).map_err(no_fields));
        Ok(CheckedGoal {
            text: goal,
            fields: fields.transpose()?,
        })
    }

    fn fit(&self, value: GoalValue) -> Option<GoalValue> {
        match self {
            Self::Any => Some(value),
            Self::Nothing => match &value {
                GoalValue::Null => Some(value),
                GoalValue::Text(text) if matches!(text.as_str(), "" | "None" | "null" | "~") => {
                    Some(value)
                }
                _ => None,
            },
            Self::ListOf(item) => match value {
                GoalValue::List(items) => {
                    let items = items.into_iter().map(|value| item.fit(value));
                    items.collect::<Option<_>>().map(GoalValue::List)
                }
                _ => None,
            },
            Self::Text { longest } => {
                let text = value.to_text().ok()?;
                longest
                    .is_none_or(|longest| text.chars().count() <= longest)
                    .then_some(value)
            }
            Self::OneOf(words) => {
                let text = value.to_text().ok()?;
                words.iter().any(|word| **word == *text).then_some(value)
            }
            Self::Bool => match value {
                GoalValue::Bool(_) => Some(value),
                GoalValue::Text(text) => goal::from_str(&text).map(GoalValue::Bool).ok(),
                _ => None,
            },
            Self::Number {
                whole, least, most, ..
            } => {
                let value = match value {
                    // In YAML 1.1, `1e3` is a text.
                    GoalValue::Text(text) => number(&text)?,
                    other => other,
                };
                let size = match value {
                    // Goals of robots are smaller than the integers that f64 cannot represent.
                    #[expect(clippy::cast_precision_loss, reason = "compared with bounds alone")]
                    GoalValue::Integer(number) => number as f64,
                    GoalValue::Float(number) if !whole && number.is_finite() => number,
                    _ => return None,
                };
                let low = least.is_some_and(|least| size < least);
                let high = most.is_some_and(|most| size > most);
                (!low && !high).then_some(value)
            }
            Self::Fields(_) => fitting(self, value, "").ok(),
        }
    }
}

/// The fields of a structured goal by name, if each fits its rule.
fn fitting(rule: &GoalRule, value: GoalValue, text: &str) -> Result<GoalValue, String> {
    let GoalRule::Fields(fields) = rule else {
        return Err(String::new());
    };
    let wrong = || format!("the goal '{}' is not {rule}", shown(text));
    let mut given: Vec<Option<GoalValue>> = vec![None; fields.len()];
    match value {
        GoalValue::List(items) if items.len() == fields.len() => {
            given = items.into_iter().map(Some).collect();
        }
        GoalValue::Map(pairs) => {
            for (key, value) in pairs {
                let name = key.to_text().map_err(|_| wrong())?;
                let place = fields.iter().position(|field| *field.name == *name);
                let place = place
                    .ok_or_else(|| format!("{}: there is no field '{}'", wrong(), shown(&name)))?;
                if let Some(slot) = given.get_mut(place) {
                    *slot = Some(value);
                }
            }
        }
        _ => return Err(wrong()),
    }
    let mut pairs = Vec::new();
    for (field, value) in fields.iter().zip(given) {
        let name = &field.name;
        let value = match (value, &field.default) {
            (Some(value), _) => {
                let text = value.to_text().unwrap_or_default();
                field
                    .rule
                    .fit(value)
                    .ok_or_else(|| format!("'{}' for {name} is not {}", shown(&text), field.rule))?
            }
            (None, Some(default)) => {
                let default = GoalValue::Text(default.to_string());
                let wrong = || format!("the default for {name} is not {}", field.rule);
                field.rule.fit(default).ok_or_else(wrong)?
            }
            (None, None) if field.optional => continue,
            (None, None) => return Err(format!("{}: {name} is missing", wrong())),
        };
        pairs.push((GoalValue::Text(name.to_string()), value));
    }
    Ok(GoalValue::Map(pairs))
}

/// A number as Python and YAML write it; an integer if it is one.
fn number(text: &str) -> Option<GoalValue> {
    let whole = goal::from_str::<i64>(text).map(|number| GoalValue::Integer(number.into()));
    whole
        .or_else(|_| goal::from_str::<f64>(text).map(GoalValue::Float))
        .ok()
}

/// A client's text for a message: without control characters, and not too long.
#[must_use]
pub fn shown(text: &str) -> String {
    const MOST: usize = 60;
    let clean = |c: char| if c.is_control() { '\u{fffd}' } else { c };
    let mut shown: String = text.chars().take(MOST).map(clean).collect();
    if text.chars().nth(MOST).is_some() {
        shown.push('…');
    }
    shown
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::describe::GoalField;

    fn number_rule(whole: bool, least: f64, most: f64) -> GoalRule {
        GoalRule::Number {
            whole,
            least: Some(least),
            most: Some(most),
            step: None,
            unit: None,
        }
    }

    fn text(rule: &GoalRule, goal: &str) -> Result<String, String> {
        rule.check(goal, false).map(|goal| goal.text)
    }

    #[test]
    fn programs_get_numbers_in_plain_form() {
        let rule = number_rule(false, -100.0, 1000.0);
        for (goal, plain) in [
            ("45", "45"),
            ("-45", "-45"),
            ("0x1F", "31"),
            ("1_000", "1000"),
            ("1e2", "100.0"),
            (".5", "0.5"),
        ] {
            assert_eq!(text(&rule, goal).as_deref(), Ok(plain), "{goal}");
        }
        for goal in [
            "", "abc", "inf", "nan", "1001", "-100.5", "[1]", "1 2", "True", "010",
        ] {
            let said = text(&rule, goal).expect_err(goal);
            assert_eq!(
                said,
                format!("the goal '{goal}' is not a number from -100 to 1000")
            );
        }
        assert!(text(&number_rule(true, 0.0, 9.0), "1.0").is_err());
        assert_eq!(text(&number_rule(true, 0.0, 9.0), "9").as_deref(), Ok("9"));
    }

    #[test]
    fn rules_for_words_texts_and_booleans() {
        let sides = GoalRule::OneOf(["left", "right", "straight on"].map(Arc::from).into());
        assert_eq!(text(&sides, "straight on").as_deref(), Ok("straight on"));
        let said = "the goal 'up' is not left, right or straight on";
        assert_eq!(text(&sides, "up").expect_err("up"), said);
        let any = GoalRule::Text { longest: None };
        assert_eq!(any.to_string(), "a text");
        let unlimited = GoalRule::Text {
            longest: Some(usize::MAX),
        };
        assert_eq!(unlimited.to_string(), "a text");
        assert!(text(&any, &"long".repeat(1000)).is_ok());
        let short = GoalRule::Text { longest: Some(3) };
        assert_eq!(short.to_string(), "a text of at most 3 characters");
        assert_eq!(text(&short, "üöä").as_deref(), Ok("üöä"));
        assert!(text(&short, "four").is_err());
        assert_eq!(text(&GoalRule::Bool, "yes").as_deref(), Ok("True"));
        assert!(text(&GoalRule::Bool, "2").is_err());
        assert_eq!(
            text(&GoalRule::Any, "[not: a { goal").as_deref(),
            Ok("[not: a { goal")
        );
    }

    #[test]
    fn fields_are_given_by_name_or_in_order() {
        let field = |name: &str, rule: GoalRule, default: Option<&str>| GoalField {
            name: name.into(),
            rule,
            optional: default.is_some(),
            default: default.map(Arc::from),
        };
        let rule = GoalRule::Fields(
            [
                field("x", number_rule(false, -1.0, 1.0), None),
                field(
                    "turn",
                    GoalRule::OneOf(["left".into()].into()),
                    Some("left"),
                ),
            ]
            .into(),
        );
        let of = |goal: &str| {
            let fields = rule.check(goal, false)?.fields.expect("fields");
            fields.to_text().map_err(|error| error.to_string())
        };
        for goal in ["{x: -0.5}", "[-.5, left]", "{'turn': 'left', 'x': '-5e-1'}"] {
            assert_eq!(
                of(goal).as_deref(),
                Ok("{'x': -0.5, 'turn': 'left'}"),
                "{goal}"
            );
        }
        for (goal, part) in [
            ("{x: 2}", "'2' for x is not a number from -1 to 1"),
            ("{turn: left}", "x is missing"),
            ("{x: 0, y: 0}", "there is no field 'y'"),
            ("[0]", "is not {x: a number from -1 to 1, turn: left}"),
            ("{x: ", "the goal '{x: ' is not {x:"),
            ("5", "is not {x:"),
        ] {
            let said = of(goal).expect_err(goal);
            assert!(said.contains(part), "{goal}: {said}");
        }
    }

    #[test]
    fn shown_text_has_no_control_characters_and_is_cut() {
        assert_eq!(shown("a\x1b[2J\n"), "a\u{fffd}[2J\u{fffd}");
        assert_eq!(shown(&"x".repeat(61)).chars().count(), 61);
    }
}
