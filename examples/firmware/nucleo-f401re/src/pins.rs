//! The pins, and the timer that makes the servo's pulse.

use core::convert::Infallible;

use board_support::Register;
use embedded_hal::{digital, pwm};

const fn register(address: usize) -> Register {
    // SAFETY: RCC, TIM3 and GPIOs of the STM32F401, which have no access to memory; the addresses are those below.
    unsafe { Register::at(address) }
}

const GPIO_CLOCKS: Register = register(0x4002_3830);
const APB1_CLOCKS: Register = register(0x4002_3840);

const TIMER_CONTROL: Register = register(0x4000_0400);
const TIMER_EVENT: Register = register(0x4000_0414);
const TIMER_MODE: Register = register(0x4000_0418);
const TIMER_ENABLE: Register = register(0x4000_0420);
const TIMER_DIVIDER: Register = register(0x4000_0428);
const TIMER_TOP: Register = register(0x4000_042C);
const TIMER_PULSE: Register = register(0x4000_0434);

/// A group of 16 pins.
#[derive(Clone, Copy)]
#[repr(usize)]
enum Port {
    A = 0x4002_0000,
    B = 0x4002_0400,
    C = 0x4002_0800,
}

impl Port {
    const fn register(self, offset: usize) -> Register {
        register(self as usize + offset)
    }

    /// Sets `bits` of the two or four that a pin has in a register.
    fn set(self, offset: usize, shift: u32, mask: u32, bits: u32) {
        let register = self.register(offset);
        register.write(register.read() & !(mask << shift) | bits << shift);
    }

    fn mode(self, pin: u32, mode: u32) {
        self.set(0x00, 2 * pin, 3, mode);
    }

    fn pull_up(self, pin: u32) {
        self.set(0x0C, 2 * pin, 3, 1);
    }

    /// Gives one of the first eight pins to a device.
    fn function(self, pin: u32, function: u32) {
        self.set(0x20, 4 * pin, 15, function);
        self.mode(pin, 2);
    }
}

/// An output.
pub(crate) struct Output(Port, u32);

impl Output {
    pub(crate) const STEP: Self = Self(Port::A, 10);
    pub(crate) const DIRECTION: Self = Self(Port::B, 3);
    pub(crate) const LAMP: Self = Self(Port::A, 5);
}

/// An input.
pub(crate) struct Input(Port, u32);

impl Input {
    pub(crate) const LIMIT: Self = Self(Port::B, 5);
    pub(crate) const STOP: Self = Self(Port::C, 13);
    pub(crate) const RESUME: Self = Self(Port::B, 10);

    /// Whether its switch or button is closed.
    pub(crate) fn is_pressed(&self) -> bool {
        self.0.register(0x10).read() & 1 << self.1 == 0
    }
}

/// The servo's output, PA6.
pub(crate) struct Servo;

/// Sets all of them up, the serial port's two as well.
pub(crate) fn start() {
    GPIO_CLOCKS.write(GPIO_CLOCKS.read() | 0b111);
    // TIM3 and USART2.
    APB1_CLOCKS.write(APB1_CLOCKS.read() | 1 << 1 | 1 << 17);
    for Output(port, pin) in [Output::STEP, Output::DIRECTION, Output::LAMP] {
        port.mode(pin, 1);
    }
    for Input(port, pin) in [Input::LIMIT, Input::STOP, Input::RESUME] {
        port.mode(pin, 0);
        port.pull_up(pin);
    }
    Port::A.function(2, 7);
    Port::A.function(3, 7);
    Port::A.function(6, 2);
    // 1 MHz and 20,000 of them: 50 Hz, and a duty is a pulse in µs. It begins with none.
    TIMER_DIVIDER.write(15);
    TIMER_TOP.write(19_999);
    TIMER_PULSE.write(0);
    // PWM, and a new pulse begins with the next period.
    TIMER_MODE.write(0b110 << 4 | 1 << 3);
    TIMER_ENABLE.write(1);
    TIMER_EVENT.write(1);
    TIMER_CONTROL.write(1);
}

impl digital::ErrorType for Output {
    type Error = Infallible;
}

impl digital::OutputPin for Output {
    fn set_low(&mut self) -> Result<(), Infallible> {
        self.0.register(0x18).write(1 << (self.1 + 16));
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        self.0.register(0x18).write(1 << self.1);
        Ok(())
    }
}

impl digital::ErrorType for Input {
    type Error = Infallible;
}

impl digital::InputPin for Input {
    fn is_high(&mut self) -> Result<bool, Infallible> {
        Ok(!self.is_pressed())
    }

    fn is_low(&mut self) -> Result<bool, Infallible> {
        Ok(self.is_pressed())
    }
}

impl pwm::ErrorType for Servo {
    type Error = Infallible;
}

impl pwm::SetDutyCycle for Servo {
    fn max_duty_cycle(&self) -> u16 {
        20_000
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        TIMER_PULSE.write(duty.into());
        Ok(())
    }
}
