//! One direction of a line that loses, alters, repeats and holds back bytes, without I/O.

use std::collections::VecDeque;
use std::ops::Range;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::time::earliest;

use super::dice::Dice;

/// Bytes that may be under way; what comes beyond is lost.
const UNDER_WAY: usize = 64 * 1024;
/// Bytes that a sender may be ahead of the line rate, as in a serial port's own buffer.
const AHEAD: u64 = 4096;

/// How bad a line is. Default: not at all.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Faults {
    /// Probability that a bit is turned round.
    pub flip: f64,
    /// Probability that a byte is lost.
    pub drop: f64,
    /// Probability that a byte comes twice.
    pub double: f64,
    /// Probability, for each byte, that the line holds back this one and all that follow.
    pub stall: f64,
    /// For how long it does so at most; each time is random, and what was held back comes at once.
    pub stall_for: Duration,
}

/// What has become of the bytes of one direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Counts {
    /// Bytes that were sent into the line.
    pub bytes: u64,
    /// Bits turned round.
    pub flips: u64,
    /// Bytes lost.
    pub drops: u64,
    /// Bytes that came twice.
    pub doubles: u64,
    /// How often the line held everything back.
    pub stalls: u64,
    /// Bytes lost while it was cut.
    pub cut: u64,
    /// Bytes lost since more were under way than it holds, or since nobody was there to take them.
    pub lost: u64,
}

impl Counts {
    /// How many things went wrong, of all kinds.
    #[must_use]
    pub const fn faults(&self) -> u64 {
        self.flips + self.drops + self.doubles + self.stalls + self.cut + self.lost
    }
}

impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} bytes, {} bits flipped, {} dropped, {} doubled, {} stalls, {} cut off, {} not taken",
            self.bytes, self.flips, self.drops, self.doubles, self.stalls, self.cut, self.lost
        )
    }
}

/// One direction of a line with faults.
///
/// *Inputs*: [`handle_bytes`](Self::handle_bytes). *Outputs*: [`poll_bytes`](Self::poll_bytes). *Next
/// wake-up*: [`poll_timeout`](Self::poll_timeout). The same seed, bytes and times bring the same
/// faults. Work per call is bounded by the bytes given or taken.
///
/// ```
/// use ztl_core::Instant;
/// use ztl_std::line::{Faults, FaultyLine};
///
/// let mut line = FaultyLine::new(Faults::default(), 1).with_baud(115_200);
/// line.handle_bytes(Instant::ZERO, b"ab");
/// let mut buffer = [0; 8];
/// // Ten bits a byte: 87 µs each.
/// assert_eq!(line.poll_bytes(Instant::from_micros(86), &mut buffer), 0);
/// assert_eq!(line.poll_bytes(Instant::from_micros(174), &mut buffer), 2);
/// assert_eq!(&buffer[..2], b"ab");
/// ```
#[derive(Debug, Clone)]
pub struct FaultyLine {
    faults: Faults,
    /// Bits a second, ten a byte; `None` takes no time.
    baud: Option<u32>,
    latency: Duration,
    dice: Dice,
    /// Each byte and when it arrives, in this order.
    under_way: VecDeque<(Instant, u8)>,
    /// When the last byte has left its sender, in nanoseconds.
    sent_ns: u64,
    held_until: Instant,
    /// What is sent in this time is lost.
    cut: Range<Instant>,
    counts: Counts,
}

impl FaultyLine {
    /// A line that takes no time; its faults follow from the seed.
    #[must_use]
    pub const fn new(faults: Faults, seed: u64) -> Self {
        Self {
            faults,
            baud: None,
            latency: Duration::ZERO,
            dice: Dice::new(seed),
            under_way: VecDeque::new(),
            sent_ns: 0,
            held_until: Instant::ZERO,
            cut: Instant::ZERO..Instant::ZERO,
            counts: Counts {
                bytes: 0,
                flips: 0,
                drops: 0,
                doubles: 0,
                stalls: 0,
                cut: 0,
                lost: 0,
            },
        }
    }

    /// Sets the line rate in bits a second; a byte takes ten, as on a UART. 0 takes no time.
    #[must_use]
    pub const fn with_baud(mut self, baud: u32) -> Self {
        self.baud = if baud == 0 { None } else { Some(baud) };
        self
    }

    /// Sets the time from the moment a byte has been sent to its arrival.
    #[must_use]
    pub const fn with_latency(mut self, latency: Duration) -> Self {
        self.latency = latency;
        self
    }

    /// Loses what is sent from `after` the clock's start on, for this long.
    #[must_use]
    pub fn with_cut(mut self, after: Duration, time: Duration) -> Self {
        let start = Instant::ZERO + after;
        self.cut(start..start + time);
        self
    }

