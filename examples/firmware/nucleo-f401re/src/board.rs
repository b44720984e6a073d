//! What the programs of this board have in common: its clock, its buttons and the pins of the robot.

use core::convert::Infallible;

use app::Pins;
use board_support::board::Clock;
use board_support::clock::{self, SysTick};
use embedded_io::Write;
use ztl_mcu::Instant;

use crate::pins::{Input, Output, Servo};

/// 16 MHz.
const CYCLES: u32 = 16_000;

/// The board with a port to its host.
pub(crate) struct Board<P> {
    pub(crate) port: P,
    pub(crate) clock: SysTick<CYCLES>,
}

impl<P: Write<Error = Infallible>> app::Board for Board<P> {
    type Port = P;

    fn port(&mut self) -> &mut P {
        &mut self.port
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

/// The pins of the robot.
pub(crate) const fn pins() -> Pins<Servo, Output, Output, Input, Output> {
    Pins {
        gripper: Servo,
        step: Output::STEP,
        direction: Output::DIRECTION,
        limit: Input::LIMIT,
        lamp: Output::LAMP,
    }
}

/// To be called each millisecond.
pub(crate) fn tick() {
    clock::tick();
    if Input::STOP.is_pressed() {
        app::STOP.raise();
    }
}
