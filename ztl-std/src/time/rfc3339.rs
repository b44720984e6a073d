//! Wall-clock times in RFC 3339, in UTC, to the microsecond; for `#[serde(with = …)]`.

use std::fmt::Write;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Deserializer, Serializer, de};

/// See the module.
///
/// # Errors
/// Those of the format.
pub fn serialize<S: Serializer>(at: &SystemTime, to: S) -> Result<S::Ok, S::Error> {
    // The format has no years before 1970 or after 9999; such a clock is wrong anyway.
    let at = (*at).max(UNIX_EPOCH);
    let mut text = String::new();
    if write!(text, "{}", humantime::format_rfc3339_micros(at)).is_err() {
        "9999-12-31T23:59:59.999999Z".clone_into(&mut text);
    }
    to.serialize_str(&text)
}

/// See the module.
///
/// # Errors
/// Those of the format.
pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<SystemTime, D::Error> {
    let text = String::deserialize(from)?;
    humantime::parse_rfc3339(&text).map_err(de::Error::custom)
}
