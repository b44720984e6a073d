//! Why a motor stopped.

/// Which part of the motor failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StepFault {
    /// The step pin.
    StepPin,
    /// The direction pin.
    DirectionPin,
    /// The enable pin.
    EnablePin,
    /// The pin of a limit switch.
    LimitPin,
    /// The motor was borrowed already: its code called itself.
    InUse,
}

impl StepFault {
    /// The reason for the task's failure.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::StepPin => "the step pin failed",
            Self::DirectionPin => "the direction pin failed",
            Self::EnablePin => "the enable pin failed",
            Self::LimitPin => "a limit switch's pin failed",
            Self::InUse => "the motor is in use",
        }
    }
}

impl core::fmt::Display for StepFault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.text())
    }
}

impl core::error::Error for StepFault {}
