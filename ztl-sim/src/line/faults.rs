//! One direction of a line that drops, alters, repeats and delays bytes, without I/O.

use std::collections::VecDeque;
use std::ops::Range;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::time::earliest;

use super::dice::Dice;

/// Most bytes in transit; further ones are lost.
const IN_TRANSIT: usize = 64 * 1024;
/// How many bytes a sender may be ahead of the line rate, like the buffer of a serial port.
const AHEAD: u64 = 4096;

/// Fault rates of a line. By default there are no faults.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Faults {
    /// Probability that a bit is flipped.
    pub flip: f64,
    /// Probability that a byte is dropped.
    pub drop: f64,
    /// Probability that a byte is duplicated.
    pub double: f64,
    /// Probability, for each byte, that the line stalls: it holds back this byte and all later ones.
    pub stall: f64,
    /// Longest stall. Each stall has a random length and then releases everything at once.
    pub stall_for: Duration,
}

/// Statistics of one direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Counts {
    /// Bytes sent into the line.
    pub bytes: u64,
    /// Bits flipped.
    pub flips: u64,
    /// Bytes dropped.
    pub drops: u64,
    /// Bytes duplicated.
    pub doubles: u64,
    /// Number of stalls.
    pub stalls: u64,
    /// Bytes lost while the line was cut.
    pub cut: u64,
    /// Bytes lost because too many were in transit, or because the receiving end was closed.
    pub lost: u64,
}

impl Counts {
    /// Total number of faults.
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
/// wake-up*: [`poll_timeout`](Self::poll_timeout). The same seed, bytes and times give the same faults. The
/// work per call is proportional to the bytes passed in or out.
///
/// ```
/// use ztl_core::Instant;
/// use ztl_sim::line::{Faults, FaultyLine};
///
/// let mut line = FaultyLine::new(Faults::default(), 1).with_baud(115_200);
/// line.handle_bytes(Instant::ZERO, b"ab");
/// let mut buffer = [0; 8];
/// // Ten bits per byte: 87 µs each.
/// assert_eq!(line.poll_bytes(Instant::from_micros(86), &mut buffer), 0);
/// assert_eq!(line.poll_bytes(Instant::from_micros(174), &mut buffer), 2);
/// assert_eq!(&buffer[..2], b"ab");
/// ```
#[derive(Debug, Clone)]
pub struct FaultyLine {
    faults: Faults,
    /// Bits per second, ten per byte; `None` means no delay.
    baud: Option<u32>,
    latency: Duration,
    dice: Dice,
    /// Each byte and its arrival time, in order.
    in_transit: VecDeque<(Instant, u8)>,
    /// When the last byte has left the sender, in nanoseconds.
    sent_ns: u64,
    held_until: Instant,
    /// Bytes sent within this period are lost.
    cut: Range<Instant>,
    counts: Counts,
}

impl FaultyLine {
    /// Creates a line without delay. The seed determines its faults.
    #[must_use]
    pub const fn new(faults: Faults, seed: u64) -> Self {
        Self {
            faults,
            baud: None,
            latency: Duration::ZERO,
            dice: Dice::new(seed),
            in_transit: VecDeque::new(),
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

    /// Sets the line rate in bits per second; a byte takes ten, as on a UART. 0 means no delay.
    #[must_use]
    pub const fn with_baud(mut self, baud: u32) -> Self {
        self.baud = if baud == 0 { None } else { Some(baud) };
        self
    }

    /// Sets the delay between a byte's end of transmission and its arrival.
    #[must_use]
    pub const fn with_latency(mut self, latency: Duration) -> Self {
        self.latency = latency;
        self
    }

    /// Cuts the line for `time`, starting `after` the clock's start.
    #[must_use]
    pub fn with_cut(mut self, after: Duration, time: Duration) -> Self {
        let start = Instant::ZERO + after;
        self.cut(start..start + time);
        self
    }

    /// Sends bytes. Bytes beyond [`room`](Self::room) are delayed; far beyond it they are lost.
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
            // Checked after the random numbers are drawn, so that a cut does not change later faults.
            if self.cut.contains(&now) {
                self.counts.cut += 1;
                continue;
            }
            if self.in_transit.len() >= IN_TRANSIT {
                self.counts.lost += 1;
                continue;
            }
            let sent = Instant::from_micros(self.sent_ns.div_ceil(1000));
            let arrives = (sent + self.latency).max(self.held_until);
            self.in_transit.push_back((arrives, byte));
            if double {
                self.counts.doubles += 1;
                self.in_transit.push_back((arrives, byte));
            }
        }
    }

    /// Writes the bytes that have arrived into `buffer` and returns their number.
    pub fn poll_bytes(&mut self, now: Instant, buffer: &mut [u8]) -> usize {
        let mut count = 0;
        for slot in buffer {
            match self.in_transit.front() {
                Some((arrives, byte)) if *arrives <= now => *slot = *byte,
                _ => break,
            }
            self.in_transit.pop_front();
            count += 1;
        }
        count
    }

