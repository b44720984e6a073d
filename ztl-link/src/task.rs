//! A task of a session.

use ztl_core::link::Loss;
use ztl_core::{Instant, State, TaskId};

use crate::journal::{Entry, Sent};

/// A task that a client has started and that has not ended.
#[derive(Debug, Clone)]
pub(crate) struct Task {
    pub(crate) component: String,
    pub(crate) goal: String,
    /// After this the device refuses it.
    pub(crate) deadline: Instant,
    pub(crate) stage: Stage,
    pub(crate) abort: bool,
    /// When the device is asked about it, if its firmware has started it.
    pub(crate) ask_at: Instant,
    /// Restored after a restart of the gateway; its client may know the id.
    pub(crate) restored: bool,
    /// The outcome, withheld while the journal cannot be written.
    pub(crate) unwritten: Option<(State, String)>,
}

impl Task {
    pub(crate) fn new(component: &str, goal: &str, deadline: Instant, stage: Stage) -> Self {
        Self {
            component: component.to_owned(),
            goal: goal.to_owned(),
            deadline,
            stage,
            abort: false,
            ask_at: Instant::NEVER,
            restored: false,
            unwritten: None,
        }
    }

    pub(crate) fn entry(&self, id: TaskId) -> Entry<'_> {
        Entry {
            id,
            component: &self.component,
            goal: &self.goal,
            sent: self.stage.sent(),
        }
    }

    /// Whether it was not sent yet, and can be rejected.
    pub(crate) fn waits(&self) -> bool {
        self.stage == Stage::Waiting && self.unwritten.is_none()
    }

    /// Whether it was sent and has no outcome yet.
    pub(crate) fn may_run(&self) -> bool {
        self.stage != Stage::Waiting && self.unwritten.is_none()
    }

    /// Whether it continues when the link is lost.
    pub(crate) fn carries_on(&self) -> bool {
        let loss = self.stage.sent().map(|sent| sent.loss);
        loss == Some(Loss::CarryOn)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stage {
    /// Not sent yet.
    Waiting,
    /// Sent; it may run.
    Sent(Sent),
    /// The device has accepted it.
    Running(Sent),
}

impl Stage {
    pub(crate) fn sent(self) -> Option<Sent> {
        match self {
            Self::Waiting => None,
            Self::Sent(sent) | Self::Running(sent) => Some(sent),
        }
    }
}
