//! How the bytes of a reading become a value for subscribers. The link does not say what they are, so their form decides.

use serde_json::Number;
use ztl_pickle::Pickle;

/// How readings are published. `docs/gateway.md` describes both forms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ReadingFormat {
    /// As values: numbers, truths, text or bytes, each as a pickle.
    #[default]
    Values,
    /// The bytes as the component wrote them.
    Raw,
}

/// The formats by their names in files and options.
pub const READING_FORMATS: [(&str, ReadingFormat); 2] = [
    ("values", ReadingFormat::Values),
    ("raw", ReadingFormat::Raw),
];

/// The value of a reading: text without control characters is a truth, a number or itself, anything else is bytes.
pub(super) fn value(bytes: &[u8]) -> Pickle {
    let text = str::from_utf8(bytes).ok();
    match text.filter(|text| !text.contains(char::is_control)) {
        Some("True") => true.into(),
        Some("False") => false.into(),
        Some(text) => match number(text) {
            Some(number) => number,
            None => known(Pickle::text(text)),
        },
        None => known(Pickle::bytes(bytes)),
    }
}

/// A number as JSON writes it. Rejects an integer beyond 64 bits, since it would lose digits.
fn number(text: &str) -> Option<Pickle> {
    let starts = text.starts_with(|c: char| c == '-' || c.is_ascii_digit());
    let ends = text.ends_with(|c: char| c.is_ascii_digit());
    if !(starts && ends) {
        return None;
    }
    // JSON's reader makes a fraction of it, and firmware that rounds writes it.
    if text == "-0" {
        return Some(0i64.into());
    }
    let number: Number = serde_json::from_str(text).ok()?;
    if let Some(whole) = number.as_i64() {
        return Some(whole.into());
    }
    if let Some(whole) = number.as_u64() {
        return Some(whole.into());
    }
    let is_whole = !text.contains(['.', 'e', 'E']);
    number.as_f64().filter(|_| !is_whole).map(Into::into)
}

/// `None` only for a value of more than a GiB, which no device can send.
fn known(value: Result<Pickle, ztl_pickle::Error>) -> Pickle {
    value.unwrap_or_else(|_| Pickle::none())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_form_of_a_reading_decides_its_value() {
        for (bytes, shown) in [
            (&b"42"[..], "42"),
            (b"-7", "-7"),
            (b"-0", "0"),
            (b"-0.0", "-0.0"),
            (b"12.50", "12.5"),
            (b"1e3", "1000.0"),
            (b"18446744073709551615", "18446744073709551615"),
            (b"True", "True"),
            (b"False", "False"),
            (b"open", "'open'"),
            (b"", "''"),
            // These are text, so that nothing is lost or guessed.
            (b"007", "'007'"),
            (b"+1", "'+1'"),
            (b" 1", "' 1'"),
            (b"1 ", "'1 '"),
            (b"nan", "'nan'"),
            (b"1e999", "'1e999'"),
            (b"18446744073709551616", "'18446744073709551616'"),
            (b"true", "'true'"),
            ("20 °C".as_bytes(), "'20 °C'"),
            (b"1\n", "b'1\\n'"),
            (b"\x01\x00\x00\x00", "b'\\x01\\x00\\x00\\x00'"),
            (b"\xff", "b'\\xff'"),
        ] {
            let pickle = Pickle::read(&value(bytes).to_bytes()).expect("a pickle");
            assert_eq!(pickle.value().repr().to_string(), shown);
        }
    }
}
