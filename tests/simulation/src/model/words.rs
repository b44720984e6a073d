//! What can happen, and what is explored.

use super::line::Way;
use super::motor::Kind;

/// What a client does.
#[derive(Debug, Clone, Copy)]
pub enum Act {
    /// Asks a gateway for the next task.
    Ask {
        /// Which gateway.
        gateway: usize,
        /// Which motor.
        motor: usize,
        /// How long it moves; `u16::MAX` is until it is stopped.
        millis: u16,
    },
    /// Wants a task to stop.
    Abort {
        /// Which gateway.
        gateway: usize,
        /// Which, from 0 in the order of asking.
        task: usize,
    },
}

/// What can go wrong. Each costs one of the faults that a scenario allows; that it goes on, or is
/// over at any later time, costs nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// A frame is lost (or damaged, which is the same).
    Drop(Way),
    /// A frame is late: it arrives at any later time, in whatever session, or never.
    Hold(Way),
    /// A frame comes a second time, at any later time.
    Copy(Way),
    /// All that is sent from now on comes a second time, in its order, at any later time.
    Tape(Way),
    /// Nothing arrives for a while, and then all.
    Stall(Way),
    /// All that is sent is lost for a while.
    Cut(Way),
    /// The device is reset.
    Reset,
    /// A gateway dies, and is started again at any later time.
    Kill(usize),
    /// It dies after it has written down what the next frame brings, before it says or tells anything.
    KillWriting(usize),
    /// The line is closed and opened again at any later time; what is under way arrives after that.
    Unplug,
}

/// What can happen next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// The next frame arrives.
    Deliver(Way),
    /// Nothing happens until the next timer.
    Wait,
    /// The client does what it does next.
    Act,
    /// Something goes wrong.
    Disturb(Fault),
    /// A frame that was held back arrives.
    Release(u8),
    /// What was taped comes again.
    Replay(Way),
    /// A stall, or a cut, is over.
    Mend(Way),
    /// A gateway is started again.
    Start(usize),
    /// The line is opened again.
    Plug,
}

/// What is explored.
#[derive(Debug, Clone, Copy)]
pub struct Scenario {
    /// Its name.
    pub name: &'static str,
    /// What happens in it.
    pub about: &'static str,
    /// The motors.
    pub motors: [Kind; 2],
    /// How many gateways are at the line, 1 or 2.
    pub gateways: usize,
    /// Whether the second one is started at any later time.
    pub late: bool,
    /// Whether they have journals.
    pub journal: bool,
    /// What the clients do, in this order, each at any time.
    pub acts: &'static [Act],
    /// What can go wrong.
    pub faults: &'static [Fault],
    /// How often something goes wrong at most.
    pub times: u8,
}

impl Scenario {
    /// The same with another number of faults.
    #[must_use]
    pub fn with_times(&self, times: u8) -> &'static Self {
        // Leaked: there are few, and a laboratory is copied often.
        Box::leak(Box::new(Self { times, ..*self }))
    }
}
