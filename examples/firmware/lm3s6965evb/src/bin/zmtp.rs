//! The desk robot as a server that a ZeroMQ client talks to over the serial port, without a gateway.
//!
//! For experiments only: a UART does not detect errors, so a real one needs the link. See docs/zmtp.md.
#![no_std]
#![no_main]

#[path = "../uart.rs"]
mod uart;

use core::panic::PanicInfo;

use board_support::board;
use board_support::boots;
use board_support::clock::{self, SysTick};
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::{entry, exception};
use uart::Uart;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    board::serve(
        boots::count(),
        Uart::start(),
        SysTick::<12_500>::start(core.SYST),
    )
}

#[exception]
fn SysTick() {
    clock::tick();
    board::poll_buttons();
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
