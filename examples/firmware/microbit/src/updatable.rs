//! A lamp whose firmware is updated over the link.

use core::cell::RefCell;
use core::time::Duration;

use board_support::board::Clock;
use board_support::clock::SysTick;
use board_support::panel::Lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::exception;
use embassy_boot::FirmwareUpdaterConfig;
use embassy_sync_08::blocking_mutex::Mutex;
use embedded_io::Write;
use microbit::flash::WHOLE;
use microbit::random;
use microbit::uart::Uart;
use microbit::watchdog::watchdog_feed;
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::update::{Image, SelfTest, Slots, Updatable, Updater};
use ztl_mcu::{Identity, Node};

/// Longer than the longest part of a verification: 1.1 s, in which the node answers nothing.
const LINK_TIMEOUT: Duration = Duration::from_secs(3);

/// Runs the node for ever, with room for this many tasks.
pub(crate) fn run<const TASKS: usize>(version: &'static str) -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let flash = Mutex::new(RefCell::new(WHOLE));
    let partitions = FirmwareUpdaterConfig::from_linkerfile_blocking(&flash, &flash);
    let image = Image {
        board: "microbit",
        version,
        key: include_bytes!("../example.firmware_key"),
        trial: Duration::from_secs(60),
        self_test: Some(SelfTest {
            component: 0,
            goal: "pulse 100",
        }),
    };
    let Some(slots) = Slots::new(partitions, image, || SCB::sys_reset()) else {
        SCB::sys_reset()
    };
    let mut node = node::<_, TASKS>(version, slots);
    let mut uart = Uart::start();
    let mut clock = SysTick::<16_000>::start(core.SYST);
    let mut received = [0; 32];
    loop {
        watchdog_feed();
        let now = clock.now();
        let count = app::RECEIVED.take(&mut received);
        node.handle_bytes(now, received.get(..count).unwrap_or_default());
        node.handle_timeout(now);
        let Ok(sent) = uart.write(node.transmit_buf(now, &()));
        node.consume(sent);
    }
}

/// The components.
type UpdatedLamp<U> = Updatable<[DigitalOutput<Lamp>; 1], U>;

// Apart, so that nothing but the node stays on the stack.
#[inline(never)]
fn node<U: Updater, const TASKS: usize>(
    version: &'static str,
    updater: U,
) -> Node<'static, UpdatedLamp<U>, TASKS, 256> {
    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let identity = Identity {
        link_timeout: LINK_TIMEOUT,
        ..Identity::new("desk", version, random::word())
    };
    Node::new(identity, Updatable::new([lamp], updater))
}

/// A new image that fails goes back to the old one by this reset.
#[exception]
unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
    SCB::sys_reset()
}
