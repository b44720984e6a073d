//! The desk robot as a server that a ZeroMQ client talks to over the serial port, without a gateway.
//!
//! For a try: a UART has no check for errors, so on a real one the link belongs. See docs/zmtp.md.
#![no_std]
#![no_main]

#[path = "../uart.rs"]
mod uart;

use core::panic::PanicInfo;

use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::{entry, exception};
use board_support::board;
use board_support::boots;
use board_support::clock::{self, SysTick};
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
    board::look_at_buttons();
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
