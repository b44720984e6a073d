//! A servo on a PCA9685 at the I2C bus of a Raspberry Pi Pico, with an async driver; over the Pico's USB, with embassy.
//!
//! SDA GP4, SCL GP5; the servo is at output 0 of the chip.
#![no_std]
#![no_main]

mod servos;

use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;
use embassy_executor::Spawner;
use embassy_futures::join::join3;
use embassy_rp::bind_interrupts;
use embassy_rp::clocks::RoscRng;
use embassy_rp::i2c::{self, I2c};
use embassy_rp::peripherals::{I2C0, USB};
use embassy_rp::usb::{self, Driver};
use embassy_time::Delay;
use embassy_usb::class::cdc_acm::{CdcAcmClass, State};
use static_cell::StaticCell;
use ztl_mcu::driver::Slot;
use ztl_mcu::link::Offer;
use ztl_mcu::pump::{Plugged, Pump};
use ztl_mcu::{Identity, Instant, Node};

use servos::Servo;

bind_interrupts!(struct Interrupts {
    USBCTRL_IRQ => usb::InterruptHandler<USB>;
    I2C0_IRQ => i2c::InterruptHandler<I2C0>;
});

/// Longest packet of a USB device of full speed.
const PACKET: usize = 64;

fn clock() -> Instant {
    Instant::from_micros(embassy_time::Instant::now().as_micros())
}

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    let chip = embassy_rp::init(embassy_rp::config::Config::default());
    let bus = I2c::new_async(
        chip.I2C0,
        chip.PIN_5,
        chip.PIN_4,
        Interrupts,
        i2c::Config::default(),
    );
    let mut servo = Servo::new(bus, Delay, 0);

    // The number of the project's own for tests, of pid.codes: not for devices that are sold.
    let mut config = embassy_usb::Config::new(0x1209, 0x0001);
    config.product = Some("ZTL head");
    config.serial_number = Some("head");
    config.max_packet_size_0 = 64;
    static STATE: StaticCell<State<'_>> = StaticCell::new();
    static BUFFERS: StaticCell<([u8; 128], [u8; 16], [u8; 64])> = StaticCell::new();
    static PACKETS: StaticCell<[u8; PACKET]> = StaticCell::new();
    let state = STATE.init(State::new());
    let (configuration, bos, control) = BUFFERS.init(([0; 128], [0; 16], [0; 64]));
    let packet = PACKETS.init([0; PACKET]);
    let driver = Driver::new(chip.USB, Interrupts);
    let mut builder =
        embassy_usb::Builder::new(driver, config, configuration, bos, &mut [], control);
    let (tx, rx) = CdcAcmClass::new(&mut builder, state, PACKET as u16).split();
    let mut tx = Plugged::new(tx, Delay);
    let mut rx = Plugged::new(rx.into_buffered(packet), Delay);
    let mut usb = builder.build();

    let slot = Slot::<Servo<_, _>>::new(Offer::new("pan").with_range(0.0, 180.0, "degrees"));
    let identity = Identity::new("head", env!("CARGO_PKG_VERSION"), RoscRng.next_u32());
    let mut node = Node::<_, 2, 128>::new(identity, [slot.component()]);
    let (pump, mut delay) = (Pump::new(), Delay);
    let link = pump.run(&mut node, &mut rx, &mut tx, &mut delay, clock);
    // None of them ends.
    let _ = join3(usb.run(), link, slot.run(&mut servo, clock)).await;
}

/// Resets the board, so that the gateway can report the task that was running.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
