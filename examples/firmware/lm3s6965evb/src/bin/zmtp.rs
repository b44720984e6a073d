//! The desk robot as a server that a ZeroMQ client talks to over the serial port, without a gateway.
//!
//! For experiments only: a UART does not detect errors, so a real one needs the link. See docs/zmtp.md.
#![no_std]
#![no_main]

#[path = "../uart.rs"]
mod uart;

use board_support::board;
use board_support::boots;
use board_support::clock::SysTick;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
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

board_support::handlers!(board::poll_buttons);
