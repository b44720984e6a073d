//! What a session writes down before it acts on it, and takes up again after a restart.

use std::time::Duration;

use ztl_core::link::{LinkId, Loss};
use ztl_core::{State, TaskId};

/// A `Start` that was sent, or is about to be: what its end depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// The task's number on the link.
    pub link: LinkId,
    /// The device's boot that was asked.
    pub boot: u32,
    /// What the component does when the link is lost.
    pub loss: Loss,
    /// After how long without a command.
    pub link_timeout: Duration,
}

/// A task as it is written down.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry<'a> {
    /// The id that its client knows.
    pub id: TaskId,
    /// Which component.
    pub component: &'a str,
    /// To what end.
    pub goal: &'a str,
    /// `None` when it was never sent.
    pub sent: Option<Sent>,
}

/// A task from before a restart that has no end in the book.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restored {
    /// The id that its client knows.
    pub id: TaskId,
    /// Which component.
    pub component: String,
    /// To what end.
    pub goal: String,
    /// The `Start` that was written down.
    pub sent: Sent,
    /// Whether the device had said that it runs.
    pub accepted: bool,
}

/// Where a session writes what must not be forgotten. A call returns when it is written; what
/// follows from it is done only then.
pub trait Book {
    /// A `Start` is about to be sent.
    ///
    /// # Errors
    /// Why it cannot be written; the task is then refused with that.
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String>;

    /// The device has said that the task runs. Nothing depends on this being written.
    fn accepted(&mut self, task: &Entry<'_>);

    /// The task is about to end: nobody has been told, and the device has no `Ack`.
    ///
    /// # Errors
    /// Why it cannot be written; it is then tried again, and nobody is told meanwhile.
    fn ended(&mut self, task: &Entry<'_>, state: State, text: &str) -> Result<(), String>;
}

/// Nothing is written: after a restart nobody knows any more.
impl Book for () {
    fn starting(&mut self, _task: &Entry<'_>) -> Result<(), String> {
        Ok(())
    }

    fn accepted(&mut self, _task: &Entry<'_>) {}

    fn ended(&mut self, _task: &Entry<'_>, _state: State, _text: &str) -> Result<(), String> {
        Ok(())
    }
}

impl<B: Book> Book for Option<B> {
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String> {
        self.as_mut().map_or(Ok(()), |book| book.starting(task))
    }

    fn accepted(&mut self, task: &Entry<'_>) {
        if let Some(book) = self {
            book.accepted(task);
        }
    }

    fn ended(&mut self, task: &Entry<'_>, state: State, text: &str) -> Result<(), String> {
        self.as_mut()
            .map_or(Ok(()), |book| book.ended(task, state, text))
    }
}
