//! The desk robot as a server that ZeroMQ clients talk to over Ethernet and TCP, without a gateway: two at
//! a time, at port 7002 of 10.0.2.15, which is the address in QEMU's network.
#![no_std]
#![no_main]

#[path = "../ethernet.rs"]
mod ethernet;

use app::tcp::Address;
use board_support::board;
use board_support::boots;
use board_support::clock::SysTick;
use board_support::vectors;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use ethernet::Ethernet;

/// Cycles per millisecond in QEMU, where the core runs at 12.5 MHz after a reset.
const CYCLES: u32 = 12_500;

/// One of those for local use.
const ADDRESS: Address = Address {
    mac: [0x02, 0, 0, 0, 0, 1],
    ip: [10, 0, 2, 15],
    prefix: 24,
};

// None is used: the clock wakes the main loop each millisecond, and that asks the controller.
vectors! { 1: 0 => board_support::unexpected }

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let clock = SysTick::<CYCLES>::start(core.SYST);
    let ethernet = Ethernet::start(ADDRESS.mac);
    board::serve_tcp(boots::count(), ethernet, ADDRESS, clock)
}

board_support::handlers!(board::poll_buttons);
