//! Steps, faults and scenarios of a shared line with two nodes.

use super::motor::ENDLESS;
use super::scenarios::{PLAIN, abort, ask};
use super::{Act, Scenario};

/// A fault of a shared line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusFault {
    /// A question is lost or damaged.
    DropQuestion,
    /// An answer is lost or damaged.
    DropAnswer,
    /// A question arrives at any later time, or never.
    HoldQuestion,
    /// An answer arrives at any later time, or never.
    HoldAnswer,
    /// A question arrives a second time, at any later time: then a node talks out of turn.
    CopyQuestion,
    /// The wires of a node are broken for a while.
    Cut(usize),
    /// A node is reset.
    Reset(usize),
    /// The second node is reset, and has the address of the first one for a while.
    Readdress,
    /// The same, and the wires of the first one are broken.
    Replace,
    /// The gateway is killed, and restarted at any later time.
    Kill,
}

/// A step on a shared line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusAction {
    /// The question arrives at the nodes.
    Ask,
    /// What the nodes send arrives. It is damaged if both send.
    Answer,
    /// Nothing happens until the next timer.
    Wait,
    /// The next act of the clients.
    Act,
    /// A fault begins.
    Disturb(BusFault),
    /// A delayed question or answer arrives.
    Release(u8),
    /// The wires of a node are mended, or it gets its address back.
    Mend(u8),
    /// The gateway is restarted.
    Start,
}

/// A scenario of a shared line to explore. Both nodes have a link when it begins.
#[derive(Debug, Clone, Copy)]
pub struct BusScenario {
    /// Its name.
    pub name: &'static str,
    /// Description.
    pub about: &'static str,
    /// The motors of each node, and whether the gateway has a journal.
    pub node: Scenario,
    /// What clients of each node have begun before, by node.
    pub before: &'static [(usize, Act)],
    /// The acts of the clients, in order, each at any time, by node.
    pub acts: &'static [(usize, Act)],
    /// The possible faults.
    pub faults: &'static [BusFault],
    /// Maximum number of faults.
    pub times: u8,
}

impl BusScenario {
    /// The scenario with another number of faults.
    #[must_use]
    pub fn with_times(&self, times: u8) -> &'static Self {
        Box::leak(Box::new(Self { times, ..*self }))
    }
}

/// While the second node has a task.
const SHARED: BusScenario = BusScenario {
    name: "",
    about: "",
    node: PLAIN,
    before: &[(1, ask(0, 0, ENDLESS))],
    acts: &[],
    faults: &[],
    times: 1,
};

/// All scenarios of shared lines.
pub const BUS_SCENARIOS: &[BusScenario] = &[
    BusScenario {
        name: "bus-frames",
        about: "a short task beside an endless one; questions and answers are lost, delayed and repeated, nodes talk out of turn",
        acts: &[(0, ask(0, 0, 40))],
        faults: &[
            BusFault::DropQuestion,
            BusFault::DropAnswer,
            BusFault::HoldQuestion,
            BusFault::HoldAnswer,
            BusFault::CopyQuestion,
        ],
        ..SHARED
    },
    BusScenario {
        name: "bus-abort",
        about: "a task is aborted beside an endless one; the wires of either node are broken, a node is reset",
        acts: &[(0, ask(0, 0, ENDLESS)), (0, abort(0, 0))],
        faults: &[BusFault::Cut(0), BusFault::Cut(1), BusFault::Reset(0)],
        ..SHARED
    },
    BusScenario {
        name: "bus-journal",
        about: "a task on each node; the gateway is killed at any time and reads its journal, a node is reset",
        node: Scenario {
            journal: true,
            ..PLAIN
        },
        acts: &[(0, ask(0, 0, 500))],
        faults: &[BusFault::Kill, BusFault::Reset(1), BusFault::DropAnswer],
        ..SHARED
    },
    BusScenario {
        name: "bus-restart",
        about: "a task on each node; the gateway is killed at any time and restarted without a journal",
        acts: &[(0, ask(0, 1, ENDLESS))],
        faults: &[BusFault::Kill, BusFault::DropAnswer],
        ..SHARED
    },
    BusScenario {
        name: "bus-second",
        about: "a task that carries on is aborted; a second board comes to the address of its node, whose wires may be broken, and goes again",
        before: &[(0, ask(0, 1, ENDLESS))],
        acts: &[(0, abort(0, 0))],
        faults: &[BusFault::Readdress, BusFault::Replace],
        ..SHARED
    },
];
