//! A lamp with parameters, with room for two tasks.

use board_support::board::Clock;
use board_support::clock::SysTick;
use board_support::panel::Lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use embedded_io::Write;
use microbit::random;
use microbit::uart::Uart;
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::parameters::{Text, Tuned};
use ztl_mcu::{Components, Identity, Node, parameters};

parameters! {
    /// What people can set.
    pub(crate) struct Settings {
        pub(crate) label: Text<16> = Parameter::<Text<16>>::new("desk").about("what people call it");
        pub(crate) gain: f32 = Parameter::<f32>::new(1.0).range(0.0, 10.0).unit("1/s");
    }
}

/// The components.
pub(crate) type TunedLamp = Tuned<[DigitalOutput<Lamp>; 1]>;

/// The lamp.
pub(crate) fn output() -> DigitalOutput<Lamp> {
    DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT)
}

/// Runs the node for ever.
pub(crate) fn run(components: impl Components) -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), random::word());
    let mut node = Node::<_, 2, 128>::new(identity, components);
    let mut uart = Uart::start();
    let mut clock = SysTick::<16_000>::start(core.SYST);
    let mut received = [0; 32];
    loop {
        let now = clock.now();
        let count = app::RECEIVED.take(&mut received);
        node.handle_bytes(now, received.get(..count).unwrap_or_default());
        node.handle_timeout(now);
        let Ok(sent) = uart.write(node.transmit_buf(now, &()));
        node.consume(sent);
    }
}
