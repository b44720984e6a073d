//! What is sent, the most urgent first: answers, ends, progress, readings, the log.

use core::hash::{Hash, Hasher};
use core::time::Duration;

use heapless::Vec;
use ztl_core::Instant;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Frame, Ids, LinkId, NO_SEQ, NO_SESSION, VERSION, Welcome, encode,
};
use ztl_core::tasks::Tasks;
use ztl_core::time::earliest;

use super::commands::Answer;
use super::tasks::{Slot, has_ended, waits};
use super::{Components, Inner};
use crate::component::Component;
use crate::log::LogSource;

/// How often an end is told again until it is acknowledged.
const ENDED_AGAIN: Duration = Duration::from_millis(100);
/// Shortest time between two progress reports of a task.
const PROGRESS_AGAIN: Duration = Duration::from_millis(50);
/// How often a node without a session announces itself.
const AWAKE_AGAIN: Duration = Duration::from_millis(250);
/// Longest pause within a command; what stands in the decoder longer is noise.
const PAUSE: Duration = Duration::from_millis(20);
/// Longest frame of what may be lost while a command is under way, so that its answer waits for no
/// more than that. A `Progress` is never longer.
const SHORT_FRAME: usize = 64;

/// How much fits into a frame.
pub(super) mod longest {
    /// Bytes of a body in a frame of this length on the line: address, sequence, check, delimiter,
    /// COBS.
    const fn body(frame: usize) -> usize {
        frame - 8 - frame / 254
    }

    /// Bytes of a reading: tag, topic, length.
    pub(in crate::node) const fn reading(frame: usize) -> usize {
        body(frame) - 4
    }

    /// Bytes of the log: tag, bytes lost, length.
    pub(super) const fn log(frame: usize) -> usize {
        body(frame) - 8
    }
}

/// The frame on its way out.
#[derive(Clone)]
pub(super) struct Transmit<const FRAME: usize> {
    buffer: [u8; FRAME],
    len: usize,
    sent: usize,
}

