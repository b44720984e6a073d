//! The messages of the link, in postcard's wire format: one enum for both directions, so that an
//! echo of one's own frame is no message for oneself.
//!
//! The format is postcard's (its derive is compared with this code in a test); it is written by hand
//! because it must work without serde, borrow its texts, and stay small on a node.

use super::ids::Ids;
use super::link_id::LinkId;
use crate::lifecycle::State;

/// Opens a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Hello {
    /// [`VERSION`](super::VERSION) of the gateway.
    pub version: u8,
    /// The new session: random, a [`session_number`](super::session_number).
    pub session: u32,
    /// Who the gateway is, so that a restarted one is known again.
    pub gateway: u64,
}

/// Answers a `Hello`: who the node is, and what it still holds.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Welcome<'a> {
    /// [`VERSION`](super::VERSION) of the node.
    pub version: u8,
    /// What the firmware calls its device.
    pub name: &'a str,
    /// The firmware's version.
    pub firmware: &'a str,
    /// Random since the last reset; another one means that everything was forgotten.
    pub boot: u32,
    /// The session this one replaces, 0 after a reset.
    pub replaces: u32,
    /// The node's clock, milliseconds since its boot.
    pub clock_ms: u64,
    /// How many tasks it can hold, unacknowledged ends included.
    pub capacity: u8,
    /// Longest body it can take, in bytes.
    pub max_body: u16,
    /// How many components it has.
    pub components: u8,
    /// After how long without a new command it acts by itself.
    pub link_timeout_ms: u32,
    /// The highest id started since boot, 0 when none. Each takeover by another gateway adds one.
    pub highest: u32,
    /// The tasks it holds: running, or ended and not acknowledged.
    pub held: Ids<'a>,
}

/// What goals a component takes.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GoalShape<'a> {
    /// Smallest and greatest number, when it takes numbers.
    pub range: Option<(f32, f32)>,
    /// Unit of the numbers; empty when it takes none.
    pub unit: &'a str,
    /// Words that it takes, separated by blanks; empty when none.
    pub words: &'a str,
}

/// What happens to a task that comes while one runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Busy {
    /// It is refused.
    Refuse,
    /// It waits for its turn, behind at most this many; one more is refused.
    Queue(u8),
    /// It takes the place of the one that runs, which is aborted, and begins when that has stopped.
    Replace,
}

/// What a component does when the link has brought no new command for the link timeout, with or without a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Loss {
    /// Stop and go to the safe state; a task ends as FAILED.
    Abort = 0,
    /// Go to a safe state that keeps the position under power; a task ends as FAILED.
    Hold = 1,
    /// Go on: finish the task, or stay as it is.
    CarryOn = 2,
}

/// What a node tells of one of its components.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Offer<'a> {
    /// Name, as a client writes it.
    pub name: &'a str,
    /// Goals that it takes.
    pub goal: GoalShape<'a>,
    /// What happens to a second task.
    pub busy: Busy,
    /// What happens when the link is lost.
    pub loss: Loss,
    /// Names of the topics under which it publishes readings, separated by blanks; empty when none.
    /// A device's topics are numbered in this order, one component's after the other's.
    pub topics: &'a str,
}

/// A message of the link.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Body<'a> {
    /// Gateway: opens a session.
    Hello(Hello),
    /// Gateway: asks for the component of this number.
    Describe {
        /// From 0.
        index: u8,
    },
    /// Gateway: starts a task.
    Start {
        /// Above every id started since the node's boot.
        task: LinkId,
        /// Number of the component.
        component: u8,
        /// The goal as the client wrote it.
        goal: &'a str,
        /// The node's clock, in milliseconds, after which it must refuse.
        before_ms: u64,
    },
    /// Gateway: stops a task.
    Abort {
        /// Which.
        task: LinkId,
    },
    /// Gateway: nothing new, only to be heard.
    Ping,
    /// Gateway: the end of this task is known, it need not be repeated.
    Ack {
        /// Which.
        task: LinkId,
    },
    /// Node: answers `Hello`.
    Welcome(Welcome<'a>),
    /// Node: answers `Describe`.
    Component {
        /// Its number.
        index: u8,
        /// What it is.
        offer: Offer<'a>,
    },
    /// Node: answers `Start`; the task runs.
    Started {
        /// Which.
        task: LinkId,
    },
    /// Node: answers any command that it does not follow.
    Refused {
        /// What was wrong, and what would be right.
        reason: &'a str,
    },
    /// Node: answers `Abort`; the end will be told.
    Aborting {
        /// Which.
        task: LinkId,
    },
    /// Node: answers `Ping`.
    Pong {
        /// Its clock in milliseconds.
        clock_ms: u64,
        /// How many tasks it holds.
        held: u8,
    },
    /// Node: a task has ended; repeated until acknowledged.
    Ended {
        /// Which.
        task: LinkId,
        /// A final state.
        state: State,
        /// What came of it.
        result: &'a str,
    },
    /// Node: where a task is; may be lost.
    Progress {
        /// Which.
        task: LinkId,
        /// The component's text.
        text: &'a str,
    },
    /// Node: a reading; may be lost.
    Publish {
        /// Its number.
        topic: u8,
        /// The reading.
        bytes: &'a [u8],
    },
    /// Node: part of its log; may be lost.
    Log {
        /// Bytes of the log that did not fit the node's memory since its boot; wraps.
        lost: u32,
        /// The next ones: a stream of frames encoded by defmt, cut anywhere.
        bytes: &'a [u8],
    },
    /// Node: it has started and knows no session.
    Awake {
        /// [`VERSION`](super::VERSION) of the node.
        version: u8,
        /// Random since the last reset.
        boot: u32,
    },
}

/// What a gateway says, as a node reads it: a [`Body`] whose goal is not looked at yet.
///
/// A node looks at it with less than `core` does, which takes 560 bytes of a Cortex-M0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Command<'a> {
    /// [`Body::Hello`].
    Hello(Hello),
    /// [`Body::Describe`].
    Describe {
        /// From 0.
        index: u8,
    },
    /// [`Body::Start`].
    Start {
        /// Above every id started since the node's boot.
        task: LinkId,
        /// Number of the component.
        component: u8,
        /// The goal, which must be UTF-8.
        goal: &'a [u8],
        /// The node's clock, in milliseconds, after which it must refuse.
        before_ms: u64,
    },
    /// [`Body::Abort`].
    Abort {
        /// Which.
        task: LinkId,
    },
    /// [`Body::Ping`].
    Ping,
    /// [`Body::Ack`].
    Ack {
        /// Which.
        task: LinkId,
    },
}
