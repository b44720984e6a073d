//! Values with placeholders, for kinds that pass values and not texts: the arguments of a method, the JSON of a request.

use ztl_std::describe::{GoalField, GoalRule, GoalValue};
use ztl_yaml::python::{self, PythonValue};
use ztl_yaml::{Node, NodeValue};

use crate::call::Call;
use crate::program::template::{Template, answer_part};
use crate::reader::ConfigReader;

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

impl<'d> ConfigReader<'d> {
    /// Reads a text with placeholders for goals of this rule.
    pub(crate) fn text_template(&mut self, node: &'d Node, rule: &GoalRule) -> Option<Template> {
        let text = self.yaml.text(node, "a text, in quotes if it has braces")?;
        let template = self.template(text, rule);
        template
            .map_err(|mistake| self.yaml.wrong(node, mistake))
            .ok()
    }

    /// Parses a text with placeholders for goals of this rule.
    pub(crate) fn template(&self, text: &str, rule: &GoalRule) -> Result<Template, String> {
        let template = match self.knows_answer {
            true => Template::parse_with_answer(text)?,
            false => Template::parse(text)?,
        };
        match template.lacks(rule) {
            Some(lacking) => Err(format!("no goal has '{lacking}': it is {rule}")),
            None => Ok(template),
        }
    }

    /// Reads a value with placeholders for goals of this rule.
    pub(crate) fn value_template(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
    ) -> Option<ValueTemplate> {
        match &node.value {
            NodeValue::Scalar { text, plain } => {
                if text.contains('{') {
                    let template = self.text_template(node, rule)?;
                    if let Some(path) = template.answer_alone() {
                        return Some(ValueTemplate::Answer(path.to_vec()));
                    }
                    return Some(match template.goal_alone() {
                        Some(path) => ValueTemplate::Goal {
                            path: path.to_vec(),
                            rule: rule.part(path).cloned().unwrap_or_default(),
                        },
                        None if template.is_fixed() => {
                            ValueTemplate::Fixed(GoalValue::Text(text.clone()))
                        }
                        None => ValueTemplate::Text(template),
                    });
                }
                let value = python::read(text, *plain, node.tag.as_deref()).and_then(fixed);
                let value = value.map_err(|mistake| self.yaml.wrong(node, mistake));
                Some(ValueTemplate::Fixed(value.ok()?))
            }
            NodeValue::List(nodes) => {
                let items = nodes.iter().map(|node| self.value_template(node, rule));
                // All mistakes are told, not only the first.
                let items: Vec<_> = items.collect();
                let items = items.into_iter().collect::<Option<_>>()?;
                Some(ValueTemplate::List(items))
            }
            NodeValue::Map(pairs) => {
                if let Some(name) = unquoted(pairs) {
                    let message = format!("YAML reads this as a mapping; write \"{{{name}}}\"");
                    self.yaml.wrong(node, message);
                    return None;
                }
                let pairs = pairs.iter().map(|(key, value)| {
                    let name = self.yaml.text(key, "the name of a field");
                    let value = self.value_template(value, rule);
                    Some((GoalValue::Text(name?.to_owned()), value?))
                });
                let pairs: Vec<_> = pairs.collect();
                let pairs = pairs.into_iter().collect::<Option<_>>()?;
                Some(ValueTemplate::Map(pairs))
            }
        }
    }
}

/// The placeholder that lacks its quotes: `{goal}` is a mapping with a key and no value.
fn unquoted(pairs: &[(Node, Node)]) -> Option<&str> {
    match pairs {
        [(key, value)] if value.is_null() => match &key.value {
            NodeValue::Scalar { text, .. } => {
                let quoted = format!("{{{text}}}");
                let template = Template::parse_with_answer(&quoted);
                template.is_ok_and(|it| !it.is_fixed()).then_some(text)
            }
            _ => None,
        },
        _ => None,
    }
}

