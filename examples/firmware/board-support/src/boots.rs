//! Counts boots.

use core::cell::UnsafeCell;
use core::mem::MaybeUninit;

struct Word(UnsafeCell<MaybeUninit<u32>>);

// SAFETY: only `count` uses it, volatile, and it is not called by interrupts.
unsafe impl Sync for Word {}

/// Survives a reset; undefined after power-on.
#[unsafe(link_section = ".uninit.BOOTS")]
static BOOTS: Word = Word(UnsafeCell::new(MaybeUninit::uninit()));

/// Counts the boots, in memory that a reset does not clear. Call it once. If a chip has a random number generator, use that
/// instead.
#[must_use]
pub fn count() -> u32 {
    let word = BOOTS.0.get().cast::<u32>();
    // SAFETY: reserved, aligned memory in which every bit pattern is a valid number. The volatile access
    // keeps the compiler from assuming a value.
    unsafe {
        let boot = word.read_volatile().wrapping_add(1);
        word.write_volatile(boot);
        boot
    }
}
