//! Limit switches.

use embedded_hal::digital::InputPin;

use super::fault::StepFault;

/// Detects that an end of the axis is reached.
///
/// Called before each step towards that end, so it must be fast.
pub trait Limit {
    /// Whether there is a switch at this end.
    const PRESENT: bool = true;

    /// Whether the axis is at this end.
    ///
    /// # Errors
    /// If this cannot be determined. The motor then stops.
    fn is_reached(&mut self) -> Result<bool, StepFault>;
}

/// No switch at this end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NoLimit;

impl Limit for NoLimit {
    const PRESENT: bool = false;

    fn is_reached(&mut self) -> Result<bool, StepFault> {
        Ok(false)
    }
}

/// A switch on an input pin.
#[derive(Debug, Clone, Hash)]
pub struct Switch<P> {
    pin: P,
    high: bool,
}

impl<P: InputPin> Switch<P> {
    /// Reached when the pin is low: a switch that closes to ground.
    pub const fn active_low(pin: P) -> Self {
        Self { pin, high: false }
    }

    /// Reached when the pin is high: one that opens, so that a broken wire stops the motor too.
    pub const fn active_high(pin: P) -> Self {
        Self { pin, high: true }
    }
}

impl<P: InputPin> Limit for Switch<P> {
    fn is_reached(&mut self) -> Result<bool, StepFault> {
        let high = self.pin.is_high().map_err(|_| StepFault::LimitPin)?;
        Ok(high == self.high)
    }
}

/// A limit that a function detects: a flag that an interrupt sets, a sensor on a bus.
///
/// The function must return `true` as long as the axis is at this end, or until the flag is cleared.
#[derive(Debug, Clone, Copy, Hash)]
pub struct LimitFlag<F>(pub F);

impl<F: FnMut() -> bool> Limit for LimitFlag<F> {
    fn is_reached(&mut self) -> Result<bool, StepFault> {
        Ok((self.0)())
    }
}
