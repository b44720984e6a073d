//! Fingerprints of the real state machines: equal for equivalent states.
//!
//! The `Debug` output is hashed in a canonical form. Times are relative to now, and all times long past are equal. Sequence
//! numbers are relative to the first one of their session that appears, task ids to the first one, and session numbers are
//! replaced by their order of appearance. An idle link then returns to an earlier state, and the number of reachable states
//! is finite.
//!
//! What is overwritten before it is read again is left out. [`exactly`](Fingerprint::exactly) keeps it, so that a test can
//! compare states that differ only in that.

mod fields;

use std::fmt::{self, Debug, Write};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::LinkId;

use fields::{
    ANSWERED, APART, CLOCK, CLOCK_MS, DEADLINE, DUE, FAILURES, FAR, FIRST, FUTURE, HEARD, HIGHEST,
    INSTANT, LINK_ID, MANY_FAILURES, NODE_CLOCKS, OVERWRITTEN, PAST, PHASE, REPLACED, RUNNING,
    SEED, SEQ, SESSIONS, SKIPPED, STAGE, UNANSWERED, step, word,
};

pub use fields::{BUS_FRAMES, NEARLY_ALL};

/// The origin of times.
#[derive(Debug, Clone, Copy)]
pub struct Origin {
    /// Now, on the clock of the next part.
    pub now: Instant,
    /// Now, on the node's clock.
    pub node: Instant,
}

/// What decides which fields of a session will be read.
#[derive(Debug, Default)]
struct InSession {
    /// Whether some of its tasks may run.
    busy: bool,
    /// Whether its `Hello` is not answered, or not sent.
    unanswered: bool,
    /// The deadline of a task whose stage follows.
    deadline: Option<u64>,
    /// The deadlines of tasks that run.
    deadlines: Vec<u64>,
}

/// Hashes the canonical form of `Debug` output.
#[derive(Debug)]
pub struct Fingerprint {
    hash: u64,
    origin: Origin,
    /// The sessions that were met so far, in this order: the number of each, and the first sequence number met in it. Entry
    /// 0 stands for frames without a session.
    sessions: Vec<(u32, Option<u64>)>,
    /// The last one that appeared, to which the next sequence number belongs.
    current: usize,
    /// The first task id, to which the others are relative.
    link: Option<u64>,
    /// What is known of the session that is being added.
    in_session: Option<InSession>,
    depth: u32,
    /// More fields without influence.
    also_skipped: &'static [u64],
    /// Whether what is overwritten before it is read again counts as well.
    exact: bool,
    /// How long ago a time is that is equal to all earlier ones.
    past: Duration,
    /// Depth of the field that is being skipped.
    skipping: Option<u32>,
    /// The current word, and the current number.
    word: Option<u64>,
    number: Option<u64>,
    /// The name before the last `:`, and the word before the last bracket.
    field: u64,
    before: u64,
    /// The node's clock in the gateway's estimate; the time of that estimate follows.
    clock: Option<u64>,
    quoted: bool,
    escaped: bool,
}

impl Fingerprint {
    /// The fingerprint of nothing.
    #[must_use]
    pub fn new(origin: Origin) -> Self {
        Self {
            hash: SEED,
            origin,
            sessions: vec![(0, None)],
            current: 0,
            link: None,
            in_session: None,
            depth: 0,
            also_skipped: &[],
            exact: false,
            past: PAST,
            skipping: None,
            word: None,
            number: None,
            field: 0,
            before: 0,
            clock: None,
            quoted: false,
            escaped: false,
        }
    }

    /// Sets the clock of the next part.
    pub const fn set_now(&mut self, now: Instant) {
        self.origin.now = now;
    }

    /// Skips these fields of the next parts, too.
    pub const fn skip(&mut self, fields: &'static [u64]) {
        self.also_skipped = fields;
    }

    /// Also compares what is overwritten before it is read again.
    #[must_use]
    pub const fn exactly(mut self) -> Self {
        self.exact = true;
        self
    }

    /// Whether that is compared.
    #[must_use]
    pub const fn is_exact(&self) -> bool {
        self.exact
    }

    /// Adds a part of the state.
    pub fn add(&mut self, part: &impl Debug) {
        // Writing into a hash cannot fail.
        let _ = write!(self, "{part:?};");
    }

