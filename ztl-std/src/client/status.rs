//! What a server says of a task and of itself.

use ztl_core::{State, client};

use crate::remote_id::RemoteId;

/// A server of this project.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerInfo {
    /// Its version.
    pub version: String,
    /// Differs after each restart of the server.
    pub boot: u32,
}

/// An accepted task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Triggered {
    /// Its id on the server.
    pub id: RemoteId,
    /// The server's text.
    pub reply: String,
}

/// A task's status.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status {
    /// The task's state.
    pub state: State,
    /// Progress, result or reason; the text `None` if nothing is known.
    pub text: String,
}

impl Status {
    /// Whether this answer to an ABORT means that the handler cannot stop the task, which continues.
    #[must_use]
    pub fn is_abort_rejected(&self) -> bool {
        client::is_abort_rejected(self.state, &self.text)
    }
}
