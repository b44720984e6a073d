//! Whether the types of both ends, or of two uses of a topic, are the same.

use std::fmt;

use crate::WireType;

/// Another part of this process uses the topic with another type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TypeConflict {
    /// The topic.
    pub topic: String,
    /// The type in use.
    pub used: String,
    /// The type that was asked for.
    pub wanted: String,
}

impl fmt::Display for TypeConflict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            topic,
            used,
            wanted,
        } = self;
        write!(
            f,
            "{topic} is used as {used} already, and cannot be {wanted}"
        )
    }
}

impl std::error::Error for TypeConflict {}

/// Whether messages of these types are the same; `*` is every type.
pub(crate) fn fits(ours: &str, theirs: &str) -> bool {
    ours == theirs || ours == "*" || theirs == "*"
}

/// Whether this process uses the topic with another type already.
pub(crate) fn conflict(
    topic: &str,
    used: &WireType,
    wanted: &WireType,
) -> Result<(), TypeConflict> {
    match used.name == wanted.name && used.md5 == wanted.md5 {
        true => Ok(()),
        false => Err(TypeConflict {
            topic: topic.to_owned(),
            used: format!("{} ({})", used.name, used.md5),
            wanted: format!("{} ({})", wanted.name, wanted.md5),
        }),
    }
}
