//! The types of simulated devices.

use std::fmt;
use std::str::FromStr;

/// The type of a simulated device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `finger`: its opening in percent, 0 to 100, at 50 percent per second.
    Gripper,
    /// `pan`: degrees from -90 to 90, or left, straight, right, at 90 degrees per second.
    Head,
    /// `probe`: takes no goals, publishes readings of 100 bytes: a thousand per second, or with
    /// [`Device::with_baud`](crate::Device::with_baud) as many as its line carries.
    Sensor,
}

impl Kind {
    /// All types.
    pub const ALL: [Self; 3] = [Self::Gripper, Self::Head, Self::Sensor];

    /// Its name, as in `sim:gripper`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Gripper => "gripper",
            Self::Head => "head",
            Self::Sensor => "sensor",
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Kind {
    type Err = UnknownKind;

    fn from_str(text: &str) -> Result<Self, UnknownKind> {
        Self::ALL
            .into_iter()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| UnknownKind(text.to_owned()))
    }
}

/// A text that names no type of simulated device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnknownKind(String);

impl fmt::Display for UnknownKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (found, known) = (&self.0, Kind::ALL.map(Kind::name).join(", "));
        write!(f, "no simulated device '{found}'; there are: {known}")
    }
}

impl std::error::Error for UnknownKind {}
