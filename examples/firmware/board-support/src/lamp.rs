//! The smallest useful server for ZeroMQ clients, and an echo to compare its size with.

use core::convert::Infallible;

use embedded_io::{Read, Write};
use ztl_mcu::Identity;
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::zmtp::{Line, Server};

use crate::board::Clock;
use crate::panel::Lamp;

/// Serves a lamp for one client at a time, two tasks, and messages of about 160 bytes. `boot` differs from reset to reset.
pub fn serve(boot: u32, mut uart: impl Write<Error = Infallible>, mut clock: impl Clock) -> ! {
    let mut server = server(boot);
    let mut line = Line::new();
    loop {
        // Neither half of the port can fail.
        let _ = line.turn(&mut server, &mut &app::RECEIVED, &mut uart, clock.now());
    }
}

/// Not inlined, so that only the server stays on the stack.
#[inline(never)]
fn server(boot: u32) -> Server<'static, [DigitalOutput<Lamp>; 1], 1, 2, 192, 1> {
    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), boot);
    Server::new("/lab", identity, [lamp])
}

/// Only a serial port and a clock: echoes received bytes.
pub fn echo(mut uart: impl Write<Error = Infallible>, mut clock: impl Clock) -> ! {
    let mut received = &app::RECEIVED;
    let mut buffer = [0; 32];
    loop {
        let count = received.read(&mut buffer).unwrap_or_default();
        let mut rest = buffer.get(..count).unwrap_or_default();
        while !rest.is_empty() {
            let written = uart.write(rest).unwrap_or_default();
            rest = rest.get(written..).unwrap_or_default();
        }
        if count == 0 && clock.now().as_micros() & 1 == 0 {
            clock.sleep();
        }
    }
}
