//! Errors of reading a pickle.

use std::fmt::{self, Display};

/// The longest part of a name that a message repeats.
const SHOWN: usize = 80;

/// Why a pickle is not read.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// It names something other than plain data, such as `os.system`. Nothing was run or built.
    Refused(String),
    /// The input ends within the pickle.
    Truncated {
        /// The length of the input.
        at: usize,
    },
    /// Python cannot read it either, or would not make plain data of it.
    Malformed {
        /// Just behind the operation that failed.
        at: usize,
        /// What is wrong.
        what: &'static str,
    },
    /// It exceeds a limit of [`Limits`](crate::Limits).
    TooLarge {
        /// The name of the limit.
        limit: &'static str,
        /// Its value.
        most: usize,
    },
    /// Python cannot use a value of this type as a key, or as an element of a set.
    Unhashable(&'static str),
}

impl Error {
    /// Refuses `module.name`, shortened and with everything escaped that a terminal could misread.
    pub(crate) fn refused(module: &[u8], name: &[u8]) -> Self {
        let part = |part: &[u8]| match part.get(..SHOWN) {
            Some(start) => format!("{}...", start.escape_ascii()),
            None => part.escape_ascii().to_string(),
        };
        match module {
            [] => Self::Refused(part(name)),
            _ => Self::Refused(format!("{}.{}", part(module), part(name))),
        }
    }
}

impl Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Refused(name) => write!(f, "refused: {name}"),
            Self::Truncated { at } => write!(f, "the pickle is cut off after {at} bytes"),
            Self::Malformed { at, what } => write!(f, "malformed pickle at byte {at}: {what}"),
            Self::TooLarge { limit, most } => {
                write!(f, "the pickle exceeds the limit on {limit}, {most}")
            }
            Self::Unhashable(name) => write!(f, "unhashable type: '{name}'"),
        }
    }
}

impl std::error::Error for Error {}