    /// When to call [`poll_bytes`](Self::poll_bytes): once everything has arrived, or when the first byte has
    /// waited for `burst`. Zero wakes for each byte.
    #[must_use]
    pub fn poll_timeout(&self, burst: Duration) -> Option<Instant> {
        let (first, _) = self.in_transit.front()?;
        let last = self.in_transit.back().map(|(last, _)| *last);
        earliest(last, Some(*first + burst))
    }

    /// How many bytes a sender may send now; 0 while its buffer is full.
    #[must_use]
    pub fn room(&self, now: Instant) -> usize {
        let late = self.sent_ns.saturating_sub(nanos(now));
        let ahead = late.div_ceil(self.byte_ns().max(1));
        let paced = match self.baud {
            Some(_) => usize::try_from(AHEAD.saturating_sub(ahead)).unwrap_or(usize::MAX),
            None => IN_TRANSIT,
        };
        paced.min(IN_TRANSIT.saturating_sub(self.in_transit.len()))
    }

    /// Sets new fault rates from now on.
    pub const fn set_faults(&mut self, faults: Faults) {
        self.faults = faults;
    }

    /// Loses all bytes sent within this period. Replaces an earlier cut.
    pub const fn cut(&mut self, time: Range<Instant>) {
        self.cut = time;
    }

    /// Delays all bytes sent from now on until `moment`.
    pub fn hold_until(&mut self, moment: Instant) {
        self.held_until = self.held_until.max(moment);
    }

    /// When the last stall ends or has ended.
    #[must_use]
    pub const fn held_until(&self) -> Instant {
        self.held_until
    }

    /// Loses all bytes in transit, as when a plug is pulled.
    pub fn lose(&mut self) {
        self.count_lost(self.in_transit.len());
        self.in_transit.clear();
        self.held_until = Instant::ZERO;
        self.sent_ns = 0;
    }

    /// Counts bytes that arrived but found no receiver.
    pub fn count_lost(&mut self, bytes: usize) {
        self.counts.lost += bytes as u64;
    }

    /// The statistics so far.
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
    fn a_line_without_faults_passes_bytes_unchanged() {
        let mut line = FaultyLine::new(Faults::default(), 1);
        line.handle_bytes(at(5), b"hello");
        assert_eq!(line.poll_timeout(Duration::ZERO), Some(at(5)));
        assert_eq!(arrived(&mut line, at(5)), b"hello");
        assert_eq!(line.poll_timeout(Duration::ZERO), None);
        assert_eq!(line.counts().bytes, 5);
    }

    #[test]
    fn bytes_arrive_at_the_line_rate_even_after_a_million() {
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
    fn a_wake_up_collects_a_burst_and_the_last_byte_is_on_time() {
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
    fn latency_delays_every_byte_without_reducing_the_rate() {
        let mut line = FaultyLine::new(Faults::default(), 1)
            .with_baud(1_000_000)
            .with_latency(Duration::from_millis(20));
        line.handle_bytes(at(0), &[1, 2, 3]);
        assert_eq!(arrived(&mut line, at(20_010)), [1]);
        assert_eq!(arrived(&mut line, at(20_030)), [2, 3]);
    }

    #[test]
    fn each_fault_occurs_at_its_rate() {
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
    fn faults_are_determined_by_the_seed() {
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
    fn a_stall_delays_everything_and_then_releases_it_at_once() {
        let mut line = FaultyLine::new(Faults::default(), 1).with_baud(1_000_000);
        line.handle_bytes(at(0), &[1]);
        line.hold_until(at(5_000));
        line.handle_bytes(at(0), &[2, 3]);
        line.handle_bytes(at(4_000), &[4]);
        assert_eq!(arrived(&mut line, at(4_999)), [1]);
        assert_eq!(arrived(&mut line, at(5_000)), [2, 3, 4]);
    }

    #[test]
    fn bytes_sent_during_a_cut_are_lost_and_counted() {
        let mut line = FaultyLine::new(Faults::default(), 1);
        line.handle_bytes(at(0), &[1]);
        line.cut(at(20)..at(100));
        line.handle_bytes(at(50), &[2, 3]);
        line.handle_bytes(at(100), &[4]);
        assert_eq!(arrived(&mut line, at(100)), [1, 4]);
        assert_eq!(line.counts().cut, 2);
    }

    #[test]
    fn a_sender_ahead_of_the_line_rate_is_blocked() {
        let mut line = FaultyLine::new(Faults::default(), 1).with_baud(1_000_000);
        assert_eq!(line.room(at(0)), 4096);
        line.handle_bytes(at(0), &[0; 4096]);
        assert_eq!(line.room(at(0)), 0);
        assert_eq!(line.room(at(1000)), 100);
        // A stall holds a limited number of bytes.
        let mut line = FaultyLine::new(Faults::default(), 1);
        line.hold_until(at(1_000_000));
        line.handle_bytes(at(0), &[0; IN_TRANSIT + 5]);
        assert_eq!((line.room(at(0)), line.counts().lost), (0, 5));
    }

    #[test]
    fn probabilities_of_zero_and_one_are_exact() {
        let sure = Faults {
            flip: 1.0,
            ..Faults::default()
        };
        let mut line = FaultyLine::new(sure, 3);
        line.handle_bytes(at(0), &[0x0F]);
        assert_eq!(arrived(&mut line, at(0)), [0xF0]);
    }
}
