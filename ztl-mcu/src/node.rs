//! The device end of the link.

mod bus;
mod commands;
mod frame_out;
mod link_state;
#[cfg(feature = "zmtp")]
mod local;
mod own;
mod parameters;
mod refusal;
mod runner;
pub(crate) mod tasks;
mod transmit;
mod update;
pub(crate) mod utf8;

use core::hash::{Hash, Hasher};
use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{
    Body, Decoder, FrameError, LINK_TIMEOUT, LONGEST_FRAME, LinkId, NO_SEQ, NO_SESSION, Offer,
    Pushed,
};
use ztl_core::time::micros;

#[cfg(doc)]
use crate::component::Component;
use crate::component::Components;
use crate::log::LogSource;
use frame_out::{FrameOut, longest};
use link_state::{Answer, LinkState, count};
use tasks::Table;

pub use link_state::{Counters, LinkUp};
pub use refusal::Reason;
use runner::IndexSet;
pub(crate) use runner::TaskRunner;

/// Default for [`Identity::reading_interval`].
const READING_INTERVAL: Duration = Duration::from_millis(10);
/// A `FRAME` must have room for a device name and a firmware version of at least this many bytes.
const SHORTEST_NAME: usize = 16;
/// Longest pause within a command. Bytes that stay in the decoder for longer are noise.
const PAUSE: Duration = Duration::from_millis(20);

/// How a node introduces itself, and its timing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Identity<'a> {
    /// Name of the device.
    pub name: &'a str,
    /// Version of its firmware.
    pub firmware: &'a str,
    /// Differs from boot to boot: random, or a counter that survives resets.
    pub boot: u32,
    /// After how long without a new command the link counts as lost. Defaults to 1 s; a gateway accepts
    /// [50 ms to 60 s](ztl_core::link::LINK_TIMEOUTS).
    pub link_timeout: Duration,
    /// Minimum time between two readings of a component. Defaults to 10 ms, which allows 100 readings a second
    /// of each. With zero, a component that always has another reading takes all of the line that nothing else
    /// needs.
    pub reading_interval: Duration,
}

impl<'a> Identity<'a> {
    /// An identity with default timing.
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

/// The longest prefix of `text` that fits into `most` bytes.
const fn cut(text: &str, mut most: usize) -> &str {
    while !text.is_char_boundary(most) && most < text.len() {
        most = most.saturating_sub(1);
    }
    match text.split_at_checked(most) {
        Some((begin, _)) => begin,
        None => text,
    }
}

/// The device end of the link, without I/O. It drives the components `C`, holds at most `TASKS` tasks, and
/// handles frames of at most `FRAME` bytes. `FRAME` is 128 to 1100, see [`new`](Self::new); a goal can have
/// about 24 bytes less.
///
/// *Inputs*: [`handle_bytes`](Self::handle_bytes) when bytes arrive, [`handle_timeout`](Self::handle_timeout)
/// in every turn of the main loop. *Outputs*, after each input: [`poll_transmit`](Self::poll_transmit), or
/// [`transmit_buf`](Self::transmit_buf) and [`consume`](Self::consume), which copy nothing. *Next wake-up*:
/// [`poll_timeout`](Self::poll_timeout). *Commands*: [`stop_everything`](Self::stop_everything),
/// [`clear_stop`](Self::clear_stop). [`Pump`](crate::pump::Pump) calls all of them for a serial port.
///
/// **Work.** The work of each call is bounded for any input:
/// - `handle_bytes` takes some ten instructions a byte. At the end of a frame it verifies the checksum, at most
///   twice, and makes one call of `check`, `start` or `abort`.
/// - `handle_timeout` calls `poll` once for each running task and tick that is due, and `start` for one that
///   waited. When the link is lost, it calls `make_safe` and `poll` at most twice for each component. It calls both
///   again, every 50 ms, for each one that fails to become safe.
/// - The outputs produce one frame of at most `FRAME` bytes at a time, and call `offer` and `poll_reading` once
///   for each component.
///
/// Tasks are searched in sequence, so all of this grows with `TASKS`.
///
/// Two nodes are equal if they behave the same from now on; their counters, and since when the link is up, do not matter.
#[derive(Debug, Clone)]
pub struct Node<'a, C, const TASKS: usize, const FRAME: usize> {
    counters: Counters,
    decoder: Decoder<FRAME>,
    state: LinkState<'a, C, TASKS, FRAME>,
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

impl<'a, C: Components, const TASKS: usize, const FRAME: usize> Node<'a, C, TASKS, FRAME> {
    /// Longest reading that a component can publish, in bytes.
    pub const LONGEST_READING: usize = longest::reading(FRAME);

