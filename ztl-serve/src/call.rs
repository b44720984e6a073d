//! A task that a client has asked for.

use ztl_core::TaskId;
use ztl_std::describe::{CheckedGoal, GoalValue};

/// A task whose goal was checked.
#[derive(Debug, Clone)]
pub(crate) struct Call {
    pub(crate) id: TaskId,
    pub(crate) scope: String,
    pub(crate) handler: String,
    pub(crate) component: String,
    pub(crate) goal: CheckedGoal,
    /// What a robot has answered to the task's request, for what comes after it.
    pub(crate) answer: Option<GoalValue>,
}
