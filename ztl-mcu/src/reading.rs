//! Buffers for readings until the line is free: only the latest, or a queue.

use core::hash::{Hash, Hasher};

use heapless::{Deque, Vec};

use crate::component::Reading;

/// Why a reading was not stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum NotKept {
    /// It is longer than the buffer.
    TooLong {
        /// Length of the reading in bytes.
        needed: usize,
        /// Size of the buffer in bytes.
        available: usize,
    },
    /// The queue is full.
    Full,
}

impl core::fmt::Display for NotKept {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::TooLong { needed, available } => {
                write!(f, "reading of {needed} bytes, room for {available}")
            }
            Self::Full => f.write_str("too many readings wait"),
        }
    }
}

impl core::error::Error for NotKept {}

/// A copy of `bytes`.
fn kept<const N: usize>(bytes: &[u8]) -> Result<Vec<u8, N>, NotKept> {
    let too_long = NotKept::TooLong {
        needed: bytes.len(),
        available: N,
    };
    let mut copy = Vec::new();
    copy.extend_from_slice(bytes).map_err(|_| too_long)?;
    Ok(copy)
}

/// Writes `bytes` into `buffer`, if they fit.
fn written(bytes: &[u8], topic: u8, buffer: &mut [u8]) -> Option<Reading> {
    let len = bytes.len();
    // The compiler cannot remove the panic branch of `copy_from_slice`.
    for (to, from) in buffer.get_mut(..len)?.iter_mut().zip(bytes) {
        *to = *from;
    }
    Some(Reading { topic, len })
}

/// Stores the latest reading, of at most `N` bytes.
///
/// ```
/// use ztl_mcu::{Latest, Reading};
/// let mut angle = Latest::<4>::new();
/// angle.set(&1.5f32.to_le_bytes())?;
/// angle.set(&2.5f32.to_le_bytes())?;
/// let mut buffer = [0; 16];
/// // The result of `poll_reading` for the first topic of the offer.
/// assert_eq!(angle.take(0, &mut buffer), Some(Reading { topic: 0, len: 4 }));
/// assert_eq!(buffer[..4], 2.5f32.to_le_bytes());
/// assert_eq!(angle.take(0, &mut buffer), None);
/// # Ok::<(), ztl_mcu::NotKept>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub struct Latest<const N: usize> {
    reading: Option<Vec<u8, N>>,
}

impl<const N: usize> Latest<N> {
    /// A buffer without a reading.
    #[must_use]
    pub const fn new() -> Self {
        Self { reading: None }
    }

    /// Replaces the reading.
    ///
    /// # Errors
    /// [`NotKept::TooLong`]; the old reading stays.
    pub fn set(&mut self, reading: &[u8]) -> Result<(), NotKept> {
        self.reading = Some(kept(reading)?);
        Ok(())
    }

    /// Moves the reading into `buffer`, if there is a new one. Drops a reading that is longer than the buffer, because it
    /// fits no frame.
    pub fn take(&mut self, topic: u8, buffer: &mut [u8]) -> Option<Reading> {
        written(&self.reading.take()?, topic, buffer)
    }
}

/// Stores up to `N` readings of at most `LEN` bytes each.
///
/// `LEN` should be at most the node's [`LONGEST_READING`](crate::Node::LONGEST_READING).
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Queued<const N: usize, const LEN: usize> {
    readings: Deque<Vec<u8, LEN>, N>,
    lost: u32,
}

impl<const N: usize, const LEN: usize> Hash for Queued<N, LEN> {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        self.readings.len().hash(hasher);
        for reading in &self.readings {
            reading.hash(hasher);
        }
        self.lost.hash(hasher);
    }
}

impl<const N: usize, const LEN: usize> Queued<N, LEN> {
    /// An empty queue.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            readings: Deque::new(),
            lost: 0,
        }
    }

    /// Appends a reading, or counts it as lost.
    ///
    /// # Errors
    /// [`NotKept`]; the stored readings stay.
    pub fn push(&mut self, reading: &[u8]) -> Result<(), NotKept> {
        let kept = kept(reading)
            .and_then(|reading| self.readings.push_back(reading).map_err(|_| NotKept::Full));
        if kept.is_err() {
            self.lost = self.lost.wrapping_add(1);
        }
        kept
    }

    /// Moves the first reading into `buffer`, if there is one. Drops and counts readings that are longer than the buffer,
    /// because they fit no frame.
    pub fn take(&mut self, topic: u8, buffer: &mut [u8]) -> Option<Reading> {
        while let Some(reading) = self.readings.pop_front() {
            if let Some(reading) = written(&reading, topic, buffer) {
                return Some(reading);
            }
            self.lost = self.lost.wrapping_add(1);
        }
        None
    }

    /// Whether the queue is full.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.readings.is_full()
    }

    /// Number of readings that were not stored or were too long to send; wraps around.
    #[must_use]
    pub const fn lost(&self) -> u32 {
        self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_oversized_reading_is_dropped_in_favour_of_the_next() {
        let mut latest = Latest::<8>::new();
        let mut queued = Queued::<2, 8>::new();
        latest.set(b"12345").unwrap();
        queued.push(b"12345").unwrap();
        queued.push(b"678").unwrap();
        let mut buffer = [0xA5; 4];
        assert_eq!(latest.take(1, &mut buffer), None);
        let fits = Some(Reading { topic: 1, len: 3 });
        assert_eq!(queued.take(1, &mut buffer), fits);
        assert_eq!(&buffer[..3], b"678");
        assert_eq!(queued.lost(), 1);
    }

    #[test]
    fn the_queue_keeps_the_order_and_counts_lost_readings() {
        let mut queued = Queued::<2, 8>::new();
        queued.push(b"a").unwrap();
        queued.push(b"b").unwrap();
        assert!(queued.is_full());
        assert_eq!(queued.push(b"c"), Err(NotKept::Full));
        let mut buffer = [0xA5; 8];
        for expected in [b"a", b"b"] {
            queued.take(0, &mut buffer).unwrap();
            assert_eq!(&buffer[..1], expected);
        }
        let (needed, available) = (9, 8);
        assert_eq!(
            queued.push(&[0; 9]),
            Err(NotKept::TooLong { needed, available })
        );
        assert_eq!(queued.lost(), 2);
        assert_eq!(queued.take(0, &mut buffer), None);
    }
}