fn fixed(value: PythonValue) -> Result<GoalValue, String> {
    Ok(match value {
        PythonValue::Null => GoalValue::Null,
        PythonValue::Bool(value) => GoalValue::Bool(value),
        PythonValue::Int(digits) => {
            let number = digits.parse().ok();
            let range = i128::from(i64::MIN)..=i128::from(u64::MAX);
            let number = number.filter(|number| range.contains(number));
            GoalValue::Integer(number.ok_or("this number has more than 64 bits")?)
        }
        PythonValue::Float(number) if number.is_finite() => GoalValue::Float(number),
        PythonValue::Text(text) => GoalValue::Text(text),
        other => {
            return Err(format!(
                "'{other}' is no finite number, text, or truth value; as a text, put it in quotes"
            ));
        }
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ztl_core::TaskId;
    use ztl_std::describe::CheckGoal;
    use ztl_yaml::Document;

    use super::*;

    /// The value of a template for a goal, or the mistakes in it.
    fn filled(template: &str, rule: &GoalRule, goal: &str) -> Result<String, String> {
        let document = Document::parse("robot.yaml", template.as_bytes()).expect("YAML");
        let mut reader = ConfigReader::new(&document, Path::new(""));
        let template = reader.value_template(document.root(), rule);
        let template = reader.yaml.finish(template).map_err(|it| it.to_string())?;
        let call = Call {
            id: TaskId::new(7).expect("an id"),
            scope: "/robot".to_owned(),
            handler: "arm".to_owned(),
            component: "move".to_owned(),
            goal: rule.check(goal, template.needs_fields())?,
            answer: None,
        };
        Ok(format!("{:?}", template.fill(&call)?))
    }

    #[test]
    fn a_placeholder_alone_keeps_its_type_and_nothing_of_a_goal_becomes_structure() {
        let any = &GoalRule::Any;
        let text = &GoalRule::Text { longest: None };
        for (template, rule, goal, value) in [
            (
                "['{goal}', 1, 0.5, yes, '1', ~]",
                any,
                "7",
                "List([Integer(7), Integer(1), Float(0.5), Bool(true), Text(\"1\"), Null])",
            ),
            ("'{goal}'", text, "7", "Text(\"7\")"),
            (
                "{a: '{goal.x}', b: 'at {goal.x}'}",
                any,
                "{x: [1]}",
                "Map([(Text(\"a\"), List([Integer(1)])), (Text(\"b\"), Text(\"at [1]\"))])",
            ),
            (
                "'{goal}'",
                text,
                "\", \"x\": {1}",
                "Text(\"\\\", \\\"x\\\": {1}\")",
            ),
        ] {
            assert_eq!(
                filled(template, rule, goal).as_deref(),
                Ok(value),
                "{template}"
            );
        }
        for goal in ["nan", "{x: -inf}", "{x: [0, nan]}"] {
            let odd = "the goal has a number that is infinite or not a number";
            let template = if goal.starts_with('{') {
                "'{goal.x}'"
            } else {
                "'{goal}'"
            };
            assert_eq!(filled(template, any, goal), Err(odd.to_owned()), "{goal}");
        }
        assert_eq!(
            filled("['{goal.y}']", any, "{x: 1}"),
            Err("the goal has no 'y'; this task needs a goal with that field or item".to_owned())
        );
    }

    #[test]
    fn mistakes_have_their_places() {
        for (template, name) in [("{a: {goal}}", "{goal}"), ("[{goal.x}]", "{goal.x}")] {
            let said = filled(template, &GoalRule::Any, "").expect_err("a mistake");
            let wanted = format!("YAML reads this as a mapping; write \"{name}\"");
            assert!(said.contains(&wanted), "{said}");
        }
        assert!(filled("{x: ~}", &GoalRule::Any, "").is_ok());
        let said =
            filled("[2020-01-01, '{gaol}', .inf]", &GoalRule::Any, "").expect_err("mistakes");
        for part in [
            "1:2: '2020-01-01' is no finite number",
            "1:24: 'inf' is no finite number",
            "1:14: unknown placeholder '{gaol}'",
        ] {
            assert!(said.contains(part), "{said}");
        }
        let number = GoalRule::Number {
            whole: false,
            least: None,
            most: None,
            step: None,
            unit: None,
        };
        let said = filled("['{goal.x}']", &number, "1").expect_err("a mistake");
        assert!(said.contains("1:2: no goal has 'x'"), "{said}");
    }
}
