//! The desk robot on a BBC micro:bit: nRF51822, Cortex-M0, 16 MHz.
//!
//! `cargo xtask qemu microbit` runs it in QEMU. Its pins are those of the panel, for a test to press
//! and see.
#![no_std]
#![no_main]

mod random;
mod uart;

use core::panic::PanicInfo;

use app::Pins;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::{entry, exception};
use qemu::clock::{self, Clock};
use qemu::panel::{Direction, Lamp, Limit, PANEL, Pulse, Step};
use ztl_mcu::Instant;

use uart::Uart;

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:ms}", clock::millis());

/// 16 MHz.
type BoardClock = Clock<16_000>;

struct Board {
    uart: Uart,
    clock: BoardClock,
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
        !PANEL.is_stop_pressed() && PANEL.is_resume_pressed()
    }

    fn sleep(&mut self) {
        cortex_m::asm::wfi();
    }
}

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let boot = random::word();
    let mut board = Board {
        clock: Clock::start(core.SYST),
        uart: Uart::start(),
    };
    let pins = Pins {
        gripper: Pulse,
        step: Step,
        direction: Direction,
        limit: Limit,
        lamp: Lamp,
    };
    app::run(boot, pins, &mut board)
}

/// Each millisecond.
#[exception]
fn SysTick() {
    clock::tick();
    if PANEL.is_stop_pressed() {
        app::STOP.raise();
    }
}

/// After a reset the gateway knows what to tell of the tasks that ran.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
