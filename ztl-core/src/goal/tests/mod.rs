//! Each case is a text and the expected result.

mod errors;
mod numbers;
mod random;
mod texts;
mod values;
mod writing;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{GoalError, from_str_with};

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Pose {
    x: f32,
    y: f32,
    theta: f32,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Move {
    Stop,
    Turn(f32),
    Go(i8, i8),
    Drive {
        to: Pose,
        #[serde(default)]
        fast: bool,
    },
}

/// Parses with ample scratch.
fn read<T: DeserializeOwned>(text: &str) -> Result<T, GoalError> {
    let mut scratch = [0xA5; 256];
    from_str_with(text, &mut scratch)
}

/// Parses without a type to expect.
fn any(text: &str) -> Result<serde_json::Value, GoalError> {
    read(text)
}
