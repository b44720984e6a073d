//! Bytes as a message, and its text as integers: either parsed and written back unchanged, or an error at a
//! position within.

use ztl_core::Message;
use ztl_core::integer::{Integer, MAX_DIGITS, ParseIntegerError};
use ztl_core::message::ParseError;
use ztl_core::sink::BufferTooSmall;

/// Reads `bytes` as a message.
pub fn check(bytes: &[u8]) {
    let separators = bytes.iter().filter(|&&byte| byte == b';').count();
    match Message::parse(bytes) {
        Ok(message) => {
            for field in [message.scope, message.state, message.id] {
                assert!(!field.contains(';'), "{message:?}");
            }
            write_back(&message, bytes);
            number(message.state);
            number(message.id);
            // Integers are rare in fields, so everything else is parsed as one too.
            number(message.payload);
        }
        Err(ParseError::NotUtf8 { at, scope }) => {
            assert!(at < bytes.len(), "{at} is outside");
            assert!(std::str::from_utf8(&bytes[..at]).is_ok());
            assert!(std::str::from_utf8(bytes).is_err());
            let first = bytes.split(|&byte| byte == b';').next().unwrap_or_default();
            assert_eq!(scope, std::str::from_utf8(first).ok());
        }
        Err(ParseError::MissingFields { found, scope }) => {
            assert_eq!(found, separators + 1);
            assert!(found < 4);
            assert!(bytes.starts_with(scope.as_bytes()) && !scope.contains(';'));
        }
        Err(other) => panic!("an error that this target does not know: {other}"),
    }
}

fn write_back(message: &Message<'_>, bytes: &[u8]) {
    let mut buffer = vec![0xA5; bytes.len()];
    assert_eq!(message.encoded_len(), bytes.len());
    assert_eq!(message.encode_into(&mut buffer), Ok(bytes));
    buffer.pop();
    let Err(BufferTooSmall {
        needed, available, ..
    }) = message.encode_into(&mut buffer)
    else {
        panic!("it fits into a buffer that is too small");
    };
    assert_eq!((needed, available), (bytes.len(), buffer.len()));
}

/// Reads `text` as a number.
fn number(text: &str) {
    let digits = || text.chars().filter(char::is_ascii_digit);
    let number = Integer::parse(text);
    let expected = is_number(text) && digits().count() <= MAX_DIGITS;
    assert_eq!(number.is_ok(), expected, "{text:?}: {number:?}");
    match number {
        Ok(number) => {
            let plain = plain(number);
            let significant: String = digits().skip_while(|&digit| digit == '0').collect();
            let expected = match (significant.is_empty(), text.contains('-')) {
                (true, _) => "0".to_owned(),
                (false, true) => format!("-{significant}"),
                (false, false) => significant,
            };
            assert_eq!(plain, expected, "{text:?}");
            assert_eq!(number.value(), plain.parse().ok(), "{text:?}");
            assert_eq!(self::plain(Integer::parse(&plain).expect(&plain)), plain);
        }
        Err(ParseIntegerError::Unexpected { at }) => {
            // A `_` is allowed in an integer, but not there; likewise whitespace and signs.
            let byte = text.as_bytes().get(at).expect("a place within");
            assert!(!byte.is_ascii_digit(), "{text:?} at {at}");
            assert!(text.is_char_boundary(at));
        }
        Err(ParseIntegerError::Empty) => assert_eq!(digits().count(), 0, "{text:?}"),
        Err(ParseIntegerError::TooLong) => assert!(digits().count() > MAX_DIGITS),
        Err(other) => panic!("an error that this target does not know: {other}"),
    }
}

/// The grammar of `docs/protocol.md` 2.1, except for the length.
fn is_number(text: &str) -> bool {
    let blank = |c: char| matches!(c, '\x09'..='\x0d' | ' ');
    let text = text.trim_matches(blank);
    let digits = text.strip_prefix(['+', '-']).unwrap_or(text);
    let group = |group: &str| !group.is_empty() && group.bytes().all(|byte| byte.is_ascii_digit());
    digits.split('_').all(group)
}

fn plain(number: Integer<'_>) -> String {
    let mut out = Vec::new();
    number.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    String::from_utf8(out).expect("ASCII")
}
