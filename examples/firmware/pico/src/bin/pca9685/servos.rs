//! A servo on a PCA9685, an I2C chip with sixteen PWM outputs, as an async driver.

use embedded_hal_async::delay::DelayNs;
use embedded_hal_async::i2c::I2c;
use ztl_mcu::driver::{Driver, Failed, Progress};
use ztl_mcu::{Refused, Report, parse_goal};

/// The chip's address with its address pins at ground.
const ADDRESS: u8 = 0x40;
const MODE: u8 = 0x00;
const DIVIDER: u8 = 0xFE;
/// In `MODE`: asleep, as after power-on, when the divider can be set; awake; both with auto-increment of registers.
const ASLEEP: u8 = 0x30;
const AWAKE: u8 = 0x20;
/// Divides the chip's 25 MHz by 4096 and this for 50 Hz.
const FOR_50_HZ: u8 = 121;

/// Range in degrees, and its pulses: 4096 counts make 20 ms.
const DEGREES: f32 = 180.0;
const PULSE: (u16, u16) = (102, 512);
/// Counts of a step, and how long it lasts: 110 degrees a second.
const STEP: u16 = 5;
const STEP_MS: u32 = 20;

/// The pulse that a goal in degrees asks for, in counts.
fn pulse(goal: &str, why: &mut Report<'_>) -> Result<u16, Refused> {
    let degrees: f32 = parse_goal(goal, why)?;
    if !(0.0..=DEGREES).contains(&degrees) {
        why.text("pan takes 0 to 180 degrees");
        return Err(Refused);
    }
    let (least, most) = PULSE;
    Ok(least + (degrees / DEGREES * f32::from(most - least) + 0.5) as u16)
}

/// The angle of a pulse, in degrees.
fn degrees(pulse: u16) -> f32 {
    let (least, most) = PULSE;
    f32::from(pulse.saturating_sub(least)) / f32::from(most - least) * DEGREES
}

/// A servo on one output of the chip.
pub(crate) struct Servo<I, D> {
    bus: I,
    delay: D,
    /// First register of the output.
    output: u8,
    /// The last pulse; unknown at first and without power.
    at: Option<u16>,
}

impl<I: I2c, D: DelayNs> Servo<I, D> {
    pub(crate) const fn new(bus: I, delay: D, output: u8) -> Self {
        Self {
            bus,
            delay,
            output: 0x06 + 4 * output,
            at: None,
        }
    }

    /// Sets the end of the pulse; its begin is 0. With bit 12, there is no pulse.
    async fn set_pulse(&mut self, end: u16) -> Result<(), I::Error> {
        let [low, high] = end.to_le_bytes();
        let frame = [self.output, 0, 0, low, high];
        self.bus.write(ADDRESS, &frame).await
    }

    async fn go(&mut self, pulse: u16, progress: Progress<'_>) -> Result<(), I::Error> {
        for (register, value) in [(MODE, ASLEEP), (DIVIDER, FOR_50_HZ), (MODE, AWAKE)] {
            self.bus.write(ADDRESS, &[register, value]).await?;
        }
        // The first motion is as fast as the servo, which does not report its position.
        let mut at = self.at.unwrap_or(pulse);
        loop {
            self.set_pulse(at).await?;
            self.at = Some(at);
            progress.write(|report| report.number(degrees(at), 1));
            if at == pulse {
                return Ok(());
            }
            self.delay.delay_ms(STEP_MS).await;
            at = pulse.min(at + STEP).max(at.saturating_sub(STEP));
        }
    }
}

impl<I: I2c, D: DelayNs> Driver for Servo<I, D> {
    fn check(goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        pulse(goal, why).map(drop)
    }

    async fn run(&mut self, goal: &str, progress: Progress<'_>) -> Result<(), Failed> {
        let pulse = progress.write(|why| pulse(goal, why)).map_err(|_| Failed)?;
        if self.go(pulse, progress).await.is_err() {
            progress.write(|report| report.text("the servo driver does not answer"));
            return Err(Failed);
        }
        Ok(())
    }

    /// Holds its last place.
    async fn abort(&mut self) {}

    /// Without a pulse the servo has no power.
    async fn make_safe(&mut self) {
        self.at = None;
        while self.set_pulse(1 << 12).await.is_err() {
            self.delay.delay_ms(5).await;
        }
    }
}
