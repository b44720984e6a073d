//! Task ids as any server assigns them.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use ztl_core::TaskId;
use ztl_core::integer::{Integer, ParseIntegerError};
use ztl_core::sink::Sink;

/// A task id in a server's answer: a whole number of any size, in decimal digits. Only a number above 0 names a
/// task.
///
/// Servers of this project assign a [`TaskId`]; the original's controllers may assign any number that Python can
/// print, and get it back unchanged.
///
/// ```
/// use ztl_std::RemoteId;
///
/// let id: RemoteId = " +340282366920938463463374607431768211457".parse()?;
/// assert_eq!(id.as_str(), "340282366920938463463374607431768211457");
/// assert!(id.names_task() && id.number().is_none());
/// # Ok::<(), ztl_core::integer::ParseIntegerError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct RemoteId(Arc<str>);

impl RemoteId {
    /// The digits, with a `-` in front if it is negative.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The id as a [`TaskId`], if it fits.
    #[must_use]
    pub fn number(&self) -> Option<TaskId> {
        self.0.parse().ok().and_then(TaskId::new)
    }

    /// Whether it names a task, which needs a number above 0.
    #[must_use]
    pub fn names_task(&self) -> bool {
        self.integer().is_some_and(Integer::is_positive)
    }

    /// The number as the protocol writes it.
    pub(crate) fn integer(&self) -> Option<Integer<'_>> {
        Integer::parse(&self.0).ok()
    }
}

impl From<Integer<'_>> for RemoteId {
    fn from(number: Integer<'_>) -> Self {
        let mut digits = String::new();
        // Only ASCII is put.
        let mut sink = |bytes: &[u8]| digits.push_str(&String::from_utf8_lossy(bytes));
        number.put(&mut sink as &mut dyn Sink);
        Self(digits.into())
    }
}

impl From<TaskId> for RemoteId {
    fn from(id: TaskId) -> Self {
        Self(id.to_string().into())
    }
}

impl From<i64> for RemoteId {
    fn from(number: i64) -> Self {
        Self(number.to_string().into())
    }
}

impl From<&Self> for RemoteId {
    fn from(id: &Self) -> Self {
        id.clone()
    }
}

impl PartialEq<TaskId> for RemoteId {
    fn eq(&self, other: &TaskId) -> bool {
        self.number() == Some(*other)
    }
}

impl FromStr for RemoteId {
    type Err = ParseIntegerError;

    /// Reads what Python's `int()` reads, in ASCII.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Integer::parse(text).map(Self::from)
    }
}

impl fmt::Display for RemoteId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

/// The largest number that every JSON reader represents exactly: a `double` has 53 bits for it.
const LARGEST_EXACT: u64 = (1 << 53) - 1;

impl Serialize for RemoteId {
    /// As a number if every JSON reader represents it exactly, else as a text.
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let exact = |number: &i64| number.unsigned_abs() <= LARGEST_EXACT;
        match self.integer().and_then(Integer::value).filter(exact) {
            Some(number) => to.serialize_i64(number),
            None => to.serialize_str(&self.0),
        }
    }
}

impl<'de> Deserialize<'de> for RemoteId {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(i64),
            Text(String),
        }
        match Written::deserialize(from)? {
            Written::Number(number) => Ok(number.into()),
            Written::Text(text) => text.parse().map_err(de::Error::custom),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_survives_json() {
        for (id, json) in [
            ("7", "7"),
            ("-1", "-1"),
            ("4294967296", "4294967296"),
            ("9007199254740991", "9007199254740991"),
            ("9007199254740992", "\"9007199254740992\""),
            ("-99999999999999999999", "\"-99999999999999999999\""),
        ] {
            let id: RemoteId = id.parse().unwrap();
            assert_eq!(serde_json::to_string(&id).unwrap(), json);
            assert_eq!(serde_json::from_str::<RemoteId>(json).unwrap(), id);
        }
        for wrong in ["1.5", "\"x\"", "null", "\"\""] {
            assert!(serde_json::from_str::<RemoteId>(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn only_an_id_that_fits_has_a_number() {
        for (id, number) in [
            ("1", Some(1)),
            ("4294967295", Some(u32::MAX)),
            ("4294967296", None),
            ("0", None),
            ("-1", None),
        ] {
            let read: RemoteId = id.parse().unwrap();
            assert_eq!(read.number().map(TaskId::get), number, "{id}");
            assert_eq!(read.names_task(), !matches!(id, "0" | "-1"), "{id}");
        }
    }
}
