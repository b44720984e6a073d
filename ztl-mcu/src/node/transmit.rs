//! What is sent, the most urgent first: answers, ends, progress, readings, the log.

use core::hash::{Hash, Hasher};
use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, FrameWriter, Ids, LinkId, NO_SEQ, NO_SESSION, VERSION, Welcome,
};

use super::commands::{Answer, NOT_TAKEN};
use super::tasks::Task;
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
pub(super) const PAUSE: Duration = Duration::from_millis(20);
/// In place of an answer that does not fit into a frame: a component's description.
const TOO_LONG: &str = "its description is longer than a frame";

/// The progress of a task that has not begun.
const WAITS: &str = "waits for another task to end";

/// How much fits into a frame.
pub(super) mod longest {
    /// Bytes of a body in a frame of this length on the line: address, sequence, check, delimiter,
    /// COBS.
    pub(in crate::node) const fn body(frame: usize) -> usize {
        frame - 8 - frame / 254
    }

    /// Bytes of a `Welcome` without its two texts and its ids, each number as long as it can be.
    const WELCOME: usize = 43;

    /// Bytes for each of the two texts of a `Welcome` that names so many tasks, whose ids are as long as they can be.
    pub(in crate::node) const fn name(frame: usize, tasks: usize) -> usize {
        body(frame).saturating_sub(WELCOME + 5 * tasks) / 2
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
#[repr(C)]
pub(super) struct Transmit<const FRAME: usize> {
    len: usize,
    sent: usize,
    buffer: [u8; FRAME],
}

impl<const FRAME: usize> Transmit<FRAME> {
    pub(super) const fn new() -> Self {
        Self {
            len: 0,
            sent: 0,
            buffer: [0; FRAME],
        }
    }

    /// What is still to be sent.
    fn pending(&self) -> &[u8] {
        self.buffer.get(self.sent..self.len).unwrap_or_default()
    }

    pub(super) fn consume(&mut self, count: usize) {
        self.sent = self.sent.saturating_add(count).min(self.len);
    }

    /// A delimiter alone.
    fn flush(&mut self) {
        if let Some(first) = self.buffer.first_mut() {
            *first = 0;
            (self.len, self.sent) = (1, 0);
        }
    }

    /// A frame that does not fit is not sent; says whether it fits.
    fn frame(&mut self, session: u32, seq: u8, put: impl FnOnce(&mut FrameWriter<'_>)) -> bool {
        let mut frame = FrameWriter::new(session, ADDR_ONLY_NODE, seq, &mut self.buffer);
        put(&mut frame);
        let len = frame.finish();
        (self.len, self.sent) = (len.unwrap_or_default(), 0);
        len.is_some()
    }

    /// Room for so many bytes at the end, from where [`FrameWriter::put_own`] takes them; where it begins.
    fn room(&mut self, bytes: usize) -> (usize, &mut [u8]) {
        let begin = FRAME.saturating_sub(bytes);
        (begin, self.buffer.get_mut(begin..).unwrap_or_default())
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

fn topics(component: &dyn Component) -> usize {
    component.offer().topics.split_ascii_whitespace().count()
}

impl<C: Components, const TASKS: usize, const FRAME: usize> Inner<'_, C, TASKS, FRAME> {
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn transmit_buf(&mut self, now: Instant, log: &dyn LogSource) -> &[u8] {
        if self.transmit.pending().is_empty() {
            self.next_frame(now, log);
        }
        self.transmit.pending()
    }

    /// When there is something to be sent; perhaps never.
    pub(super) fn next_transmit(&self, now: Instant) -> Instant {
        let at_once =
            self.answer_due || self.refusal.is_some() || !self.transmit.pending().is_empty();
        if at_once {
            return now;
        }
        if self.session == NO_SESSION {
            return self.awake_due;
        }
        let tasks = self.runner.tasks.held().filter(|task| task.is_due());
        let mut wake = tasks.fold(Instant::NEVER, |wake, task| wake.min(task.due));
        if self.is_heard() {
            wake = wake.min(self.readings_at.max(self.receiving));
        }
        wake
    }

    /// Whether anybody listens, as far as the node knows.
    fn is_heard(&self) -> bool {
        self.session != NO_SESSION && self.lost_at != Instant::NEVER
    }

    /// Encodes what is most urgent into the transmit buffer.
    fn next_frame(&mut self, now: Instant, log: &dyn LogSource) {
        if let Some((session, reason)) = self.refusal.take() {
            return self.encode_answer(session, now, NO_SEQ, Answer::Refused(reason));
        }
        if self.session == NO_SESSION {
            return self.announce(now);
        }
        if core::mem::take(&mut self.answer_due) {
            let session = match self.answer {
                Answer::Welcome => self.hello,
                _ => self.session,
            };
            return self.encode_answer(session, now, self.seq, self.answer);
        }
        if self.encode_task(now) {
            return;
        }
        // What may be lost does not keep the answer to a command that is coming in waiting.
        if self.is_heard() && now >= self.receiving && !self.encode_reading(now) {
            self.encode_log(log);
        }
    }

    fn announce(&mut self, now: Instant) {
        if now < self.awake_due {
            return;
        }
        // A delimiter first: it flushes what the line made of the reset.
        self.flushed = !self.flushed;
        if self.flushed {
            return self.transmit.flush();
        }
        self.awake_due = now + AWAKE_AGAIN;
        let version = VERSION;
        let boot = self.boot;
        self.transmit.frame(NO_SESSION, NO_SEQ, |frame| {
            Body::Awake { version, boot }.put(frame);
        });
    }

    /// Tells of a task: of one that has ended, if there is one.
    fn encode_task(&mut self, now: Instant) -> bool {
        let mut first: Option<&mut Task> = None;
        for task in self.runner.tasks.held_mut() {
            let more_urgent = |known: &&mut Task| known.end().is_none() && task.end().is_some();
            if task.is_due() && now >= task.due && first.as_ref().is_none_or(more_urgent) {
                first = Some(task);
            }
        }
        let Some(slot) = first else { return false };
        slot.news = false;
        let task = slot.id;
        let end = slot.end();
        let waits = slot.waits();
        slot.due = now
            + if end.is_some() {
                ENDED_AGAIN
            } else {
                PROGRESS_AGAIN
            };
        self.transmit.frame(self.session, NO_SEQ, |frame| {
            let text = if waits { WAITS } else { slot.text.as_str() };
            match end {
                Some(state) => Body::Ended {
                    task,
                    state,
                    result: text,
                }
                .put(frame),
                None => Body::Progress { task, text }.put(frame),
            }
        });
        true
    }

    /// Sends the next reading. In each round every component is asked for one; the next round begins when the least
    /// time between two readings has passed.
    fn encode_reading(&mut self, now: Instant) -> bool {
        if now < self.readings_at {
            return false;
        }
        let (begin, room) = self.transmit.room(const { longest::reading(FRAME) });
        // When the first of the components that have none wants to be asked again.
        let mut wake = Instant::NEVER;
        loop {
            let place = usize::from(self.publisher);
            let component = self.runner.components.component_mut(place);
            let (Some(component), Some(next)) = (component, self.publisher.checked_add(1)) else {
                self.publisher = 0;
                self.readings_at = now.after(self.reading_interval);
                if !core::mem::take(&mut self.published) {
                    self.readings_at = self.readings_at.max(wake);
                } else if self.reading_interval == 0 {
                    continue;
                }
                return false;
            };
            self.publisher = next;
            let own = topics(component);
            if own == 0 {
                continue;
            }
            let Some(reading) = component.poll_reading(now, room) else {
                wake = wake.min(component.poll_timeout(now));
                continue;
            };
            let topic = usize::from(reading.topic);
            if reading.len > room.len() || topic >= own {
                continue;
            }
            let before = (0..place).filter_map(|place| self.runner.components.component(place));
            let number = before.map(topics).sum::<usize>() + topic;
            let Ok(topic) = u8::try_from(number) else {
                continue;
            };
            self.published = true;
            return self.transmit.frame(self.session, NO_SEQ, |frame| {
                Body::put_publish(topic, reading.len, frame);
                frame.put_own(begin, reading.len);
            });
        }
    }

    fn encode_log(&mut self, log: &dyn LogSource) {
        let (begin, room) = self.transmit.room(const { longest::log(FRAME) });
        let count = log.read(room).min(room.len());
        if count > 0 {
            let lost = log.lost();
            self.transmit.frame(self.session, NO_SEQ, |frame| {
                Body::put_log(lost, count, frame);
                frame.put_own(begin, count);
            });
        }
    }

    #[cfg_attr(target_os = "none", inline(never))]
    fn encode_answer(&mut self, session: u32, now: Instant, seq: u8, answer: Answer) {
        let mut ids = [LinkId(0); TASKS];
        let mut held = 0u8;
        for (id, task) in ids.iter_mut().zip(self.runner.tasks.held()) {
            *id = task.id;
            held += 1;
        }
        let clock_ms = now.as_millis();
        let fits = self.transmit.frame(session, seq, |frame| match answer {
            Answer::Nothing => {}
            Answer::Welcome => Body::Welcome(Welcome {
                version: VERSION,
                name: self.name,
                firmware: self.firmware,
                boot: self.boot,
                replaces: self.replaced,
                clock_ms,
                capacity: TASKS as u8,
                max_body: u16::try_from(FRAME - 6).unwrap_or(u16::MAX),
                components: u8::try_from(self.runner.components.count()).unwrap_or(u8::MAX),
                link_timeout_ms: Instant::from_micros(self.link_timeout).as_millis() as u32,
                highest: self.highest.0,
                held: Ids::new(ids.get(..usize::from(held)).unwrap_or_default()),
            })
            .put(frame),
            Answer::Component(index) => {
                if let Some(component) = self.runner.components.component(usize::from(index)) {
                    let offer = component.offer();
                    Body::Component { index, offer }.put(frame);
                }
            }
            Answer::Started(task) => Body::Started { task }.put(frame),
            Answer::Refused(reason) => {
                let own = reason.len() == NOT_TAKEN.len();
                let reason = if own {
                    self.runner.reason.as_str()
                } else {
                    reason
                };
                Body::Refused { reason }.put(frame);
            }
            Answer::Aborting(task) => Body::Aborting { task }.put(frame),
            Answer::Pong => Body::Pong { clock_ms, held }.put(frame),
        });
        if !fits {
            let reason = TOO_LONG;
            self.transmit
                .frame(session, seq, |frame| Body::Refused { reason }.put(frame));
        }
    }
}