    /// Adds a part that looks back no further than this.
    pub fn add_recent(&mut self, part: &impl Debug, past: Duration) {
        self.past = if self.exact { PAST } else { past };
        self.add(part);
        self.past = PAST;
    }

    /// Adds the session of a gateway. `busy`: some of its tasks may run.
    pub fn add_session(&mut self, session: &impl Debug, busy: bool) {
        self.in_session = (!self.exact).then(|| InSession {
            busy,
            ..InSession::default()
        });
        self.add(session);
        self.in_session = None;
    }

    /// Returns the fingerprint, spread over all bits.
    #[must_use]
    pub const fn finish(&self) -> u64 {
        let mixed = (self.hash ^ (self.hash >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed ^ (mixed >> 32)
    }

    const fn take(&mut self, number: u64) {
        if self.skipping.is_none() {
            self.hash = step(self.hash, number);
        }
    }

    /// Handles a complete number.
    fn on_number(&mut self, number: u64) {
        let (now, node) = (self.origin.now, self.origin.node);
        if let Some(session) = &mut self.in_session
            && self.before == INSTANT
        {
            match self.field {
                DEADLINE => {
                    session.deadline = Some(number);
                    return;
                }
                HEARD => self.on_heard(number),
                _ => {}
            }
        }
        let canonical = if self.before == INSTANT {
            match self.clock.take() {
                // Only the error of the estimate matters, not when it was made.
                Some(clock) => {
                    let error = clock.wrapping_sub(number.wrapping_sub(now.as_micros()));
                    self.clock_error(error)
                }
                None if DUE.contains(&self.field) => {
                    let future = FUTURE.as_micros() as u64;
                    number.saturating_sub(now.as_micros()).min(future)
                }
                None => self.relative(number, now.as_micros()),
            }
        } else if self.field == CLOCK {
            let clock = number.wrapping_mul(1000).wrapping_sub(node.as_micros());
            self.clock = Some(clock);
            return;
        } else if NODE_CLOCKS.contains(&self.field) {
            let clock = self.relative(number.saturating_mul(1000), node.as_micros());
            match self.field {
                // Ahead, it is of an earlier boot.
                CLOCK_MS if !self.exact => clock.min(self.past.as_micros() as u64 + 1),
                _ => clock,
            }
        } else if FAILURES.contains(&self.field) {
            number.min(MANY_FAILURES)
        } else if self.field == SEQ && number != 0 {
            self.sequence(number)
        } else if REPLACED.contains(&self.field) && !self.exact {
            number.min(1)
        } else if SESSIONS.contains(&self.field) || REPLACED.contains(&self.field) {
            self.session(number)
        } else if self.before == LINK_ID && LinkId(number as u32).is_local() {
            // Few, and apart from the others.
            number
        } else if self.before == LINK_ID || self.field == HIGHEST {
            let base = *self.link.get_or_insert(number);
            link_relative(number, base)
        } else {
            number
        };
        self.take(canonical);
    }

    /// A device has ended a task by itself when the link timeout has passed since its deadline, and twice the link timeout since
    /// the last answer. So a deadline before the last answer does not matter.
    fn on_heard(&mut self, heard: u64) {
        let Some(session) = &mut self.in_session else {
            return;
        };
        for deadline in std::mem::take(&mut session.deadlines) {
            self.take(self.relative(deadline.max(heard), self.origin.now.as_micros()));
        }
    }

    /// The time by which the gateway's estimate of the node's clock is ahead. The estimate can be late by no more than a task
    /// may wait, and ahead only if it is of an earlier boot.
    fn clock_error(&self, ahead: u64) -> u64 {
        if self.exact {
            return ahead;
        }
        let most = PAST.as_micros() as i64;
        (ahead as i64).clamp(-most, 1) as u64
    }

    /// Microseconds after now, as a nonnegative number.
    fn relative(&self, moment: u64, now: u64) -> u64 {
        let past = self.past.as_micros() as u64;
        let future = FUTURE.as_micros() as u64;
        let after = moment.saturating_add(past).saturating_sub(now);
        after.min(past + future)
    }

    /// Replaces a session number by its index; the lowest eight bits are the boot id in its key.
    fn session(&mut self, number: u64) -> u64 {
        let Ok(key) = u32::try_from(number) else {
            return number;
        };
        let (opened, boot) = (key >> 8, number & 0xff);
        let known = self.sessions.iter().position(|known| known.0 == opened);
        self.current = known.unwrap_or_else(|| {
            self.sessions.push((opened, None));
            self.sessions.len() - 1
        });
        (self.current as u64) << 8 | boot
    }

    /// A sequence number from 1 to 255, relative to the first one of its session.
    fn sequence(&mut self, number: u64) -> u64 {
        let first = *self.sessions[self.current].1.get_or_insert(number);
        let ahead = (number + 255 - first) % 255;
        let near = !(FAR..=255 - FAR).contains(&ahead);
        let differs = number < FIRST || number >= NEARLY_ALL.into();
        (if differs { number } else { FIRST }) << 8 | (if near { ahead } else { FAR })
    }

    fn on_quoted(&mut self, byte: u8) {
        self.take(u64::from(byte));
        self.quoted = self.escaped || byte != b'"';
        self.escaped = !self.escaped && byte == b'\\';
    }

    const fn on_digit(&mut self, digit: u8) {
        let number = match self.number {
            Some(number) => number.wrapping_mul(10),
            None => 0,
        };
        self.number = Some(number.wrapping_add((digit - b'0') as u64));
    }

    fn on_word(&mut self, piece: &[u8]) {
        self.word = Some(word(self.word.unwrap_or(SEED), piece));
    }

    fn is_skipped(&self, field: u64) -> bool {
        let overwritten = |session: &InSession| {
            session.unanswered && OVERWRITTEN.contains(&field) || !session.busy && field == HEARD
        };
        SKIPPED.contains(&field)
            || self.also_skipped.contains(&field)
            || self.in_session.as_ref().is_some_and(overwritten)
    }

    /// Handles the word after the name of a field.
    fn on_value(&mut self, word: u64) {
        let Some(session) = &mut self.in_session else {
            return;
        };
        match self.field {
            PHASE if UNANSWERED.contains(&word) => session.unanswered = true,
            PHASE if ANSWERED.contains(&word) => session.unanswered = false,
            STAGE => match session.deadline.take() {
                Some(deadline) if word == RUNNING => session.deadlines.push(deadline),
                Some(deadline) => {
                    self.take(self.relative(deadline, self.origin.now.as_micros()));
                }
                None => {}
            },
            _ => {}
        }
    }

    /// Handles a mark, which ends a word or a number.
    fn on_mark(&mut self, mark: u8) {
        let (number, word) = (self.number.take(), self.word.take().unwrap_or(0));
        if let Some(number) = number
            && self.skipping.is_none()
        {
            self.on_number(number);
        }
        match mark {
            b'"' => self.quoted = true,
            b':' if self.skipping.is_none() => {
                self.field = word;
                if self.is_skipped(word) {
                    self.skipping = Some(self.depth);
                }
            }
            b'(' | b'[' | b'{' => {
                self.depth += 1;
                self.before = word;
            }
            b')' | b']' | b'}' => {
                self.depth = self.depth.saturating_sub(1);
                self.before = 0;
            }
            _ => {}
        }
        if mark != b':' {
            self.on_value(word);
        }
        let over = |depth| self.depth < depth || (self.depth == depth && mark == b',');
        if self.skipping.is_some_and(over) {
            self.skipping = None;
        }
        self.take(word ^ u64::from(mark));
    }
}

/// Whether a byte is part of a word or of a number.
const fn is_part(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

/// A task id relative to another one.
const fn link_relative(number: u64, base: u64) -> u64 {
    let difference = number.wrapping_sub(base) as i64;
    let clamped = if difference > APART {
        APART
    } else if difference < -APART {
        -APART
    } else {
        difference
    };
    clamped as u64
}

impl Write for Fingerprint {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let mut bytes = text.as_bytes();
        while let Some((first, rest)) = bytes.split_first() {
            if self.quoted {
                self.on_quoted(*first);
                bytes = rest;
            } else if is_part(*first) && !first.is_ascii_digit() {
                let len = bytes.iter().take_while(|byte| is_part(**byte)).count();
                let (piece, rest) = bytes.split_at(len);
                if self.skipping.is_none() {
                    self.on_word(piece);
                }
                bytes = rest;
            } else {
                match *first {
                    b' ' => {}
                    digit @ b'0'..=b'9' => self.on_digit(digit),
                    mark => self.on_mark(mark),
                }
                bytes = rest;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
