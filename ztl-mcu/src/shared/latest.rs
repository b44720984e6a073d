//! The latest reading, copied in short critical sections.

use core::cell::Cell;

use critical_section::Mutex;

use super::COPIED;
use crate::NotKept;
use crate::component::Reading;

/// The latest reading of a component, of at most `N` bytes, which interrupts or an async driver set: a
/// [`Latest`](crate::Latest) in a static.
///
/// The bytes are copied a few at a time, so a reading of any length masks interrupts only briefly. For that it has two
/// buffers of `N` bytes: no reading is mixed from two, whichever side interrupts the other.
pub struct LatestReading<const N: usize>(Mutex<Buffers<N>>);

struct Buffers<const N: usize> {
    /// Which buffer has the latest reading, and whether it was not taken yet.
    latest: Cell<bool>,
    is_new: Cell<bool>,
    /// Whether a reader copies from a buffer, and from which.
    is_read: Cell<bool>,
    read: Cell<bool>,
    /// Number of readings begun, modulo 2^32. When a writer interrupts another one, the later reading counts.
    begun: Cell<u32>,
    len: Cell<usize>,
    bytes: [[Cell<u8>; N]; 2],
}

impl<const N: usize> Buffers<N> {
    /// Begins a reading: its number, and the buffer to write to, from which nobody reads.
    fn begin(&self) -> (u32, bool) {
        let number = self.begun.get().wrapping_add(1);
        self.begun.set(number);
        let in_use = if self.is_read.get() {
            &self.read
        } else {
            &self.latest
        };
        let buffer = !in_use.get();
        if buffer == self.latest.get() {
            self.is_new.set(false);
        }
        (number, buffer)
    }

    /// Writes a piece, unless a later reading was begun.
    fn put(&self, (number, buffer): (u32, bool), at: usize, piece: &[u8]) {
        if number == self.begun.get() {
            let bytes = self.buffer(buffer).get(at..).unwrap_or_default();
            for (to, from) in bytes.iter().zip(piece) {
                to.set(*from);
            }
        }
    }

    /// All pieces are written.
    fn finish(&self, (number, buffer): (u32, bool), len: usize) {
        if number == self.begun.get() {
            self.latest.set(buffer);
            self.len.set(len);
            self.is_new.set(true);
        }
    }

    /// Begins to read a new reading: its buffer and its length.
    fn take(&self) -> Option<(bool, usize)> {
        if self.is_read.get() || !self.is_new.take() {
            return None;
        }
        self.is_read.set(true);
        self.read.set(self.latest.get());
        Some((self.latest.get(), self.len.get()))
    }

    fn buffer(&self, buffer: bool) -> &[Cell<u8>] {
        let [first, second] = &self.bytes;
        if buffer { second } else { first }
    }
}

impl<const N: usize> LatestReading<N> {
    /// Without a reading.
    #[must_use]
    pub const fn new() -> Self {
        Self(Mutex::new(Buffers {
            latest: Cell::new(false),
            is_new: Cell::new(false),
            is_read: Cell::new(false),
            read: Cell::new(false),
            begun: Cell::new(0),
            len: Cell::new(0),
            bytes: [const { [const { Cell::new(0) }; N] }; 2],
        }))
    }

    /// Replaces the reading. If a set interrupts another one, the interrupted reading is dropped.
    ///
    /// # Errors
    /// [`NotKept::TooLong`]; the old reading stays.
    pub fn set(&self, reading: &[u8]) -> Result<(), NotKept> {
        let (needed, available) = (reading.len(), N);
        if needed > available {
            return Err(NotKept::TooLong { needed, available });
        }
        let writing = self.with(Buffers::begin);
        let mut at = 0;
        for piece in reading.chunks(COPIED) {
            self.with(|buffers| buffers.put(writing, at, piece));
            at += piece.len();
        }
        self.with(|buffers| buffers.finish(writing, needed));
        Ok(())
    }

