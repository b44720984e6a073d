//! The journal of a session: what it writes before it acts, and restores after a restart.

use std::time::Duration;

use ztl_core::link::{LinkId, Loss};
use ztl_core::{State, TaskId};

/// A `Start` that was sent or is about to be sent, or a task that the firmware has started itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// The task's id on the link.
    pub link: LinkId,
    /// The boot of the device that it was sent to.
    pub boot: u32,
    /// What the component does when the link is lost.
    pub loss: Loss,
    /// After how long without a new command the device considers the link lost.
    pub link_timeout: Duration,
}

/// A task, as the journal stores it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry<'a> {
    /// The id that its client knows.
    pub id: TaskId,
    /// Name of the component.
    pub component: &'a str,
    /// The goal.
    pub goal: &'a str,
    /// The `Start`, if it was sent.
    pub sent: Option<Sent>,
}

/// A task from before a restart that has no outcome in the journal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restored {
    /// The id that its client knows.
    pub id: TaskId,
    /// Name of the component.
    pub component: String,
    /// The goal.
    pub goal: String,
    /// The `Start` in the journal.
    pub sent: Sent,
    /// Whether the device had accepted it.
    pub accepted: bool,
}

/// The durable record of a session. Each call returns when the entry is written; only then does the session act
/// on it.
pub trait SessionJournal {
    /// Records that a `Start` is about to be sent, or that a task of the firmware itself is taken up.
    ///
    /// # Errors
    /// Why it cannot be written. The task is rejected with this reason.
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String>;

    /// Records that the device has accepted the task. Nothing depends on this entry.
    fn accepted(&mut self, task: &Entry<'_>);

    /// Records an outcome before the client receives it and before the device gets an `Ack`.
    ///
    /// # Errors
    /// Why it cannot be written. The session retries, and withholds the outcome until then.
    fn ended(&mut self, task: &Entry<'_>, state: State, text: &str) -> Result<(), String>;

    /// The last task that the firmware of the device has started itself and that was recorded, ended or not: the boot of
    /// the device, and the id. Asked once, when the session is created. Defaults to `None`: none was recorded.
    fn latest_own(&self) -> Option<(u32, LinkId)> {
        None
    }
}

/// No journal: a restart loses all tasks.
impl SessionJournal for () {
    fn starting(&mut self, _task: &Entry<'_>) -> Result<(), String> {
        Ok(())
    }

    fn accepted(&mut self, _task: &Entry<'_>) {}

    fn ended(&mut self, _task: &Entry<'_>, _state: State, _text: &str) -> Result<(), String> {
        Ok(())
    }
}

impl<J: SessionJournal> SessionJournal for Option<J> {
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String> {
        self.as_mut()
            .map_or(Ok(()), |journal| journal.starting(task))
    }

    fn accepted(&mut self, task: &Entry<'_>) {
        if let Some(journal) = self {
            journal.accepted(task);
        }
    }

    fn ended(&mut self, task: &Entry<'_>, state: State, text: &str) -> Result<(), String> {
        self.as_mut()
            .map_or(Ok(()), |journal| journal.ended(task, state, text))
    }

    fn latest_own(&self) -> Option<(u32, LinkId)> {
        self.as_ref()?.latest_own()
    }
}
