//! A task of any robot, as the page shows it.

use serde::Serialize;
use ztl_std::RemoteId;

/// A task as it is shown.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Task {
    pub(crate) robot: String,
    pub(crate) scope: String,
    pub(crate) id: RemoteId,
    /// `handler:component:goal`.
    pub(crate) task: String,
    pub(crate) state: String,
    pub(crate) text: String,
    pub(crate) runs: bool,
    /// Wall clock in ms; `null` if the server does not tell it.
    pub(crate) started_ms: Option<u64>,
    /// Who started it, if this console did.
    pub(crate) by: Option<String>,
}
