//! A serial port and a clock, which every image has. Its recorded size is subtracted from others.
#![no_std]
#![no_main]

use board_support::clock::SysTick;
use board_support::lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use microbit::uart::Uart;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    lamp::echo(Uart::start(), SysTick::<16_000>::start(core.SYST))
}

board_support::handlers!();
