//! The smallest useful node: a lamp with room for two tasks. Its size is recorded.
#![no_std]
#![no_main]

use board_support::board::Clock;
use board_support::clock::SysTick;
use board_support::panel::Lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use embedded_io::Write;
use microbit::random;
use microbit::uart::Uart;
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::{Identity, Node};

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let mut node = node();
    let mut uart = Uart::start();
    let mut clock = SysTick::<16_000>::start(core.SYST);
    let mut received = [0; 8];
    loop {
        // What a `Pump` does, without its errors, its log and its sleep.
        let now = clock.now();
        let count = app::RECEIVED.take(&mut received);
        node.handle_bytes(now, received.get(..count).unwrap_or_default());
        node.handle_timeout(now);
        let Ok(sent) = uart.write(node.transmit_buf(now, &()));
        node.consume(sent);
    }
}

// Apart, so that nothing but the node stays on the stack.
#[inline(never)]
fn node() -> Node<'static, [DigitalOutput<Lamp>; 1], 2, 128> {
    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), random::word());
    Node::new(identity, [lamp])
}

board_support::handlers!();
