//! The desk robot on a board in QEMU.

use core::convert::Infallible;

use app::Pins;
use embedded_io::Write;
use ztl_mcu::Instant;

use crate::panel::{Direction, Lamp, Limit, PANEL, Pulse, Step};

/// The time since the reset.
pub trait Clock {
    /// The time since it was started. Not to be asked where interrupts are held off.
    fn now(&mut self) -> Instant;

    /// Waits for an interrupt.
    fn sleep(&mut self);
}

struct Board<U, C> {
    uart: U,
    clock: C,
}

impl<U: Write<Error = Infallible>, C: Clock> app::Board for Board<U, C> {
    type Port = U;

    fn port(&mut self) -> &mut U {
        &mut self.uart
    }

    fn now(&mut self) -> Instant {
        self.clock.now()
    }

    fn may_resume(&mut self) -> bool {
        !PANEL.is_stop_pressed() && PANEL.is_resume_pressed()
    }

    fn sleep(&mut self) {
        self.clock.sleep();
    }
}

/// Runs for ever, with the pins of the panel. `boot` differs from reset to reset.
pub fn run(boot: u32, uart: impl Write<Error = Infallible>, clock: impl Clock) -> ! {
    let pins = Pins {
        gripper: Pulse,
        step: Step,
        direction: Direction,
        limit: Limit,
        lamp: Lamp,
    };
    app::run(boot, pins, &mut Board { uart, clock })
}

/// To be called by the clock's interrupt, each millisecond: looks at the emergency button.
pub fn look_at_buttons() {
    if PANEL.is_stop_pressed() {
        app::STOP.raise();
    }
}
