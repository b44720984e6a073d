//! A shared, half-duplex line on which ends that send at once damage each other's bytes, without I/O.

use std::time::Duration;

use ztl_core::Instant;

use super::dice::Dice;

/// How many bytes a sender may be ahead of the line rate, like the buffer of a serial port.
const AHEAD: usize = 4096;

/// What one end sends without a pause.
#[derive(Debug, Clone)]
struct Talk {
    end: usize,
    /// When its first byte begins, in ns.
    begin: u64,
    bytes: Vec<u8>,
    /// Number of bytes that have ended.
    heard: usize,
}

impl Talk {
    fn at(&self, byte: usize, time: u64) -> u64 {
        let before = u64::try_from(byte).unwrap_or(u64::MAX);
        self.begin.saturating_add(before.saturating_mul(time))
    }

    fn until(&self, time: u64) -> u64 {
        self.at(self.bytes.len(), time)
    }
}

/// Bytes that were on a [`HalfDuplex`] line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Heard {
    /// The bytes, damaged if there are several senders.
    pub bytes: Vec<u8>,
    /// The ends that sent at that time, and heard nothing.
    pub senders: Vec<usize>,
}

/// A line with several ends. Each hears what the others send, and nothing while it sends. Bytes that several ends send at
/// once are damaged, and some of them are lost.
///
/// *Inputs*: [`send`](Self::send). *Outputs*: [`poll`](Self::poll). *Next wake-up*: [`poll_timeout`](Self::poll_timeout).
/// The same seed, bytes and times give the same damage.
///
/// ```
/// use ztl_core::Instant;
/// use ztl_sim::line::HalfDuplex;
///
/// let mut line = HalfDuplex::new(115_200, 1);
/// line.send(Instant::ZERO, 0, b"ab");
/// // Ten bits per byte: 87 µs each.
/// let heard = line.poll(Instant::from_micros(174));
/// assert_eq!((heard[0].bytes.as_slice(), heard[0].senders.as_slice()), (&b"ab"[..], &[0][..]));
/// ```
#[derive(Debug, Clone)]
pub struct HalfDuplex {
    /// Of one byte, in ns.
    byte_time: u64,
    talks: Vec<Talk>,
    dice: Dice,
    collided: u64,
}

impl HalfDuplex {
    /// A line of this rate in bits per second, ten per byte.
    #[must_use]
    pub fn new(baud: u32, seed: u64) -> Self {
        Self {
            byte_time: 10_000_000_000 / u64::from(baud.max(1)),
            talks: Vec::new(),
            dice: Dice::new(seed),
            collided: 0,
        }
    }

    /// An end sends these bytes, after what it is sending.
    pub fn send(&mut self, now: Instant, end: usize, bytes: &[u8]) {
        let (begin, time) = (nanos(now), self.byte_time);
        let mut its = self.talks.iter_mut();
        match its.find(|talk| talk.end == end && talk.until(time) >= begin) {
            Some(talk) => talk.bytes.extend_from_slice(bytes),
            None if bytes.is_empty() => {}
            None => self.talks.push(Talk {
                end,
                begin,
                bytes: bytes.to_vec(),
                heard: 0,
            }),
        }
    }

    /// How many bytes an end may send now; 0 while its buffer is full.
    #[must_use]
    pub fn room(&self, end: usize) -> usize {
        let its = self.talks.iter().filter(|talk| talk.end == end);
        let waiting: usize = its.map(|talk| talk.bytes.len() - talk.heard).sum();
        AHEAD.saturating_sub(waiting)
    }

    /// Loses what is on the line.
    pub fn clear(&mut self) {
        self.talks.clear();
    }

    /// What has ended until now, in order. All ends but the senders hear it.
    pub fn poll(&mut self, now: Instant) -> Vec<Heard> {
        let mut all: Vec<Heard> = Vec::new();
        let (now, time) = (nanos(now), self.byte_time);
        while let Some((begin, mut byte)) = self.next_until(now) {
            let end = begin + time;
            let sends = |talk: &&Talk| talk.begin < end && talk.until(time) > begin;
            let senders: Vec<usize> = self.talks.iter().filter(sends).map(|it| it.end).collect();
            let many = u64::try_from(senders.len()).unwrap_or(u64::MAX);
            if many > 1 {
                self.collided += 1;
                // As many bytes as there is time for, not as many as are sent.
                if self.dice.below(many) != 0 {
                    continue;
                }
                let [noise, ..] = self.dice.throw().to_le_bytes();
                byte ^= noise;
            }
            match all.last_mut() {
                Some(heard) if heard.senders == senders => heard.bytes.push(byte),
                _ => all.push(Heard {
                    bytes: vec![byte],
                    senders,
                }),
            }
        }
        // The last byte of a talk may still collide with one that has not ended.
        self.talks.retain(|talk| talk.until(time) + time > now);
        all
    }

