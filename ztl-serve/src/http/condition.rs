//! What an answer means: by its status code, or by a field of its JSON.

use ztl_std::describe::GoalValue;
use ztl_yaml::{Node, NodeValue};

use super::exchange::Answer;
use crate::reader::ConfigReader;

/// When an answer counts as done.
#[derive(Debug, Clone)]
pub(super) enum Condition {
    /// A status code from 200 to 299.
    Success,
    /// One of these status codes.
    Codes(Vec<u16>),
    /// This value of a field, beside a status code from 200 to 299.
    Field { path: Vec<String>, is: GoalValue },
}

impl Condition {
    pub(super) fn holds(&self, answer: &Answer) -> bool {
        let success = (200..300).contains(&answer.status);
        match self {
            Self::Success => success,
            Self::Codes(codes) => codes.contains(&answer.status),
            Self::Field { path, is } => {
                let field = answer.field(path);
                success && field.is_some_and(|field| same(&field, is))
            }
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

impl<'d> ConfigReader<'d> {
    /// Reads what an answer must be.
    pub(super) fn http_condition(&mut self, node: &'d Node) -> Option<Condition> {
        match &node.value {
            NodeValue::Map(_) => {
                let mut fields = self.yaml.fields(node, "field: status, is: Success")?;
                let path = fields.required("field", "field: status");
                let is = fields.required("is", "is: Success");
                fields.finish(&mut self.yaml);
                let path = self.http_field(path?);
                let is = self.fixed_value(is?);
                Some(Condition::Field {
                    path: path?,
                    is: is?,
                })
            }
            NodeValue::List(nodes) => {
                let codes: Vec<_> = nodes.iter().map(|node| self.status_code(node)).collect();
                Some(Condition::Codes(codes.into_iter().collect::<Option<_>>()?))
            }
            NodeValue::Scalar { .. } => Some(Condition::Codes(vec![self.status_code(node)?])),
        }
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

    fn status_code(&mut self, node: &'d Node) -> Option<u16> {
        let what = "a status code from 200 to 599, a list of them, or {field: status, is: Success}";
        self.yaml.parsed(node, what, |text| {
            let code = text.parse().ok().filter(|code| (200..600).contains(code));
            code.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }
}
