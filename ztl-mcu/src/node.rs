//! The device end of the link.

use core::hash::{Hash, Hasher};
use core::time::Duration;

use heapless::Vec;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Decoder, Frame, Hello, Ids, LINK_TIMEOUT, LinkId, Loss, NO_SEQ,
    NO_SESSION, VERSION, Welcome, encode, next_seq, session_key, session_number,
};
use ztl_core::tasks::{NoRoom, Task, TaskRules, TaskTable, Tasks};
use ztl_core::time::earliest;
use ztl_core::{Event, Instant};

use crate::component::{Components, Refused, Report, Run};

/// Longest progress, result or reason of a task in bytes.
pub(crate) const TEXT: usize = 48;
/// Longest reason to refuse a command.
const REASON: usize = 96;

/// How often an end is told again until it is acknowledged.
const ENDED_AGAIN: Duration = Duration::from_millis(100);
/// Shortest time between two progress reports of a task.
const PROGRESS_AGAIN: Duration = Duration::from_millis(50);
/// How often a node without a session announces itself.
const AWAKE_AGAIN: Duration = Duration::from_millis(250);

/// Who a node is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Identity<'a> {
    /// What the device is called.
    pub name: &'a str,
    /// Version of its firmware.
    pub firmware: &'a str,
    /// Differs from boot to boot: random, or a counter that survives resets.
    pub boot: u32,
    /// After how long without a new command the node acts by itself. Default 1 s.
    pub link_timeout: Duration,
}

impl<'a> Identity<'a> {
    /// An identity with the default link timeout.
    #[must_use]
    pub const fn new(name: &'a str, firmware: &'a str, boot: u32) -> Self {
        Self {
            name,
            firmware,
            boot,
            link_timeout: LINK_TIMEOUT,
        }
    }
}

/// What a node has seen on its line since boot; the counts wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Counters {
    /// Frames whose check was right.
    pub frames: u32,
    /// Frames dropped: damaged, of another session, too long.
    pub errors: u32,
    /// Commands answered again without being executed again.
    pub repeats: u32,
    /// Commands out of sequence, dropped.
    pub out_of_sequence: u32,
}

/// What a node knows of a task besides its state and text.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Job {
    component: u8,
    /// When the end or the progress is told next.
    due: Instant,
    /// Whether the text has changed since it was told.
    news: bool,
    aborting: bool,
}

type Slot = Task<Job, heapless::String<TEXT>>;

fn runs(task: &Slot) -> bool {
    !task.state.is_final()
}

fn end(task: &mut Slot, now: Instant, event: Event, reason: Option<&str>) {
    task.apply(now, event, reason);
    task.extra.due = now;
}

/// The answer to the last command, kept to be repeated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Answer {
    Welcome,
    Component(u8),
    Started(LinkId),
    Refused(&'static str),
    /// For the reason that the component gave.
    NotTaken,
    Aborting(LinkId),
    Pong,
}

/// The device end of the link, without I/O: it moves the components `C`, holds at most `TASKS` tasks
/// and frames of at most `FRAME` bytes (128 and more; a goal may be some 24 bytes shorter).
///
/// *Inputs*: [`handle_bytes`](Self::handle_bytes) as bytes arrive,
/// [`handle_timeout`](Self::handle_timeout) in every turn of the main loop. *Outputs*:
/// [`poll_transmit`](Self::poll_transmit), to be called after each input until it returns 0. *Next
/// wake-up*: [`poll_timeout`](Self::poll_timeout). *Commands*:
/// [`stop_everything`](Self::stop_everything), [`clear_stop`](Self::clear_stop). The work of a call
/// is bounded by the number of bytes given and of tasks held.
///
/// Two nodes are equal when they will do the same from now on; what they have counted does not matter.
#[derive(Debug, Clone)]
pub struct Node<'a, C, const TASKS: usize, const FRAME: usize> {
    decoder: Decoder<FRAME>,
    /// Apart from the decoder, whose buffer a frame borrows while it is acted on.
    state: Inner<'a, C, TASKS, FRAME>,
    counters: Counters,
}

impl<C: PartialEq, const TASKS: usize, const FRAME: usize> PartialEq for Node<'_, C, TASKS, FRAME> {
    fn eq(&self, other: &Self) -> bool {
        self.decoder == other.decoder && self.state == other.state
    }
}

