//! The desk robot on an ST Nucleo-F401RE: STM32F401, Cortex-M4F, at the 16 MHz that it comes up with, over the
//! serial port of its ST-Link.
//!
//! Gripper D12 (servo), stage D2 (step), D3 (direction), D4 (limit switch to ground), lamp D13 (the LED on the
//! board). The blue button is the emergency stop, D6 to ground ends it.
#![no_std]
#![no_main]

mod board;
mod pins;
mod uart;

use core::panic::PanicInfo;

use board_support::boots;
use board_support::clock::SysTick;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::{entry, exception};

use board::Board;
use uart::Uart;

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", board_support::clock::micros());

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    pins::start();
    let mut board = Board {
        port: Uart::start(),
        clock: SysTick::start(core.SYST),
    };
    app::run(boots::count(), board::pins(), &mut board)
}

/// Each millisecond.
#[exception]
fn SysTick() {
    board::tick();
}

/// Resets the board, so that the gateway can report the tasks that were running.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
