//! The gateway's end of a link, without I/O: bytes, commands and the time come in, bytes and events
//! come out.
//!
//! One command is under way at a time. It is repeated until answered, and given up only by opening
//! a new session; a `Start` is never sent again in another one. Of a task whose `Start` was sent and
//! not answered it is unknown whether it runs, so it is never told REJECTED until the device itself
//! has said so.

mod book;
mod ends;
mod health;
mod receive;
mod send;

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ztl_core::link::{Busy, Decoder, LINK_TIMEOUT, LinkId, Loss, NO_SEQ, NO_SESSION};
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId};

pub use book::{Book, Entry, Restored, Sent};
pub use health::{LinkCounters, RoundTrips};

/// Longest time from a client's INIT to the moment after which a node refuses its `Start`.
const START_LIMIT: Duration = Duration::from_millis(1000);
/// Shortest time before a command is repeated.
const REPEAT_LEAST: Duration = Duration::from_millis(25);
/// The same while nothing is known about the line.
const REPEAT_FIRST: Duration = Duration::from_millis(100);
/// Longest decoded frame; bodies of a node are at most 1 KiB.
const FRAME: usize = 1100;
/// What counts as the line's whole turnaround when it is repeated: a multiple of the measured one.
const REPEAT_FACTOR: u32 = 2;

/// What a device told about one of its components.
#[derive(Debug, Clone, PartialEq)]
pub struct ComponentInfo {
    /// Name, as a client writes it.
    pub name: String,
    /// Smallest and greatest number it takes.
    pub range: Option<(f32, f32)>,
    /// Unit of the numbers.
    pub unit: String,
    /// Words that it takes.
    pub words: Vec<String>,
    /// What happens to a second task while one runs.
    pub busy: Busy,
    /// What it does when the link is lost.
    pub loss: Loss,
    /// Topics under which it publishes readings.
    pub topics: Vec<String>,
}

/// What a device told about itself.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceInfo {
    /// What its firmware calls it.
    pub name: String,
    /// Version of its firmware.
    pub firmware: String,
    /// Random since its last reset.
    pub boot: u32,
    /// Longest body that it takes, in bytes.
    pub max_body: usize,
    /// After how long without a new command it acts by itself.
    pub link_timeout: Duration,
    /// How many components it has.
    pub count: u8,
    /// Those that it has described.
    pub components: Vec<ComponentInfo>,
}

impl DeviceInfo {
    /// The component and the name of a topic: they are numbered one component's after the other's.
    #[must_use]
    pub fn topic(&self, number: u8) -> Option<(&str, &str)> {
        let topics = self.components.iter().flat_map(|component| {
            let topics = component.topics.iter();
            topics.map(|topic| (component.name.as_str(), topic.as_str()))
        });
        topics.into_iter().nth(usize::from(number))
    }
}

