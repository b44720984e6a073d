//! The smallest useful server for ZeroMQ clients without a gateway: a lamp. Its size is recorded.
#![no_std]
#![no_main]

use board_support::clock::SysTick;
use board_support::lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use microbit::random;
use microbit::uart::Uart;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    lamp::serve(
        random::word(),
        Uart::start(),
        SysTick::<16_000>::start(core.SYST),
    )
}

board_support::handlers!();
