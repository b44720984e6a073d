//! Parses values of options and arguments.

use std::fmt;
use std::time::Duration;

use ztl_core::integer::Integer;
use ztl_core::repr::put_quoted;
use ztl_std::{TaskSpec, scope};

/// A whole number as Python's `int()` reads it, for options of the original.
pub(crate) fn whole<N: TryFrom<i64>>(text: &str) -> Option<N> {
    let number = Integer::parse(text).ok()?.value()?;
    N::try_from(number).ok()
}

/// What Python says of a text that is not a whole number.
pub(crate) fn no_number(text: &str) -> String {
    let mut literal = Vec::new();
    put_quoted(text, &mut |bytes: &[u8]| literal.extend_from_slice(bytes));
    let literal = String::from_utf8_lossy(&literal);
    format!("invalid literal for int() with base 10: {literal}")
}

/// A port.
pub(crate) fn port(text: &str) -> Result<u16, &'static str> {
    whole(text).ok_or("expected 0 to 65535")
}

/// The port of a server to connect to. A wider type, since the original's tools accept any number.
pub(crate) fn port_to_reach(text: &str) -> Result<i64, &'static str> {
    port(text).map(i64::from)
}

/// A time with its unit.
pub(crate) fn duration(text: &str) -> Result<Duration, &'static str> {
    humantime::parse_duration(text)
        .map_err(|_| "expected a number with a unit, such as 500ms, 2s or 1m")
}

/// A time in seconds.
pub(crate) fn seconds(text: &str) -> Result<i64, &'static str> {
    whole(text).ok_or("expected a whole number of seconds")
}

/// A scope to serve.
pub(crate) fn scope_to_serve(text: &str) -> Result<String, String> {
    scope::cannot_be_served(text).map_or_else(|| Ok(text.to_owned()), Err)
}

/// The payload of an INIT for a task that is written as `handler:component:goal`.
pub(crate) fn request(payload: &str) -> Result<String, InvalidTask> {
    let spec = TaskSpec::split(payload).map_err(|_| InvalidTask)?;
    let mut request = vec![0; spec.encoded_len()];
    let request = spec.encode_into(&mut request).unwrap_or_default();
    Ok(request.to_owned())
}

/// A text is not a task. The tool prints this and its help, as the original's does.
#[derive(Debug)]
pub(crate) struct InvalidTask;

impl fmt::Display for InvalidTask {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(
            "Error: Invalid task specification. Payload needs to specify handler, component and goal separated by ':', e.g. 'handler:component:goal'",
        )
    }
}

impl std::error::Error for InvalidTask {}
/// The value of one of these words.
pub(crate) fn one_of<T: Copy>(text: &str, known: &[(&str, T)]) -> Result<T, String> {
    let found = known.iter().find(|(word, _)| *word == text);
    let words = || known.iter().map(|(word, _)| *word).collect::<Vec<_>>();
    found.map_or_else(
        || Err(format!("there are: {}", words().join(", "))),
        |(_, value)| Ok(*value),
    )
}