/// What becomes of tasks and of the link.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The device has started the task.
    Accepted(TaskId),
    /// The task was not started and never will be.
    Rejected(TaskId, String),
    /// Where the task is.
    Progress(TaskId, String),
    /// The task has ended.
    Ended(TaskId, State, String),
    /// The device is known and takes tasks.
    Up,
    /// Nothing has answered the greeting for the link timeout; told again as long as that is so.
    Silent,
    /// It no longer answers.
    Lost,
    /// It has forgotten everything.
    Reset,
    /// It will not talk to this gateway.
    Refused(String),
    /// A reading, under the topic of this number.
    Reading(u8, Vec<u8>),
    /// The next bytes of the firmware's log, and how many it has lost since its boot, which wraps.
    Log {
        /// Since the boot.
        lost: u32,
        /// Cut anywhere.
        bytes: Vec<u8>,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// There is no line.
    Down,
    /// A `Hello` is under way.
    Greeting,
    /// The device is asked for its components.
    Describing,
    /// Tasks can be started.
    Up,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Command {
    Hello,
    Describe(u8),
    Start(TaskId),
    Abort(LinkId),
    Ping,
}

/// The command under way.
#[derive(Debug, Clone)]
struct InFlight {
    command: Command,
    seq: u8,
    bytes: Vec<u8>,
    sent: Instant,
    repeat: Instant,
    repeated: bool,
}

#[derive(Debug, Clone)]
struct Task {
    component: String,
    goal: String,
    /// The moment after which the device refuses it.
    deadline: Instant,
    stage: Stage,
    abort: bool,
    /// From before a restart of the gateway: its client may know its id.
    restored: bool,
    /// An end that nobody is told yet, since the book could not take it.
    unwritten: Option<(State, String)>,
}

impl Task {
    fn new(component: &str, goal: &str, deadline: Instant, stage: Stage) -> Self {
        Self {
            component: component.to_owned(),
            goal: goal.to_owned(),
            deadline,
            stage,
            abort: false,
            restored: false,
            unwritten: None,
        }
    }

    fn entry(&self, id: TaskId) -> Entry<'_> {
        Entry {
            id,
            component: &self.component,
            goal: &self.goal,
            sent: self.stage.sent(),
        }
    }

    /// Not sent yet, so it can be refused.
    fn waits(&self) -> bool {
        self.stage == Stage::Waiting && self.unwritten.is_none()
    }

    /// Sent, and it has no end yet: it may run.
    fn may_run(&self) -> bool {
        self.stage != Stage::Waiting && self.unwritten.is_none()
    }

    /// It goes on without a link.
    fn carries_on(&self) -> bool {
        let loss = self.stage.sent().map(|sent| sent.loss);
        loss == Some(Loss::CarryOn)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// Not sent yet.
    Waiting,
    /// Sent: it may run.
    Sent(Sent),
    /// The device has said that it runs.
    Running(Sent),
}

impl Stage {
    fn sent(self) -> Option<Sent> {
        match self {
            Self::Waiting => None,
            Self::Sent(sent) | Self::Running(sent) => Some(sent),
        }
    }
}

/// The gateway's end of one link, which writes into a [`Book`] before it acts; `()` is none.
///
/// *Inputs*: [`handle_connected`](Self::handle_connected), [`handle_bytes`](Self::handle_bytes),
/// [`handle_disconnected`](Self::handle_disconnected), [`handle_timeout`](Self::handle_timeout).
/// *Commands*: [`restore`](Self::restore), [`start`](Self::start), [`abort`](Self::abort). *Outputs*, to be emptied after each
/// of them: [`poll_transmit`](Self::poll_transmit), [`poll_event`](Self::poll_event). *Next
/// wake-up*: [`poll_timeout`](Self::poll_timeout). Work per call is bounded by the bytes given and the
/// tasks under way.
#[derive(Debug, Clone)]
pub struct Session<B = ()> {
    book: B,
    gateway: u64,
    baud: Option<u32>,
    random: fn() -> u32,
    phase: Phase,
    /// What frames are checked under: the `Hello`'s number until there is a `Welcome`.
    session: u32,
    seq: u8,
    decoder: Decoder<FRAME>,
    out: Vec<u8>,
    in_flight: Option<InFlight>,
    /// Tasks that the device holds and nobody here knows.
    strangers: VecDeque<LinkId>,
    tasks: BTreeMap<TaskId, Task>,
    events: VecDeque<Event>,
    device: Option<DeviceInfo>,
    /// When an end that could not be written is tried again.
    write_again: Option<Instant>,
    /// The highest number of a task that the device has taken, as far as is known. The next `Start` has the one above,
    /// so that a device which another gateway takes over knows which one may still be under way.
    highest: u32,
    /// The device's clock and when it was heard: that it has passed `.0` ms is certain at `.1`.
    clock: Option<(u64, Instant)>,
    /// When the last new command was first sent.
    commanded: Instant,
    /// When the last answer to a command was heard: the device had taken that command by then.
    heard: Instant,
    /// Measured from a command to its answer.
    turnaround: Option<Duration>,
    round_trips: RoundTrips,
    counters: LinkCounters,
}

impl Session {
    /// A session that is not connected, without a book. `random` gives numbers for sessions.
    pub fn new(gateway: u64, baud: Option<u32>, random: fn() -> u32) -> Self {
        Self::with_book((), gateway, baud, random)
    }
}

impl<B: Book> Session<B> {
    /// A session that is not connected. `random` gives numbers for sessions.
    pub fn with_book(book: B, gateway: u64, baud: Option<u32>, random: fn() -> u32) -> Self {
        Self {
            book,
            gateway,
            baud,
            random,
            phase: Phase::Down,
            session: NO_SESSION,
            seq: NO_SEQ,
            decoder: Decoder::new(),
            out: Vec::new(),
            in_flight: None,
            strangers: VecDeque::new(),
            tasks: BTreeMap::new(),
            events: VecDeque::new(),
            device: None,
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

    /// The rate of the line that is opened next, where it has one.
    pub const fn set_baud(&mut self, baud: Option<u32>) {
        self.baud = baud;
    }

    /// The line is open.
    pub fn handle_connected(&mut self, now: Instant) {
        self.decoder.reset();
        // Flushes what the line made of being opened.
        self.out.clear();
        self.out.push(0);
        self.greet(now);
    }

    /// The line is gone. Tasks that may run stay as they are until the device must have acted.
    pub fn handle_disconnected(&mut self) {
        self.out.clear();
        if self.phase != Phase::Down {
            self.lose();
            self.phase = Phase::Down;
            self.in_flight = None;
        }
    }

    /// Bytes have arrived.
    pub fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        if self.phase == Phase::Down {
            return;
        }
        // The decoder is borrowed by the frame while the frame is acted on.
        let mut decoder = std::mem::take(&mut self.decoder);
        for &byte in bytes {
            let frame = match decoder.push(byte) {
                Ok(false) => continue,
                Ok(true) => decoder.frame(&[self.session, NO_SESSION]),
                Err(error) => Err(error),
            };
            self.on_frame(now, frame);
        }
        self.decoder = decoder;
    }

    /// Time has passed.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.write_ends(now);
        self.give_up_waiting(now);
        self.give_up_running(now);
        let timeout = self.link_timeout();
        if let Some(in_flight) = &mut self.in_flight {
            let wait = in_flight.sent + timeout;
            if now >= wait && in_flight.command == Command::Hello {
                // Nobody there yet: go on with the same session, in case it was only late.
                in_flight.sent = now;
                self.events.push_back(Event::Silent);
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

    /// A client wants a task. The answer comes as an event: within one second, unless the
    /// device takes the `Start` and its answer is lost.
    pub fn start(&mut self, now: Instant, id: TaskId, component: &str, goal: &str) {
        let task = Task::new(component, goal, now + START_LIMIT, Stage::Waiting);
        self.tasks.insert(id, task);
        self.next_command(now);
    }

    /// A client wants a task to stop.
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

    /// The bytes to be sent, in order.
    pub fn poll_transmit(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.out)
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let mut wake = self.write_again;
        for task in self.tasks.values() {
            let at = if task.waits() {
                Some(task.deadline)
            } else if task.may_run() && !self.answers() && !task.carries_on() {
                Some(self.must_have_acted(task))
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

    /// Where it writes.
    pub const fn book_mut(&mut self) -> &mut B {
        &mut self.book
    }

    /// What the device told about itself, once it has.
    #[must_use]
    pub fn device(&self) -> Option<&DeviceInfo> {
        self.device.as_ref()
    }

    /// What the line has brought.
    #[must_use]
    pub const fn counters(&self) -> LinkCounters {
        self.counters
    }

    /// The latest times from a command to its answer.
    #[must_use]
    pub const fn round_trips(&self) -> &RoundTrips {
        &self.round_trips
    }

    /// How many tasks wait for their `Start` to be sent.
    #[must_use]
    pub fn queued(&self) -> usize {
        self.tasks.values().filter(|task| task.waits()).count()
    }

    /// How long the device has run since its reset, as far as it has told.
    #[must_use]
    pub fn uptime(&self, now: Instant) -> Option<Duration> {
        let (clock, heard) = self.clock?;
        Some(Duration::from_millis(clock) + now.since(heard))
    }

    /// What the device does with a task when the link is lost; `None` when it has never been sent one
    /// of that id.
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

    /// Whether the session lives: then the device's own word ends its tasks.
    fn answers(&self) -> bool {
        matches!(self.phase, Phase::Describing | Phase::Up)
    }

    fn link_timeout(&self) -> Duration {
        self.device
            .as_ref()
            .map_or(LINK_TIMEOUT, |device| device.link_timeout)
    }

    fn ping_due(&self) -> Instant {
        self.commanded + self.link_timeout() / 4
    }

    /// The device is not heard: what carries on says so while it does.
    fn lose(&mut self) {
        if self.answers() {
            self.counters.lost += 1;
            self.events.push_back(Event::Lost);
        }
        let carrying: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.may_run() && task.carries_on())
            .map(|(id, _)| *id)
            .collect();
        for id in carrying {
            let text = "device is not answering".to_owned();
            self.events.push_back(Event::Progress(id, text));
        }
    }
}
