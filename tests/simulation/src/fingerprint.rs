//! Fingerprints of the real state machines: equal for equivalent states.
//!
//! The `Debug` output is hashed in a canonical form. Times are relative to now, and all times long past are equal. Sequence
//! numbers are relative to the first one of their session that appears, task ids to the first one, and session numbers are
//! replaced by their order of appearance. An idle link then returns to an earlier state, and the number of reachable states
//! is finite.

use std::fmt::{self, Debug, Write};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::LinkId;

/// Times further in the past are equal: no timer looks back that far.
const PAST: Duration = Duration::from_millis(2600);
/// Times further in the future are equal.
const FUTURE: Duration = Duration::from_secs(60);

/// Fields without influence on the behaviour: derived from others, statistics, or for readings, which the model has not.
const SKIPPED: [u64; 9] = [
    name("ending"),
    name("decoder"),
    name("bytes"),
    name("counters"),
    name("random"),
    name("frame_out"),
    name("readings_at"),
    name("turnaround"),
    name("round_trips"),
];

/// Frames that a bus keeps as bytes. Whoever skips them adds them in another form.
pub const BUS_FRAMES: [u64; 2] = [name("sent"), name("unasked")];

/// How often in a row something has failed. Larger numbers are equal.
const FAILURES: [u64; 2] = [name("garbled"), name("silent")];
const MANY_FAILURES: u64 = 12;

const SEQ: u64 = name("seq");
const CLOCK: u64 = name("clock");
const NODE_CLOCKS: [u64; 2] = [name("clock_ms"), name("before_ms")];
const SESSIONS: [u64; 4] = [
    name("session"),
    name("hello"),
    name("replaced"),
    name("replaces"),
];
/// Times at which something is due: how long ago does not matter.
const DUE: [u64; 12] = [
    name("ask_at"),
    name("awake_due"),
    name("begun_due"),
    name("due"),
    name("event_due"),
    name("not_before"),
    name("quiet_at"),
    name("receiving"),
    name("repeat"),
    name("safety_wake"),
    name("until"),
    name("wake"),
];
const INSTANT: u64 = name("Instant");
/// Ids of tasks on the link. Only their differences matter.
const LINK_ID: u64 = name("LinkId");
const HIGHEST: u64 = name("highest");
/// Larger differences are equal: no scenario has that many tasks.
const APART: i64 = 9;

/// Larger differences between the sequence numbers of a session are equal.
const FAR: u64 = 9;
/// Smaller sequence numbers differ, because a delayed `Hello` opens a session again and its numbers begin again.
const FIRST: u64 = 3;
/// Sequence numbers from here on differ, because the gateway opens a new session after 255.
pub const NEARLY_ALL: u8 = 250;

const SEED: u64 = 0xcbf2_9ce4_8422_2325;
const PRIME: u64 = 0x9e37_79b9_7f4a_7c15;

const fn step(hash: u64, number: u64) -> u64 {
    (hash.rotate_left(23) ^ number).wrapping_mul(PRIME)
}

const fn name(text: &str) -> u64 {
    word(SEED, text.as_bytes())
}

/// Hashes a piece of a word, eight bytes at a time.
const fn word(mut hash: u64, bytes: &[u8]) -> u64 {
    let (mut eight, mut place) = (0, 0);
    while place < bytes.len() {
        eight = eight << 8 | bytes[place] as u64;
        place += 1;
        if place % 8 == 0 || place == bytes.len() {
            hash = step(hash, eight);
            eight = 0;
        }
    }
    hash
}

/// The origin of times.
#[derive(Debug, Clone, Copy)]
pub struct Origin {
    /// Now, on the clock of the next part.
    pub now: Instant,
    /// Now, on the node's clock.
    pub node: Instant,
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
    depth: u32,
    /// More fields without influence.
    also_skipped: &'static [u64],
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
            depth: 0,
            also_skipped: &[],
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

