//! The device end of the link.

mod commands;
#[cfg(feature = "zmtp")]
mod local;
mod runner;
pub(crate) mod tasks;
pub(crate) mod text;
mod transmit;

use core::hash::{Hash, Hasher};
use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{Body, Decoder, LINK_TIMEOUT, LinkId, NO_SEQ, NO_SESSION, Offer, Pushed};
use ztl_core::time::micros;

use crate::component::Components;
use crate::log::LogSource;
use commands::Answer;
pub(crate) use runner::Runner;
use tasks::Table;
use transmit::{PAUSE, Transmit, longest};

/// Least time between two readings of a component, unless the firmware says otherwise.
const READING_INTERVAL: Duration = Duration::from_millis(10);
/// Bytes that a device's name, and its firmware's version, can have at least.
const SHORTEST_NAME: usize = 16;

/// Why a component does not take a goal; at most 96 bytes, and the mark of a cut.
pub type Reason = heapless::String<99>;

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
    /// Least time between two readings of a component. Default 10 ms, which is 100 readings a second of each. With
    /// zero a component that always has another reading gets all of the line that nothing else needs.
    pub reading_interval: Duration,
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
            reading_interval: READING_INTERVAL,
        }
    }
}

/// `text`, or as much of its beginning as fits into so many bytes.
const fn cut(text: &str, mut most: usize) -> &str {
    while !text.is_char_boundary(most) && most < text.len() {
        most = most.saturating_sub(1);
    }
    match text.split_at_checked(most) {
        Some((begin, _)) => begin,
        None => text,
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

fn count(counter: &mut u32) {
    *counter = counter.wrapping_add(1);
}

/// The device end of the link, without I/O: it moves the components `C`, holds at most `TASKS` tasks
/// and frames of at most `FRAME` bytes (128 and more, see [`new`](Self::new); a goal may be some 24 bytes shorter).
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
/// `abort`. `handle_timeout`: `poll` once for each task that moves and is due, and `start` for one that waited; when
/// the link is lost, `make_safe` and twice `poll` for each component. The outputs: one frame of at most `FRAME` bytes at a time, and once for each
/// component `offer` and `poll_reading`. Tasks are searched in turn, so all of it grows with `TASKS`.
///
/// Two nodes are equal when they will do the same from now on; what they have counted does not matter.
#[derive(Debug, Clone)]
pub struct Node<'a, C, const TASKS: usize, const FRAME: usize> {
    counters: Counters,
    decoder: Decoder<FRAME>,
    /// Apart from the decoder, whose buffer a frame borrows while it is acted on.
    state: Inner<'a, C, TASKS, FRAME>,
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

// What is small stands first: there a Cortex-M0 reaches it with one instruction.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[repr(C)]
struct Inner<'a, C, const TASKS: usize, const FRAME: usize> {
    /// `seq` of the last command executed.
    seq: u8,
    answer_due: bool,
    /// A delimiter was sent before the next announcement.
    flushed: bool,
    /// The component that is asked for a reading next; in each round every one is asked once.
    publisher: u8,
    /// Whether one had a reading in this round.
    published: bool,
    /// The session that runs, [`NO_SESSION`] after a reset.
    session: u32,
    /// The number of the `Hello` that opened it.
    hello: u32,
    /// The same of the session before.
    replaced: u32,
    highest: LinkId,
    answer: Answer,
    gateway: u64,
    /// In µs.
    link_timeout: u64,
    awake_due: Instant,
    /// When a new command was last executed, or a session opened; until the link timeout has
    /// passed no other gateway gets in.
    heard: Instant,
    /// When the link timer runs out: the link timeout after the last new command was executed.
    /// [`Instant::NEVER`] once it has.
    lost_at: Instant,
    /// Until when what stands in the decoder is a command that is coming in.
    receiving: Instant,
    /// When the next round of readings begins.
    readings_at: Instant,
    /// In µs.
    reading_interval: u64,
    /// A `Hello` to be refused: its session, and why.
    refusal: Option<(u32, &'static str)>,
    name: &'a str,
    firmware: &'a str,
    boot: u32,
    runner: Runner<C, TASKS>,
    transmit: Transmit<FRAME>,
}

impl<'a, C: Components, const TASKS: usize, const FRAME: usize> Node<'a, C, TASKS, FRAME> {
    /// Longest reading that a component can publish, in bytes.
    pub const LONGEST_READING: usize = longest::reading(FRAME);

    /// Longest name of the device, and longest version of its firmware, in bytes. What is longer is cut, so that the
    /// node can tell a gateway who it is and which tasks it holds, however many and whatever their ids.
    pub const LONGEST_NAME: usize = longest::name(FRAME, TASKS);

    /// A node after its reset. `components` are at most 255.
    ///
    /// It compiles with `TASKS` from 1 to 255 and a `FRAME` of at least 128 bytes that has room for the ids of as many
    /// tasks: 128 for 9 tasks, 256 for 34.
    pub const fn new(identity: Identity<'a>, components: C) -> Self {
        const {
            assert!(FRAME >= 128, "a frame has at least 128 bytes");
            assert!(TASKS >= 1 && TASKS <= 255, "there are 1 to 255 tasks");
            assert!(
                Self::LONGEST_NAME >= SHORTEST_NAME,
                "a frame has room for the ids of all tasks: raise FRAME, or lower TASKS"
            );
        };
        Self {
            counters: Counters {
                frames: 0,
                errors: 0,
                repeats: 0,
                out_of_sequence: 0,
            },
            decoder: Decoder::new(),
            state: Inner {
                seq: NO_SEQ,
                answer_due: false,
                flushed: false,
                publisher: 0,
                published: false,
                session: NO_SESSION,
                hello: NO_SESSION,
                replaced: NO_SESSION,
                highest: LinkId(0),
                answer: Answer::Nothing,
                gateway: 0,
                link_timeout: micros(identity.link_timeout),
                reading_interval: micros(identity.reading_interval),
                awake_due: Instant::ZERO,
                heard: Instant::ZERO,
                lost_at: Instant::NEVER,
                receiving: Instant::ZERO,
                readings_at: Instant::ZERO,
                refusal: None,
                name: cut(identity.name, Self::LONGEST_NAME),
                firmware: cut(identity.firmware, Self::LONGEST_NAME),
                boot: identity.boot,
                // No call, since what one returns is copied, and a Cortex-M0's stack then has it twice.
                runner: Runner {
                    stopped: false,
                    all_to_safety: false,
                    safety_wake: Instant::NEVER,
                    components,
                    reason: Reason::new(),
                    tasks: Table::new(),
                },
                transmit: Transmit::new(),
            },
        }
    }

    /// Whether what a component offers can be told to a gateway: it fits into a frame. Of one that is longer the node
    /// refuses the description, and its gateway does not serve the device and says why.
    #[must_use]
    pub fn fits(offer: &Offer<'_>) -> bool {
        let body = Body::Component {
            index: u8::MAX,
            offer: *offer,
        };
        let mut len = 0;
        body.put(&mut |bytes: &[u8]| len += bytes.len());
        len <= longest::body(FRAME)
    }

    /// Bytes have arrived, in pieces of any length.
    // This and others are functions of their own in firmware, where what they become in a main loop's is larger.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn handle_bytes(&mut self, now: Instant, mut bytes: &[u8]) {
        if bytes.is_empty() {
            return;
        }
        while !bytes.is_empty() {
            match self.decoder.push_all(&mut bytes) {
                Pushed::Nothing => {}
                Pushed::Frame => self.on_frame(now),
                Pushed::Truncated | Pushed::TooLong => self.on_damage(),
            }
        }
        self.state.receiving = Instant::ZERO;
        if self.decoder.has_begun() {
            self.state.receiving = now + PAUSE;
        }
    }

    /// A frame has come to its end.
    fn on_frame(&mut self, now: Instant) {
        let sessions = [self.state.session, NO_SESSION];
        match self.decoder.command(&sessions) {
            Ok(frame) => self.state.on_frame(now, &frame, &mut self.counters),
            Err(_) => self.on_damage(),
        }
        self.decoder.reset();
    }

    /// A frame is dropped.
    fn on_damage(&mut self) {
        count(&mut self.counters.errors);
    }

    /// Time has passed: moves the components on, and acts by itself when the link is lost.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.state.look_at_link(now);
        self.state.runner.handle_timeout(now);
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
        match self.next_move().min(self.next_transmit(now)) {
            Instant::NEVER => now + Duration::from_secs(1),
            wake => wake,
        }
    }

    /// When `handle_timeout` has something to do; perhaps [`Instant::NEVER`].
    pub(crate) fn next_move(&self) -> Instant {
        self.state.lost_at.min(self.state.runner.next_move())
    }

    /// When there is something to be sent; perhaps [`Instant::NEVER`].
    pub(crate) fn next_transmit(&self, now: Instant) -> Instant {
        self.state.next_transmit(now)
    }

    /// Emergency stop: every component goes to its safe state, every task ends as ABORTED, one that waits at once, one
    /// that moves when its component is safe, and no other starts until [`clear_stop`](Self::clear_stop).
    pub fn stop_everything(&mut self, now: Instant) {
        self.state.runner.stop_everything(now);
    }

    /// Ends the emergency stop. Only the firmware may: the link has no command for it.
    pub const fn clear_stop(&mut self) {
        self.state.runner.clear_stop();
    }

    /// Whether there was an emergency stop that is not cleared.
    #[must_use]
    pub const fn is_stopped(&self) -> bool {
        self.state.runner.is_stopped()
    }

    /// What the line has brought.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// What it moves.
    #[must_use]
    pub const fn components(&self) -> &C {
        self.state.runner.components()
    }

    /// What it moves, for what firmware has to tell a component: a setting, a reading. What a task
    /// moves is the node's alone.
    pub const fn components_mut(&mut self) -> &mut C {
        self.state.runner.components_mut()
    }
}

#[cfg(test)]
mod tests;