impl<const FRAME: usize> Transmit<FRAME> {
    pub(super) const fn new() -> Self {
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

    pub(super) fn consume(&mut self, count: usize) {
        self.sent = self.sent.saturating_add(count).min(self.len);
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

/// Shows what is still to be sent.
impl<const FRAME: usize> core::fmt::Debug for Transmit<FRAME> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_tuple("Transmit").field(&self.pending()).finish()
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

/// Whether there is something to tell of a task, at once or later.
fn is_due(task: &Slot) -> bool {
    task.extra.news || has_ended(task)
}

fn topics(component: &dyn Component) -> usize {
    component.offer().topics.split_ascii_whitespace().count()
}

impl<C: Components, const TASKS: usize, const FRAME: usize> Inner<'_, C, TASKS, FRAME> {
    pub(super) fn transmit_buf(&mut self, now: Instant, log: &dyn LogSource) -> &[u8] {
        if self.transmit.pending().is_empty() {
            self.next_frame(now, log);
        }
        self.transmit.pending()
    }

    /// When there is something to be sent.
    pub(super) fn next_transmit(&self, now: Instant) -> Option<Instant> {
        let at_once = self.answer_due
            || self.refusal.is_some()
            || self.readings
            || !self.transmit.pending().is_empty();
        if at_once {
            return Some(now);
        }
        if self.session == NO_SESSION {
            return Some(self.awake_due);
        }
        let tasks = self.tasks.iter().filter(|(_, task)| is_due(task));
        let mut wake = tasks.map(|(_, task)| task.extra.due).min();
        for place in 0..self.components.count() {
            let component = self.components.component(place);
            if let Some(component) = component.filter(|c| self.is_heard() && topics(*c) > 0) {
                wake = earliest(wake, Some(component.poll_timeout(now)));
            }
        }
        wake
    }

    /// Whether anybody listens, as far as the node knows.
    const fn is_heard(&self) -> bool {
        self.session != NO_SESSION && self.commanded.is_some()
    }

    /// Encodes what is most urgent into the transmit buffer.
    fn next_frame(&mut self, now: Instant, log: &dyn LogSource) {
        if let Some((session, reason)) = self.refusal.take() {
            let body = Body::Refused { reason };
            return self.transmit.frame(session, NO_SEQ, body);
        }
        if self.session == NO_SESSION {
            return self.announce(now);
        }
        if core::mem::take(&mut self.answer_due) {
            return self.encode_answer(now);
        }
        if self.encode_task(now, has_ended) || self.encode_task(now, |task| !has_ended(task)) {
            return;
        }
        self.readings = false;
        if self.is_heard() {
            let command = self.receiving.is_some_and(|last| now < last + PAUSE);
            let most = if command { SHORT_FRAME } else { FRAME };
            self.readings = self.encode_reading(now, most);
            if !self.readings {
                self.encode_log(log, most);
            }
        }
    }

    fn announce(&mut self, now: Instant) {
        if now < self.awake_due {
            return;
        }
        self.awake_due = now + AWAKE_AGAIN;
        let body = Body::Awake {
            version: VERSION,
            boot: self.identity.boot,
        };
        // A delimiter first: it flushes what the line made of the reset.
        self.transmit.frame_after(1, NO_SESSION, NO_SEQ, body);
    }

    /// Tells of a task that is one of `those`.
    fn encode_task(&mut self, now: Instant, those: fn(&Slot) -> bool) -> bool {
        let due = |task: &Slot| those(task) && is_due(task) && now >= task.extra.due;
        let Some((task, slot)) = self.tasks.iter_mut().find(|(_, task)| due(task)) else {
            return false;
        };
        let task = *task;
        slot.extra.news = false;
        let (state, text) = (slot.state, slot.text.as_str());
        let (again, body) = if has_ended(slot) {
            let result = text;
            let ended = Body::Ended {
                task,
                state,
                result,
            };
            (ENDED_AGAIN, ended)
        } else if waits(slot) {
            let text = "waits for another task to end";
            (PROGRESS_AGAIN, Body::Progress { task, text })
        } else {
            (PROGRESS_AGAIN, Body::Progress { task, text })
        };
        self.transmit.frame(self.session, NO_SEQ, body);
        slot.extra.due = now + again;
        true
    }

    /// Sends the next reading in a frame of at most `most` bytes; each component gets its turn.
    fn encode_reading(&mut self, now: Instant, most: usize) -> bool {
        let mut buffer = [0; FRAME];
        let room = buffer.get_mut(..longest::reading(most));
        let room = room.unwrap_or_default();
        let count = self.components.count();
        for place in (self.publisher..count).chain(0..self.publisher.min(count)) {
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            let own = topics(component);
            if own == 0 {
                continue;
            }
            let Some(reading) = component.poll_reading(now, room) else {
                continue;
            };
            let Some(bytes) = room.get(..reading.len) else {
                continue;
            };
            let topic = usize::from(reading.topic);
            let before = (0..place).filter_map(|place| self.components.component(place));
            let number = before.map(topics).sum::<usize>() + topic;
            let Some(topic) = u8::try_from(number).ok().filter(|_| topic < own) else {
                continue;
            };
            self.publisher = place + 1;
            let body = Body::Publish { topic, bytes };
            self.transmit.frame(self.session, NO_SEQ, body);
            return true;
        }
        false
    }

    fn encode_log(&mut self, log: &dyn LogSource, most: usize) {
        let mut buffer = [0; FRAME];
        let room = buffer.get_mut(..longest::log(most));
        let room = room.unwrap_or_default();
        let count = log.read(room);
        if let Some(bytes) = room.get(..count).filter(|bytes| !bytes.is_empty()) {
            let lost = log.lost();
            let body = Body::Log { lost, bytes };
            self.transmit.frame(self.session, NO_SEQ, body);
        }
    }

    fn encode_answer(&mut self, now: Instant) {
        let seq = self.seq;
        let held = u8::try_from(self.tasks.len()).unwrap_or(u8::MAX);
        let clock_ms = now.as_millis();
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
                    let _ = ids.push(id);
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
                    link_timeout_ms: u32::try_from(
                        (Instant::ZERO + self.identity.link_timeout).as_millis(),
                    )
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