    /// Longest [result](Component::result) that a component can hand over, in bytes. A longer one is cut and ends in `…`.
    pub const LONGEST_RESULT: usize = longest::result(FRAME);

    /// Longest device name and firmware version, in bytes. Longer ones are cut, so that the node's introduction
    /// to a gateway always fits a frame together with the ids of all tasks.
    pub const LONGEST_NAME: usize = longest::name(FRAME, TASKS);

    const CHECKED: () = {
        assert!(FRAME >= 128, "FRAME must be at least 128");
        assert!(
            FRAME <= LONGEST_FRAME,
            "FRAME must be at most 1100: a gateway decodes no longer frame"
        );
        assert!(TASKS >= 1 && TASKS <= 255, "TASKS must be 1 to 255");
        assert!(
            Self::LONGEST_NAME >= SHORTEST_NAME,
            "FRAME has no room for the ids of all tasks: raise FRAME, or lower TASKS"
        );
    };

    /// A node after its reset, with at most 255 components.
    ///
    /// The compiler checks that `TASKS` is 1 to 255 and that `FRAME` is at least 128, at most
    /// [`LONGEST_FRAME`], which a gateway decodes, and has room for the ids of that many tasks: 128 suffices for
    /// 9 tasks, 256 for 34, 1100 for 202.
    ///
    /// ```
    /// # use ztl_mcu::{Component, Identity, Node};
    /// # let arms: [&mut dyn Component; 0] = [];
    /// Node::<_, 2, 1100>::new(Identity::new("arm", "1.0.0", 7), arms);
    /// # let arms: [&mut dyn Component; 0] = [];
    /// Node::<_, 9, 128>::new(Identity::new("arm", "1.0.0", 7), arms);
    /// ```
    ///
    /// ```compile_fail,E0080
    /// # use ztl_mcu::{Component, Identity, Node};
    /// # let arms: [&mut dyn Component; 0] = [];
    /// Node::<_, 2, 1101>::new(Identity::new("arm", "1.0.0", 7), arms);
    /// ```
    ///
    /// ```compile_fail,E0080
    /// # use ztl_mcu::{Component, Identity, Node};
    /// # let arms: [&mut dyn Component; 0] = [];
    /// Node::<_, 10, 128>::new(Identity::new("arm", "1.0.0", 7), arms);
    /// ```
    pub const fn new(identity: Identity<'a>, components: C) -> Self {
        const { Self::CHECKED };
        Self {
            counters: Counters {
                frames: 0,
                errors: 0,
                repeats: 0,
                out_of_sequence: 0,
                up_since: Instant::ZERO,
            },
            decoder: Decoder::new(),
            state: LinkState {
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
                // Not by a call: its result would be copied, and take its stack space twice.
                runner: TaskRunner {
                    stopped: false,
                    safety_wake: Instant::NEVER,
                    retry_at: Instant::ZERO,
                    readings_wake: Instant::ZERO,
                    unsafe_components: IndexSet::new(),
                    components,
                    reason: Reason::new(),
                    tasks: Table::new(),
                },
                frame_out: FrameOut::new(),
            },
        }
    }

    /// Whether a component's description fits a frame; the compiler checks `FRAME` as for [`new`](Self::new). A
    /// node refuses to send a longer one; the gateway then does not serve the device, and reports why.
    #[must_use]
    pub fn fits(offer: &Offer<'_>) -> bool {
        const { Self::CHECKED };
        let body = Body::Component {
            index: u8::MAX,
            offer: *offer,
        };
        let mut len = 0;
        body.put(&mut |bytes: &[u8]| len += bytes.len());
        len <= longest::body(FRAME)
    }

    /// Handles received bytes, in pieces of any length.
    // Not inlined in firmware: that saves 224 bytes in `mps2-an386`.
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

    /// Handles a complete frame.
    fn on_frame(&mut self, now: Instant) {
        if self.on_bus_frame(now) {
            return self.decoder.reset();
        }
        let sessions = [self.state.session, NO_SESSION];
        match self.decoder.command(&sessions) {
            Ok(frame) => self.state.on_frame(now, &frame, &mut self.counters),
            Err(FrameError::Body(_)) if C::ACTING || C::PARAMETER_COUNT > 0 || C::UPDATES => {
                self.on_other_frame(now);
            }
            Err(_) => self.on_damage(),
        }
        self.decoder.reset();
    }

