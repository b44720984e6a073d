//! The device end of the link.

mod commands;
#[cfg(feature = "zmtp")]
mod local;
mod tasks;
mod transmit;

use core::hash::{Hash, Hasher};
use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{Decoder, LINK_TIMEOUT, LinkId, NO_SEQ, NO_SESSION};
use ztl_core::tasks::TaskTable;

use crate::component::Components;
use crate::log::LogSource;
use commands::Answer;
#[cfg(feature = "zmtp")]
pub(crate) use local::LocalTasks;
use tasks::Job;
pub(crate) use tasks::TEXT;
use transmit::{Transmit, longest};

/// Why a component does not take a goal; at most 96 bytes.
pub type Reason = heapless::String<96>;

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
    /// After how long without a new command the node acts by itself. Default 1 s; a gateway takes
    /// [50 ms to 60 s](ztl_core::link::LINK_TIMEOUTS).
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

/// The device end of the link, without I/O: it moves the components `C`, holds at most `TASKS` tasks
/// and frames of at most `FRAME` bytes (128 and more; a goal may be some 24 bytes shorter).
///
/// *Inputs*: [`handle_bytes`](Self::handle_bytes) as bytes arrive,
/// [`handle_timeout`](Self::handle_timeout) in every turn of the main loop. *Outputs*:
/// [`poll_transmit`](Self::poll_transmit), to be called after each input; or
/// [`transmit_buf`](Self::transmit_buf) and [`consume`](Self::consume), which copy nothing. *Next
/// wake-up*: [`poll_timeout`](Self::poll_timeout). *Commands*:
/// [`stop_everything`](Self::stop_everything), [`clear_stop`](Self::clear_stop).
/// [`Pump`](crate::pump::Pump) calls all of them for a serial port.
///
/// **Work.** A call's work is bounded, whatever arrives. `handle_bytes`: some ten instructions a byte,
/// and at the end of a frame the check over it, twice at most, and one call of `check`, `start` or
/// `abort`. `handle_timeout`: `poll` once for each task that moves; and `start` for one that waited, or
/// `make_safe`. The outputs: one frame of at most `FRAME` bytes at a time, and once for each
/// component `offer` and `poll_reading`. Tasks are searched in turn, so all of it grows with `TASKS`.
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
    reason: Reason,
    answer_due: bool,
    /// A `Hello` to be refused: its session, and why.
    refusal: Option<(u32, &'static str)>,
    /// When a new command was last executed, or a session opened; until the link timeout has
    /// passed no other gateway gets in.
    heard: Instant,
    /// When the last new command was executed: the link timer. `None` once it has fired.
    commanded: Option<Instant>,
    /// When the last byte of a frame came that is not complete yet.
    receiving: Option<Instant>,
    stopped: bool,
    tasks: TaskTable<LinkId, Job, TASKS, TEXT>,
    highest: LinkId,
    awake_due: Instant,
    /// Whose readings are sent next, so that each gets its turn.
    publisher: usize,
    /// The last time there was a reading, so there may be another.
    readings: bool,
    transmit: Transmit<FRAME>,
}

impl<'a, C, const TASKS: usize, const FRAME: usize> Inner<'a, C, TASKS, FRAME> {
    const fn new(identity: Identity<'a>, components: C) -> Self {
        Self {
            identity,
            components,
            session: NO_SESSION,
            hello: NO_SESSION,
            replaced: NO_SESSION,
            gateway: 0,
            seq: NO_SEQ,
            answer: None,
            reason: Reason::new(),
            answer_due: false,
            refusal: None,
            heard: Instant::ZERO,
            commanded: None,
            receiving: None,
            stopped: false,
            tasks: TaskTable::new(),
            highest: LinkId(0),
            awake_due: Instant::ZERO,
            publisher: 0,
            readings: false,
            transmit: Transmit::new(),
        }
    }
}

