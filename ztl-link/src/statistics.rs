//! Statistics of a link.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use ztl_core::link::FrameError;

/// Counters of a link since the gateway was started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct LinkCounters {
    /// Frames with a valid checksum.
    pub frames: u64,
    /// Frames dropped because they were damaged or of another session.
    pub damaged: u64,
    /// Frames dropped because they ended too early.
    pub truncated: u64,
    /// Frames dropped because they were too long.
    pub too_long: u64,
    /// Frames with a valid checksum that are not a message, or not an answer to the command.
    pub not_understood: u64,
    /// Commands repeated because no answer arrived.
    pub repeats: u64,
    /// Repeated answers, dropped.
    pub duplicates: u64,
    /// Sessions opened.
    pub sessions: u64,
    /// Resets of the device.
    pub resets: u64,
    /// How often the link was lost.
    pub lost: u64,
}

impl LinkCounters {
    pub(crate) const fn count(&mut self, error: FrameError) {
        match error {
            FrameError::Check => self.damaged += 1,
            FrameError::Truncated => self.truncated += 1,
            FrameError::TooLong => self.too_long += 1,
            _ => self.not_understood += 1,
        }
    }

    /// All dropped frames.
    #[must_use]
    pub const fn errors(&self) -> u64 {
        // They may come from a gateway elsewhere.
        let dropped = self.damaged.saturating_add(self.truncated);
        dropped
            .saturating_add(self.too_long)
            .saturating_add(self.not_understood)
    }
}

/// Number of round trips kept.
const LATEST: usize = 128;

/// The latest times from a command to its answer. Repeated commands are left out, because it is unknown which
/// copy was answered.
#[derive(Clone, PartialEq, Eq)]
pub struct RoundTrips {
    micros: [u32; LATEST],
    /// Round trips measured so far.
    count: usize,
}

/// Shows only their number.
impl std::fmt::Debug for RoundTrips {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RoundTrips")
            .field("count", &self.count)
            .finish_non_exhaustive()
    }
}

impl Default for RoundTrips {
    fn default() -> Self {
        Self {
            micros: [0; LATEST],
            count: 0,
        }
    }
}

impl RoundTrips {
    pub(crate) fn add(&mut self, time: Duration) {
        let micros = u32::try_from(time.as_micros()).unwrap_or(u32::MAX);
        if let Some(slot) = self.micros.get_mut(self.count % LATEST) {
            *slot = micros;
        }
        self.count = self.count.wrapping_add(1);
    }

    /// The time that this percentage of them did not exceed; `None` before the first.
    #[must_use]
    pub fn percentile(&self, percent: usize) -> Option<Duration> {
        let mut sorted = self.micros;
        let sorted = sorted.get_mut(..self.count.min(LATEST))?;
        sorted.sort_unstable();
        let last = sorted.len().checked_sub(1)?;
        let micros = sorted.get((last * percent.min(100)).div_ceil(100))?;
        Some(Duration::from_micros(u64::from(*micros)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_of_the_latest_round_trips() {
        let mut trips = RoundTrips::default();
        assert_eq!(trips.percentile(50), None);
        for millis in 1..=1000 {
            trips.add(Duration::from_millis(millis));
        }
        // 873 to 1000 are left.
        assert_eq!(trips.percentile(0), Some(Duration::from_millis(873)));
        assert_eq!(trips.percentile(50), Some(Duration::from_millis(937)));
        assert_eq!(trips.percentile(99), Some(Duration::from_millis(999)));
        assert_eq!(trips.percentile(100), Some(Duration::from_millis(1000)));
    }
}
