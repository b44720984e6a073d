//! The messages of the link. One enum has both directions, so that an echo of an own frame is not mistaken for a message.
//!
//! The encoding is postcard's, and a test compares it with postcard's derive. It is implemented here because it must work
//! without serde, borrow its texts, and stay small on a node.

use super::ids::Ids;
use super::link_id::LinkId;
use super::parameter::ParameterMessage;
use super::update::UpdateMessage;
use crate::lifecycle::State;

/// Opens a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Hello {
    /// [`VERSION`](super::VERSION) of the gateway.
    pub version: u8,
    /// The new session: a random [`session_number`](super::session_number).
    pub session: u32,
    /// Identity of the gateway, which stays the same when it restarts.
    pub gateway: u64,
}

/// Answers a `Hello`: describes the node and the tasks that it holds.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Welcome<'a> {
    /// [`VERSION`](super::VERSION) of the node.
    pub version: u8,
    /// Name of the device.
    pub name: &'a str,
    /// Version of the firmware.
    pub firmware: &'a str,
    /// Number that changes with each reset, which loses all tasks.
    pub boot: u32,
    /// The session that this one replaces; 0 after a reset.
    pub replaces: u32,
    /// The node's clock, milliseconds since its boot.
    pub clock_ms: u64,
    /// How many tasks it can hold, including ended ones that are not acknowledged.
    pub capacity: u8,
    /// Longest body that it accepts, in bytes.
    pub max_body: u16,
    /// Number of components.
    pub components: u8,
    /// After how long without a new command it considers the link lost.
    pub link_timeout_ms: u32,
    /// The highest id started since boot; 0 if none. Each takeover by another gateway adds one.
    pub highest: u32,
    /// The tasks that it holds: running, or ended and not acknowledged.
    pub held: Ids<'a>,
}

/// The goals that a component accepts.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GoalShape<'a> {
    /// Smallest and largest number, if it accepts numbers.
    pub range: Option<(f32, f32)>,
    /// Unit of the numbers; empty without numbers.
    pub unit: &'a str,
    /// Words that it accepts, separated by spaces.
    pub words: &'a str,
}

/// What happens to a task that arrives while another one runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Busy {
    /// The new task is refused.
    Refuse,
    /// The new task waits. At most this many wait; any other is refused.
    Queue(u8),
    /// The running task is aborted, and the new one begins when it has stopped.
    Replace,
}

/// What a component does when no new command has arrived for the link timeout, with or without a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Loss {
    /// Stops and goes to the safe state; its tasks end as FAILED.
    Abort = 0,
    /// Goes to a safe state that keeps the position under power; its tasks end as FAILED.
    Hold = 1,
    /// Continues: finishes its tasks, or keeps its state.
    CarryOn = 2,
}

/// The description of a component.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Offer<'a> {
    /// Name, as clients write it.
    pub name: &'a str,
    /// The goals that it accepts.
    pub goal: GoalShape<'a>,
    /// What happens to a second task.
    pub busy: Busy,
    /// What happens when the link is lost.
    pub loss: Loss,
    /// Topics of its readings, separated by spaces. The topics of a device are numbered in the order of its components.
    pub topics: &'a str,
}

impl<'a> Offer<'a> {
    /// A component that refuses a second task, aborts when the link is lost, describes no goals and publishes nothing.
    #[must_use]
    pub const fn new(name: &'a str) -> Self {
        Self {
            name,
            goal: GoalShape {
                range: None,
                unit: "",
                words: "",
            },
            busy: Busy::Refuse,
            loss: Loss::Abort,
            topics: "",
        }
    }

    /// Accepts numbers from `least` to `most`.
    #[must_use]
    pub const fn with_range(mut self, least: f32, most: f32, unit: &'a str) -> Self {
        self.goal.range = Some((least, most));
        self.with_unit(unit)
    }

    /// Accepts goals in this unit.
    #[must_use]
    pub const fn with_unit(mut self, unit: &'a str) -> Self {
        self.goal.unit = unit;
        self
    }

    /// Accepts these words, separated by spaces.
    #[must_use]
    pub const fn with_words(mut self, words: &'a str) -> Self {
        self.goal.words = words;
        self
    }

    /// What happens to a second task.
    #[must_use]
    pub const fn with_busy(mut self, busy: Busy) -> Self {
        self.busy = busy;
        self
    }

    /// What happens when the link is lost.
    #[must_use]
    pub const fn with_loss(mut self, loss: Loss) -> Self {
        self.loss = loss;
        self
    }

    /// Publishes readings of these topics, separated by spaces.
    #[must_use]
    pub const fn with_topics(mut self, topics: &'a str) -> Self {
        self.topics = topics;
        self
    }
}

