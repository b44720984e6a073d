//! The desk robot on a Stellaris LM3S6965 board: Cortex-M3.
//!
//! `cargo xtask qemu lm3s6965evb` runs it in QEMU. Its pins are the simulated ones of the panel, which
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

/// Cycles per millisecond in QEMU, where the core runs at 12.5 MHz after a reset.
const CYCLES: u32 = 12_500;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let boot = boots::count();
    board::run(boot, Uart::start(), SysTick::<CYCLES>::start(core.SYST))
}

board_support::handlers!(board::poll_buttons);
