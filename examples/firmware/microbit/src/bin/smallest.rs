//! The smallest node that is of use: a lamp, for two tasks. Its size is recorded beside the robot's.
#![no_std]
#![no_main]

use core::panic::PanicInfo;

use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::{entry, exception};
use microbit::random;
use microbit::uart::Uart;
use qemu::board::Clock;
use qemu::clock::{self, SysTick};
use qemu::panel::Lamp;
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::pump::Pump;
use ztl_mcu::{Identity, Node};

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), random::word());
    let mut node = Node::<_, 2, 128>::new(identity, [lamp]);
    let mut uart = Uart::start();
    let mut clock = SysTick::<16_000>::start(core.SYST);
    let pump = Pump::new();
    loop {
        // Neither half of the port can fail.
        let _ = pump.turn_split(&mut node, &mut &app::RECEIVED, &mut uart, clock.now());
    }
}

#[exception]
fn SysTick() {
    clock::tick();
}

/// After a reset the gateway knows what to tell of the tasks that ran.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
