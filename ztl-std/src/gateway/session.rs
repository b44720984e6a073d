//! The gateway's end of a link, without I/O: bytes, commands and the time come in, bytes and events
//! come out.
//!
//! One command is under way at a time. It is repeated until answered, and given up only by opening
//! a new session; a `Start` is never sent again in another one. Of a task whose `Start` was sent and
//! not answered it is unknown whether it runs, so it is never told REJECTED until the device itself
//! has said so.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Decoder, Frame, FrameError, Hello, LINK_TIMEOUT, LinkId, Loss, NO_SEQ,
    NO_SESSION, VERSION, Welcome, encode, next_seq, session_key,
};
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId};

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
    /// What it does when the link is lost.
    pub loss: Loss,
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
    /// It no longer answers.
    Lost,
    /// It has forgotten everything.
    Reset,
    /// It will not talk to this gateway.
    Refused(String),
}

/// What the line has brought.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkCounters {
    /// Frames whose check was right.
    pub frames: u64,
    /// Frames dropped.
    pub errors: u64,
    /// Commands sent again.
    pub repeats: u64,
    /// Sessions opened.
    pub sessions: u64,
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
#[derive(Debug)]
struct InFlight {
    command: Command,
    seq: u8,
    bytes: Vec<u8>,
    sent: Instant,
    repeat: Instant,
    repeated: bool,
}

#[derive(Debug)]
struct Task {
    component: String,
    goal: String,
    /// The moment after which the device refuses it.
    deadline: Instant,
    stage: Stage,
    abort: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// Not sent yet, so it can be refused.
    Waiting,
    /// Sent under this id: it may run.
    Sent(LinkId),
    /// The device has said that it runs.
    Running(LinkId),
}

impl Stage {
    fn link(self) -> Option<LinkId> {
        match self {
            Self::Waiting => None,
            Self::Sent(link) | Self::Running(link) => Some(link),
        }
    }
}

/// The gateway's end of one link.
///
/// *Inputs*: [`handle_connected`](Self::handle_connected), [`handle_bytes`](Self::handle_bytes),
/// [`handle_disconnected`](Self::handle_disconnected), [`handle_timeout`](Self::handle_timeout).
/// *Commands*: [`start`](Self::start), [`abort`](Self::abort). *Outputs*, to be emptied after each
/// of them: [`poll_transmit`](Self::poll_transmit), [`poll_event`](Self::poll_event). *Next
/// wake-up*: [`poll_timeout`](Self::poll_timeout). Work per call is bounded by the bytes given and the
/// tasks under way.
#[derive(Debug)]
pub struct Session {
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
    next_link: u32,
    /// The device's clock and when it was heard: that it has passed `.0` ms is certain at `.1`.
    clock: Option<(u64, Instant)>,
    /// When the last new command was first sent: the device's link timer was restarted then at the
    /// latest by the one before.
    commanded: Instant,
    /// Measured from a command to its answer.
    turnaround: Option<Duration>,
    counters: LinkCounters,
}

