//! Steps, faults and scenarios of the model.

use super::line::Way;
use super::motor::Kind;

/// An act of a client.
#[derive(Debug, Clone, Copy)]
pub enum Act {
    /// Starts the next task.
    Ask {
        /// Which gateway.
        gateway: usize,
        /// Which motor.
        motor: usize,
        /// Duration of the task; `u16::MAX` means until it is stopped.
        millis: u16,
    },
    /// Aborts a task.
    Abort {
        /// Which gateway.
        gateway: usize,
        /// The task, from 0 in the order of starting.
        task: usize,
    },
    /// A button of the device starts the next task.
    Press {
        /// Which motor.
        motor: usize,
        /// As for [`Ask`](Self::Ask).
        millis: u16,
    },
    /// Sets the next value of a motor's parameter.
    Set {
        /// Which gateway.
        gateway: usize,
        /// Which motor.
        motor: usize,
    },
    /// The clients do nothing until a gateway has sent nearly all commands that fit a session.
    Idle,
}

/// A fault. Each takes one of the faults that a scenario allows; its duration and end take none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// A frame is lost or damaged.
    Drop(Way),
    /// A frame is delayed: it arrives at any later time, in any session, or never.
    Hold(Way),
    /// A frame arrives a second time, at any later time.
    Copy(Way),
    /// All frames from now on arrive a second time, in order, at any later time.
    Tape(Way),
    /// All frames are delayed for a while.
    Stall(Way),
    /// All frames are lost for a while.
    Cut(Way),
    /// The device is reset.
    Reset,
    /// A gateway is killed, and restarted at any later time.
    Kill(usize),
    /// A gateway is killed after it has journaled the next frame, before it sends or reports anything.
    KillWriting(usize),
    /// The line is closed, and opened again at any later time. Frames on the line arrive after that.
    Unplug,
}

/// A step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// The next frame arrives.
    Deliver(Way),
    /// Nothing happens until the next timer.
    Wait,
    /// The next act of the clients.
    Act,
    /// A fault begins.
    Disturb(Fault),
    /// A delayed frame arrives.
    Release(u8),
    /// The recorded frames arrive again.
    Replay(Way),
    /// A stall or cut ends.
    Mend(Way),
    /// A gateway is restarted.
    Start(usize),
    /// The line is opened again.
    Plug,
}

/// A scenario to explore.
#[derive(Debug, Clone, Copy)]
pub struct Scenario {
    /// Its name.
    pub name: &'static str,
    /// Description.
    pub about: &'static str,
    /// The motors.
    pub motors: [Kind; 2],
    /// Number of gateways on the line, 1 or 2.
    pub gateways: usize,
    /// Whether the second gateway is started at any later time.
    pub late: bool,
    /// Whether they have journals.
    pub journal: bool,
    /// The acts of the clients, in order, each at any time.
    pub acts: &'static [Act],
    /// The possible faults.
    pub faults: &'static [Fault],
    /// Maximum number of faults.
    pub times: u8,
}

impl Scenario {
    /// The scenario with another number of faults.
    #[must_use]
    pub fn with_times(&self, times: u8) -> &'static Self {
        // Leaked: there are few scenarios, and laboratories are cloned often.
        Box::leak(Box::new(Self { times, ..*self }))
    }
}