    /// Bytes are sent. Those beyond [`room`](Self::room) make the line late, and far beyond it they
    /// are lost.
    pub fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        for &byte in bytes {
            self.counts.bytes += 1;
            self.sent_ns = self.sent_ns.max(nanos(now)) + self.byte_ns();
            let mut byte = byte;
            if self.dice.chance(self.faults.stall) {
                self.counts.stalls += 1;
                let longest = u64::try_from(self.faults.stall_for.as_micros()).unwrap_or(u64::MAX);
                let time = Duration::from_micros(self.dice.below(longest.saturating_add(1)));
                self.hold_until(now + time);
            }
            if self.dice.chance(self.faults.drop) {
                self.counts.drops += 1;
                continue;
            }
            for bit in 0..8 {
                if self.dice.chance(self.faults.flip) {
                    self.counts.flips += 1;
                    byte ^= 1 << bit;
                }
            }
            let double = self.dice.chance(self.faults.double);
            // After the dice, so that a cut does not change what happens later.
            if self.cut.contains(&now) {
                self.counts.cut += 1;
                continue;
            }
            if self.under_way.len() >= UNDER_WAY {
                self.counts.lost += 1;
                continue;
            }
            let sent = Instant::from_micros(self.sent_ns.div_ceil(1000));
            let arrives = (sent + self.latency).max(self.held_until);
            self.under_way.push_back((arrives, byte));
            if double {
                self.counts.doubles += 1;
                self.under_way.push_back((arrives, byte));
            }
        }
    }

    /// Writes the bytes that have arrived into `buffer` and says how many; 0 when there are none.
    pub fn poll_bytes(&mut self, now: Instant, buffer: &mut [u8]) -> usize {
        let mut count = 0;
        for place in buffer {
            match self.under_way.front() {
                Some((arrives, byte)) if *arrives <= now => *place = *byte,
                _ => break,
            }
            self.under_way.pop_front();
            count += 1;
        }
        count
    }

    /// When [`poll_bytes`](Self::poll_bytes) has something: all that is under way, or what has been
    /// there for `burst`. Zero asks for each byte at its own moment.
    #[must_use]
    pub fn poll_timeout(&self, burst: Duration) -> Option<Instant> {
        let (first, _) = self.under_way.front()?;
        let last = self.under_way.back().map(|(last, _)| *last);
        earliest(last, Some(*first + burst))
    }

    /// How many bytes a sender may send now; 0 while its own buffer would be full.
    #[must_use]
    pub fn room(&self, now: Instant) -> usize {
        let late = self.sent_ns.saturating_sub(nanos(now));
        let ahead = late.div_ceil(self.byte_ns().max(1));
        let paced = match self.baud {
            Some(_) => usize::try_from(AHEAD.saturating_sub(ahead)).unwrap_or(usize::MAX),
            None => UNDER_WAY,
        };
        paced.min(UNDER_WAY.saturating_sub(self.under_way.len()))
    }

    /// From now on the line is that bad.
    pub const fn set_faults(&mut self, faults: Faults) {
        self.faults = faults;
    }

    /// What is sent in this time is lost. Replaces an earlier cut.
    pub const fn cut(&mut self, time: Range<Instant>) {
        self.cut = time;
    }

    /// What is sent from now on arrives at this moment at the earliest.
    pub fn hold_until(&mut self, moment: Instant) {
        self.held_until = self.held_until.max(moment);
    }

    /// Loses what is under way, as when a plug is pulled.
    pub fn lose(&mut self) {
        self.count_lost(self.under_way.len());
        self.under_way.clear();
        self.held_until = Instant::ZERO;
        self.sent_ns = 0;
    }

    /// Bytes that had arrived, and that nobody took.
    pub fn count_lost(&mut self, bytes: usize) {
        self.counts.lost += bytes as u64;
    }

    /// What has become of the bytes.
    #[must_use]
    pub const fn counts(&self) -> Counts {
        self.counts
    }

    fn byte_ns(&self) -> u64 {
        self.baud.map_or(0, |baud| 10_000_000_000 / u64::from(baud))
    }
}

