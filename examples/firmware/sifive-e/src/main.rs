//! The desk robot on a SiFive E: FE310, RISC-V.
//!
//! `cargo xtask qemu sifive-e` runs it in QEMU. Its pins are the simulated ones of the panel, which
//! tests read and write.
#![no_std]
#![no_main]

mod clock;
mod uart;

use core::panic::PanicInfo;

use board_support::{board, boots};
use riscv_rt::entry;

use clock::Clock;
use uart::Uart;

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", clock::micros());

#[entry]
fn main() -> ! {
    let boot = boots::count();
    let uart = Uart::start();
    board::run(boot, uart, Clock::start())
}

/// The chip cannot reset itself. The gateway detects that it does not answer.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    loop {
        riscv::asm::wfi();
    }
}