impl<'a, C: Components, const TASKS: usize, const FRAME: usize> Node<'a, C, TASKS, FRAME> {
    /// Longest reading that a component can publish, in bytes.
    pub const LONGEST_READING: usize = longest::reading(FRAME);

    /// A node after its reset. `components` are at most 255.
    pub const fn new(identity: Identity<'a>, components: C) -> Self {
        const { assert!(FRAME >= 128 && TASKS >= 1 && TASKS <= 255) };
        Self {
            decoder: Decoder::new(),
            state: Inner::new(identity, components),
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
                Ok(true) => self.decoder.command(&[self.state.session, NO_SESSION]),
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
        if !bytes.is_empty() {
            self.state.receiving = self.decoder.has_begun().then_some(now);
        }
    }

    /// Time has passed: moves the components on, and acts by itself when the link is lost.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.state.handle_timeout(now);
    }

    /// Writes the next bytes to be sent into `buffer` and says how many: it is full, or nothing more
    /// is to be sent now. The log is left out.
    ///
    /// Where components always have readings there is always something to be sent, so a main loop
    /// must not wait for the end of it.
    pub fn poll_transmit(&mut self, now: Instant, buffer: &mut [u8]) -> usize {
        let mut written = 0;
        while let Some(room) = buffer.get_mut(written..).filter(|room| !room.is_empty()) {
            let pending = self.transmit_buf(now, &());
            let count = pending.len().min(room.len());
            if count == 0 {
                break;
            }
            for (to, from) in room.iter_mut().zip(pending) {
                *to = *from;
            }
            self.consume(count);
            written += count;
        }
        written
    }

    /// The next bytes to be sent: the rest of the frame under way, or the most urgent next one;
    /// empty when there is nothing. To be followed by [`consume`](Self::consume).
    pub fn transmit_buf(&mut self, now: Instant, log: &dyn LogSource) -> &[u8] {
        self.state.transmit_buf(now, log)
    }

    /// The first `count` bytes of [`transmit_buf`](Self::transmit_buf) are sent.
    pub fn consume(&mut self, count: usize) {
        self.state.transmit.consume(count);
    }

    /// When [`handle_timeout`](Self::handle_timeout) and [`poll_transmit`](Self::poll_transmit) are
    /// to be called even if no byte arrives; after 1 s if there is nothing to do.
    pub fn poll_timeout(&self, now: Instant) -> Instant {
        let wake = [self.next_move(now), self.next_transmit(now)];
        let wake = wake.into_iter().flatten().min();
        wake.unwrap_or(now + Duration::from_secs(1))
    }

    /// When `handle_timeout` has something to do.
    pub(crate) fn next_move(&self, now: Instant) -> Option<Instant> {
        self.state.next_move(now)
    }

    /// When there is something to be sent.
    pub(crate) fn next_transmit(&self, now: Instant) -> Option<Instant> {
        self.state.next_transmit(now)
    }

    /// Emergency stop: every component goes to its safe state, every task ends as ABORTED, also one
    /// that waits, and no other starts until [`clear_stop`](Self::clear_stop).
    pub fn stop_everything(&mut self, now: Instant) {
        self.state.stop_everything(now);
    }

    /// Ends the emergency stop. Only the firmware may: the link has no command for it.
    pub const fn clear_stop(&mut self) {
        self.state.stopped = false;
    }

    /// Whether there was an emergency stop that is not cleared.
    #[must_use]
    pub const fn is_stopped(&self) -> bool {
        self.state.stopped
    }

    /// What the line has brought.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// What it moves.
    #[must_use]
    pub const fn components(&self) -> &C {
        &self.state.components
    }

    /// What it moves, for what firmware has to tell a component: a setting, a reading. What a task
    /// moves is the node's alone.
    pub const fn components_mut(&mut self) -> &mut C {
        &mut self.state.components
    }
}

#[cfg(test)]
mod tests;