impl<C: Eq, const TASKS: usize, const FRAME: usize> Eq for Node<'_, C, TASKS, FRAME> {}

impl<C: Hash, const TASKS: usize, const FRAME: usize> Hash for Node<'_, C, TASKS, FRAME> {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        self.decoder.hash(hasher);
        self.state.hash(hasher);
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Inner<'a, C, const TASKS: usize, const FRAME: usize> {
    identity: Identity<'a>,
    components: C,
    /// The session that runs, [`NO_SESSION`] after a reset.
    session: u32,
    /// The number of the `Hello` that opened it.
    hello: u32,
    /// The same of the session before.
    replaced: u32,
    gateway: u64,
    /// `seq` of the last command executed.
    seq: u8,
    answer: Option<Answer>,
    /// What the component said when it did not take the last goal.
    reason: heapless::String<REASON>,
    answer_due: bool,
    /// A `Hello` to be refused: its session, and why.
    refusal: Option<(u32, &'static str)>,
    /// When a new command was last executed, or a session opened; until the link timeout has
    /// passed no other gateway gets in.
    heard: Instant,
    /// When the last new command was executed: the link timer. `None` once it has fired.
    commanded: Option<Instant>,
    stopped: bool,
    tasks: TaskTable<LinkId, Job, TASKS, TEXT>,
    highest: LinkId,
    awake_due: Instant,
    transmit: Transmit<FRAME>,
}

/// The frame on its way out.
#[derive(Debug, Clone)]
struct Transmit<const FRAME: usize> {
    buffer: [u8; FRAME],
    len: usize,
    sent: usize,
}

impl<const FRAME: usize> Transmit<FRAME> {
    const fn new() -> Self {
        Self {
            buffer: [0; FRAME],
            len: 0,
            sent: 0,
        }
    }

    /// What is still to be sent.
    fn pending(&self) -> &[u8] {
        self.buffer.get(self.sent..self.len).unwrap_or_default()
    }

    /// A body that does not fit is not sent; firmware learns of it from its gateway, which then
    /// gets no answer. Names and reasons are constants, so it shows on the first try.
    fn frame(&mut self, session: u32, seq: u8, body: Body<'_>) {
        self.frame_after(0, session, seq, body);
    }

    /// The same with this many delimiters before it.
    fn frame_after(&mut self, delimiters: usize, session: u32, seq: u8, body: Body<'_>) {
        let frame = Frame {
            addr: ADDR_ONLY_NODE,
            seq,
            body,
        };
        self.sent = 0;
        self.len = 0;
        let Some((before, rest)) = self.buffer.split_at_mut_checked(delimiters) else {
            return;
        };
        if let Ok(len) = encode(session, &frame, rest) {
            before.fill(0);
            self.len = delimiters + len;
        }
    }
}

/// Equal when the same is still to be sent.
impl<const FRAME: usize> PartialEq for Transmit<FRAME> {
    fn eq(&self, other: &Self) -> bool {
        self.pending() == other.pending()
    }
}

impl<const FRAME: usize> Eq for Transmit<FRAME> {}

impl<const FRAME: usize> Hash for Transmit<FRAME> {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        self.pending().hash(hasher);
    }
}

impl<'a, C: Components, const TASKS: usize, const FRAME: usize> Node<'a, C, TASKS, FRAME> {
    /// A node after its reset. `components` are at most 255.
    pub const fn new(identity: Identity<'a>, components: C) -> Self {
        const { assert!(FRAME >= 128 && TASKS >= 1 && TASKS <= 255) };
        let state = Inner {
            identity,
            components,
            session: NO_SESSION,
            hello: NO_SESSION,
            replaced: NO_SESSION,
            gateway: 0,
            seq: NO_SEQ,
            answer: None,
            reason: heapless::String::new(),
            answer_due: false,
            refusal: None,
            heard: Instant::ZERO,
            commanded: None,
            stopped: false,
            tasks: TaskTable::new(),
            highest: LinkId(0),
            awake_due: Instant::ZERO,
            transmit: Transmit::new(),
        };
        Self {
            decoder: Decoder::new(),
            state,
            counters: Counters {
                frames: 0,
                errors: 0,
                repeats: 0,
                out_of_sequence: 0,
            },
        }
    }