    /// Takes the next byte that ends by this time: when it begins, and what it is.
    fn next_until(&mut self, now: u64) -> Option<(u64, u8)> {
        let time = self.byte_time;
        let open = self
            .talks
            .iter_mut()
            .filter(|talk| talk.heard < talk.bytes.len() && talk.at(talk.heard + 1, time) <= now);
        let talk = open.min_by_key(|talk| talk.at(talk.heard, time))?;
        let next = (talk.at(talk.heard, time), *talk.bytes.get(talk.heard)?);
        talk.heard += 1;
        Some(next)
    }

    /// When to call [`poll`](Self::poll): when an end has sent everything, or the first byte has waited for `burst`.
    #[must_use]
    pub fn poll_timeout(&self, burst: Duration) -> Option<Instant> {
        let (time, burst) = (self.byte_time, nanos(Instant::ZERO + burst));
        let open = self
            .talks
            .iter()
            .filter(|talk| talk.heard < talk.bytes.len());
        let wake = open.map(|talk| {
            let first = talk.at(talk.heard + 1, time);
            talk.until(time).min(first.saturating_add(burst))
        });
        wake.min().map(|at| Instant::from_micros(at.div_ceil(1000)))
    }

    /// How many bytes were sent while another end sent.
    #[must_use]
    pub const fn collided(&self) -> u64 {
        self.collided
    }
}

const fn nanos(moment: Instant) -> u64 {
    moment.as_micros().saturating_mul(1000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_that_send_at_once_are_damaged_and_hear_nothing() {
        let mut line = HalfDuplex::new(1_000_000, 1);
        line.send(Instant::ZERO, 0, &[0x55; 100]);
        line.send(Instant::from_micros(505), 1, &[0x55; 100]);
        let heard = line.poll(Instant::from_millis(3));
        let senders: Vec<&[usize]> = heard.iter().map(|it| it.senders.as_slice()).collect();
        assert_eq!(senders, [&[0][..], &[0, 1], &[1]]);
        assert_eq!(heard[0].bytes, [0x55; 50]);
        assert!(heard[1].bytes.iter().filter(|byte| **byte == 0x55).count() < 5);
        assert!((30..70).contains(&heard[1].bytes.len()), "{heard:?}");
        assert_eq!(heard[2].bytes, [0x55; 50]);
        assert_eq!(line.collided(), 100);
    }

    #[test]
    fn a_sender_continues_and_one_that_waits_does_not_collide() {
        let mut line = HalfDuplex::new(1_000_000, 1);
        line.send(Instant::ZERO, 0, b"ab");
        line.send(Instant::from_micros(15), 0, b"cd");
        assert_eq!(
            line.poll_timeout(Duration::from_secs(1)),
            Some(Instant::from_micros(40))
        );
        assert_eq!(
            line.poll_timeout(Duration::ZERO),
            Some(Instant::from_micros(10))
        );
        assert_eq!(line.poll(Instant::from_micros(40))[0].bytes, b"abcd");
        line.send(Instant::from_micros(40), 1, b"x");
        assert_eq!(line.poll(Instant::from_micros(50))[0].bytes, b"x");
        assert_eq!(
            (line.poll_timeout(Duration::ZERO), line.collided()),
            (None, 0)
        );
    }

    #[test]
    fn a_sender_ahead_of_the_line_rate_is_blocked() {
        let mut line = HalfDuplex::new(1_000_000, 1);
        line.send(Instant::ZERO, 0, &[0; AHEAD]);
        assert_eq!((line.room(0), line.room(1)), (0, AHEAD));
        line.poll(Instant::from_millis(1));
        assert_eq!(line.room(0), 100);
    }
}
