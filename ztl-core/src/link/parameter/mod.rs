//! Parameters of a node: typed values that a gateway reads, sets and saves (`docs/link.md`, section 13).

mod codec;
#[cfg(test)]
mod tests;

pub(super) use codec::{FIRST, LAST};

/// Longest body of a [`Parameter`], in bytes: it fits the shortest frame of a node, and delays other frames only briefly.
pub const LONGEST_PARAMETER: usize = 120;

/// The component of a parameter that belongs to the firmware as a whole. In a `Description`, it announces the number of
/// parameters ([13.1]).
pub const NO_COMPONENT: u8 = u8::MAX;

/// Why a value does not fit a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Unfit {
    /// The value is of another kind.
    Kind,
    /// The number is out of the range or is NaN, or the text is too long.
    Range,
}

/// A value of a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Value<'a> {
    /// A switch.
    Bool(bool),
    /// A number without sign.
    U32(u32),
    /// A whole number.
    I32(i32),
    /// A number.
    F32(f32),
    /// A text.
    Text(&'a str),
}

/// The values that a parameter takes.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Domain {
    /// `true` and `false`.
    Bool,
    /// Numbers without sign.
    U32 {
        /// The smallest.
        least: u32,
        /// The largest.
        most: u32,
    },
    /// Whole numbers.
    I32 {
        /// The smallest.
        least: i32,
        /// The largest.
        most: i32,
    },
    /// Numbers; never NaN.
    F32 {
        /// The smallest.
        least: f32,
        /// The largest.
        most: f32,
    },
    /// Texts.
    Text {
        /// Their greatest length in bytes.
        longest: u8,
    },
}

impl Domain {
    /// Checks a value.
    ///
    /// # Errors
    /// [`Unfit`].
    pub fn check(&self, value: &Value<'_>) -> Result<(), Unfit> {
        let fits = match (*self, *value) {
            (Self::Bool, Value::Bool(_)) => true,
            (Self::U32 { least, most }, Value::U32(number)) => (least..=most).contains(&number),
            (Self::I32 { least, most }, Value::I32(number)) => (least..=most).contains(&number),
            (Self::F32 { least, most }, Value::F32(number)) => (least..=most).contains(&number),
            (Self::Text { longest }, Value::Text(text)) => text.len() <= usize::from(longest),
            _ => return Err(Unfit::Kind),
        };
        if fits { Ok(()) } else { Err(Unfit::Range) }
    }
}

/// What happens to a value when the node restarts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Kept {
    /// The node cannot save: a restart sets the default.
    Never = 0,
    /// A restart keeps the value.
    Saved = 1,
    /// The value was set and not saved: a restart brings back the value saved before.
    Changed = 2,
    /// The saved value does not fit the parameter any more, so the value is the default.
    Replaced = 3,
}

/// A parameter, as its node describes it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Parameter<'a> {
    /// Its number at the node, from 0.
    pub index: u8,
    /// Index of its component, or [`NO_COMPONENT`].
    pub component: u8,
    /// Its name, which differs from those of the other parameters of its component.
    pub name: &'a str,
    /// Unit of the numbers; may be empty.
    pub unit: &'a str,
    /// What it means; may be empty.
    pub about: &'a str,
    /// What happens to its value when the node restarts.
    pub kept: Kept,
    /// The values that it takes.
    pub domain: Domain,
    /// Its value until it is set.
    pub default: Value<'a>,
    /// Its value now.
    pub value: Value<'a>,
}

/// A command of a gateway about parameters, as a node parses it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParameterCommand<'a> {
    /// Asks for a parameter.
    Read {
        /// Its number.
        index: u8,
    },
    /// Sets a parameter.
    Set {
        /// Its number.
        index: u8,
        /// The new value.
        value: Value<'a>,
    },
    /// Saves all values, so that a restart keeps them.
    Save,
}

/// A message about parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParameterMessage<'a> {
    /// Gateway: a command.
    Command(ParameterCommand<'a>),
    /// Node: answers [`Read`](ParameterCommand::Read) and [`Set`](ParameterCommand::Set).
    Is(Parameter<'a>),
    /// Node: answers [`Save`](ParameterCommand::Save).
    Saved,
}
