//! The desk robot on a Raspberry Pi Pico: RP2040, over its USB, with embassy.
//!
//! Gripper GP15 (servo), stage GP2 (step), GP3 (direction), GP4 (limit switch to ground), lamp GP25 (the LED on the board).
//! Emergency button GP5, button that ends the stop GP6, both to ground.
#![no_std]
#![no_main]

use core::panic::PanicInfo;

use app::Pins;
use cortex_m::peripheral::SCB;
use embassy_executor::Spawner;
use embassy_futures::join::join3;
use embassy_rp::bind_interrupts;
use embassy_rp::clocks::RoscRng;
use embassy_rp::gpio::{Input, Level, Output, Pull};
use embassy_rp::peripherals::USB;
use embassy_rp::pwm::{self, Pwm};
use embassy_rp::usb::{Driver, InterruptHandler};
use embassy_time::Delay;
use embassy_usb::class::cdc_acm::{CdcAcmClass, State};
use static_cell::StaticCell;
use ztl_mcu::Instant;
use ztl_mcu::pump::Plugged;

bind_interrupts!(struct Interrupts {
    USBCTRL_IRQ => InterruptHandler<USB>;
});

#[cfg(feature = "defmt")]
defmt::timestamp!("{=u64:ms}", embassy_time::Instant::now().as_millis());

/// Longest packet of a USB device of full speed.
const PACKET: u16 = 64;

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    let chip = embassy_rp::init(embassy_rp::config::Config::default());
    // 1 MHz and 20,000 of them: 50 Hz, and a duty is a pulse in µs.
    let mut timer = pwm::Config::default();
    timer.divider = 125u8.into();
    timer.top = 19_999;
    let servo = Pwm::new_output_b(chip.PWM_SLICE7, chip.PIN_15, timer);
    let (_, Some(gripper)) = servo.split() else {
        SCB::sys_reset()
    };
    let pins = Pins {
        gripper,
        step: Output::new(chip.PIN_2, Level::Low),
        direction: Output::new(chip.PIN_3, Level::Low),
        limit: Input::new(chip.PIN_4, Pull::Up),
        lamp: Output::new(chip.PIN_25, Level::Low),
    };
    let mut stop = Input::new(chip.PIN_5, Pull::Up);
    let mut resume = Input::new(chip.PIN_6, Pull::Up);

    // The number of the project's own for tests, of pid.codes: not for devices that are sold.
    let mut config = embassy_usb::Config::new(0x1209, 0x0001);
    config.product = Some("ZTL desk robot");
    config.serial_number = Some("desk");
    config.max_packet_size_0 = 64;
    static STATE: StaticCell<State<'_>> = StaticCell::new();
    static BUFFERS: StaticCell<([u8; 128], [u8; 16], [u8; 64])> = StaticCell::new();
    let state = STATE.init(State::new());
    let (configuration, bos, control) = BUFFERS.init(([0; 128], [0; 16], [0; 64]));
    let driver = Driver::new(chip.USB, Interrupts);
    let mut builder =
        embassy_usb::Builder::new(driver, config, configuration, bos, &mut [], control);
    let class = CdcAcmClass::new(&mut builder, state, PACKET);
    let (tx, rx) = class.split();
    static PACKETS: StaticCell<[u8; PACKET as usize]> = StaticCell::new();
    let rx = rx.into_buffered(PACKETS.init([0; PACKET as usize]));
    let (mut rx, mut tx) = (Plugged::new(rx, Delay), Plugged::new(tx, Delay));
    let mut usb = builder.build();

    let buttons = async {
        loop {
            stop.wait_for_low().await;
            app::STOP.raise();
            stop.wait_for_high().await;
        }
    };
    let robot = app::run_async(
        RoscRng.next_u32(),
        pins,
        &mut rx,
        &mut tx,
        Delay,
        || Instant::from_micros(embassy_time::Instant::now().as_micros()),
        async || resume.wait_for_falling_edge().await,
    );
    join3(usb.run(), buttons, robot).await;
}

/// Resets the board, so that the gateway can report the tasks that were running.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
