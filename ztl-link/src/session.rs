//! The gateway's end of a link, without I/O: bytes, commands and the time go in; bytes and events come out. A
//! [`Session`] outlives the sessions of the link, each of which lasts from one `Hello` to the next.
//!
//! One command is in flight at a time. It is repeated until it is answered; only a new session gives it up. A
//! `Start` is never sent again in another session. While a `Start` is unanswered, the task may run, so it is
//! reported as REJECTED only if the device itself says so.

mod doubt;
mod outcome;
mod own;
mod parameters;
mod receive;
mod send;
mod updates;

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Decoder, LINK_TIMEOUT, LONGEST_FRAME, LinkId, Loss, NO_SEQ, NO_SESSION,
};
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId};

use crate::device::DeviceInfo;
use crate::event::LinkEvent;
use crate::journal::SessionJournal;
use crate::parameters::ParameterRequest;
use crate::statistics::{LinkCounters, RoundTrips};
use crate::task::{Stage, Task};
use doubt::Doubt;
pub use own::BegunTask;
use own::Own;
use updates::Updates;

/// A node refuses a `Start` that arrives later than this after the client's INIT.
pub(crate) const START_LIMIT: Duration = Duration::from_millis(1000);
pub(crate) const FRAME: usize = LONGEST_FRAME;

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
    /// A question for a part that was lost with its session, and whether such a part was asked for again in this boot.
    pub(crate) lost_part: Option<u8>,
    pub(crate) asked_again: bool,
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

impl Session {
    /// A session that is not connected and has no journal. `random` returns numbers for sessions.
    pub fn new(gateway: u64, baud: Option<u32>, random: fn() -> u32) -> Self {
        Self::with_journal((), gateway, baud, random)
    }
}

impl<J: SessionJournal> Session<J> {
    /// A session that is not connected. `random` returns numbers for sessions.
    pub fn with_journal(journal: J, gateway: u64, baud: Option<u32>, random: fn() -> u32) -> Self {
        Self {
            own: Own::new(journal.latest_own()),
            journal,
            address: ADDR_ONLY_NODE,
            gateway,
            baud,
            random,
            phase: Phase::Down,
            session: NO_SESSION,
            ending: NO_SESSION,
            seq: NO_SEQ,
            decoder: Decoder::new(),
            out: Vec::new(),
            in_flight: None,
            strangers: VecDeque::new(),
            doubt: Doubt::default(),
            tasks: BTreeMap::new(),
            events: VecDeque::new(),
            device: None,
            next_part: None,
            lost_part: None,
            asked_again: false,
            parameter_asked: None,
            parameter_requests: VecDeque::new(),
            updates: Updates::default(),
            write_again: None,
            highest: 0,
            clock: None,
            commanded: Instant::ZERO,
            heard: Instant::ZERO,
            turnaround: None,
            round_trips: RoundTrips::default(),
            counters: LinkCounters::default(),
        }
    }

    /// The node's address on a [`Bus`](crate::bus::Bus).
    #[must_use]
    pub fn with_address(mut self, address: u8) -> Self {
        self.address = address;
        self
    }

    /// Sets the node's address for the line that is opened next.
    pub const fn set_address(&mut self, address: u8) {
        self.address = address;
    }

    /// What the session needs of a [`Bus`](crate::bus::Bus) now.
    #[must_use]
    pub fn bus_needs(&self) -> BusNeeds {
        let mut tasks = self.tasks.values().filter(|task| !self.is_astray(task));
        BusNeeds {
            busy: self.tasks.values().any(Task::may_run),
            urgent: !self.strangers.is_empty()
                || tasks.any(|task| task.waits() || task.abort && task.may_run()),
            patience: self.link_timeout() * 3 / 10,
        }
    }

    /// Sets the baud rate of the line that is opened next, if it has one.
    pub const fn set_baud(&mut self, baud: Option<u32>) {
        self.baud = baud;
    }

    /// Starts a session on a line that was just opened.
    pub fn handle_connected(&mut self, now: Instant) {
        self.decoder.reset();
        // A delimiter ends any noise that opening the line caused.
        self.out.clear();
        self.out.push(0);
        self.greet(now);
    }

    /// Handles the loss of the line. Tasks that may run keep their state until the device must have ended them.
    pub fn handle_disconnected(&mut self) {
        self.out.clear();
        if self.phase != Phase::Down {
            self.lose();
            self.phase = Phase::Down;
            self.in_flight = None;
        }
    }

