//! What an answer or an event means: by its status code, its name, or fields of its JSON.

use ztl_std::describe::{GoalRule, GoalValue};
use ztl_yaml::{Node, NodeValue};

use super::exchange::Answer;
use crate::call::Call;
use crate::reader::ConfigReader;
use crate::value_template::ValueTemplate;

/// When an answer or an event is what a task waits for.
#[derive(Debug, Clone)]
pub(super) enum Condition {
    /// A status code from 200 to 299.
    Success,
    /// This status code.
    Code(u16),
    /// The name of an event.
    Name(String),
    /// It has this field.
    Has(Vec<String>),
    /// These values of fields, beside a status code from 200 to 299.
    Fields(Vec<(Vec<String>, ValueTemplate)>),
    /// Any of these.
    Any(Vec<Condition>),
}

impl Condition {
    /// Whether it is so for this task.
    pub(super) fn holds(&self, answer: &Answer, call: &Call) -> bool {
        let success = (200..300).contains(&answer.status);
        match self {
            Self::Success => success,
            Self::Code(code) => answer.status == *code,
            Self::Name(name) => answer.name.as_ref() == Some(name),
            Self::Has(path) => answer.field(path).is_some(),
            Self::Fields(fields) => {
                success
                    && fields.iter().all(|(path, is)| {
                        let field = answer.field(path);
                        field.is_some_and(|field| is.fill(call).is_ok_and(|is| same(&field, &is)))
                    })
            }
            Self::Any(conditions) => conditions.iter().any(|it| it.holds(answer, call)),
        }
    }

    /// What it needs of a goal, or of an answer, and does not find.
    ///
    /// # Errors
    /// What is missing.
    pub(super) fn check(&self, call: &Call) -> Result<(), String> {
        match self {
            Self::Success | Self::Code(_) | Self::Name(_) | Self::Has(_) => Ok(()),
            Self::Fields(fields) => fields
                .iter()
                .try_for_each(|(_, is)| is.fill(call).map(drop)),
            Self::Any(conditions) => conditions.iter().try_for_each(|it| it.check(call)),
        }
    }

    /// Whether it uses fields of the answer to the task's request.
    pub(super) fn uses_answer(&self) -> bool {
        match self {
            Self::Success | Self::Code(_) | Self::Name(_) | Self::Has(_) => false,
            Self::Fields(fields) => fields.iter().any(|(_, is)| is.uses_answer()),
            Self::Any(conditions) => conditions.iter().any(Self::uses_answer),
        }
    }

    /// Whether only what belongs to this task fulfils it: in each way it names the task's id, or the answer.
    pub(super) fn names_task(&self) -> bool {
        match self {
            Self::Success | Self::Code(_) | Self::Name(_) | Self::Has(_) => false,
            Self::Fields(fields) => fields.iter().any(|(_, is)| is.names_task()),
            Self::Any(conditions) => conditions.iter().all(Self::names_task),
        }
    }

    /// Adds each part of the goal that it uses.
    pub(super) fn goal_paths<'s>(&'s self, paths: &mut Vec<&'s [String]>) {
        match self {
            Self::Success | Self::Code(_) | Self::Name(_) | Self::Has(_) => {}
            Self::Fields(fields) => fields.iter().for_each(|(_, is)| is.goal_paths(paths)),
            Self::Any(conditions) => conditions.iter().for_each(|it| it.goal_paths(paths)),
        }
    }
}

/// Whether both are the same value; of numbers, `1` and `1.0` are.
fn same(one: &GoalValue, other: &GoalValue) -> bool {
    match (one, other) {
        (GoalValue::Integer(whole), GoalValue::Float(number))
        | (GoalValue::Float(number), GoalValue::Integer(whole)) => *whole as f64 == *number,
        _ => one == other,
    }
}

/// What a condition is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Of {
    Answer,
    Event,
}

impl<'d> ConfigReader<'d> {
    /// Reads what an answer or an event must be.
    pub(super) fn http_condition(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
        of: Of,
    ) -> Option<Condition> {
        match &node.value {
            NodeValue::Map(_) => self.http_fields_condition(node, rule, of),
            NodeValue::List(nodes) if nodes.is_empty() => {
                self.yaml
                    .wrong(node, "this list is empty, so that nothing is enough");
                None
            }
            NodeValue::List(nodes) => {
                let all = nodes
                    .iter()
                    .map(|node| self.http_condition(node, rule, of))
                    .collect::<Vec<_>>();
                Some(Condition::Any(all.into_iter().collect::<Option<_>>()?))
            }
            NodeValue::Scalar { .. } => self.status_code(node, of).map(Condition::Code),
        }
    }

    fn http_fields_condition(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
        of: Of,
    ) -> Option<Condition> {
        let example = "field: status, is: Success";
        let mut fields = self.yaml.fields(node, example)?;
        let several = fields.optional("fields");
        let has = fields.optional("has");
        let name = match of {
            Of::Event => fields.optional("event"),
            Of::Answer => None,
        };
        let condition = match (several, has, name) {
            (Some(several), ..) => {
                let pairs = self
                    .yaml
                    .pairs(several, "fields with values, as state: idle");
                let pairs = pairs.unwrap_or_default().iter().map(|(path, is)| {
                    let path = self.http_field(path);
                    let is = self.value_template(is, rule);
                    Some((path?, is?))
                });
                // All mistakes are told, not only the first.
                let pairs: Vec<_> = pairs.collect();
                let pairs: Option<_> = pairs.into_iter().collect();
                pairs.map(Condition::Fields)
            }
            (None, Some(has), _) => self.http_field(has).map(Condition::Has),
            (None, None, Some(name)) => {
                let name = self.yaml.text(name, "the name of an event");
                name.map(|name| Condition::Name(name.to_owned()))
            }
            (None, None, None) => {
                let path = fields.required("field", "field: status");
                let is = fields.required("is", "is: Success");
                let path = path.and_then(|node| self.http_field(node));
                let is = is.and_then(|node| self.value_template(node, rule));
                path.zip(is).map(|field| Condition::Fields(vec![field]))
            }
        };
        fields.finish(&mut self.yaml);
        condition
    }

    /// Reads the path of a field in an answer.
    pub(super) fn http_field(&mut self, node: &'d Node) -> Option<Vec<String>> {
        let what = "a field of the answer, as result.state";
        self.yaml.parsed(node, what, |text| {
            let path: Vec<String> = text.split('.').map(str::to_owned).collect();
            match path.iter().any(String::is_empty) {
                true => Err(format!("'{text}' is not {what}")),
                false => Ok(path),
            }
        })
    }

    fn status_code(&mut self, node: &'d Node, of: Of) -> Option<u16> {
        let what = match of {
            Of::Answer => {
                "a status code from 200 to 599, a list of them, or {field: status, is: Success}"
            }
            Of::Event => "{field: state, is: idle}, {event: done}, or a list of them",
        };
        self.yaml.parsed(node, what, |text| {
            let code = text.parse().ok().filter(|code| (200..600).contains(code));
            let code = code.filter(|_| of == Of::Answer);
            code.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }
}
