//! The lamp of `smallest.rs` with a button: it shines while somebody presses it, for a minute at most. Its size is recorded.
#![no_std]
#![no_main]

use board_support::board::Clock;
use board_support::clock::SysTick;
use board_support::panel::{Lamp, PANEL};
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use embedded_io::Write;
use microbit::random;
use microbit::uart::Uart;
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::{Acting, Identity, Node};

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), random::word());
    let mut node = Node::<_, 2, 128>::new(identity, Acting::new([lamp]));
    let mut uart = Uart::start();
    let mut clock = SysTick::<16_000>::start(core.SYST);
    let mut received = [0; 8];
    let mut shining = None;
    let mut was_pressed = false;
    loop {
        let now = clock.now();
        let count = app::RECEIVED.take(&mut received);
        node.handle_bytes(now, received.get(..count).unwrap_or_default());
        let is_pressed = PANEL.is_resume_pressed();
        if is_pressed && !was_pressed {
            match node.start_here(now, 0, "pulse 60000") {
                Ok(task) => shining = Some(task),
                Err(reason) => {
                    node.report_event(now, &reason);
                }
            }
        } else if !is_pressed && let Some(task) = shining.take() {
            node.abort_here(now, task);
        }
        was_pressed = is_pressed;
        node.handle_timeout(now);
        let Ok(sent) = uart.write(node.transmit_buf(now, &()));
        node.consume(sent);
    }
}

board_support::handlers!();
