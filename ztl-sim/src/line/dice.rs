//! Seeded random numbers, identical on every machine and in every run.

/// The generator splitmix64. Any seed works, even 0.
#[derive(Debug, Clone)]
pub struct Dice(u64);

impl Dice {
    /// Starts the sequence.
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The next number.
    pub const fn throw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    }

    /// A number below `bound`; 0 if `bound` is 0.
    pub const fn below(&mut self, bound: u64) -> u64 {
        match self.throw().checked_rem(bound) {
            Some(rest) => rest,
            None => 0,
        }
    }

    /// True with this probability. Consumes no number if the probability is 0.
    pub fn chance(&mut self, probability: f64) -> bool {
        probability > 0.0 && (self.throw() as f64) < probability * TWO_TO_64
    }
}

const TWO_TO_64: f64 = 18_446_744_073_709_551_616.0;
