//! Chooses and encodes the next frame. In order of urgency: answers, outcomes, progress, readings, the log.

use core::time::Duration;

use ztl_core::link::parameter::ParameterMessage;
use ztl_core::link::{Body, FrameWriter, Ids, LinkId, NO_SEQ, NO_SESSION, VERSION, Welcome};
use ztl_core::sink::Sink as _;
use ztl_core::{Instant, State};

use super::frame_out::longest;
use super::link_state::{Answer, LinkState, Other};
use super::own::is_listed;
use super::refusal::Refusal;
use super::runner::kept_result;
use super::tasks::Task;
use crate::component::{Component, Components};
use crate::describe::{has_parts, part};
use crate::log::LogSource;

/// How often an outcome is repeated until it is acknowledged.
const OUTCOME_INTERVAL: Duration = Duration::from_millis(100);
/// Minimum time between two progress reports of a task.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(50);
/// How often a node without a session announces itself.
const AWAKE_INTERVAL: Duration = Duration::from_millis(250);
/// The progress of a waiting task.
const WAITS: &str = "waits for another task to end";

/// Number of topics that a component publishes.
fn topics(component: &dyn Component) -> usize {
    component.offer().topics.split_ascii_whitespace().count()
}

/// Writes an outcome, whose text is cut if it is longer than a frame.
fn put_ended(task: LinkId, state: State, text: &str, frame: usize, out: &mut FrameWriter<'_>) {
    let mut fitting = text.len();
    let mut mark = "";
    if fitting > longest::result(frame) {
        mark = "…";
        fitting = text.floor_char_boundary(longest::result(frame) - mark.len());
    }
    Body::put_ended(task, state, fitting + mark.len(), out);
    out.put(text.as_bytes().get(..fitting).unwrap_or_default());
    out.put(mark.as_bytes());
}

