//! The desk robot on Arm's MPS2 with the image AN386: Cortex-M4 with a floating-point unit.
//!
//! `cargo xtask qemu mps2-an386` runs it in QEMU. Its pins are the simulated ones of the panel, which
//! tests read and write.
#![no_std]
#![no_main]

mod uart;

use board_support::board;
use board_support::boots;
use board_support::clock::{self, SysTick};
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use uart::Uart;

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", clock::micros());

/// Cycles per millisecond.
const CYCLES: u32 = 25_000;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let boot = boots::count();
    board::run(boot, Uart::start(), SysTick::<CYCLES>::start(core.SYST))
}

board_support::handlers!(board::poll_buttons);
