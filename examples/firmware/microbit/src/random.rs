//! The nRF51's random number generator.

use board_support::Register;

// SAFETY: registers of the nRF51's RNG, which has no access to memory.
const START: Register = unsafe { Register::at(0x4000_D000) };
// SAFETY: as above.
const STOP: Register = unsafe { Register::at(0x4000_D004) };
// SAFETY: as above.
const READY: Register = unsafe { Register::at(0x4000_D100) };
// SAFETY: as above.
const VALUE: Register = unsafe { Register::at(0x4000_D508) };

/// 32 random bits; takes some milliseconds.
#[must_use]
pub fn word() -> u32 {
    READY.write(0);
    START.write(1);
    let mut word = 0;
    for _ in 0..4 {
        while READY.read() == 0 {}
        READY.write(0);
        word = word << 8 | VALUE.read();
    }
    STOP.write(1);
    word
}
