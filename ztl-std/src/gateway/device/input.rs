//! Messages to a device's thread.

use ztl_core::repr::put_quoted;
use ztl_core::{TaskId, TaskSpec};
use ztl_link::{Entry, Restored};

use super::line_reader::LineEvent;
use crate::gateway::journal::UnendedUpdate;
use crate::gateway::opener::Opener;
use crate::server::{Claim, ReservedId, TaskReporter};
use crate::task_request::TaskRequest;

/// Longest part of a request that is shown, in bytes.
const SHOWN: usize = 100;

/// A message to a device's thread.
pub(super) enum Input {
    Start(TaskReporter, DeviceRequest),
    Resume(TaskReporter, Restored),
    Abort(TaskId),
    /// The id for the next task that the firmware starts.
    Reserved(ReservedId),
    /// A request about parameters.
    Parameters(TaskReporter, DeviceRequest),
    /// A request about firmware.
    Update(TaskReporter, DeviceRequest),
    /// An update from before a restart.
    ResumeUpdate(TaskReporter, UnendedUpdate),
    /// The id for the task that tests new firmware.
    TestReserved(ReservedId),
    /// Of the line with this number.
    Line(u64, LineEvent),
    /// Abort all tasks, reject new ones, and close the line when all have ended.
    Retire,
    /// Serve the device again, at this line.
    Serve(Opener),
    /// End the thread. With `true`, its tasks are left running, otherwise they are aborted first.
    Stop(bool),
}

/// What a client asks of a device.
pub(super) struct DeviceRequest {
    pub(super) component: String,
    pub(super) goal: String,
    /// The specification, to be shown in reasons.
    pub(super) shown: String,
    /// The text that answers the INIT.
    pub(super) reply: String,
    /// To be claimed before the task is started, if there is a journal.
    pub(super) claim: Option<Claim>,
}

impl DeviceRequest {
    /// Its journal entry, if the gateway carries it out by itself.
    pub(super) fn own_entry(&self, id: TaskId) -> Entry<'_> {
        Entry {
            id,
            component: &self.component,
            goal: &self.goal,
            sent: None,
        }
    }
}

impl From<&TaskRequest> for DeviceRequest {
    fn from(request: &TaskRequest) -> Self {
        Self {
            component: request.component.clone(),
            goal: request.goal.clone(),
            shown: shown(&request.spec()),
            reply: request.reply(),
            claim: None,
        }
    }
}

/// A specification as it is shown to people: in quotes, and not longer than a line.
pub(in crate::gateway) fn shown(spec: &TaskSpec<'_>) -> String {
    let mut text = spec.to_string();
    if text.len() > SHOWN {
        text.truncate(text.floor_char_boundary(SHOWN));
        text.push('…');
    }
    let mut quoted = Vec::new();
    put_quoted(&text, &mut |bytes: &[u8]| quoted.extend_from_slice(bytes));
    String::from_utf8_lossy(&quoted).into_owned()
}
