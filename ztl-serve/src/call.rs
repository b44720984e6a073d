//! A task that a client has asked for.

use ztl_core::TaskId;
use ztl_std::describe::CheckedGoal;

/// A task whose goal was checked.
#[derive(Debug, Clone)]
pub(crate) struct Call {
    pub(crate) id: TaskId,
    pub(crate) scope: String,
    pub(crate) handler: String,
    pub(crate) component: String,
    pub(crate) goal: CheckedGoal,
}
