//! The nRF51's watchdog, which resets the chip unless it is fed. Once started it cannot be stopped.

use board_support::Register;

const fn register(offset: usize) -> Register {
    // SAFETY: the nRF51's WDT, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x4001_0000 + offset) }
}

const START: Register = register(0x000);
/// Ticks until the reset, less one.
const TICKS: Register = register(0x504);
const FEED: Register = register(0x600);

/// 10 s, in ticks of 32,768 Hz: longer than a swap of images, and than the longest part of a verification.
const TIMEOUT: u32 = 10 * 32_768 - 1;

/// What feeds it.
const FOOD: u32 = 0x6E52_4635;

/// Starts the watchdog, or feeds it if it runs already. Not inlined, so that a debugger can see it.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn watchdog_start() {
    TICKS.write(TIMEOUT);
    START.write(1);
    FEED.write(FOOD);
}

/// Has no effect if it does not run. The same.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn watchdog_feed() {
    FEED.write(FOOD);
}
