//! The state of a session.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ztl_core::link::{Decoder, LinkId};
use ztl_core::{Instant, TaskId};

use crate::device::DeviceInfo;
use crate::doubt::Doubt;
use crate::event::LinkEvent;
use crate::own::Own;
use crate::parameters::ParameterRequest;
use crate::statistics::{LinkCounters, RoundTrips};
use crate::task::Task;
use crate::update::Updates;

/// A node refuses a `Start` that arrives later than this after the client's INIT.
pub(crate) const START_LIMIT: Duration = Duration::from_millis(1000);
/// Longest decoded frame. The bodies of a node have at most 1 KiB.
pub(crate) const FRAME: usize = 1100;

/// How far the connection to the device is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// The line is closed.
    Down,
    /// `Hello` was sent and is not answered.
    Greeting,
    /// The device is describing its components.
    Describing,
    /// Tasks can be started.
    Up,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CommandKind {
    Hello,
    Describe(u8),
    /// A `Describe` beyond the last component.
    DescribePart(u8),
    Start(TaskId),
    Abort(LinkId),
    Ping,
    /// The request in [`Session::parameter_asked`].
    Parameter,
    /// The request in [`Session::updates`].
    Update,
}

/// The command that was sent and is not answered.
#[derive(Debug, Clone)]
pub(crate) struct InFlight {
    pub(crate) command: CommandKind,
    pub(crate) seq: u8,
    pub(crate) bytes: Vec<u8>,
    pub(crate) sent: Instant,
    /// When it is sent again.
    pub(crate) repeat: Instant,
    pub(crate) repeated: bool,
}

/// What a session needs of a [`Bus`](crate::bus::Bus).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BusNeeds {
    /// The device may hold tasks that have not ended.
    pub busy: bool,
    /// A `Start` or an `Abort` is to be sent.
    pub urgent: bool,
    /// How long any other command can wait.
    pub patience: Duration,
}

/// The gateway's end of one link, over many sessions: it opens a new one after each loss. It writes into a
/// [`SessionJournal`](crate::SessionJournal) before it acts; `()` keeps no journal.
///
/// *Inputs*: [`handle_connected`](Self::handle_connected), [`handle_bytes`](Self::handle_bytes),
/// [`handle_disconnected`](Self::handle_disconnected), [`handle_timeout`](Self::handle_timeout).
/// *Commands*: [`restore`](Self::restore), [`start`](Self::start),
/// [`take_up`](Self::take_up), [`abort`](Self::abort). *Outputs*, to empty after each
/// of them: [`poll_transmit`](Self::poll_transmit), [`poll_event`](Self::poll_event). *Next
/// wake-up*: [`poll_timeout`](Self::poll_timeout). Work per call is bounded by the bytes given and the
/// number of tasks.
#[derive(Debug, Clone)]
pub struct Session<J = ()> {
    pub(crate) journal: J,
    /// The address of the node.
    pub(crate) address: u8,
    pub(crate) gateway: u64,
    pub(crate) baud: Option<u32>,
    pub(crate) random: fn() -> u32,
    pub(crate) phase: Phase,
    /// The session that frames are verified under: the number of the `Hello` until the `Welcome`.
    pub(crate) session: u32,
    /// The session that has had all its commands, until the `Welcome` of the next one. Its readings and log still count.
    pub(crate) ending: u32,
    pub(crate) seq: u8,
    pub(crate) decoder: Decoder<FRAME>,
    pub(crate) out: Vec<u8>,
    pub(crate) in_flight: Option<InFlight>,
    /// Tasks that the device holds and this gateway does not know. They are aborted.
    pub(crate) strangers: VecDeque<LinkId>,
    pub(crate) tasks: BTreeMap<TaskId, Task>,
    pub(crate) own: Own,
    pub(crate) doubt: Doubt,
    pub(crate) events: VecDeque<LinkEvent>,
    pub(crate) device: Option<DeviceInfo>,
    /// The next part of the descriptions to ask for; `None` if the device has no more.
    pub(crate) next_part: Option<u8>,
    /// The request about parameters in flight, and those that wait, each with its number.
    pub(crate) parameter_asked: Option<(u64, ParameterRequest)>,
    pub(crate) parameter_requests: VecDeque<(u64, ParameterRequest)>,
    pub(crate) updates: Updates,
    /// When to retry outcomes that could not be written.
    pub(crate) write_again: Option<Instant>,
    /// The highest link id that the device is known to have started. The next `Start` uses the one above, so that a
    /// device that another gateway takes over knows which `Start` may still arrive.
    pub(crate) highest: u32,
    /// The device's clock in ms, and when it was received: by then the clock had passed this value.
    pub(crate) clock: Option<(u64, Instant)>,
    /// When the last new command was first sent.
    pub(crate) commanded: Instant,
    /// When the last answer arrived; by then the device had executed that command.
    pub(crate) heard: Instant,
    /// Mean time from a command to its answer.
    pub(crate) turnaround: Option<Duration>,
    pub(crate) round_trips: RoundTrips,
    pub(crate) counters: LinkCounters,
}
