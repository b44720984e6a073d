//! `ros1-parameter`: reads a parameter of the ROS master.

use std::sync::Arc;

use ztl_ros1::xmlrpc::Value;
use ztl_std::describe::{GoalRule, GoalValue};
use ztl_yaml::{Fields, Node};

use super::connection::Connection;
use super::shown::bounded;
use super::used_name::UsedType;
use crate::call::Call;
use crate::kind::{Effect, JobContext, Kind, Outcome, Services, Start};
use crate::reader::{ComponentContext, ConfigReader};
use crate::thread_job;

/// A parameter.
#[derive(Debug)]
pub(crate) struct Parameter {
    connection: Arc<Connection>,
    name: String,
}

/// Reads a parameter's name.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    _: Option<&mut Fields<'d>>,
    _: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let name = reader.ros1_name(node, "/robot_description");
    reader.uses_name(node, name.as_ref(), UsedType::parameter());
    Some(Arc::new(Parameter {
        connection: Arc::clone(&reader.ros1.connection),
        name: name?,
    }))
}

impl Kind for Parameter {
    fn goal_rule(&self) -> GoalRule {
        GoalRule::Nothing
    }

    fn start(self: Arc<Self>, _: Arc<Call>, task: JobContext, _: &Services) -> Start {
        thread_job::start(task, move |task, _| {
            task.effect(Effect::Accept);
            let read = self.connection.node();
            let read = read.and_then(|node| {
                let value = node.param(&self.name);
                value.map_err(|error| format!("{}: {error}", self.name))
            });
            let text = read.map(|value| match goal_value(value).to_text() {
                Ok(text) => Outcome::Completed(bounded(text)),
                Err(error) => Outcome::Failed(format!("{}: {error}", self.name)),
            });
            text.unwrap_or_else(Outcome::Failed)
        })
    }
}

fn goal_value(value: Value) -> GoalValue {
    match value {
        Value::Nil => GoalValue::Null,
        Value::Bool(value) => GoalValue::Bool(value),
        Value::Int(number) => GoalValue::Integer(number.into()),
        Value::Double(number) => GoalValue::Float(number),
        Value::String(text) | Value::Raw(text) => GoalValue::Text(text),
        Value::Array(items) => GoalValue::List(items.into_iter().map(goal_value).collect()),
        Value::Struct(fields) => {
            let pair = |(name, value)| (GoalValue::Text(name), goal_value(value));
            GoalValue::Map(fields.into_iter().map(pair).collect())
        }
    }
}
