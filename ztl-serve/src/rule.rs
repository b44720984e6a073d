//! What goals a task takes: checked before anything starts.

use std::fmt;

use ztl_core::goal;

use super::value::Value;

/// What a goal must be.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) enum Rule {
    /// Whatever the client says.
    #[default]
    Any,
    /// At most so many characters, if there is a limit.
    Text { longest: Option<usize> },
    /// A finite number within bounds.
    Number {
        whole: bool,
        least: Option<f64>,
        most: Option<f64>,
    },
    /// True or False.
    Truth,
    /// One of these words.
    OneOf(Vec<String>),
    /// All of these fields and no others: a mapping, or a list in their order.
    Fields(Vec<Field>),
}

/// A field of a structured goal.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Field {
    pub(super) name: String,
    pub(super) rule: Rule,
    /// Taken when the client leaves it out.
    pub(super) default: Option<Value>,
}

/// A goal that was checked.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Goal {
    /// As programs are given it. A number is written plainly, whatever way the client wrote it.
    pub(super) text: String,
    /// Its value, where it has fields.
    pub(super) fields: Option<Value>,
}

impl Rule {
    /// Reads and checks a goal; `fields` says whether its fields are wanted, which a rule without
    /// any does not tell.
    pub(super) fn check(&self, text: &str, fields: bool) -> Result<Goal, String> {
        let wrong = || format!("the goal '{}' is not {self}", shown(text));
        let plain = |value: Value| value.to_text().map_err(|_| wrong());
        let goal = match self {
            Self::Any | Self::Text { .. } | Self::OneOf(_) => {
                self.fit(Value::Text(text.to_owned())).ok_or_else(wrong)?;
                text.to_owned()
            }
            Self::Number { .. } | Self::Truth => {
                let value = self.fit(Value::Text(text.to_owned())).ok_or_else(wrong)?;
                plain(value)?
            }
            Self::Fields(_) => {
                let value = Value::of_goal(text);
                let value = value.map_err(|error| format!("{}: {error}", wrong()))?;
                let value = self.fitting(value, text)?;
                return Ok(Goal {
                    text: text.to_owned(),
                    fields: Some(value),
                });
            }
        };
        let value = match fields {
            true => Value::of_goal(text)
                .map_err(|error| format!("the goal '{}' has no fields: {error}", shown(text)))?,
            false => {
                return Ok(Goal {
                    text: goal,
                    fields: None,
                });
            }
        };
        Ok(Goal {
            text: goal,
            fields: Some(value),
        })
    }

    /// The value as programs are given it, if it fits.
    pub(super) fn fit(&self, value: Value) -> Option<Value> {
        match self {
            Self::Any => Some(value),
            Self::Text { longest } => {
                let text = value.to_text().ok()?;
                longest
                    .is_none_or(|longest| text.chars().count() <= longest)
                    .then_some(value)
            }
            Self::OneOf(words) => {
                let text = value.to_text().ok()?;
                words.contains(&text).then_some(value)
            }
            Self::Truth => match value {
                Value::Truth(_) => Some(value),
                Value::Text(text) => goal::from_str(&text).map(Value::Truth).ok(),
                _ => None,
            },
            Self::Number { whole, least, most } => {
                let value = match value {
                    // YAML 1.1 takes `1e3` for a text.
                    Value::Text(text) => number(&text)?,
                    other => other,
                };
                let size = match value {
                    // Bounds are f64 as well; a whole number of that size is no goal of a robot.
                    #[expect(clippy::cast_precision_loss, reason = "compared with bounds alone")]
                    Value::Whole(number) => number as f64,
                    Value::Number(number) if !whole && number.is_finite() => number,
                    _ => return None,
                };
                let low = least.is_some_and(|least| size < least);
                let high = most.is_some_and(|most| size > most);
                (!low && !high).then_some(value)
            }
            Self::Fields(_) => self.fitting(value, "").ok(),
        }
    }

    /// The fields of a structured goal by their names, each of which fits.
    fn fitting(&self, value: Value, text: &str) -> Result<Value, String> {
        let Self::Fields(fields) = self else {
            return Err(String::new());
        };
        let wrong = || format!("the goal '{}' is not {self}", shown(text));
        let mut given: Vec<Option<Value>> = vec![None; fields.len()];
        match value {
            Value::List(items) if items.len() == fields.len() => {
                given = items.into_iter().map(Some).collect();
            }
            Value::Map(pairs) => {
                for (key, value) in pairs {
                    let name = key.to_text().map_err(|_| wrong())?;
                    let place = fields.iter().position(|field| field.name == name);
                    let place = place.ok_or_else(|| {
                        format!("{}: there is no field '{}'", wrong(), shown(&name))
                    })?;
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
                    field.rule.fit(value).ok_or_else(|| {
                        format!("'{}' for {name} is not {}", shown(&text), field.rule)
                    })?
                }
                (None, Some(default)) => default.clone(),
                (None, None) => return Err(format!("{}: {name} is missing", wrong())),
            };
            pairs.push((Value::Text(name.clone()), value));
        }
        Ok(Value::Map(pairs))
    }

