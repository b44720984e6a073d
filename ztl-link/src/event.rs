//! What a session reports.

use ztl_core::{State, TaskId};

use crate::parameters::ParameterAnswer;
use crate::updates::UpdateAnswer;

/// A change of a task or of the link.
#[derive(Debug, Clone, PartialEq)]
pub enum LinkEvent {
    /// The device has started the task.
    Accepted(TaskId),
    /// The task was not started and never will be.
    TaskRejected(TaskId, String),
    /// Progress of the task.
    Progress(TaskId, String),
    /// The task has ended, with this final state and text.
    Ended(TaskId, State, String),
    /// The device has described itself and takes tasks. Again in each new session, also without [`Lost`](Self::Lost).
    Up,
    /// Nothing has answered `Hello` for the link timeout. Repeated as long as nothing answers.
    Silent,
    /// The device, which answered before, is not answering.
    Lost,
    /// The device was reset and has lost its tasks.
    Reset,
    /// On a shared line: a board with another boot has answered at this address while tasks of the device may run. It was reset,
    /// or two boards have the address. See [`Session::handle_search`](crate::Session::handle_search).
    OtherBoard,
    /// The device refuses this gateway, or is unusable for this reason.
    DeviceUnusable(String),
    /// The firmware has started a task itself: see [`Session::begun`](crate::Session::begun). This event repeats until the
    /// task is taken up.
    Begun,
    /// The firmware reports this event.
    Reported(String),
    /// The answer to the request about parameters with this number.
    Parameter(u64, ParameterAnswer),
    /// The answer to the request about updates with this number.
    Update(u64, UpdateAnswer),
    /// A reading, with the number of its topic.
    Reading(u8, Vec<u8>),
    /// The next bytes of the firmware's log.
    Log {
        /// Bytes dropped by the device since boot; wraps around.
        lost: u32,
        /// A stream, split anywhere.
        bytes: Vec<u8>,
    },
}
