//! Random numbers from a seed, and test sizes from the environment.

use std::io::Write;
use std::time::{SystemTime, UNIX_EPOCH};

/// Random numbers that a seed determines (SplitMix64).
pub struct Random(u64);

impl Random {
    /// Starts the sequence.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ mixed >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ mixed >> 31
    }

    /// From 0 to below `limit`.
    pub fn below(&mut self, limit: usize) -> usize {
        (((self.bits() >> 32) * limit as u64) >> 32) as usize
    }

    /// True once in so many times.
    pub fn once_in(&mut self, times: usize) -> bool {
        self.below(times) == 0
    }

    /// One of these.
    pub fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }
}

/// The seed in `ZTL_SEED`, or the time of day. It is printed, so that a failure can be repeated.
pub fn seed() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let now = now.map_or(0, |now| now.as_millis() as u64);
    let seed = number("ZTL_SEED", now);
    // Not by a macro, whose output the test harness captures.
    let _ = writeln!(std::io::stderr(), "ZTL_SEED={seed}");
    seed
}

/// The number in an environment variable.
///
/// # Panics
/// When it is set to something else.
#[track_caller]
pub fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |text| {
        let number = text.parse();
        number.unwrap_or_else(|_| panic!("{variable} is a number, not '{text}'"))
    })
}
