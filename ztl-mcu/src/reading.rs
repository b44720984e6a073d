//! Where a component keeps its readings until the line has room: the latest alone, or a queue.

use core::hash::{Hash, Hasher};

use heapless::{Deque, Vec};

use crate::component::Reading;

/// Why a reading was not kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum NotKept {
    /// It is longer than the place.
    TooLong {
        /// Its bytes.
        needed: usize,
        /// Bytes of the place.
        available: usize,
    },
    /// As many as there are places wait already.
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

/// Writes `bytes` into `buffer`, if they fit into a frame.
fn written(bytes: &[u8], topic: u8, buffer: &mut [u8]) -> Option<Reading> {
    let len = bytes.len();
    // Not `copy_from_slice`, in which the compiler does not see equal lengths.
    for (to, from) in buffer.get_mut(..len)?.iter_mut().zip(bytes) {
        *to = *from;
    }
    Some(Reading { topic, len })
}

/// A reading of at most `N` bytes, of which only the latest matters.
///
/// ```
/// use ztl_mcu::{Latest, Reading};
/// let mut angle = Latest::<4>::new();
/// angle.set(&1.5f32.to_le_bytes())?;
/// angle.set(&2.5f32.to_le_bytes())?;
/// let mut buffer = [0; 16];
/// // What `poll_reading` returns, for the first of the offer's topics.
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
    /// Nothing to be published.
    #[must_use]
    pub const fn new() -> Self {
        Self { reading: None }
    }

    /// Takes the place of the one before.
    ///
    /// # Errors
    /// [`NotKept::TooLong`]; the one before stays then.
    pub fn set(&mut self, reading: &[u8]) -> Result<(), NotKept> {
        self.reading = Some(kept(reading)?);
        Ok(())
    }

    /// Writes the reading into `buffer`, if there is a new one; it is told once. One that is longer than the buffer fits
    /// into no frame and is dropped.
    pub fn take(&mut self, topic: u8, buffer: &mut [u8]) -> Option<Reading> {
        written(&self.reading.take()?, topic, buffer)
    }
}

/// At most `N` readings of at most `LEN` bytes each, every one of which matters.
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
    /// Nothing to be published.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            readings: Deque::new(),
            lost: 0,
        }
    }

    /// Adds a reading behind the others. One that is not kept is counted.
    ///
    /// # Errors
    /// [`NotKept`]; those before stay.
    pub fn push(&mut self, reading: &[u8]) -> Result<(), NotKept> {
        let kept = kept(reading)
            .and_then(|reading| self.readings.push_back(reading).map_err(|_| NotKept::Full));
        if kept.is_err() {
            self.lost = self.lost.wrapping_add(1);
        }
        kept
    }

    /// Writes the first reading into `buffer`, if there is one. Those that are longer than the buffer fit into no frame;
    /// they are dropped and counted, and the next one is taken.
    pub fn take(&mut self, topic: u8, buffer: &mut [u8]) -> Option<Reading> {
        while let Some(reading) = self.readings.pop_front() {
            if let Some(reading) = written(&reading, topic, buffer) {
                return Some(reading);
            }
            self.lost = self.lost.wrapping_add(1);
        }
        None
    }

    /// Whether another would not be kept.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.readings.is_full()
    }

    /// How many readings were not kept, or were too long to be sent; wraps.
    #[must_use]
    pub const fn lost(&self) -> u32 {
        self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reading_that_no_frame_holds_is_dropped_and_the_next_one_is_taken() {
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
    fn the_queue_keeps_the_order_and_counts_what_it_does_not_keep() {
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
