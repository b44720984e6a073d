//! Values with placeholders, for kinds that pass values and not texts: the arguments of a method, the JSON of a request.

use ztl_std::describe::{GoalField, GoalRule, GoalValue};

use crate::call::Call;
use crate::program::template::{Template, answer_part};

/// A value in which some parts come from the goal.
#[derive(Debug, Clone)]
pub(crate) enum ValueTemplate {
    Fixed(GoalValue),
    /// The goal, or the part of it at this path.
    Goal {
        path: Vec<String>,
        rule: GoalRule,
    },
    /// The answer to the task's request, or the part of it at this path.
    Answer(Vec<String>),
    /// A text with placeholders.
    Text(Template),
    List(Vec<ValueTemplate>),
    Map(Vec<(GoalValue, ValueTemplate)>),
}

impl ValueTemplate {
    /// The value for a task, or why its goal has no such part.
    pub(crate) fn fill(&self, call: &Call) -> Result<GoalValue, String> {
        Ok(match self {
            Self::Fixed(value) => value.clone(),
            Self::Goal { path, rule } => goal_part(call, path, rule)?,
            Self::Answer(path) => answer_part(call, path)?.clone(),
            Self::Text(template) => GoalValue::Text(template.fill(call)?),
            Self::List(items) => {
                let items = items.iter().map(|item| item.fill(call));
                GoalValue::List(items.collect::<Result<_, _>>()?)
            }
            Self::Map(pairs) => {
                let pairs = pairs
                    .iter()
                    .map(|(key, value)| Ok((key.clone(), value.fill(call)?)));
                GoalValue::Map(pairs.collect::<Result<_, String>>()?)
            }
        })
    }

    /// Whether it needs the goal as a value, not only as its text.
    pub(crate) fn needs_fields(&self) -> bool {
        match self {
            Self::Fixed(_) | Self::Answer(_) => false,
            Self::Goal { path, .. } => !path.is_empty(),
            Self::Text(template) => template.has_fields(),
            Self::List(items) => items.iter().any(Self::needs_fields),
            Self::Map(pairs) => pairs.iter().any(|(_, value)| value.needs_fields()),
        }
    }

    /// Whether it uses the answer to the task's request.
    #[cfg(feature = "http")]
    pub(crate) fn uses_answer(&self) -> bool {
        match self {
            Self::Answer(_) => true,
            Self::Text(template) => template.uses_answer(),
            Self::Fixed(_) | Self::Goal { .. } => false,
            Self::List(items) => items.iter().any(Self::uses_answer),
            Self::Map(pairs) => pairs.iter().any(|(_, value)| value.uses_answer()),
        }
    }

    /// Whether it differs from task to task of the same goal: it uses the task's id, or the answer.
    #[cfg(feature = "http")]
    pub(crate) fn names_task(&self) -> bool {
        match self {
            Self::Answer(_) => true,
            Self::Text(template) => template.names_task(),
            Self::Fixed(_) | Self::Goal { .. } => false,
            Self::List(items) => items.iter().any(Self::names_task),
            Self::Map(pairs) => pairs.iter().any(|(_, value)| value.names_task()),
        }
    }

    /// Adds each part of the goal that it uses.
    pub(crate) fn goal_paths<'t>(&'t self, paths: &mut Vec<&'t [String]>) {
        match self {
            Self::Fixed(_) | Self::Answer(_) => {}
            Self::Goal { path, .. } => paths.push(path),
            Self::Text(template) => paths.extend(template.goal_paths()),
            Self::List(items) => items.iter().for_each(|item| item.goal_paths(paths)),
            Self::Map(pairs) => pairs.iter().for_each(|(_, value)| value.goal_paths(paths)),
        }
    }
}

/// The rule for goals of which these parts are used, where the file has no rule.
pub(crate) fn rule_of_paths(paths: &[&[String]]) -> GoalRule {
    if paths.is_empty() {
        return GoalRule::Nothing;
    }
    let mut fields: Vec<GoalField> = Vec::new();
    for path in paths {
        let [name] = path else {
            return GoalRule::Any;
        };
        if fields.iter().all(|field| *field.name != **name) {
            fields.push(GoalField {
                name: name.as_str().into(),
                rule: GoalRule::Any,
                optional: false,
                default: None,
            });
        }
    }
    GoalRule::Fields(fields.into())
}

fn goal_part(call: &Call, path: &[String], rule: &GoalRule) -> Result<GoalValue, String> {
    let text = &call.goal.text;
    if path.is_empty() {
        let is_text = matches!(rule, GoalRule::Text { .. } | GoalRule::OneOf(_));
        let parsed = match (&call.goal.fields, is_text) {
            (_, true) => None,
            (Some(fields), _) => Some(fields.clone()),
            (None, false) => GoalValue::parse(text).ok(),
        };
        return finite(parsed.unwrap_or_else(|| GoalValue::Text(text.clone())));
    }
    let fields = call.goal.fields.as_ref();
    let part = fields.and_then(|fields| path.iter().try_fold(fields, |value, key| value.part(key)));
    let part = part.cloned().ok_or_else(|| {
        let path = path.join(".");
        format!("the goal has no '{path}'; this task needs a goal with that field or item")
    });
    finite(part?)
}

/// A value whose numbers are finite: no robot moves to infinity.
fn finite(value: GoalValue) -> Result<GoalValue, String> {
    fn is_finite(value: &GoalValue) -> bool {
        match value {
            GoalValue::Float(number) => number.is_finite(),
            GoalValue::List(items) => items.iter().all(is_finite),
            GoalValue::Map(pairs) => pairs.iter().all(|(_, value)| is_finite(value)),
            _ => true,
        }
    }
    match is_finite(&value) {
        true => Ok(value),
        false => Err("the goal has a number that is infinite or not a number".to_owned()),
    }
}