    /// Bytes have arrived, in pieces of any length.
    pub fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        for &byte in bytes {
            let frame = match self.decoder.push(byte) {
                Ok(false) => continue,
                Ok(true) => self.decoder.frame(&[self.state.session, NO_SESSION]),
                Err(error) => Err(error),
            };
            match frame {
                Ok((place, frame)) => {
                    self.counters.frames = self.counters.frames.wrapping_add(1);
                    self.state.on_frame(now, place, frame, &mut self.counters);
                }
                Err(_) => self.counters.errors = self.counters.errors.wrapping_add(1),
            }
            self.decoder.reset();
        }
    }

    /// Time has passed: moves the components on, and acts by itself when the link is lost.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.state.handle_timeout(now);
    }

    /// Writes the next bytes to be sent into `buffer` and says how many; 0 when there is nothing.
    pub fn poll_transmit(&mut self, now: Instant, buffer: &mut [u8]) -> usize {
        self.state.poll_transmit(now, buffer)
    }

    /// When [`handle_timeout`](Self::handle_timeout) and [`poll_transmit`](Self::poll_transmit) are
    /// to be called even if no byte arrives.
    pub fn poll_timeout(&self, now: Instant) -> Instant {
        self.state.poll_timeout(now)
    }

    /// Emergency stop: every component goes to its safe state, every task ends as ABORTED, and no
    /// other starts until [`clear_stop`](Self::clear_stop).
    pub fn stop_everything(&mut self, now: Instant) {
        self.state.stop_everything(now);
    }

    /// Ends the emergency stop. Only the firmware may: the link has no command for it.
    pub fn clear_stop(&mut self) {
        self.state.stopped = false;
    }

    /// What the line has brought.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }
}

