//! Time as the state machines see it: a number that the caller's clock provides.

use core::time::Duration;

/// A moment on a clock that never goes back, in microseconds since any fixed start.
///
/// The caller's clock chooses the start (boot, process start); instants of different clocks must
/// not be mixed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Instant(u64);

impl Instant {
    /// The clock's start.
    pub const ZERO: Self = Self(0);

    /// The end of time, which no clock reaches.
    pub const NEVER: Self = Self(u64::MAX);

    /// The moment `micros` microseconds after the clock's start.
    #[must_use]
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// The moment `millis` milliseconds after the clock's start.
    #[must_use]
    pub const fn from_millis(millis: u64) -> Self {
        Self(millis.saturating_mul(1000))
    }

    /// Microseconds since the clock's start.
    #[must_use]
    pub const fn as_micros(self) -> u64 {
        self.0
    }

    /// Whole milliseconds since the clock's start.
    #[must_use]
    pub const fn as_millis(self) -> u64 {
        // Byte by byte, since a division of 64 bits would cost a Cortex-M0 900 bytes, and one of 32 bits 400.
        let mut millis = self.0.to_be_bytes();
        let (mut rest, mut others) = (0, millis.as_mut_slice());
        while let [byte, behind @ ..] = others {
            let part = rest << 8 | *byte as u32;
            // An eighth of it is below 32000; of such a number this is a 125th.
            let thousandth = ((part >> 3) * 67_109) >> 23;
            rest = part - thousandth * 1000;
            *byte = thousandth as u8;
            others = behind;
        }
        u64::from_be_bytes(millis)
    }

    /// The moment so many microseconds later. Saturates at the end of time.
    // Apart in firmware, since it is needed in many places.
    #[cfg_attr(target_os = "none", inline(never))]
    #[must_use]
    pub const fn after(self, micros: u64) -> Self {
        Self(self.0.saturating_add(micros))
    }

    /// The moment so many microseconds before, or `None` when the clock had not started then.
    pub(crate) fn before(self, micros: u64) -> Option<Self> {
        self.0.checked_sub(micros).map(Self)
    }

    /// How long after `earlier` this moment is; zero when it is not after it.
    #[must_use]
    pub const fn since(self, earlier: Self) -> Duration {
        Duration::from_micros(self.0.saturating_sub(earlier.0))
    }
}

impl core::ops::Add<Duration> for Instant {
    type Output = Self;

    /// Saturates at the end of time.
    // Of a constant, nothing is left of the conversion.
    #[cfg_attr(target_os = "none", inline(always))]
    fn add(self, rhs: Duration) -> Self {
        self.after(micros(rhs))
    }
}

/// The duration in microseconds. Saturates.
#[must_use]
pub const fn micros(time: Duration) -> u64 {
    // In u64: a u128 division would cost a Cortex-M0 a kilobyte.
    let micros = time.as_secs().saturating_mul(1_000_000);
    micros.saturating_add(time.subsec_micros() as u64)
}

/// The earlier of two wake-up times, where `None` means "no need to wake".
#[must_use]
pub fn earliest(a: Option<Instant>, b: Option<Instant>) -> Option<Instant> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a.min(b)),
        (a, b) => a.or(b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn milliseconds_are_whole_ones() {
        for micros in [
            0,
            999,
            1000,
            1_999_999,
            999_999_999,
            u64::from(u32::MAX) + 1,
            u64::MAX - 7,
            u64::MAX,
        ] {
            assert_eq!(Instant::from_micros(micros).as_millis(), micros / 1000);
        }
    }
}
