//! Simulated pins: words of memory, which a test reads and writes from outside.

use core::convert::Infallible;
use core::sync::atomic::{AtomicU32, Ordering};

use embedded_hal::{digital, pwm};

/// The pins. A test finds the panel by its symbol, and knows the order of the words.
#[derive(Debug)]
#[repr(C)]
pub struct Panel {
    /// Nonzero while a test presses the limit switch. The switch is also closed at positions up to 0.
    limit: AtomicU32,
    /// Nonzero while the emergency button is pressed.
    stop: AtomicU32,
    /// Nonzero while the button that ends an emergency stop is pressed.
    resume: AtomicU32,
    /// The servo's pulse in µs; 0 for none.
    pulse: AtomicU32,
    /// Position of the stage: steps above its switch.
    place: AtomicU32,
    /// Whether the lamp is lit.
    lamp: AtomicU32,
}

/// Position of the stage at the reset.
const START: u32 = 400;

/// The only panel.
#[unsafe(no_mangle)]
pub static PANEL: Panel = Panel {
    limit: AtomicU32::new(0),
    stop: AtomicU32::new(0),
    resume: AtomicU32::new(0),
    pulse: AtomicU32::new(0),
    place: AtomicU32::new(START),
    lamp: AtomicU32::new(0),
};

impl Panel {
    /// Whether the emergency button is pressed.
    pub fn is_stop_pressed(&self) -> bool {
        self.stop.load(Ordering::Relaxed) != 0
    }

    /// Whether the button that ends an emergency stop is pressed.
    pub fn is_resume_pressed(&self) -> bool {
        self.resume.load(Ordering::Relaxed) != 0
    }
}

/// The servo's PWM output: the duty is the pulse in µs.
#[derive(Debug)]
pub struct Pulse;

impl pwm::ErrorType for Pulse {
    type Error = Infallible;
}

impl pwm::SetDutyCycle for Pulse {
    fn max_duty_cycle(&self) -> u16 {
        20_000
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        PANEL.pulse.store(duty.into(), Ordering::Relaxed);
        Ok(())
    }
}

/// Step input of the stage.
#[derive(Debug)]
pub struct Step;

/// Direction input of the stage.
#[derive(Debug)]
pub struct Direction;

static FORWARD: AtomicU32 = AtomicU32::new(0);

impl digital::ErrorType for Step {
    type Error = Infallible;
}

impl digital::OutputPin for Step {
    fn set_low(&mut self) -> Result<(), Infallible> {
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        let place = PANEL.place.load(Ordering::Relaxed);
        let forward = FORWARD.load(Ordering::Relaxed) != 0;
        let place = if forward {
            place.wrapping_add(1)
        } else {
            place.wrapping_sub(1)
        };
        PANEL.place.store(place, Ordering::Relaxed);
        Ok(())
    }
}

impl digital::ErrorType for Direction {
    type Error = Infallible;
}

impl digital::OutputPin for Direction {
    fn set_low(&mut self) -> Result<(), Infallible> {
        FORWARD.store(0, Ordering::Relaxed);
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        FORWARD.store(1, Ordering::Relaxed);
        Ok(())
    }
}

/// The stage's limit switch, closed to ground.
#[derive(Debug)]
pub struct Limit;

impl digital::ErrorType for Limit {
    type Error = Infallible;
}

impl digital::InputPin for Limit {
    fn is_high(&mut self) -> Result<bool, Infallible> {
        self.is_low().map(|low| !low)
    }

    fn is_low(&mut self) -> Result<bool, Infallible> {
        let place = PANEL.place.load(Ordering::Relaxed).cast_signed();
        Ok(place <= 0 || PANEL.limit.load(Ordering::Relaxed) != 0)
    }
}

/// The lamp.
#[derive(Debug)]
pub struct Lamp;

impl digital::ErrorType for Lamp {
    type Error = Infallible;
}

impl digital::OutputPin for Lamp {
    fn set_low(&mut self) -> Result<(), Infallible> {
        PANEL.lamp.store(0, Ordering::Relaxed);
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        PANEL.lamp.store(1, Ordering::Relaxed);
        Ok(())
    }
}
