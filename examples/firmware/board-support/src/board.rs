//! The desk robot on a board in QEMU.

use core::convert::Infallible;

use app::Pins;
use embedded_io::Write;
use ztl_mcu::Instant;

use crate::panel::{Direction, Lamp, Limit, PANEL, Pulse, Step};

/// The time since the reset.
pub trait Clock {
    /// The time since the start. Do not call it while interrupts are masked.
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

/// The pins of the panel.
const fn pins() -> Pins<Pulse, Step, Direction, Limit, Lamp> {
    Pins {
        gripper: Pulse,
        step: Step,
        direction: Direction,
        limit: Limit,
        lamp: Lamp,
    }
}

/// Runs forever, with the pins of the panel. `boot` differs from reset to reset.
pub fn run(boot: u32, uart: impl Write<Error = Infallible>, clock: impl Clock) -> ! {
    app::run(boot, pins(), &mut Board { uart, clock })
}

/// Like [`run`], with components that say what they are.
pub fn run_described(boot: u32, uart: impl Write<Error = Infallible>, clock: impl Clock) -> ! {
    app::run_described(boot, pins(), &mut Board { uart, clock })
}

/// Like [`run`], as a server for a ZeroMQ client on the serial port.
pub fn serve(boot: u32, uart: impl Write<Error = Infallible>, clock: impl Clock) -> ! {
    app::serve(boot, pins(), &mut Board { uart, clock })
}

/// Like [`run`], as a server for several clients over TCP.
#[cfg(feature = "tcp")]
pub fn serve_tcp(
    boot: u32,
    device: impl smoltcp::phy::Device,
    address: app::tcp::Address,
    clock: impl Clock,
) -> ! {
    let mut board = Board {
        uart: NoPort,
        clock,
    };
    app::tcp::serve(boot, pins(), &mut board, device, address)
}

/// A serial port that drops all bytes.
#[cfg(feature = "tcp")]
struct NoPort;

#[cfg(feature = "tcp")]
impl embedded_io::ErrorType for NoPort {
    type Error = Infallible;
}

#[cfg(feature = "tcp")]
impl Write for NoPort {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

/// Polls the emergency button. The clock's interrupt calls it every millisecond.
pub fn poll_buttons() {
    if PANEL.is_stop_pressed() {
        app::STOP.raise();
    }
}
