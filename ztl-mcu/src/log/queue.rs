//! The log buffer.

use core::cell::RefCell;

use critical_section::Mutex;
#[cfg(feature = "defmt")]
use critical_section::RestoreState;

use super::source::LogSource;
use crate::pieces::in_pieces;

/// Buffers up to `N` bytes of log. Anyone can write; the main loop reads. Use it as a `static`.
///
/// A record that does not fit is dropped whole and its bytes are counted, so the reader never sees a partial
/// record. The oldest records stay, because they tell the cause of a failure.
#[derive(Debug)]
pub struct LogQueue<const N: usize> {
    state: Mutex<RefCell<State<N>>>,
}

#[derive(Debug)]
struct State<const N: usize> {
    ring: Ring<N>,
    #[cfg(feature = "defmt")]
    record: Record,
}

/// Bytes copied in one critical section.
const COPIED: usize = 8;

/// A ring buffer of records. A record can be read only when it is complete.
#[derive(Debug)]
struct Ring<const N: usize> {
    bytes: [u8; N],
    start: usize,
    /// Bytes of complete records.
    len: usize,
    /// Bytes reserved by complete records and by those being copied.
    taken: usize,
    /// Number of records being copied.
    copied: usize,
    /// Length of the record that defmt is writing after those, whether it fits or not.
    #[cfg(feature = "defmt")]
    open: usize,
    lost: u32,
}

impl<const N: usize> Ring<N> {
    /// Wraps an index below `2 * N`.
    const fn wrapped(index: usize) -> usize {
        if index < N { index } else { index - N }
    }

    #[cfg(feature = "defmt")]
    fn put(&mut self, bytes: &[u8]) {
        for byte in bytes {
            let used = self.taken.saturating_add(self.open);
            self.open = self.open.saturating_add(1);
            if used < N
                && let Some(slot) = self.bytes.get_mut(Self::wrapped(self.start + used))
            {
                *slot = *byte;
            }
        }
    }

    /// Reserves room for a record of this length. Returns its position; `None` if it does not fit.
    fn begin(&mut self, record: usize) -> Option<usize> {
        if self.taken.saturating_add(record) > N {
            let bytes = u32::try_from(record).unwrap_or(u32::MAX);
            self.lost = self.lost.wrapping_add(bytes);
            return None;
        }
        let place = Self::wrapped(self.start + self.taken);
        self.taken += record;
        self.copied += 1;
        Some(place)
    }

    /// Copies bytes of a record to this position. Returns the position of the next ones.
    fn copy(&mut self, mut place: usize, bytes: &[u8]) -> usize {
        for byte in bytes {
            if let Some(to) = self.bytes.get_mut(place) {
                *to = *byte;
            }
            place = Self::wrapped(place + 1);
        }
        place
    }

    /// Completes a record. It can be read when all records before it are complete.
    const fn end(&mut self) {
        self.copied -= 1;
        if self.copied == 0 {
            self.len = self.taken;
        }
    }

    /// Completes the record that defmt is writing.
    #[cfg(feature = "defmt")]
    fn end_open(&mut self) {
        let record = core::mem::take(&mut self.open);
        // Its bytes are in place already.
        if self.begin(record).is_some() {
            self.end();
        }
    }

    fn read(&mut self, buffer: &mut [u8]) -> usize {
        let count = self.len.min(buffer.len());
        for slot in buffer.iter_mut().take(count) {
            *slot = self.bytes.get(self.start).copied().unwrap_or_default();
            self.start = Self::wrapped(self.start + 1);
        }
        self.len -= count;
        self.taken -= count;
        count
    }
}

impl<const N: usize> LogQueue<N> {
    /// Creates an empty queue.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            state: Mutex::new(RefCell::new(State {
                ring: Ring {
                    bytes: [0; N],
                    start: 0,
                    len: 0,
                    taken: 0,
                    copied: 0,
                    #[cfg(feature = "defmt")]
                    open: 0,
                    lost: 0,
                },
                #[cfg(feature = "defmt")]
                record: Record::new(),
            })),
        }
    }

    fn with<T>(&self, act: impl FnOnce(&mut State<N>) -> T) -> Option<T> {
        critical_section::with(|cs| {
            // Never fails: it is not borrowed anywhere else.
            let mut state = self.state.borrow(cs).try_borrow_mut().ok()?;
            Some(act(&mut state))
        })
    }

    /// Adds a complete record in the encoding that the gateway expects; returns whether it fit.
    pub fn push(&self, record: &[u8]) -> bool {
        let place = self.with(|state| state.ring.begin(record.len()));
        let Some(mut place) = place.flatten() else {
            return false;
        };
        for piece in record.chunks(COPIED) {
            place = self
                .with(|state| state.ring.copy(place, piece))
                .unwrap_or(place);
        }
        self.with(|state| state.ring.end());
        true
    }
}