    /// Moves the reading into `buffer`, if there is a new one: the result of `poll_reading`. Drops a reading that is longer
    /// than the buffer. One reader at a time: another one finds nothing.
    pub fn take(&self, topic: u8, buffer: &mut [u8]) -> Option<Reading> {
        let (from, len) = self.with(Buffers::take)?;
        let mut at = 0;
        let to = buffer.get_mut(..len);
        let fits = to.is_some();
        for piece in to.unwrap_or_default().chunks_mut(COPIED) {
            self.with(|buffers| {
                let bytes = buffers.buffer(from).get(at..).unwrap_or_default();
                for (to, from) in piece.iter_mut().zip(bytes) {
                    *to = from.get();
                }
            });
            at += piece.len();
        }
        self.with(|buffers| buffers.is_read.set(false));
        fits.then_some(Reading { topic, len })
    }

    fn with<T>(&self, act: impl FnOnce(&Buffers<N>) -> T) -> T {
        critical_section::with(|cs| act(self.0.borrow(cs)))
    }
}

impl<const N: usize> core::fmt::Debug for LatestReading<N> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("LatestReading")
    }
}

impl<const N: usize> Default for LatestReading<N> {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::thread;

    #[test]
    fn a_set_that_is_interrupted_by_another_is_dropped() {
        let latest = LatestReading::<40>::new();
        let early = latest.with(Buffers::begin);
        latest.with(|buffers| buffers.put(early, 0, &[1; 16]));
        latest.set(&[2; 40]).unwrap();
        latest.with(|buffers| buffers.put(early, 16, &[1; 16]));
        latest.with(|buffers| buffers.finish(early, 32));
        let mut buffer = [0xA5; 48];
        assert_eq!(
            latest.take(7, &mut buffer),
            Some(Reading { topic: 7, len: 40 })
        );
        assert_eq!(buffer[..40], [2; 40]);
        assert_eq!(latest.take(7, &mut buffer), None);
    }

    #[test]
    fn a_reading_that_is_being_taken_is_not_written_over() {
        let latest = LatestReading::<4>::new();
        latest.set(&[1; 4]).unwrap();
        let (from, _) = latest.with(Buffers::take).unwrap();
        for number in [2, 3, 4] {
            latest.set(&[number; 4]).unwrap();
            assert_eq!(latest.take(0, &mut [0; 4]), None, "one reader at a time");
        }
        let bytes = latest.with(|buffers| buffers.buffer(from).iter().all(|byte| byte.get() == 1));
        assert!(bytes);
        // The reader is ready while the next reading is being written: it is not there yet.
        let writing = latest.with(Buffers::begin);
        latest.with(|buffers| buffers.is_read.set(false));
        assert_eq!(latest.take(0, &mut [0; 4]), None);
        latest.with(|buffers| buffers.put(writing, 0, &[5; 4]));
        latest.with(|buffers| buffers.finish(writing, 4));
        let mut buffer = [0xA5; 4];
        assert!(latest.take(0, &mut buffer).is_some());
        assert_eq!(buffer, [5; 4]);
    }

    #[test]
    fn a_reading_that_is_too_long_is_dropped() {
        let latest = LatestReading::<4>::new();
        let (needed, available) = (5, 4);
        latest.set(&[1; 4]).unwrap();
        assert_eq!(
            latest.set(&[2; 5]),
            Err(NotKept::TooLong { needed, available })
        );
        assert_eq!(latest.take(0, &mut [0; 3]), None);
        latest.set(&[]).unwrap();
        assert_eq!(
            latest.take(0, &mut [0; 3]),
            Some(Reading { topic: 0, len: 0 })
        );
    }

    #[test]
    fn no_reading_is_mixed_from_two() {
        static LATEST: LatestReading<500> = LatestReading::new();
        static DONE: AtomicBool = AtomicBool::new(false);
        let writers = [1, 2].map(|number| {
            thread::spawn(move || {
                let mut len = 1;
                while !DONE.load(Ordering::Relaxed) {
                    len = len % 250 + 1;
                    let mut reading = [len as u8; 500];
                    reading[0] = number;
                    LATEST.set(&reading[..len * 2]).unwrap();
                }
            })
        });
        let mut buffer = [0xA5; 500];
        let mut taken = 0;
        while taken < 3000 {
            if let Some(Reading { len, .. }) = LATEST.take(0, &mut buffer) {
                let expected = (len / 2) as u8;
                assert!(buffer[1..len].iter().all(|byte| *byte == expected));
                taken += 1;
            }
        }
        DONE.store(true, Ordering::Relaxed);
        for writer in writers {
            writer.join().unwrap();
        }
    }
}