impl<C: Components, const TASKS: usize, const FRAME: usize> LinkState<'_, C, TASKS, FRAME> {
    // Not inlined in firmware: that saves 108 bytes in `microbit-quiet`.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn transmit_buf(&mut self, now: Instant, log: &dyn LogSource) -> &[u8] {
        if self.frame_out.pending().is_empty() && self.take_turn(now) {
            self.next_frame(now, log);
            self.end_turn();
        }
        self.frame_out.pending()
    }

    /// When there is something to send, or [`Instant::NEVER`].
    pub(super) fn next_transmit(&self, now: Instant) -> Instant {
        if let Some(turn) = self.next_turn(now) {
            return turn;
        }
        let at_once =
            self.answer_due || self.refusal.is_some() || !self.frame_out.pending().is_empty();
        if at_once {
            return now;
        }
        if self.session == NO_SESSION {
            return self.awake_due;
        }
        let tasks = self.runner.tasks.held().filter(|task| task.is_due());
        let mut wake = tasks.fold(Instant::NEVER, |wake, task| wake.min(task.due));
        if self.is_heard() {
            let asked = self.readings_at.max(self.runner.readings_wake);
            wake = wake.min(asked.max(self.receiving));
        }
        if C::ACTING {
            wake = wake.min(self.next_own());
        }
        wake
    }

    /// Whether a gateway listens: the link timer has not expired.
    pub(super) fn is_heard(&self) -> bool {
        self.session != NO_SESSION && self.lost_at != Instant::NEVER
    }

    /// Encodes what is most urgent into the transmit buffer.
    fn next_frame(&mut self, now: Instant, log: &dyn LogSource) {
        if let Some((session, refusal)) = self.refusal.take() {
            return self.encode_answer(session, now, NO_SEQ, Answer::Refused(refusal));
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
        if C::ACTING && self.encode_own_task(now) || self.encode_task(now) {
            return;
        }
        // Readings and log can be lost, so they do not delay the answer to a command that is arriving.
        if self.is_heard()
            && now >= self.receiving
            && !(C::ACTING && self.encode_event(now))
            && !self.encode_reading(now)
        {
            self.encode_log(log);
        }
    }

    fn announce(&mut self, now: Instant) {
        if now < self.awake_due {
            return;
        }
        // First a delimiter, which ends any noise that the reset caused on the line.
        self.flushed = !self.flushed;
        if self.flushed {
            return self.frame_out.delimiter();
        }
        self.awake_due = now + AWAKE_INTERVAL;
        let version = VERSION;
        let boot = self.boot;
        let address = self.address();
        self.frame_out.encode(address, NO_SESSION, NO_SEQ, |frame| {
            Body::Awake { version, boot }.put(frame);
        });
    }

    /// Reports a task that is due, an ended one first. Returns whether there was one.
    fn encode_task(&mut self, now: Instant) -> bool {
        let address = self.address();
        let mut first: Option<&mut Task> = None;
        for task in self.runner.tasks.held_mut() {
            let more_urgent = |known: &&mut Task| known.end().is_none() && task.end().is_some();
            if task.is_due() && now >= task.due && first.as_ref().is_none_or(more_urgent) {
                first = Some(task);
            }
        }
        let Some(slot) = first else { return false };
        slot.changed = false;
        let task = slot.id;
        let end = slot.end();
        let waits = slot.waits();
        slot.due = now
            + if end.is_some() {
                OUTCOME_INTERVAL
            } else {
                PROGRESS_INTERVAL
            };
        let mut text = if waits { WAITS } else { slot.text.as_str() };
        let kept = kept_result(&self.runner.components, slot);
        if let Some(result) = kept {
            text = result;
        }
        self.frame_out
            .encode(address, self.session, NO_SEQ, |frame| match end {
                Some(state) if kept.is_some() => put_ended(task, state, text, FRAME, frame),
                Some(state) => Body::Ended {
                    task,
                    state,
                    result: text,
                }
                .put(frame),
                None => Body::Progress { task, text }.put(frame),
            });
        true
    }

    /// Sends the next reading; returns whether there was one. Each round asks every component for a reading. The next
    /// round begins after the reading interval, and without readings not before a component wants to be asked or has changed.
    fn encode_reading(&mut self, now: Instant) -> bool {
        if now < self.readings_at || now < self.runner.readings_wake {
            return false;
        }
        let address = self.address();
        let (begin, room) = self.frame_out.room(const { longest::reading(FRAME) });
        // The earliest time at which a component without a reading wants to be asked again.
        let mut wake = Instant::NEVER;
        // Number of topics of those that have no reading.
        let mut all = 0;
        loop {
            let index = usize::from(self.publisher);
            let component = self.runner.components.component_mut(index);
            let (Some(component), Some(next)) = (component, self.publisher.checked_add(1)) else {
                self.publisher = 0;
                self.readings_at = now.after(self.reading_interval);
                if !core::mem::take(&mut self.published) {
                    self.runner.readings_wake = wake;
                    if all == 0 {
                        self.readings_at = Instant::NEVER;
                    }
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
            all += own;
            let Some(reading) = component.poll_reading(now, room) else {
                wake = wake.min(component.poll_timeout(now));
                continue;
            };
            let topic = usize::from(reading.topic);
            if reading.len > room.len() || topic >= own {
                wake = now;
                continue;
            }
            let before = (0..index).filter_map(|index| self.runner.components.component(index));
            let number = before.map(topics).sum::<usize>() + topic;
            let Ok(topic) = u8::try_from(number) else {
                continue;
            };
            self.published = true;
            return self
                .frame_out
                .encode(address, self.session, NO_SEQ, |frame| {
                    Body::put_publish(topic, reading.len, frame);
                    frame.put_own(begin, reading.len);
                });
        }
    }

    fn encode_log(&mut self, log: &dyn LogSource) {
        let address = self.address();
        let (begin, room) = self.frame_out.room(const { longest::log(FRAME) });
        let count = log.read(room).min(room.len());
        if count > 0 {
            let lost = log.lost();
            self.frame_out
                .encode(address, self.session, NO_SEQ, |frame| {
                    Body::put_log(lost, count, frame);
                    frame.put_own(begin, count);
                });
        }
    }

    fn encode_answer(&mut self, session: u32, now: Instant, seq: u8, answer: Answer) {
        let mut ids = [LinkId(0); TASKS];
        let mut held = 0u8;
        let listed = self.runner.tasks.held();
        let listed = listed.filter(|task| is_listed::<C>(task.id));
        for (id, task) in ids.iter_mut().zip(listed) {
            *id = task.id;
            held += 1;
        }
        let clock_ms = now.as_millis();
        let address = self.address();
        let fits = self
            .frame_out
            .encode(address, session, seq, |frame| match answer {
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
                    } else if has_parts::<C>()
                        && let Some((component, bytes)) = part(&self.runner.components, index)
                    {
                        Body::Description {
                            index,
                            component,
                            bytes,
                        }
                        .put(frame);
                    }
                }
                Answer::Started(task) => Body::Started { task }.put(frame),
                Answer::Refused(refusal) => {
                    let reason = match refusal {
                        Refusal::ByComponent => self.runner.reason.as_str(),
                        refusal => refusal.as_str(),
                    };
                    Body::Refused { reason }.put(frame);
                }
                Answer::Aborting(task) => Body::Aborting { task }.put(frame),
                Answer::Pong => Body::Pong { clock_ms, held }.put(frame),
                Answer::Parameter(index) if C::PARAMETER_COUNT > 0 => {
                    self.runner.put_parameter(index, frame);
                }
                Answer::Other(other) if C::UPDATES && other != Other::Saved => {
                    self.runner.put_update(other, frame);
                }
                Answer::Other(_) if C::PARAMETER_COUNT > 0 => {
                    ParameterMessage::Saved.put(frame);
                }
                Answer::Parameter(_) | Answer::Other(_) => {}
            });
        if !fits {
            let reason = Refusal::DescriptionTooLong.as_str();
            self.frame_out.encode(address, session, seq, |frame| {
                Body::Refused { reason }.put(frame)
            });
        }
    }
}
