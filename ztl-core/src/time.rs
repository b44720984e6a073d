//! Time as the state machines see it: a number from the caller's clock.

use core::time::Duration;

/// A point in time on a monotonic clock, in microseconds since an arbitrary start.
///
/// The caller's clock defines the start (boot, process start). Do not mix instants of different clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Instant(u64);

impl Instant {
    /// The clock's start.
    pub const ZERO: Self = Self(0);

    /// Later than any time a clock reaches.
    pub const NEVER: Self = Self(u64::MAX);

    /// The instant `micros` microseconds after the clock's start.
    #[must_use]
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// The instant `millis` milliseconds after the clock's start.
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
        // Byte by byte: a 64-bit division costs 900 bytes on a Cortex-M0, a 32-bit one 400.
        let mut millis = self.0.to_be_bytes();
        let (mut rest, mut others) = (0, millis.as_mut_slice());
        while let [byte, behind @ ..] = others {
            let part = rest << 8 | *byte as u32;
            // `part / 8` is below 32000; for such numbers this divides by 125 exactly.
            let thousandth = ((part >> 3) * 67_109) >> 23;
            rest = part - thousandth * 1000;
            *byte = thousandth as u8;
            others = behind;
        }
        u64::from_be_bytes(millis)
    }

    /// The instant `micros` microseconds later. Saturates at [`NEVER`](Self::NEVER).
    // Not inlined in firmware: with the attribute of `add`, that saves 296 bytes in `microbit-quiet`.
    #[cfg_attr(target_os = "none", inline(never))]
    #[must_use]
    pub const fn after(self, micros: u64) -> Self {
        Self(self.0.saturating_add(micros))
    }

    /// The instant `micros` microseconds earlier, or `None` before the clock's start.
    pub(crate) fn before(self, micros: u64) -> Option<Self> {
        self.0.checked_sub(micros).map(Self)
    }

    /// Time elapsed since `earlier`; zero if `earlier` is later.
    #[must_use]
    pub const fn since(self, earlier: Self) -> Duration {
        Duration::from_micros(self.0.saturating_sub(earlier.0))
    }
}

impl core::ops::Add<Duration> for Instant {
    type Output = Self;

    /// Saturates at [`Instant::NEVER`].
    // Inlined, so that the conversion of a constant costs nothing.
    #[cfg_attr(target_os = "none", inline(always))]
    fn add(self, rhs: Duration) -> Self {
        self.after(micros(rhs))
    }
}

/// The duration in microseconds; saturates.
#[must_use]
pub const fn micros(time: Duration) -> u64 {
    // In `u64`: a `u128` division costs a kilobyte on a Cortex-M0.
    let micros = time.as_secs().saturating_mul(1_000_000);
    micros.saturating_add(time.subsec_micros() as u64)
}

/// The earlier of two wake-up times; `None` means "no need to wake".
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
    fn milliseconds_are_rounded_down() {
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