impl<const N: usize> Default for LogQueue<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> LogSource for LogQueue<N> {
    fn read(&self, buffer: &mut [u8]) -> usize {
        in_pieces(buffer, COPIED, |piece| {
            self.with(|state| state.ring.read(piece))
                .unwrap_or_default()
        })
    }

    fn lost(&self) -> u32 {
        self.with(|state| state.ring.lost).unwrap_or_default()
    }
}

/// The record that defmt is writing.
#[cfg(feature = "defmt")]
struct Record {
    encoder: defmt::Encoder,
    /// Ends the critical section of this record.
    restore: Option<RestoreState>,
    /// Depth of records started within this one: code that formats a value must not log, so they are dropped.
    within: u32,
}

#[cfg(feature = "defmt")]
impl core::fmt::Debug for Record {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Record")
    }
}

#[cfg(feature = "defmt")]
impl Record {
    const fn new() -> Self {
        Self {
            encoder: defmt::Encoder::new(),
            restore: None,
            within: 0,
        }
    }
}

/// For [`defmt_logger`](crate::defmt_logger).
#[cfg(feature = "defmt")]
impl<const N: usize> LogQueue<N> {
    /// Opens a record within a critical section. Returns `restore` if a record is already open.
    #[doc(hidden)]
    pub fn begin(&self, restore: RestoreState) -> Option<RestoreState> {
        self.with(|state| {
            let State { ring, record } = state;
            if record.restore.is_some() {
                record.within += 1;
                return Some(restore);
            }
            record.restore = Some(restore);
            record.encoder.start_frame(|bytes| ring.put(bytes));
            None
        })
        .flatten()
    }

    /// Appends to the record.
    #[doc(hidden)]
    pub fn write(&self, bytes: &[u8]) {
        self.with(|state| {
            let State { ring, record } = state;
            if record.within == 0 {
                record.encoder.write(bytes, |bytes| ring.put(bytes));
            }
        });
    }

    /// Completes the record and returns what ends the critical section.
    #[doc(hidden)]
    pub fn end(&self) -> Option<RestoreState> {
        self.with(|state| {
            let State { ring, record } = state;
            if let Some(within) = record.within.checked_sub(1) {
                record.within = within;
                return None;
            }
            record.encoder.end_frame(|bytes| ring.put(bytes));
            ring.end_open();
            record.restore.take()
        })
        .flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    fn read(queue: &impl LogSource, most: usize) -> Vec<u8> {
        let mut buffer = std::vec![0xA5; most];
        let count = queue.read(&mut buffer);
        buffer.truncate(count);
        buffer
    }

    #[test]
    fn a_record_that_does_not_fit_is_dropped_whole_and_counted() {
        let queue = LogQueue::<8>::new();
        assert!(queue.push(b"12345"));
        assert!(!queue.push(b"6789"));
        assert_eq!(queue.lost(), 4);
        assert!(queue.push(b"678"));
        assert_eq!(read(&queue, 6), b"123456");
        // Wraps around the end of the buffer.
        assert!(queue.push(b"abcdef"));
        assert!(!queue.push(&[0; 300]));
        assert_eq!(queue.lost(), 304);
        assert_eq!(read(&queue, 20), b"78abcdef");
        assert_eq!(read(&queue, 20), b"");
    }

    #[test]
    fn an_interrupts_record_follows_the_one_being_copied() {
        let queue = LogQueue::<16>::new();
        let in_ring = |act: &mut dyn FnMut(&mut Ring<16>)| queue.with(|state| act(&mut state.ring));
        let mut place = None;
        in_ring(&mut |ring| place = ring.begin(5));
        let mut place = place.unwrap();
        in_ring(&mut |ring| place = ring.copy(place, b"fir"));
        assert!(queue.push(b"second"));
        assert!(!queue.push(b"third!"));
        assert_eq!(read(&queue, 20), b"", "the first is not complete yet");
        in_ring(&mut |ring| place = ring.copy(place, b"st"));
        in_ring(&mut |ring| ring.end());
        assert_eq!(read(&queue, 20), b"firstsecond");
        assert_eq!(queue.lost(), 6);
    }

    #[test]
    fn records_are_read_in_order() {
        let queue = LogQueue::<13>::new();
        let (mut kept, mut seen, mut lost) = (Vec::new(), Vec::new(), 0);
        for turn in 0..500usize {
            let record: Vec<u8> = (0..turn % 6).map(|byte| (turn + byte) as u8).collect();
            if queue.push(&record) {
                kept.extend(record);
            } else {
                lost += record.len();
            }
            seen.extend(read(&queue, turn % 4));
        }
        seen.extend(read(&queue, 20));
        assert_eq!(seen, kept);
        assert_eq!(queue.lost() as usize, lost);
        assert!(lost > 0);
    }
}
