//! Why a node refuses a command.

use ztl_core::tasks::NoRoom;

/// A component's reason to refuse a goal: at most 96 bytes, and the mark of a cut.
pub type Reason = heapless::String<99>;

/// Why a node refuses a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Refusal {
    /// The component refused the goal, or the firmware what only some nodes have, and wrote the reason into [`TaskRunner::reason`](super::runner::TaskRunner).
    ByComponent,
    /// The gateway speaks another version of the link.
    OtherVersion,
    /// The session of another gateway is still alive.
    OtherGateway,
    NoSuchComponent,
    TooLate,
    /// A `Start` that was sent before a later one arrives after it.
    StaleTask,
    NoSuchTask,
    EmergencyStop,
    /// The component's policy is to refuse a second task.
    Busy,
    GoingToSafeState,
    QueueFull,
    GoalTooLongToWait,
    /// All places of the task table hold running tasks.
    TableFull,
    /// Some places of the task table hold ended tasks that the gateway has not acknowledged.
    TableFullOfEnded,
    /// The component's description does not fit a frame.
    DescriptionTooLong,
}

impl Refusal {
    /// The text that the gateway shows; for [`ByComponent`](Self::ByComponent) it is empty. Where the compiler knows which
    /// reasons are possible, it leaves out the others.
    pub(crate) const fn as_str(self) -> &'static str {
        match self {
            Self::ByComponent => "",
            Self::OtherVersion => "this node speaks version 1 of the link",
            Self::OtherGateway => "another gateway holds this device",
            Self::NoSuchComponent => "no such component",
            Self::TooLate => "the command came too late",
            Self::StaleTask => "a task of this or a later id was started already",
            Self::NoSuchTask => "no such task",
            Self::EmergencyStop => EMERGENCY_STOP,
            Self::Busy => "busy with another task",
            Self::GoingToSafeState => "busy going to its safe state",
            Self::QueueFull => "busy, and no more tasks may wait",
            Self::GoalTooLongToWait => "busy, and the goal is too long to wait: more than 48 bytes",
            Self::TableFull => NoRoom.as_str(),
            Self::TableFullOfEnded => "ends not yet acknowledged",
            Self::DescriptionTooLong => "its description is longer than a frame",
        }
    }
}

/// Also ends the tasks that run when it begins.
pub(super) const EMERGENCY_STOP: &str = "emergency stop";
/// Also ends the tasks that run when an update begins.
pub(super) const UPDATING: &str = "a firmware update is in progress";
/// Also ends the tasks that run when a trial is over.
pub(super) const RESTARTING: &str = "the device restarts";
