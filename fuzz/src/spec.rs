//! Any text as an INIT's payload, and any text as a task: decoded as it was encoded, or an error.

use ztl_core::base64::{self, DecodeError};
use ztl_core::spec::SpecError;
use ztl_core::{TaskId, TaskSpec};

/// Decodes `bytes` as a payload, then encodes them as a task.
pub fn check(bytes: &[u8]) {
    decoded(bytes);
    if let Ok(text) = std::str::from_utf8(bytes) {
        payload(text);
        task(text);
        quoted(text);
    }
}

/// The decoder's documented promises.
fn decoded(text: &[u8]) {
    let most = text.len() * 3 / 4;
    let mut buffer = vec![0xA5; most];
    let whole = base64::decode(text, &mut buffer);
    let alphabet = |byte: &u8| byte.is_ascii_alphanumeric() || b"+/".contains(byte);
    match whole {
        Err(DecodeError::BufferTooSmall { .. }) => panic!("three quarters do not suffice"),
        Err(DecodeError::LoneCharacter { characters }) => {
            assert_eq!(characters % 4, 1);
            assert!(characters <= text.iter().filter(|byte| alphabet(byte)).count());
        }
        _ => {}
    }
    // Characters outside the alphabet have no effect.
    let bare: Vec<u8> = text
        .iter()
        .copied()
        .filter(|byte| alphabet(byte) || *byte == b'=')
        .collect();
    let mut other = vec![0x5A; most];
    assert_eq!(base64::decode(&bare, &mut other), whole);
    // A smaller buffer is either large enough, or reported as too small.
    let len = whole.map_or(most, <[u8]>::len);
    if let Some(less) = len.checked_sub(1) {
        let mut small = vec![0xA5; less];
        let available = less;
        let again = base64::decode(text, &mut small);
        if whole.is_ok() {
            assert_eq!(again, Err(DecodeError::BufferTooSmall { available }));
        }
    }
}

fn payload(text: &str) {
    let mut buffer = vec![0xA5; text.len() * 3 / 4];
    match TaskSpec::decode(text, &mut buffer) {
        Ok(spec) => round_trip(&spec),
        Err(SpecError::NotUtf8 { at }) => assert!(at < text.len() * 3 / 4),
        Err(_) => {}
    }
}

fn task(text: &str) {
    match TaskSpec::split(text) {
        Ok(spec) => {
            assert_eq!(spec.to_string(), text);
            round_trip(&spec);
        }
        Err(SpecError::NoComponent) => assert!(!text.contains(':')),
        Err(SpecError::NoGoal) => assert_eq!(text.matches(':').count(), 1),
        Err(other) => panic!("not of a text: {other}"),
    }
}

fn round_trip(spec: &TaskSpec<'_>) {
    assert!(!spec.handler.contains(':') && !spec.component.contains(':'));
    let mut payload = vec![0xA5; spec.encoded_len()];
    let payload = spec.encode_into(&mut payload).expect("room");
    let mut decoded = vec![0xA5; payload.len() * 3 / 4];
    assert_eq!(TaskSpec::decode(payload, &mut decoded), Ok(*spec));
    let id = TaskId::new(7).expect("not 0");
    let mut initiated = Vec::new();
    spec.put_initiated(id, &mut |bytes: &[u8]| initiated.extend_from_slice(bytes));
    assert!(initiated.starts_with(b"Initiated task '7' with request: {'handler': "));
}

/// Unquotes the text by hand.
fn quoted(text: &str) {
    let mut out = Vec::new();
    ztl_core::repr::put_quoted(text, &mut |bytes: &[u8]| out.extend_from_slice(bytes));
    let out = String::from_utf8(out).expect("UTF-8");
    let quote = out.chars().next().expect("a quote");
    assert!(quote == '\'' || quote == '"');
    let inside = out[1..].strip_suffix(quote).expect("the same quote");
    let mut chars = inside.chars();
    let mut read = String::new();
    while let Some(c) = chars.next() {
        assert!(c != quote && !c.is_control(), "{out}");
        let escaped = |digits: usize, chars: &mut std::str::Chars<'_>| {
            let code: String = chars.take(digits).collect();
            let code = u32::from_str_radix(&code, 16).expect("hexadecimal");
            char::from_u32(code).expect("a character")
        };
        read.push(match c {
            '\\' => match chars.next().expect("what is escaped") {
                'n' => '\n',
                'r' => '\r',
                't' => '\t',
                'x' => escaped(2, &mut chars),
                'u' => escaped(4, &mut chars),
                'U' => escaped(8, &mut chars),
                same => {
                    assert!(same == '\\' || same == quote, "{out}");
                    same
                }
            },
            c => c,
        });
    }
    assert_eq!(read, text);
}
