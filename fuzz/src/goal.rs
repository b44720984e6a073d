//! Any text as a goal, for a target that takes everything and for typed ones: parsed, or an error at a
//! position within. What was parsed can be written and parsed again.

mod any;

use serde::{Deserialize, Serialize};
use ztl_core::goal::{self, GoalError, GoalErrorKind, WriteError};

use any::Any;

/// A target with a bit of everything.
#[derive(Debug, Default, Deserialize, Serialize)]
#[serde(default)]
struct Typed<'a> {
    on: bool,
    i: i8,
    u: u64,
    x: f32,
    y: f64,
    c: char,
    #[serde(borrow)]
    s: &'a str,
    o: Option<Mode<'a>>,
    p: (i16, f32),
    r: [u8; 3],
    v: Vec<Mode<'a>>,
    n: (),
}

#[derive(Debug, Deserialize, Serialize)]
enum Mode<'a> {
    Off,
    #[serde(borrow)]
    Say(&'a str),
    Turn(f32, i32),
    Go {
        x: f64,
        #[serde(default)]
        by: Option<u8>,
    },
}

/// Parses a text as each of these types, and then what that is written as.
macro_rules! typed {
    ($text:ident: $($target:ty),+) => {
        $({
            let mut scratch = vec![0xA5; room($text)];
            let read = goal::from_str_with::<$target>($text, &mut scratch);
            place($text, &read);
            if let Ok(value) = read {
                let again = written(&value).expect("no deeper than it was read");
                let mut scratch = vec![0xA5; room(&again)];
                let read = goal::from_str_with::<$target>(&again, &mut scratch);
                let read = read.unwrap_or_else(|error| panic!("{error} in {again}, of {}", $text));
                assert_eq!(written(&read).as_ref(), Ok(&again));
            }
        })+
    };
}

/// Parses `bytes` as each target.
pub fn check(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    any(text);
    number(text);
    typed!(text: Typed<'_>, Mode<'_>, Vec<Mode<'_>>, (Option<bool>, f32, &str), Vec<f64>);
    typed!(text: f32, f64, i64, u8, bool, char, &str, Option<&str>);
}

/// A plain number parses as in the standard library, which rounds correctly.
fn number(text: &str) {
    let digits = text.bytes().filter(u8::is_ascii_digit).count();
    let exponent = text.bytes().rev().take_while(u8::is_ascii_digit).count();
    if digits > 19 || exponent > 4 && text.contains(['e', 'E']) {
        return;
    }
    let plain = |c: char| c.is_ascii_digit() || "+-.eE".contains(c);
    let unsigned = text.trim_start_matches(['+', '-']).as_bytes();
    let octal = matches!(unsigned, [b'0', b'0'..=b'9', ..]);
    if octal || !text.chars().all(plain) {
        return;
    }
    let ours = (goal::from_str::<f64>(text), goal::from_str::<f32>(text));
    match (text.parse::<f64>(), &ours.0) {
        (Ok(value), Ok(ours)) => assert_eq!(value.to_bits(), ours.to_bits(), "{text}"),
        (Ok(value), Err(error)) => {
            assert!(
                value.is_infinite() && error.kind == GoalErrorKind::OutOfRange,
                "{text}"
            );
        }
        (Err(_), ours) => assert!(ours.is_err(), "{text}"),
    }
    match (text.parse::<f32>(), ours.1) {
        (Ok(value), Ok(ours)) => assert_eq!(value.to_bits(), ours.to_bits(), "{text}"),
        (Ok(value), Err(_)) => assert!(value.is_infinite(), "{text}"),
        (Err(_), ours) => assert!(ours.is_err(), "{text}"),
    }
}

fn any(text: &str) {
    let mut scratch = vec![0xA5; room(text)];
    let read = goal::from_str_with::<Any>(text, &mut scratch);
    place(text, &read);
    // Without scratch the result is the same, or the error says that scratch is needed.
    let bare = goal::from_str::<Any>(text);
    place(text, &bare);
    match (&read, bare) {
        (Ok(value), Ok(bare)) => assert_eq!(written(value), written(&bare)),
        (_, Err(error)) if error.kind == GoalErrorKind::NeedsScratch => tight(text, &read),
        (Err(error), Err(bare)) => assert_eq!(*error, bare),
        (read, bare) => panic!("{read:?} with scratch, {bare:?} without"),
    }
    let Ok(value) = read else { return };
    // A text at the top is unquoted, and parsed by its looks; in a list it is quoted.
    let list = Any::List(vec![value]);
    match written(&list) {
        Ok(again) => {
            let mut scratch = vec![0xA5; room(&again)];
            let read = goal::from_str_with::<Any>(&again, &mut scratch);
            let read = read.unwrap_or_else(|error| panic!("{error} in {again}, of {text}"));
            assert_eq!(written(&read).as_ref(), Ok(&again));
        }
        Err(error) => assert_eq!(error, WriteError::TooDeep, "{text}"),
    }
}

/// Scratch of any size is enough, or reported as too small.
fn tight(text: &str, read: &Result<Any, GoalError>) {
    for len in (0..text.len()).step_by(1 + text.len() / 7) {
        match (read, goal::from_str_with::<Any>(text, &mut vec![0xA5; len])) {
            (Ok(value), Ok(small)) => assert_eq!(written(value), written(&small)),
            (Err(error), Err(small)) if *error == small => {}
            (_, Err(error)) => {
                let GoalErrorKind::ScratchTooSmall { needed, available } = error.kind else {
                    panic!("{error} with {len} bytes of scratch, else {read:?}");
                };
                assert!(needed > available && available == len, "{error:?}");
            }
            (read, small) => panic!("{read:?} with enough scratch, {small:?} with {len} bytes"),
        }
    }
}

/// A size of scratch that is always enough.
fn room(text: &str) -> usize {
    text.len() + text.matches(['L', 'P']).count()
}

/// An error's position is within the text or at its end.
fn place<T>(text: &str, read: &Result<T, GoalError>) {
    if let Err(error) = read {
        assert!(text.is_char_boundary(error.at), "{error:?} in {text:?}");
        assert!(
            error
                .to_string()
                .starts_with(&format!("goal, byte {}: ", error.at)),
            "{error}"
        );
    }
}

fn written<T: Serialize>(value: &T) -> Result<String, WriteError> {
    let mut out = Vec::new();
    goal::to_sink(value, &mut |bytes: &[u8]| out.extend_from_slice(bytes))?;
    Ok(String::from_utf8(out).expect("UTF-8"))
}
