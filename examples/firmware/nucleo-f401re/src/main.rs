//! The desk robot on an ST Nucleo-F401RE: STM32F401, Cortex-M4F, at the 16 MHz that it comes up with, over the
//! serial port of its ST-Link.
//!
//! Gripper D12 (servo), stage D2 (step), D3 (direction), D4 (limit switch to ground), lamp D13 (the LED on the
//! board). The blue button is the emergency stop, D6 to ground ends it.
#![no_std]
#![no_main]

mod pins;
mod uart;

use core::panic::PanicInfo;

use app::Pins;
use board_support::board::Clock;
use board_support::boots;
use board_support::clock::{self, SysTick};
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::{entry, exception};
use ztl_mcu::Instant;

use pins::{Input, Output, Servo};
use uart::Uart;

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:us}", clock::micros());

/// 16 MHz.
const CYCLES: u32 = 16_000;

struct Board {
    uart: Uart,
    clock: SysTick<CYCLES>,
}

impl app::Board for Board {
    type Port = Uart;

    fn port(&mut self) -> &mut Uart {
        &mut self.uart
    }

    fn now(&mut self) -> Instant {
        self.clock.now()
    }

    fn may_resume(&mut self) -> bool {
        !Input::STOP.is_pressed() && Input::RESUME.is_pressed()
    }

    fn sleep(&mut self) {
        self.clock.sleep();
    }
}

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    pins::start();
    let pins = Pins {
        gripper: Servo,
        step: Output::STEP,
        direction: Output::DIRECTION,
        limit: Input::LIMIT,
        lamp: Output::LAMP,
    };
    let mut board = Board {
        uart: Uart::start(),
        clock: SysTick::start(core.SYST),
    };
    app::run(boots::count(), pins, &mut board)
}

/// Each millisecond.
#[exception]
fn SysTick() {
    clock::tick();
    if Input::STOP.is_pressed() {
        app::STOP.raise();
    }
}

/// Resets the board, so that the gateway can report the tasks that were running.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