/// A message of the link.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Body<'a> {
    /// Gateway: opens a session.
    Hello(Hello),
    /// Gateway: asks for the description of a component.
    Describe {
        /// Index of the component; from the number of components on, a part of their descriptions.
        index: u8,
    },
    /// Gateway: starts a task.
    Start {
        /// Higher than every id started since the node's boot.
        task: LinkId,
        /// Index of the component.
        component: u8,
        /// The goal, as the client wrote it.
        goal: &'a str,
        /// The node must refuse after this time, in milliseconds of its clock.
        before_ms: u64,
    },
    /// Gateway: aborts a task.
    Abort {
        /// The task.
        task: LinkId,
    },
    /// Gateway: keeps the link alive.
    Ping,
    /// Gateway: acknowledges the outcome of a task.
    Ack {
        /// The task.
        task: LinkId,
    },
    /// Node: answers `Hello`.
    Welcome(Welcome<'a>),
    /// Node: answers `Describe`.
    Component {
        /// Index of the component.
        index: u8,
        /// The description.
        offer: Offer<'a>,
    },
    /// Node: answers `Start`; the task runs.
    Started {
        /// The task.
        task: LinkId,
    },
    /// Node: refuses a command.
    Refused {
        /// What is wrong, and what would be right.
        reason: &'a str,
    },
    /// Node: answers `Abort`; the outcome follows.
    Aborting {
        /// The task.
        task: LinkId,
    },
    /// Node: answers `Ping`.
    Pong {
        /// Its clock in milliseconds.
        clock_ms: u64,
        /// Number of tasks that it holds.
        held: u8,
    },
    /// Node: a task has ended; repeated until acknowledged.
    Ended {
        /// The task.
        task: LinkId,
        /// A final state.
        state: State,
        /// The result or reason.
        result: &'a str,
    },
    /// Node: progress of a task; may be lost.
    Progress {
        /// The task.
        task: LinkId,
        /// The component's text.
        text: &'a str,
    },
    /// Node: a reading; may be lost.
    Publish {
        /// Number of the topic.
        topic: u8,
        /// The reading.
        bytes: &'a [u8],
    },
    /// Node: part of its log; may be lost.
    Log {
        /// Bytes of the log dropped since boot because the buffer was full; wraps around.
        lost: u32,
        /// The next bytes: a stream of frames encoded by defmt, split anywhere.
        bytes: &'a [u8],
    },
    /// Node: was reset and has no session.
    Awake {
        /// [`VERSION`](super::VERSION) of the node.
        version: u8,
        /// Number that changes with each reset.
        boot: u32,
    },
    /// Node: answers `Describe` beyond the last component.
    Description {
        /// The index in the `Describe`.
        index: u8,
        /// Index of the component that it describes.
        component: u8,
        /// The next bytes of its description, at most [`DESCRIPTION_PART`](super::DESCRIPTION_PART).
        bytes: &'a [u8],
    },
    /// Node: has started a task itself; repeated until noted.
    Begun {
        /// The task, a [local](LinkId::is_local) one.
        task: LinkId,
        /// Index of the component.
        component: u8,
        /// The goal.
        goal: &'a str,
    },
    /// Gateway: has taken up a task that the node has started itself.
    Noted {
        /// The task.
        task: LinkId,
    },
    /// Node: something happened; repeated until acknowledged.
    Event {
        /// Increases with each event since the node's boot.
        number: u32,
        /// What happened.
        text: &'a str,
    },
    /// Gateway: has received an event.
    EventAck {
        /// Number of the event.
        number: u32,
    },
    /// Either: about parameters.
    Parameter(ParameterMessage<'a>),
    /// Either: about firmware updates.
    Update(UpdateMessage<'a>),
}

/// A message of a gateway, as a node parses it: like [`Body`], but the goal is not validated.
///
/// A node validates the goal itself, because `core`'s validation takes 560 bytes on a Cortex-M0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum LinkCommand<'a> {
    /// [`Body::Hello`].
    Hello(Hello),
    /// [`Body::Describe`].
    Describe {
        /// Index of the component.
        index: u8,
    },
    /// [`Body::Start`].
    Start {
        /// Higher than every id started since the node's boot.
        task: LinkId,
        /// Index of the component.
        component: u8,
        /// The goal, which must be UTF-8.
        goal: &'a [u8],
        /// The node must refuse after this time, in milliseconds of its clock.
        before_ms: u64,
    },
    /// [`Body::Abort`].
    Abort {
        /// The task.
        task: LinkId,
    },
    /// [`Body::Ping`].
    Ping,
    /// [`Body::Ack`].
    Ack {
        /// The task.
        task: LinkId,
    },
}

/// The answers of a gateway about tasks and events of a node itself. Not a [`LinkCommand`], so that a node without them has
/// no code for these answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum OwnAnswer {
    /// [`Body::Noted`].
    Noted {
        /// The task.
        task: LinkId,
    },
    /// [`Body::EventAck`].
    EventAck {
        /// Number of the event.
        number: u32,
    },
}
