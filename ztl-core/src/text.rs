//! Small operations on texts, without panics.

/// The longest valid UTF-8 prefix of `bytes`.
///
/// `from_utf8` is faster on long texts, but takes more flash.
pub(crate) fn valid_start(bytes: &[u8]) -> &str {
    let chunk = bytes.utf8_chunks().next();
    chunk.map_or("", |chunk| chunk.valid())
}

/// Whether Python treats this ASCII byte as whitespace.
pub(crate) fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t'..=b'\r')
}

/// Splits `text` at the first `mark`, an ASCII character.
///
/// Used in place of `str::split_once`, whose panic branch the compiler cannot remove.
pub(crate) fn split_at_mark(text: &str, mark: char) -> Option<(&str, &str)> {
    let at = text.bytes().position(|byte| char::from(byte) == mark)?;
    Some((text.get(..at)?, text.get(at + 1..)?))
}