    /// Adds a part of the state.
    pub fn add(&mut self, part: &impl Debug) {
        // Writing into a hash cannot fail.
        let _ = write!(self, "{part:?};");
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
        let canonical = if self.before == INSTANT {
            match self.clock.take() {
                // Only the error of the estimate matters, not when it was made.
                Some(clock) => clock.wrapping_sub(number.wrapping_sub(now.as_micros())),
                None if DUE.contains(&self.field) => {
                    let future = FUTURE.as_micros() as u64;
                    number.saturating_sub(now.as_micros()).min(future)
                }
                None => relative(number, now.as_micros()),
            }
        } else if self.field == CLOCK {
            let clock = number.wrapping_mul(1000).wrapping_sub(node.as_micros());
            self.clock = Some(clock);
            return;
        } else if NODE_CLOCKS.contains(&self.field) {
            relative(number.saturating_mul(1000), node.as_micros())
        } else if FAILURES.contains(&self.field) {
            number.min(MANY_FAILURES)
        } else if self.field == SEQ && number != 0 {
            self.sequence(number)
        } else if SESSIONS.contains(&self.field) && self.skipping.is_none() {
            self.session(number)
        } else if self.before == LINK_ID && LinkId(number as u32).is_local() {
            // Few, and apart from the others.
            number
        } else if (self.before == LINK_ID || self.field == HIGHEST) && self.skipping.is_none() {
            let base = *self.link.get_or_insert(number);
            link_relative(number, base)
        } else {
            number
        };
        self.take(canonical);
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

    /// Handles a mark or a digit; words are handled as a whole.
    fn on_byte(&mut self, byte: u8) {
        if self.quoted {
            self.take(u64::from(byte));
            self.quoted = self.escaped || byte != b'"';
            self.escaped = !self.escaped && byte == b'\\';
            return;
        }
        if byte.is_ascii_digit() {
            let digit = u64::from(byte - b'0');
            let number = self.number.unwrap_or(0);
            self.number = Some(number.wrapping_mul(10).wrapping_add(digit));
            return;
        }
        if let Some(number) = self.number.take() {
            self.on_number(number);
        }
        let word = self.word.take().unwrap_or(0);
        self.on_mark(byte, word);
    }

    fn on_word(&mut self, piece: &[u8]) {
        self.word = Some(word(self.word.unwrap_or(SEED), piece));
    }

    fn on_mark(&mut self, mark: u8, word: u64) {
        match mark {
            b'"' => self.quoted = true,
            b':' => {
                self.field = word;
                let skipped = SKIPPED.contains(&word) || self.also_skipped.contains(&word);
                if self.skipping.is_none() && skipped {
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
        let over = |depth| self.depth < depth || (self.depth == depth && mark == b',');
        if self.skipping.is_some_and(over) {
            self.skipping = None;
        }
        self.take(word ^ u64::from(mark));
    }
}

const fn is_letter(byte: u8) -> bool {
    byte.is_ascii_alphabetic() || byte == b'_'
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

/// Microseconds after now, as a nonnegative number.
fn relative(moment: u64, now: u64) -> u64 {
    let past = PAST.as_micros() as u64;
    let future = FUTURE.as_micros() as u64;
    let after = moment.saturating_add(past).saturating_sub(now);
    after.min(past + future)
}

impl Write for Fingerprint {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let mut bytes = text.as_bytes();
        while let Some((first, rest)) = bytes.split_first() {
            if self.quoted || !is_letter(*first) {
                self.on_byte(*first);
                bytes = rest;
                continue;
            }
            let part = |byte: &u8| is_letter(*byte) || byte.is_ascii_digit();
            let len = bytes.iter().take_while(|byte| part(byte)).count();
            let (piece, rest) = bytes.split_at(len);
            self.on_word(piece);
            bytes = rest;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    struct Shown {
        session: u32,
        seq: u8,
        #[expect(dead_code, reason = "only shown")]
        bytes: [u8; 2],
        at: Option<Instant>,
        clock: Option<(u64, Instant)>,
        text: &'static str,
    }

    fn shown() -> Shown {
        Shown {
            session: 0x0501,
            seq: 17,
            bytes: [1, 2],
            at: Some(Instant::from_millis(900)),
            clock: Some((400, Instant::from_millis(1000))),
            text: "a \"seq: 7\"",
        }
    }

    fn of(parts: &[&Shown], now: u64) -> u64 {
        let origin = Origin {
            now: Instant::from_millis(now),
            node: Instant::from_millis(now - 500),
        };
        let mut print = Fingerprint::new(origin);
        for part in parts {
            print.add(part);
        }
        print.finish()
    }

    #[test]
    fn the_fingerprint_ignores_completed_pings() {
        let before = shown();
        let after = Shown {
            session: 0x0901,
            seq: 43,
            bytes: [3, 4],
            at: Some(Instant::from_millis(5900)),
            // Heard later, and as right as before.
            clock: Some((4900, Instant::from_millis(5500))),
            text: before.text,
        };
        assert_eq!(of(&[&before], 1000), of(&[&after], 6000));
    }

    /// The fingerprint of parts with these sessions and sequence numbers.
    fn numbered<const PARTS: usize>(numbers: [(u32, u8); PARTS]) -> u64 {
        let parts = numbers.map(|(session, seq)| Shown {
            session,
            seq,
            ..shown()
        });
        of(&parts.each_ref(), 1000)
    }

    #[test]
    fn the_fingerprint_compares_sequence_numbers_of_a_session() {
        let (one, two) = (0x0501, 0x0601);
        let same = numbered([(one, 17), (one, 16), (two, 90), (two, 91)]);
        assert_eq!(numbered([(one, 57), (one, 56), (two, 30), (two, 31)]), same);
        assert_ne!(numbered([(one, 57), (one, 57), (two, 30), (two, 31)]), same);
        assert_ne!(numbered([(one, 57), (one, 56), (two, 30), (two, 30)]), same);
        // Long ago.
        assert_eq!(
            numbered([(one, 57), (one, 40)]),
            numbered([(one, 57), (one, 30)])
        );
        // First and last ones, even of another session.
        assert_ne!(numbered([(two, 1)]), numbered([(two, 2)]));
        assert_ne!(numbered([(two, 254)]), numbered([(two, 255)]));
        assert_ne!(
            numbered([(one, 57), (one, 1)]),
            numbered([(one, 57), (one, 2)])
        );
        // The numbers of a faulty gateway begin again.
        assert_ne!(
            numbered([(one, 255), (one, 1)]),
            numbered([(one, 255), (one, 2)])
        );
    }

    #[test]
    fn the_fingerprint_includes_relevant_fields() {
        let same = of(&[&shown()], 1000);
        let differ = |change: fn(&mut Shown)| {
            let mut other = shown();
            change(&mut other);
            assert_ne!(of(&[&other], 1000), same, "{other:?}");
        };
        differ(|s| s.seq = 0);
        differ(|s| s.seq = 2);
        differ(|s| s.session = 0x0502);
        differ(|s| s.session = 0);
        differ(|s| s.at = None);
        differ(|s| s.at = Some(Instant::from_millis(901)));
        differ(|s| s.clock = Some((401, Instant::from_millis(1000))));
        differ(|s| s.clock = Some((400, Instant::from_millis(1001))));
        differ(|s| s.text = "a \"seq: 8\"");
        // Two parts of one session, and of two.
        let (one, mut two) = (shown(), shown());
        two.session = 0x0601;
        assert_ne!(of(&[&one, &one], 1000), of(&[&one, &two], 1000));
    }

    #[test]
    fn the_fingerprint_ignores_the_distant_past() {
        let past = |millis| {
            let mut state = shown();
            state.at = Some(Instant::from_millis(millis));
            state.clock = None;
            of(&[&state], 100_000)
        };
        assert_eq!(past(0), past(97_000));
        assert_ne!(past(97_000), past(97_500));
    }
}
