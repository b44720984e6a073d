//! The time since the reset, from the SysTick timer.

use core::cell::Cell;

use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use critical_section::Mutex;
use ztl_mcu::Instant;

use crate::board::Clock;

/// In µs, at the last tick.
static TICKED: Mutex<Cell<u64>> = Mutex::new(Cell::new(0));

/// SysTick with this many cycles per millisecond, and a tick every millisecond.
#[derive(Debug)]
pub struct SysTick<const CYCLES: u32>(());

impl<const CYCLES: u32> SysTick<CYCLES> {
    /// Starts the timer. The board's `SysTick` handler must call [`tick`].
    #[must_use]
    pub fn start(mut timer: SYST) -> Self {
        timer.set_clock_source(SystClkSource::Core);
        timer.set_reload(CYCLES - 1);
        timer.clear_current();
        timer.enable_counter();
        timer.enable_interrupt();
        Self(())
    }
}

impl<const CYCLES: u32> Clock for SysTick<CYCLES> {
    fn now(&mut self) -> Instant {
        loop {
            let before = micros();
            let cycles = CYCLES.saturating_sub(SYST::get_current() + 1);
            // Otherwise there was a tick in between.
            if before == micros() {
                let since = cycles * 1000 / CYCLES;
                return Instant::from_micros(before + u64::from(since));
            }
        }
    }

    fn sleep(&mut self) {
        cortex_m::asm::wfi();
    }
}

/// Adds a millisecond; called by the interrupt.
pub fn tick() {
    critical_section::with(|cs| {
        let ticked = TICKED.borrow(cs);
        ticked.set(ticked.get().wrapping_add(1000));
    });
}

/// Microseconds from the start to the last tick: for timestamps.
#[must_use]
pub fn micros() -> u64 {
    critical_section::with(|cs| TICKED.borrow(cs).get())
}
