//! Reads texts and values with placeholders.

use ztl_std::describe::{GoalRule, GoalValue};
use ztl_yaml::python::{self, PythonValue};
use ztl_yaml::{Node, NodeValue};

use super::ConfigReader;
use crate::program::template::Template;
use crate::value_template::ValueTemplate;

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
    use crate::call::Call;

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
