//! The smallest useful node on a shared line: a lamp at address 1, whose transceiver's driver is enabled by pin 0. Its size
//! is recorded.
#![no_std]
#![no_main]

use core::convert::Infallible;

use board_support::Register;
use board_support::board::Clock;
use board_support::clock::SysTick;
use board_support::panel::Lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use embedded_hal::digital::{ErrorType, OutputPin};
use embedded_io::Write;
use microbit::random;
use microbit::uart::Uart;
use ztl_mcu::bus::{DriverEnable, OnBus};
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::{Identity, Node};

/// The node's address, as a switch would set it.
const ADDRESS: u8 = 1;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let mut node = node();
    let Ok(mut line) = DriverEnable::new(Port(Uart::start()), DriverPin::start());
    let mut clock = SysTick::<16_000>::start(core.SYST);
    let mut received = [0; 8];
    let mut sending = false;
    loop {
        // What a `Pump` does, without its errors, its log and its sleep.
        let now = clock.now();
        let count = app::RECEIVED.take(&mut received);
        node.handle_bytes(now, received.get(..count).unwrap_or_default());
        node.handle_timeout(now);
        let pending = node.transmit_buf(now, &());
        if !pending.is_empty() {
            let Ok(sent) = line.write(pending);
            node.consume(sent);
            sending = true;
        } else if sending {
            let Ok(()) = line.flush();
            sending = false;
        }
    }
}

// Apart, so that nothing but the node stays on the stack.
#[inline(never)]
fn node() -> Node<'static, OnBus<[DigitalOutput<Lamp>; 1]>, 2, 128> {
    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), random::word());
    Node::new(identity, OnBus::new([lamp], chip_id(), ADDRESS))
}

/// The UART, of which `flush` waits, so that the driver is not disabled too early.
struct Port(Uart);

impl embedded_io::ErrorType for Port {
    type Error = Infallible;
}

impl Write for Port {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        self.0.wait_sent();
        Ok(())
    }
}

/// The chip's own number.
fn chip_id() -> u64 {
    // SAFETY: factory information of the nRF51, which cannot be written.
    let [low, high] = unsafe { [Register::at(0x1000_0060), Register::at(0x1000_0064)] };
    u64::from(high.read()) << 32 | u64::from(low.read())
}

// SAFETY: registers of the nRF51's GPIO, which has no access to memory.
const SET: Register = unsafe { Register::at(0x5000_0508) };
// SAFETY: as above.
const CLEAR: Register = unsafe { Register::at(0x5000_050C) };
// SAFETY: as above.
const MAKE_OUTPUT: Register = unsafe { Register::at(0x5000_0518) };

/// The micro:bit's pin 0, P0.03 of the chip, at the transceiver's driver enable.
struct DriverPin;

impl DriverPin {
    const BIT: u32 = 1 << 3;

    fn start() -> Self {
        CLEAR.write(Self::BIT);
        MAKE_OUTPUT.write(Self::BIT);
        Self
    }
}

impl ErrorType for DriverPin {
    type Error = Infallible;
}

impl OutputPin for DriverPin {
    fn set_low(&mut self) -> Result<(), Infallible> {
        CLEAR.write(Self::BIT);
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        SET.write(Self::BIT);
        Ok(())
    }
}

board_support::handlers!();
