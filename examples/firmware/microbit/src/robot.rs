//! The desk robot, as the image's `run` runs it.

use board_support::board;
use board_support::clock::SysTick;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use microbit::random;
use microbit::uart::Uart;

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", board_support::clock::micros());

/// Cycles per millisecond.
const CYCLES: u32 = 16_000;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let boot = random::word();
    super::run(boot, Uart::start(), SysTick::<CYCLES>::start(core.SYST))
}

board_support::handlers!(board::poll_buttons);