    /// Handles what only some nodes know: commands about parameters and updates, and answers about tasks and events of the firmware.
    fn on_other_frame(&mut self, now: Instant) {
        let session = self.state.session;
        if session == NO_SESSION {
            return self.on_damage();
        }
        if C::PARAMETER_COUNT > 0
            && let Ok(command) = self.decoder.parameter_command(session)
        {
            let counters = &mut self.counters;
            return self.state.on_parameter_command(now, command, counters);
        }
        if C::UPDATES
            && let Ok(command) = self.decoder.update_command(session)
        {
            let counters = &mut self.counters;
            return self.state.on_update_command(now, command, counters);
        }
        let address = self.state.address();
        if C::ACTING
            && let Some(answer) = self.decoder.own_answer(address, session)
        {
            count(&mut self.counters.frames);
            return self.state.on_own_answer(now, answer);
        }
        self.on_damage();
    }

    /// Counts a dropped frame.
    fn on_damage(&mut self) {
        self.end_turn();
        count(&mut self.counters.errors);
    }

    /// Advances the components, and makes them safe when the link is lost.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.state.check_link_timer(now);
        self.state.runner.handle_timeout(now);
        if C::UPDATES {
            self.state.on_update_timeout(now);
        }
    }

    /// Writes the next bytes to send into `buffer` and returns how many. Fewer than the buffer holds means that
    /// there is nothing more to send now. The log is not included.
    ///
    /// If components always have readings, there is always more to send; a main loop must not wait for the end.
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

    /// The next bytes to send: the rest of the current frame, or the most urgent next one. Empty if there is
    /// nothing to send. Call [`consume`](Self::consume) after sending.
    pub fn transmit_buf(&mut self, now: Instant, log: &dyn LogSource) -> &[u8] {
        self.state.transmit_buf(now, log)
    }

    /// Marks the first `count` bytes of [`transmit_buf`](Self::transmit_buf) as sent.
    pub fn consume(&mut self, count: usize) {
        self.state.frame_out.consume(count);
    }

    /// When to call [`handle_timeout`](Self::handle_timeout) and [`poll_transmit`](Self::poll_transmit) even if
    /// no byte arrives; in 1 s if there is nothing to do.
    pub fn poll_timeout(&self, now: Instant) -> Instant {
        match self.next_move().min(self.next_transmit(now)) {
            Instant::NEVER => now + Duration::from_secs(1),
            wake => wake,
        }
    }

    /// When `handle_timeout` has work, or [`Instant::NEVER`].
    pub(crate) fn next_move(&self) -> Instant {
        let next = self.state.lost_at.min(self.state.runner.next_move());
        if C::UPDATES {
            return next.min(self.state.next_update());
        }
        next
    }

    /// When there is something to send, or [`Instant::NEVER`].
    pub(crate) fn next_transmit(&self, now: Instant) -> Instant {
        self.state.next_transmit(now)
    }

    /// Emergency stop: every component goes to its safe state, and every task ends as ABORTED: a waiting one at
    /// once, a running one when its component is safe. No task starts until [`clear_stop`](Self::clear_stop).
    pub fn stop_everything(&mut self, now: Instant) {
        self.state.runner.stop_everything(now);
    }

    /// Ends the emergency stop. Only the firmware can do this; the link has no command for it.
    pub const fn clear_stop(&mut self) {
        self.state.runner.clear_stop();
    }

    /// Whether an emergency stop is in effect.
    #[must_use]
    pub const fn is_stopped(&self) -> bool {
        self.state.runner.is_stopped()
    }

    /// The gateway and since when the link is up, or `None`: there was no command yet, or none for the link timeout.
    #[must_use]
    pub fn link(&self, now: Instant) -> Option<LinkUp> {
        let lost_at = self.state.lost_at;
        (lost_at != Instant::NEVER && now < lost_at).then_some(LinkUp {
            gateway: self.state.gateway,
            since: self.counters.up_since,
        })
    }

    /// Statistics of the line.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// The components.
    #[must_use]
    pub const fn components(&self) -> &C {
        self.state.runner.components()
    }

    /// The components, mutable, so that firmware can pass them settings and readings. Only the node may start
    /// and stop their motions. The node then asks them for readings again, so call it only when there is something to pass.
    pub const fn components_mut(&mut self) -> &mut C {
        self.state.runner.components_mut()
    }
}

#[cfg(test)]
mod tests;