const fn nanos(moment: Instant) -> u64 {
    moment.as_micros().saturating_mul(1000)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    fn arrived(line: &mut FaultyLine, now: Instant) -> Vec<u8> {
        let mut all = Vec::new();
        let mut buffer = [0xA5; 100];
        loop {
            let count = line.poll_bytes(now, &mut buffer);
            if count == 0 {
                return all;
            }
            all.extend_from_slice(&buffer[..count]);
        }
    }

    #[test]
    fn a_line_without_faults_hands_on_what_it_is_given() {
        let mut line = FaultyLine::new(Faults::default(), 1);
        line.handle_bytes(at(5), b"hello");
        assert_eq!(line.poll_timeout(Duration::ZERO), Some(at(5)));
        assert_eq!(arrived(&mut line, at(5)), b"hello");
        assert_eq!(line.poll_timeout(Duration::ZERO), None);
        assert_eq!(line.counts().bytes, 5);
    }

    #[test]
    fn bytes_come_at_the_line_rate_also_after_a_million_of_them() {
        let mut line = FaultyLine::new(Faults::default(), 1).with_baud(921_600);
        let mut now = at(0);
        for _ in 0..1000 {
            line.handle_bytes(now, &[0; 1000]);
            now = line.poll_timeout(Duration::from_secs(9)).unwrap();
            assert_eq!(arrived(&mut line, now).len(), 1000);
        }
        let exact = 10_000_000.0 * 1_000_000.0 / 921_600.0;
        let ratio = now.as_micros() as f64 / exact;
        assert!((0.9999..1.0002).contains(&ratio), "{ratio}");
    }

    #[test]
    fn a_wake_up_brings_a_burst_and_the_last_byte_is_not_late() {
        let mut line = FaultyLine::new(Faults::default(), 1).with_baud(115_200);
        line.handle_bytes(at(0), &[0; 20]);
        let burst = Duration::from_millis(1);
        assert_eq!(line.poll_timeout(Duration::ZERO), Some(at(87)));
        assert_eq!(line.poll_timeout(burst), Some(at(1087)));
        assert_eq!(arrived(&mut line, at(1087)).len(), 12);
        assert_eq!(line.poll_timeout(burst), Some(at(1737)));
        assert_eq!(arrived(&mut line, at(1737)).len(), 8);
    }

    #[test]
    fn the_latency_moves_every_byte_and_costs_no_rate() {
        let mut line = FaultyLine::new(Faults::default(), 1)
            .with_baud(1_000_000)
            .with_latency(Duration::from_millis(20));
        line.handle_bytes(at(0), &[1, 2, 3]);
        assert_eq!(arrived(&mut line, at(20_010)), [1]);
        assert_eq!(arrived(&mut line, at(20_030)), [2, 3]);
    }

    #[test]
    fn each_fault_comes_as_often_as_it_should() {
        let faults = Faults {
            flip: 1e-3,
            drop: 2e-3,
            double: 4e-3,
            stall: 1e-4,
            stall_for: Duration::from_millis(2),
        };
        let mut line = FaultyLine::new(faults, 42);
        let mut came = 0;
        for turn in 0..1000 {
            line.handle_bytes(at(turn * 1000), &[0; 1000]);
            came += arrived(&mut line, at(turn * 1000)).len() as u64;
        }
        came += arrived(&mut line, at(u64::MAX)).len() as u64;
        let counts = line.counts();
        assert_eq!(came, 1_000_000 - counts.drops + counts.doubles);
        for (count, expected) in [
            (counts.flips, 8_000.0),
            (counts.drops, 2_000.0),
            (counts.doubles, 4_000.0),
            (counts.stalls, 100.0),
        ] {
            let off = (count as f64 - expected).abs();
            assert!(off < 5.0 * f64::sqrt(expected), "{counts:?}");
        }
    }

    #[test]
    fn the_same_seed_brings_the_same_faults_and_another_one_others() {
        let faults = Faults {
            flip: 0.01,
            drop: 0.01,
            double: 0.01,
            ..Faults::default()
        };
        let bytes = [0x5A; 500];
        let outcome = |seed| {
            let mut line = FaultyLine::new(faults, seed);
            line.handle_bytes(at(0), &bytes);
            arrived(&mut line, at(0))
        };
        assert_eq!(outcome(7), outcome(7));
        assert_ne!(outcome(7), outcome(8));
    }

    #[test]
    fn a_stall_holds_everything_back_and_then_lets_it_go_at_once() {
        let mut line = FaultyLine::new(Faults::default(), 1).with_baud(1_000_000);
        line.handle_bytes(at(0), &[1]);
        line.hold_until(at(5_000));
        line.handle_bytes(at(0), &[2, 3]);
        line.handle_bytes(at(4_000), &[4]);
        assert_eq!(arrived(&mut line, at(4_999)), [1]);
        assert_eq!(arrived(&mut line, at(5_000)), [2, 3, 4]);
    }

    #[test]
    fn what_is_sent_while_it_is_cut_is_lost_and_counted() {
        let mut line = FaultyLine::new(Faults::default(), 1);
        line.handle_bytes(at(0), &[1]);
        line.cut(at(20)..at(100));
        line.handle_bytes(at(50), &[2, 3]);
        line.handle_bytes(at(100), &[4]);
        assert_eq!(arrived(&mut line, at(100)), [1, 4]);
        assert_eq!(line.counts().cut, 2);
    }

    #[test]
    fn a_sender_that_is_ahead_has_no_room_until_the_line_has_caught_up() {
        let mut line = FaultyLine::new(Faults::default(), 1).with_baud(1_000_000);
        assert_eq!(line.room(at(0)), 4096);
        line.handle_bytes(at(0), &[0; 4096]);
        assert_eq!(line.room(at(0)), 0);
        assert_eq!(line.room(at(1000)), 100);
        // A stall is finite in what it holds.
        let mut line = FaultyLine::new(Faults::default(), 1);
        line.hold_until(at(1_000_000));
        line.handle_bytes(at(0), &[0; UNDER_WAY + 5]);
        assert_eq!((line.room(at(0)), line.counts().lost), (0, 5));
    }

    #[test]
    fn certainty_and_impossibility_are_what_they_say() {
        let sure = Faults {
            flip: 1.0,
            ..Faults::default()
        };
        let mut line = FaultyLine::new(sure, 3);
        line.handle_bytes(at(0), &[0x0F]);
        assert_eq!(arrived(&mut line, at(0)), [0xF0]);
    }
}