impl<C: Components, const TASKS: usize, const FRAME: usize> Inner<'_, C, TASKS, FRAME> {
    fn handle_timeout(&mut self, now: Instant) {
        if let Some(commanded) = self.commanded
            && now >= commanded + self.identity.link_timeout
        {
            self.commanded = None;
            self.on_link_lost(now);
        }
        for (_, task) in self.tasks.iter_mut().filter(|(_, task)| runs(task)) {
            let place = usize::from(task.extra.component);
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            let before = task.text.clone();
            let run = component.poll(now, &mut Report::new(&mut task.text));
            task.extra.news |= before != task.text;
            match run {
                Run::Running => {}
                Run::Completed => end(task, now, Event::Complete, None),
                Run::Failed => end(task, now, Event::Fail, None),
                Run::Aborted => end(task, now, Event::Abort, None),
            }
        }
    }

    fn poll_transmit(&mut self, now: Instant, buffer: &mut [u8]) -> usize {
        if self.transmit.pending().is_empty() {
            self.next_frame(now);
        }
        let pending = self.transmit.pending();
        let count = pending.len().min(buffer.len());
        for (to, from) in buffer.iter_mut().zip(pending) {
            *to = *from;
        }
        self.transmit.sent += count;
        count
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        if self.answer_due || self.refusal.is_some() || !self.transmit.pending().is_empty() {
            return now;
        }
        let mut wake = self.commanded.map(|at| at + self.identity.link_timeout);
        if self.session == NO_SESSION {
            wake = earliest(wake, Some(self.awake_due));
        }
        for (_, task) in self.tasks.iter() {
            let job = &task.extra;
            if runs(task) {
                let component = self.components.component(usize::from(job.component));
                wake = earliest(wake, component.map(|c| c.poll_timeout(now)));
            }
            if self.session != NO_SESSION && (job.news || !runs(task)) {
                wake = earliest(wake, Some(job.due));
            }
        }
        // Nothing to do: the next byte wakes it.
        wake.unwrap_or(now + Duration::from_secs(1))
    }

    fn stop_everything(&mut self, now: Instant) {
        self.stopped = true;
        for place in 0..self.components.count() {
            if let Some(component) = self.components.component_mut(place) {
                component.make_safe(now);
            }
        }
        for (_, task) in self.tasks.iter_mut().filter(|(_, task)| runs(task)) {
            end(task, now, Event::Abort, Some("emergency stop"));
        }
    }

    fn clock_ms(now: Instant) -> u64 {
        now.as_micros() / 1000
    }

    /// `frame` was checked against the session that runs, then against no session.
    fn on_frame(&mut self, now: Instant, place: usize, frame: Frame<'_>, counters: &mut Counters) {
        let in_session = place == 0 && self.session != NO_SESSION;
        if frame.addr != ADDR_ONLY_NODE {
            return;
        }
        match (in_session, frame.seq, frame.body) {
            (false, NO_SEQ, Body::Hello(hello)) => self.on_hello(now, hello),
            (true, NO_SEQ, Body::Ack { task }) => {
                // Known or not; a task that still runs is not let go.
                self.tasks.acknowledge(task);
            }
            (true, seq, body) if seq != NO_SEQ => self.on_command(now, seq, body, counters),
            _ => {}
        }
    }

    fn on_hello(&mut self, now: Instant, hello: Hello) {
        if hello.session != session_number(hello.session) {
            return;
        }
        if hello.version != VERSION {
            self.refusal = Some((hello.session, "this node speaks version 1 of the link"));
            return;
        }
        if hello.session != self.hello {
            let live = self.session != NO_SESSION && now < self.heard + self.identity.link_timeout;
            if live && hello.gateway != self.gateway {
                self.refusal = Some((hello.session, "another gateway holds this device"));
                return;
            }
            self.replaced = self.hello;
            self.hello = hello.session;
            self.session = session_key(hello.session, self.identity.boot);
            self.gateway = hello.gateway;
            self.seq = NO_SEQ;
            // A new session proves nothing about the way back, so the link timer runs on.
            self.heard = now;
            for (_, task) in self.tasks.iter_mut() {
                task.extra.due = now;
                task.extra.news = true;
            }
        }
        if self.seq == NO_SEQ {
            self.answer = Some(Answer::Welcome);
            self.answer_due = true;
        }
    }

    fn on_command(&mut self, now: Instant, seq: u8, body: Body<'_>, counters: &mut Counters) {
        if seq == self.seq {
            counters.repeats = counters.repeats.wrapping_add(1);
            self.answer_due = self.answer.is_some();
            return;
        }
        if seq != next_seq(self.seq) {
            counters.out_of_sequence = counters.out_of_sequence.wrapping_add(1);
            return;
        }
        let answer = match body {
            Body::Describe { index } if usize::from(index) < self.components.count() => {
                Answer::Component(index)
            }
            Body::Describe { .. } => Answer::Refused("no such component"),
            Body::Start {
                task,
                component,
                goal,
                before_ms,
            } => match self.start(now, task, component, goal, before_ms) {
                Ok(()) => Answer::Started(task),
                Err(answer) => answer,
            },
            Body::Abort { task } => self.abort(now, task),
            Body::Ping => Answer::Pong,
            // The node's own messages, come back as an echo.
            _ => return,
        };
        self.seq = seq;
        self.answer = Some(answer);
        self.answer_due = true;
        self.heard = now;
        self.commanded = Some(now);
    }

    fn start(
        &mut self,
        now: Instant,
        task: LinkId,
        component: u8,
        goal: &str,
        before_ms: u64,
    ) -> Result<(), Answer> {
        let refused = |reason| Err(Answer::Refused(reason));
        if Self::clock_ms(now) > before_ms {
            return refused("the command came too late");
        }
        if task <= self.highest {
            return refused("a task of this or a later id was started already");
        }
        if self.stopped {
            return refused("emergency stop");
        }
        let place = usize::from(component);
        let Some(part) = self.components.component_mut(place) else {
            return refused("no such component");
        };
        let busy = |task: &Slot| runs(task) && task.extra.component == component;
        if self.tasks.iter().any(|(_, task)| busy(task)) {
            return refused("busy with another task");
        }
        let mut why = Report::new(&mut self.reason);
        part.check(goal, &mut why)
            .map_err(|Refused| Answer::NotTaken)?;
        let job = || {
            let mut job = Task::new(Job {
                component,
                due: now,
                news: false,
                aborting: false,
            });
            job.unacknowledged = true;
            job
        };
        if let Err(full) = self.tasks.admit(task, job) {
            return refused(match full {
                NoRoom::Running => "too many tasks are running",
                NoRoom::Unacknowledged => "ends not yet acknowledged",
            });
        }
        if part.start(now, goal, &mut Report::new(&mut self.reason)) == Err(Refused) {
            self.tasks.remove(task);
            return Err(Answer::NotTaken);
        }
        self.tasks.apply(now, task, Event::Accept, None);
        self.highest = task;
        Ok(())
    }

    fn abort(&mut self, now: Instant, id: LinkId) -> Answer {
        let Some(task) = self.tasks.get_mut(id) else {
            return Answer::Refused("no such task");
        };
        if runs(task) && !task.extra.aborting {
            task.extra.aborting = true;
            let place = usize::from(task.extra.component);
            if let Some(component) = self.components.component_mut(place) {
                component.abort(now);
            }
        }
        Answer::Aborting(id)
    }

    fn on_link_lost(&mut self, now: Instant) {
        for (_, task) in self.tasks.iter_mut().filter(|(_, task)| runs(task)) {
            let place = usize::from(task.extra.component);
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            if component.offer().loss == Loss::CarryOn {
                continue;
            }
            component.make_safe(now);
            end(task, now, Event::Fail, Some("link was lost"));
        }
    }

    /// Encodes what is most urgent into the transmit buffer.
    fn next_frame(&mut self, now: Instant) {
        if let Some((session, reason)) = self.refusal.take() {
            let body = Body::Refused { reason };
            return self.transmit.frame(session, NO_SEQ, body);
        }
        if self.session == NO_SESSION {
            if now >= self.awake_due {
                self.awake_due = now + AWAKE_AGAIN;
                let body = Body::Awake {
                    version: VERSION,
                    boot: self.identity.boot,
                };
                // A delimiter first: it flushes what the line made of the reset.
                self.transmit.frame_after(1, NO_SESSION, NO_SEQ, body);
            }
            return;
        }
        if core::mem::take(&mut self.answer_due) {
            return self.encode_answer(now);
        }
        let due = |task: &Slot| (task.extra.news || !runs(task)) && now >= task.extra.due;
        let Some((task, slot)) = self.tasks.iter_mut().find(|(_, task)| due(task)) else {
            return;
        };
        let task = *task;
        slot.extra.news = false;
        let again = if runs(slot) {
            PROGRESS_AGAIN
        } else {
            ENDED_AGAIN
        };
        slot.extra.due = now + again;
        let (state, result) = (slot.state, slot.text.as_str());
        let body = if runs(slot) {
            Body::Progress { task, text: result }
        } else {
            Body::Ended {
                task,
                state,
                result,
            }
        };
        self.transmit.frame(self.session, NO_SEQ, body);
    }

    fn encode_answer(&mut self, now: Instant) {
        let seq = self.seq;
        let held = u8::try_from(self.tasks.len()).unwrap_or(u8::MAX);
        let clock_ms = Self::clock_ms(now);
        let Some(answer) = self.answer else { return };
        let session = match answer {
            Answer::Welcome => self.hello,
            _ => self.session,
        };
        let mut frame = |body| self.transmit.frame(session, seq, body);
        match answer {
            Answer::Welcome => {
                // Pushed, since `collect` panics where the compiler cannot see that all fit.
                let mut ids = Vec::<LinkId, TASKS>::new();
                for (id, _) in self.tasks.iter() {
                    let _ = ids.push(*id);
                }
                frame(Body::Welcome(Welcome {
                    version: VERSION,
                    name: self.identity.name,
                    firmware: self.identity.firmware,
                    boot: self.identity.boot,
                    replaces: self.replaced,
                    clock_ms,
                    capacity: u8::try_from(TASKS).unwrap_or(u8::MAX),
                    max_body: u16::try_from(FRAME - 6).unwrap_or(u16::MAX),
                    components: u8::try_from(self.components.count()).unwrap_or(u8::MAX),
                    link_timeout_ms: u32::try_from(self.identity.link_timeout.as_millis())
                        .unwrap_or(u32::MAX),
                    highest: self.highest.0,
                    held: Ids::new(&ids),
                }));
            }
            Answer::Component(index) => {
                if let Some(component) = self.components.component(usize::from(index)) {
                    let offer = component.offer();
                    frame(Body::Component { index, offer });
                }
            }
            Answer::Started(task) => frame(Body::Started { task }),
            Answer::Refused(reason) => frame(Body::Refused { reason }),
            Answer::NotTaken => frame(Body::Refused {
                reason: &self.reason,
            }),
            Answer::Aborting(task) => frame(Body::Aborting { task }),
            Answer::Pong => frame(Body::Pong { clock_ms, held }),
        }
    }
}

#[cfg(test)]
mod tests;