    /// Handles received bytes.
    pub fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        if self.phase == Phase::Down {
            return;
        }
        // The frame borrows the decoder while it is handled.
        let mut decoder = std::mem::take(&mut self.decoder);
        for &byte in bytes {
            let frame = match decoder.push(byte) {
                Ok(false) => continue,
                Ok(true) => decoder.frame(&[self.session, NO_SESSION, self.ending]),
                Err(error) => Err(error),
            };
            self.on_frame(now, frame);
        }
        self.decoder = decoder;
    }

    /// Repeats commands, sends pings, and ends what has timed out.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.retry_outcomes(now);
        self.reject_late(now);
        self.fail_unreachable(now);
        self.ask_about_own(now);
        let timeout = self.link_timeout();
        if let Some(in_flight) = &mut self.in_flight {
            let wait = in_flight.sent + timeout;
            if now >= wait && in_flight.command == CommandKind::Hello {
                // Keep the session, in case the answer is only late.
                in_flight.sent = now;
                if self.ending != NO_SESSION {
                    self.lose();
                }
                self.events.push_back(LinkEvent::Silent);
            } else if now >= wait {
                self.lose();
                self.greet(now);
                return;
            }
        }
        let pause = self.repeat_pause();
        if let Some(in_flight) = &mut self.in_flight
            && now >= in_flight.repeat
        {
            self.out.extend_from_slice(&in_flight.bytes);
            in_flight.repeat = now + pause;
            in_flight.repeated = true;
            self.counters.repeats += 1;
        }
        self.next_command(now);
    }

    /// Starts a task for a client. The decision arrives as an event within one second, unless the device executes
    /// the `Start` and its answer is lost; then it arrives with the next session, or the task ends as FAILED.
    pub fn start(&mut self, now: Instant, id: TaskId, component: &str, goal: &str) {
        let task = Task::new(component, goal, now + START_LIMIT, Stage::Waiting);
        self.tasks.insert(id, task);
        self.next_command(now);
    }

    /// Aborts a task for a client.
    pub fn abort(&mut self, now: Instant, id: TaskId) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        if task.waits() {
            self.end(now, id, State::Aborted, "aborted before it began");
        } else if task.may_run() {
            task.abort = true;
            self.next_command(now);
        }
    }

    /// Asks the device for an answer now, if it is not asked anything.
    pub fn ping(&mut self, now: Instant) {
        if self.in_flight.is_none() && self.phase == Phase::Up {
            self.command(now, CommandKind::Ping, Body::Ping);
        }
    }

    /// Takes the bytes to send.
    pub fn poll_transmit(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.out)
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<LinkEvent> {
        self.events.pop_front()
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    pub fn poll_timeout(&self) -> Option<Instant> {
        let mut wake = self.write_again;
        for task in self.tasks.values() {
            let at = if task.waits() {
                Some(task.deadline)
            } else if task.may_run() && !self.answers() && !task.carries_on() {
                Some(self.must_have_acted(task))
            } else if task.waits_for_word() && self.answers() && !self.is_astray(task) {
                Some(task.ask_at)
            } else {
                None
            };
            wake = earliest(wake, at);
        }
        match &self.in_flight {
            Some(in_flight) => {
                let give_up = in_flight.sent + self.link_timeout();
                earliest(wake, Some(in_flight.repeat.min(give_up)))
            }
            None if self.phase == Phase::Up => earliest(wake, Some(self.ping_due())),
            None => wake,
        }
    }

    /// The journal.
    pub const fn journal_mut(&mut self) -> &mut J {
        &mut self.journal
    }

    /// The device, once it has described itself.
    #[must_use]
    pub fn device(&self) -> Option<&DeviceInfo> {
        self.device.as_ref()
    }

    /// Statistics of the line.
    #[must_use]
    pub const fn counters(&self) -> LinkCounters {
        self.counters
    }

    /// The latest times from a command to its answer.
    #[must_use]
    pub const fn round_trips(&self) -> &RoundTrips {
        &self.round_trips
    }

    /// When the device answered a command, or opened the session, last.
    #[must_use]
    pub const fn heard(&self) -> Instant {
        self.heard
    }

    /// Number of tasks whose `Start` was not sent yet.
    #[must_use]
    pub fn queued(&self) -> usize {
        self.tasks.values().filter(|task| task.waits()).count()
    }

    /// Time since the last reset of the device, if known.
    #[must_use]
    pub fn uptime(&self, now: Instant) -> Option<Duration> {
        let (clock, heard) = self.clock?;
        Some(Duration::from_millis(clock) + now.since(heard))
    }

    /// What the device does with a task when the link is lost; `None` if no such task was sent.
    #[must_use]
    pub fn policy(&self, id: TaskId) -> Option<Loss> {
        let sent = self.tasks.get(&id)?.stage.sent();
        sent.map(|sent| sent.loss)
    }

    /// Whether the device takes tasks now.
    #[must_use]
    pub fn is_up(&self) -> bool {
        self.phase == Phase::Up
    }

    /// Whether the session is alive. Then only the device decides how its tasks end.
    pub(crate) fn answers(&self) -> bool {
        matches!(self.phase, Phase::Describing | Phase::Up)
    }

    pub(crate) fn link_timeout(&self) -> Duration {
        self.device
            .as_ref()
            .map_or(LINK_TIMEOUT, |device| device.link_timeout)
    }

    pub(crate) fn ping_due(&self) -> Instant {
        // A bus has less room for pings.
        let eighths = if self.address == ADDR_ONLY_NODE { 2 } else { 3 };
        self.commanded + self.link_timeout() * eighths / 8
    }

    /// Handles the loss of the link, and reports it as the progress of tasks that carry on.
    pub(crate) fn lose(&mut self) {
        // Also if the full session is lost before the one that follows it has begun.
        let ending = std::mem::replace(&mut self.ending, NO_SESSION);
        if self.answers() || ending != NO_SESSION {
            self.counters.lost += 1;
            self.events.push_back(LinkEvent::Lost);
        }
        self.fail_parameter_requests();
        self.fail_update_requests();
        let carrying: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.may_run() && task.carries_on())
            .map(|(id, _)| *id)
            .collect();
        for id in carrying {
            let text = "device is not answering".to_owned();
            self.events.push_back(LinkEvent::Progress(id, text));
        }
    }
}
