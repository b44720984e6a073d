//! The desk robot.

use core::panic::PanicInfo;

use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::{entry, exception};
use microbit::random;
use microbit::uart::Uart;
use board_support::board;
use board_support::clock::{self, SysTick};

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", clock::micros());

/// Cycles a millisecond.
const CYCLES: u32 = 16_000;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let boot = random::word();
    board::run(boot, Uart::start(), SysTick::<CYCLES>::start(core.SYST))
}

#[exception]
fn SysTick() {
    clock::tick();
    board::look_at_buttons();
}

/// After a reset the gateway knows what to tell of the tasks that ran.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