impl Session {
    /// A session that is not connected. `random` gives numbers other than 0, for sessions.
    pub fn new(gateway: u64, baud: Option<u32>, random: fn() -> u32) -> Self {
        Self {
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
            next_link: 1,
            clock: None,
            commanded: Instant::ZERO,
            turnaround: None,
            counters: LinkCounters::default(),
        }
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
        self.give_up_waiting(now);
        self.give_up_running(now);
        let timeout = self.link_timeout();
        if let Some(in_flight) = &mut self.in_flight {
            let wait = in_flight.sent + timeout;
            if now >= wait && in_flight.command == Command::Hello {
                // Nobody there yet: go on with the same session, in case it was only late.
                in_flight.sent = now;
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

    /// A client wants a task. The answer comes as an event: within [`START_LIMIT`], unless the
    /// device takes the `Start` and its answer is lost.
    pub fn start(&mut self, now: Instant, id: TaskId, component: &str, goal: &str) {
        let task = Task {
            component: component.to_owned(),
            goal: goal.to_owned(),
            deadline: now + START_LIMIT,
            stage: Stage::Waiting,
            abort: false,
        };
        self.tasks.insert(id, task);
        self.next_command(now);
    }

    /// A client wants a task to stop.
    pub fn abort(&mut self, now: Instant, id: TaskId) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        if task.stage == Stage::Waiting {
            self.tasks.remove(&id);
            let text = "aborted before it began".to_owned();
            self.events
                .push_back(Event::Ended(id, State::Aborted, text));
            return;
        }
        task.abort = true;
        self.next_command(now);
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
        let mut wake = None;
        for task in self.tasks.values() {
            let at = match task.stage {
                Stage::Waiting => Some(task.deadline),
                Stage::Sent(_) | Stage::Running(_) if self.answers() => None,
                _ if self.carries_on(task) => None,
                _ => Some(self.must_have_acted(task)),
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

    fn carries_on(&self, task: &Task) -> bool {
        let device = self.device.as_ref();
        let component =
            device.and_then(|device| device.components.iter().find(|c| c.name == task.component));
        component.is_some_and(|component| component.loss == Loss::CarryOn)
    }

    /// When a device that is not heard has brought the task to its end by itself.
    ///
    /// Its link timer was restarted at the latest by the last new command; that one came, if at
    /// all, within one link timeout of the one before, or the timer had fired. A `Start` is taken
    /// at the latest at its deadline.
    fn must_have_acted(&self, task: &Task) -> Instant {
        let timeout = self.link_timeout();
        (self.commanded + timeout * 2).max(task.deadline + timeout)
    }

    /// Refuses what was never sent and has become too late.
    fn give_up_waiting(&mut self, now: Instant) {
        let late: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.stage == Stage::Waiting && now >= task.deadline)
            .map(|(id, _)| *id)
            .collect();
        for id in late {
            self.tasks.remove(&id);
            let reason = if self.phase == Phase::Up {
                "the device is busy with other commands"
            } else {
                "the device is not answering"
            };
            self.events
                .push_back(Event::Rejected(id, reason.to_owned()));
        }
    }

    /// Ends what a device that is not heard must have ended by itself.
    fn give_up_running(&mut self, now: Instant) {
        if self.answers() {
            return;
        }
        let over: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.stage != Stage::Waiting && !self.carries_on(task))
            .filter(|(_, task)| now >= self.must_have_acted(task))
            .map(|(id, _)| *id)
            .collect();
        for id in over {
            self.end(id, State::Failed, "device is not answering");
        }
    }

    fn end(&mut self, id: TaskId, state: State, text: &str) {
        if let Some(task) = self.tasks.remove(&id) {
            if matches!(task.stage, Stage::Sent(_)) {
                self.events.push_back(Event::Accepted(id));
            }
            self.events
                .push_back(Event::Ended(id, state, text.to_owned()));
        }
    }

    /// The device is not heard: what carries on says so while it does.
    fn lose(&mut self) {
        if self.answers() {
            self.events.push_back(Event::Lost);
        }
        let carrying: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.stage != Stage::Waiting && self.carries_on(task))
            .map(|(id, _)| *id)
            .collect();
        for id in carrying {
            let text = "device is not answering".to_owned();
            self.events.push_back(Event::Progress(id, text));
        }
    }

    /// Opens a new session.
    fn greet(&mut self, now: Instant) {
        self.phase = Phase::Greeting;
        self.session = (self.random)();
        self.seq = NO_SEQ;
        self.strangers.clear();
        self.counters.sessions += 1;
        let hello = Body::Hello(Hello {
            version: VERSION,
            session: self.session,
            gateway: self.gateway,
        });
        let bytes = frame_bytes(NO_SESSION, NO_SEQ, hello);
        self.send(now, Command::Hello, NO_SEQ, bytes);
    }

    fn send(&mut self, now: Instant, command: Command, seq: u8, bytes: Vec<u8>) {
        self.out.extend_from_slice(&bytes);
        self.in_flight = Some(InFlight {
            command,
            seq,
            bytes,
            sent: now,
            repeat: now + self.repeat_pause(),
            repeated: false,
        });
    }

    fn command(&mut self, now: Instant, command: Command, body: Body<'_>) {
        self.seq = next_seq(self.seq);
        self.commanded = now;
        let bytes = frame_bytes(self.session, self.seq, body);
        self.send(now, command, self.seq, bytes);
    }

    fn repeat_pause(&self) -> Duration {
        let measured = self
            .turnaround
            .map_or(REPEAT_FIRST, |time| time * REPEAT_FACTOR);
        // A slow line is busy with the command for this long: 10 bits a byte, both ways.
        let line = self.baud.map_or(Duration::ZERO, |baud| {
            Duration::from_micros(640_000_000 / u64::from(baud.max(1)))
        });
        measured.max(line).max(REPEAT_LEAST)
    }

    /// Sends the most urgent command, when none is under way: aborts before starts.
    fn next_command(&mut self, now: Instant) {
        if self.in_flight.is_some() || self.phase != Phase::Up {
            return;
        }
        if let Some(link) = self.next_abort() {
            return self.command(now, Command::Abort(link), Body::Abort { task: link });
        }
        while let Some(id) = self.next_waiting() {
            if self.send_start(now, id) {
                return;
            }
        }
        if now >= self.ping_due() {
            self.command(now, Command::Ping, Body::Ping);
        }
    }

    /// An abort stays wanted until it is answered, so a new session sends it again.
    fn next_abort(&mut self) -> Option<LinkId> {
        let wanted = self.tasks.values().find(|task| task.abort);
        match wanted.and_then(|task| task.stage.link()) {
            Some(link) => Some(link),
            None => self.strangers.pop_front(),
        }
    }

    fn next_waiting(&self) -> Option<TaskId> {
        let waiting = |task: &Task| task.stage == Stage::Waiting;
        self.tasks
            .iter()
            .find(|(_, task)| waiting(task))
            .map(|(id, _)| *id)
    }

    /// Sends a `Start`, or refuses the task; says whether a command is under way now.
    fn send_start(&mut self, now: Instant, id: TaskId) -> bool {
        let (Some(task), Some(device)) = (self.tasks.get_mut(&id), &self.device) else {
            return false;
        };
        let place = device
            .components
            .iter()
            .position(|component| component.name == task.component);
        let Some((Ok(component), (clock, heard))) = place.map(u8::try_from).zip(self.clock) else {
            let names: Vec<&str> = device.components.iter().map(|c| c.name.as_str()).collect();
            let reason = format!(
                "no component '{}'; it has: {}",
                task.component,
                names.join(", ")
            );
            self.reject(id, reason);
            return false;
        };
        let left = task.deadline.since(heard).as_millis();
        let link = LinkId(self.next_link);
        let goal = task.goal.clone();
        let body = Body::Start {
            task: link,
            component,
            goal: &goal,
            before_ms: clock.saturating_add(u64::try_from(left).unwrap_or(u64::MAX)),
        };
        let mut len = 0;
        body.put(&mut |bytes: &[u8]| len += bytes.len());
        if len > device.max_body {
            let most = goal.len().saturating_sub(len - device.max_body);
            let reason = format!(
                "the goal is {} bytes long, the device takes {most}",
                goal.len()
            );
            self.reject(id, reason);
            return false;
        }
        task.stage = Stage::Sent(link);
        self.next_link = self.next_link.saturating_add(1);
        self.command(now, Command::Start(id), body);
        true
    }

    fn reject(&mut self, id: TaskId, reason: String) {
        self.tasks.remove(&id);
        self.events.push_back(Event::Rejected(id, reason));
    }

    fn on_frame(&mut self, now: Instant, frame: Result<(usize, Frame<'_>), FrameError>) {
        let Ok((place, frame)) = frame else {
            self.counters.errors += 1;
            return;
        };
        self.counters.frames += 1;
        match (place, frame.seq, frame.body) {
            (1, NO_SEQ, Body::Awake { boot, .. }) => self.on_awake(now, boot),
            (0, NO_SEQ, Body::Welcome(welcome)) => self.on_welcome(now, &welcome),
            (0, NO_SEQ, Body::Refused { reason }) if self.phase == Phase::Greeting => {
                self.events.push_back(Event::Refused(reason.to_owned()));
            }
            (
                0,
                NO_SEQ,
                Body::Ended {
                    task,
                    state,
                    result,
                },
            ) => {
                // The frame's check covers the session, so it speaks of this device's tasks.
                if let Some(id) = self.find(task) {
                    self.end(id, state, result);
                }
                let ack = frame_bytes(self.session, NO_SEQ, Body::Ack { task });
                self.out.extend_from_slice(&ack);
            }
            (0, NO_SEQ, Body::Progress { task, text }) => {
                if let Some(id) = self.find(task) {
                    self.events.push_back(Event::Progress(id, text.to_owned()));
                }
            }
            (0, seq, body) if seq != NO_SEQ => self.on_answer(now, seq, &body),
            // Echoes of one's own frames, readings nobody asked for yet.
            _ => {}
        }
    }

    fn find(&self, link: LinkId) -> Option<TaskId> {
        self.tasks
            .iter()
            .find(|(_, task)| task.stage.link() == Some(link))
            .map(|(id, _)| *id)
    }

    /// A device has started anew: greet it at once.
    fn on_awake(&mut self, now: Instant, boot: u32) {
        let known = self.device.as_ref().map(|device| device.boot);
        match self.phase {
            Phase::Greeting => {
                let pause = self.repeat_pause();
                if let Some(in_flight) = &mut self.in_flight {
                    self.out.extend_from_slice(&in_flight.bytes);
                    in_flight.repeat = now + pause;
                }
            }
            // A late announcement of the boot that is greeted already changes nothing.
            Phase::Describing | Phase::Up if known != Some(boot) => {
                self.lose();
                self.greet(now);
            }
            _ => {}
        }
    }

    fn on_welcome(&mut self, now: Instant, welcome: &Welcome<'_>) {
        if self.phase != Phase::Greeting {
            return;
        }
        if welcome.version != VERSION {
            let reason = format!("it speaks version {} of the link", welcome.version);
            self.events.push_back(Event::Refused(reason));
            return;
        }
        self.session = session_key(self.session, welcome.boot);
        self.clock = Some((welcome.clock_ms, now));
        self.next_link = self.next_link.max(welcome.highest.saturating_add(1));
        let known = self
            .device
            .take()
            .filter(|device| device.boot == welcome.boot);
        if known.is_none() {
            self.on_reset();
        }
        let components = known.map(|device| device.components).unwrap_or_default();
        self.device = Some(DeviceInfo {
            name: welcome.name.to_owned(),
            firmware: welcome.firmware.to_owned(),
            boot: welcome.boot,
            max_body: usize::from(welcome.max_body),
            link_timeout: Duration::from_millis(u64::from(welcome.link_timeout_ms)),
            count: welcome.components,
            components,
        });
        self.compare_held(welcome);
        self.in_flight = None;
        self.phase = Phase::Describing;
        // The first command starts the device's link timer anew.
        self.describe_next(now);
    }

    /// Another boot: what the device held is gone.
    fn on_reset(&mut self) {
        let held: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.stage != Stage::Waiting)
            .map(|(id, _)| *id)
            .collect();
        if !held.is_empty() {
            self.events.push_back(Event::Reset);
        }
        for id in held {
            self.end(id, State::Failed, "device was reset");
        }
    }

    /// What the device holds against what is known here.
    fn compare_held(&mut self, welcome: &Welcome<'_>) {
        let held: Vec<LinkId> = welcome.held.iter().collect();
        let ours: Vec<(TaskId, Stage)> = self
            .tasks
            .iter()
            .map(|(id, task)| (*id, task.stage))
            .collect();
        for (id, stage) in ours {
            match stage {
                Stage::Waiting => {}
                Stage::Sent(link) if held.contains(&link) => self.on_started(id),
                // Sent in a session that is over, and never taken: now it never will be.
                Stage::Sent(link) if link.0 > welcome.highest => {
                    let reason = "the device did not take it before the link was lost";
                    self.reject(id, reason.to_owned());
                }
                Stage::Running(link) if held.contains(&link) => {}
                Stage::Sent(_) | Stage::Running(_) => {
                    self.end(id, State::Failed, "the device no longer holds the task");
                }
            }
        }
        self.strangers = held
            .into_iter()
            .filter(|link| self.find(*link).is_none())
            .collect();
    }

    fn on_started(&mut self, id: TaskId) {
        if let Some(task) = self.tasks.get_mut(&id)
            && let Stage::Sent(link) = task.stage
        {
            task.stage = Stage::Running(link);
            self.events.push_back(Event::Accepted(id));
        }
    }

    fn describe_next(&mut self, now: Instant) {
        let Some(device) = &self.device else { return };
        match u8::try_from(device.components.len()) {
            Ok(index) if index < device.count => {
                self.command(now, Command::Describe(index), Body::Describe { index });
            }
            _ => {
                self.phase = Phase::Up;
                self.events.push_back(Event::Up);
                self.command(now, Command::Ping, Body::Ping);
            }
        }
    }

    fn on_answer(&mut self, now: Instant, seq: u8, body: &Body<'_>) {
        let Some(in_flight) = self.in_flight.take_if(|in_flight| in_flight.seq == seq) else {
            return;
        };
        if !in_flight.repeated {
            let measured = now.since(in_flight.sent);
            // A running mean over some eight answers.
            self.turnaround = Some(
                self.turnaround
                    .map_or(measured, |mean| (mean * 7 + measured) / 8),
            );
        }
        match (in_flight.command, *body) {
            (Command::Describe(asked), Body::Component { index, offer }) if asked == index => {
                if let Some(device) = &mut self.device {
                    device.components.push(ComponentInfo {
                        name: offer.name.to_owned(),
                        range: offer.goal.range,
                        unit: offer.goal.unit.to_owned(),
                        words: offer
                            .goal
                            .words
                            .split_whitespace()
                            .map(str::to_owned)
                            .collect(),
                        loss: offer.loss,
                    });
                }
                self.describe_next(now);
            }
            (Command::Start(id), Body::Started { .. }) => self.on_started(id),
            (Command::Start(id), Body::Refused { reason }) => self.reject(id, reason.to_owned()),
            (Command::Ping, Body::Pong { clock_ms, .. }) => self.clock = Some((clock_ms, now)),
            // The end will be told, or has been.
            (Command::Abort(link), Body::Aborting { .. } | Body::Refused { .. }) => {
                if let Some(task) = self.find(link).and_then(|id| self.tasks.get_mut(&id)) {
                    task.abort = false;
                }
            }
            // No answer to what was asked: the check was right, so it is another version's.
            _ => self.counters.errors += 1,
        }
        self.next_command(now);
    }
}

/// A frame as bytes; every body that the gateway sends fits.
fn frame_bytes(session: u32, seq: u8, body: Body<'_>) -> Vec<u8> {
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq,
        body,
    };
    let needed = match encode(session, &frame, &mut []) {
        Ok(len) => len,
        Err(error) => error.needed,
    };
    let mut bytes = vec![0; needed];
    // Cannot fail: the room was measured.
    let _ = encode(session, &frame, &mut bytes);
    bytes
}

#[cfg(test)]
mod tests;