    /// Whether what fits cannot be taken for an option of a program unless the one who wrote the rule
    /// wants it: a number, or one of few words.
    pub(super) const fn is_closed(&self) -> bool {
        matches!(self, Self::Number { .. } | Self::Truth | Self::OneOf(_))
    }

    /// The rule for a part of the goal; `None` when there is certainly no such part.
    pub(super) fn part(&self, path: &[String]) -> Option<&Self> {
        static ANY: Rule = Rule::Any;
        let Some((first, rest)) = path.split_first() else {
            return Some(self);
        };
        match self {
            Self::Any => Some(&ANY),
            Self::Fields(fields) => {
                let field = fields.iter().find(|field| field.name == *first)?;
                field.rule.part(rest)
            }
            _ => None,
        }
    }
}

/// A number as Python and YAML write it; whole where it is.
fn number(text: &str) -> Option<Value> {
    let whole = goal::from_str::<i64>(text).map(|number| Value::Whole(number.into()));
    whole
        .or_else(|_| goal::from_str::<f64>(text).map(Value::Number))
        .ok()
}

/// What is shown of a client's text.
pub(super) fn shown(text: &str) -> String {
    const MOST: usize = 60;
    let clean = |c: char| if c.is_control() { '\u{fffd}' } else { c };
    let mut shown: String = text.chars().take(MOST).map(clean).collect();
    if text.chars().nth(MOST).is_some() {
        shown.push('…');
    }
    shown
}

impl fmt::Display for Rule {
    /// What is wanted, as `a number from 0 to 100`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => f.write_str("anything"),
            Self::Text { longest: None } => f.write_str("a text"),
            Self::Text {
                longest: Some(longest),
            } => write!(f, "a text of at most {longest} characters"),
            Self::Number { whole, least, most } => {
                f.write_str(if *whole { "a whole number" } else { "a number" })?;
                match (least, most) {
                    (Some(least), Some(most)) => write!(f, " from {least} to {most}"),
                    (Some(least), None) => write!(f, " of at least {least}"),
                    (None, Some(most)) => write!(f, " of at most {most}"),
                    (None, None) => Ok(()),
                }
            }
            Self::Truth => f.write_str("True or False"),
            Self::OneOf(words) => match words.split_last() {
                Some((last, [])) => f.write_str(last),
                Some((last, others)) => write!(f, "{} or {last}", others.join(", ")),
                None => Ok(()),
            },
            Self::Fields(fields) => {
                f.write_str("{")?;
                for (place, field) in fields.iter().enumerate() {
                    let separator = if place == 0 { "" } else { ", " };
                    write!(f, "{separator}{}: {}", field.name, field.rule)?;
                }
                f.write_str("}")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number_rule(whole: bool, least: f64, most: f64) -> Rule {
        Rule::Number {
            whole,
            least: Some(least),
            most: Some(most),
        }
    }

    fn text(rule: &Rule, goal: &str) -> Result<String, String> {
        rule.check(goal, false).map(|goal| goal.text)
    }

    #[test]
    fn a_number_is_handed_over_plainly_however_it_was_written() {
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
    fn words_texts_and_truths() {
        let sides = Rule::OneOf(["left", "right", "straight on"].map(str::to_owned).to_vec());
        assert_eq!(text(&sides, "straight on").as_deref(), Ok("straight on"));
        let said = "the goal 'up' is not left, right or straight on";
        assert_eq!(text(&sides, "up").expect_err("up"), said);
        let any = Rule::Text { longest: None };
        assert_eq!(any.to_string(), "a text");
        assert!(text(&any, &"long".repeat(1000)).is_ok());
        let short = Rule::Text { longest: Some(3) };
        assert_eq!(short.to_string(), "a text of at most 3 characters");
        assert_eq!(text(&short, "üöä").as_deref(), Ok("üöä"));
        assert!(text(&short, "four").is_err());
        assert_eq!(text(&Rule::Truth, "yes").as_deref(), Ok("True"));
        assert!(text(&Rule::Truth, "2").is_err());
        assert_eq!(
            text(&Rule::Any, "[not: a { goal").as_deref(),
            Ok("[not: a { goal")
        );
    }

    #[test]
    fn fields_are_taken_by_name_or_in_their_order_and_none_may_be_wrong() {
        let field = |name: &str, rule: Rule, default| Field {
            name: name.to_owned(),
            rule,
            default,
        };
        let rule = Rule::Fields(vec![
            field("x", number_rule(false, -1.0, 1.0), None),
            field(
                "turn",
                Rule::OneOf(vec!["left".to_owned()]),
                Some(Value::Text("left".to_owned())),
            ),
        ]);
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
    fn what_a_client_wrote_is_shown_without_what_a_terminal_obeys_and_not_endlessly() {
        assert_eq!(shown("a\x1b[2J\n"), "a\u{fffd}[2J\u{fffd}");
        assert_eq!(shown(&"x".repeat(61)).chars().count(), 61);
    }
}
