//! Keys that are pressed, and what they are called.

use std::time::Duration;

use ztl_script::event::{Question, RunCommand};

/// A key that comes again sooner is held down: keyboards wait that long at most before they repeat a key.
pub(crate) const FIRST_REPEAT: Duration = Duration::from_millis(700);
/// The same of one that came again already. Keyboards repeat every 30 to 50 ms; a busy machine may be late in
/// reading them.
pub(crate) const HELD: Duration = Duration::from_millis(250);

/// A key that was pressed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Pressed {
    /// As it is called: `Enter`, `s`, `Ctrl-C`.
    pub(crate) key: String,
    /// What it meant by what the operator saw; `None`: nothing.
    pub(crate) command: Option<RunCommand>,
    /// What was asked on the screen that the operator saw.
    pub(crate) question: Option<Question>,
}

/// Takes the first key from what a terminal sent; `None` when it is not whole yet.
pub(crate) fn first(bytes: &[u8]) -> Option<(String, usize)> {
    let (&byte, rest) = bytes.split_first()?;
    let name = |name: &str, length: usize| Some((name.to_owned(), length));
    match byte {
        b'\r' | b'\n' => name("Enter", 1),
        b'\t' => name("Tab", 1),
        b' ' => name("Space", 1),
        0x7f | 0x08 => name("Backspace", 1),
        0x1b => escape(rest),
        // Those above have gone.
        0..=0x1f => Some((format!("Ctrl-{}", char::from(byte | 0x40)), 1)),
        0x21..=0x7e => Some((char::from(byte).to_string(), 1)),
        _ => {
            let length = match byte {
                0xc2..=0xdf => 2,
                0xe0..=0xef => 3,
                0xf0..=0xf4 => 4,
                _ => return name("?", 1),
            };
            match bytes.get(..length) {
                None => None,
                Some(char) => match std::str::from_utf8(char) {
                    Ok(char) => name(char, length),
                    Err(_) => name("?", 1),
                },
            }
        }
    }
}

/// What comes after an ESC: the sequence of a key, or nothing when it was that key itself.
fn escape(rest: &[u8]) -> Option<(String, usize)> {
    let name = |name: &str, length: usize| Some((name.to_owned(), length));
    match rest {
        [] => None,
        [b'[' | b'O', sequence @ ..] => {
            let end = sequence
                .iter()
                .position(|byte| (0x40..=0x7e).contains(byte))?;
            let key = match sequence.get(..=end).unwrap_or_default() {
                [.., b'A'] => "Up",
                [.., b'B'] => "Down",
                [.., b'C'] => "Right",
                [.., b'D'] => "Left",
                [.., b'H'] | b"1~" | b"7~" => "Home",
                [.., b'F'] | b"4~" | b"8~" => "End",
                b"5~" => "PageUp",
                b"6~" => "PageDown",
                _ => "a function key",
            };
            name(key, end + 3)
        }
        [0x1b, ..] => name("Esc", 1),
        [other, ..] => Some((format!("Alt-{}", char::from(*other)), 2)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(bytes: &[u8]) -> Vec<String> {
        let mut rest = bytes;
        let mut names = Vec::new();
        while let Some((name, length)) = first(rest) {
            names.push(name);
            rest = &rest[length..];
        }
        names
    }

    #[test]
    fn a_key_is_one_key_however_many_bytes_it_has() {
        assert_eq!(names(b"\x1b[A"), ["Up"]);
        assert_eq!(names(b"\x1bOB\r"), ["Down", "Enter"]);
        assert_eq!(names(b"\x1b[15;2~s"), ["a function key", "s"]);
        assert_eq!(names(b"\x1b[5~\x1b[6~"), ["PageUp", "PageDown"]);
        // Terminals differ in these.
        assert_eq!(names(b"\x1b[H\x1bOH\x1b[1~\x1b[7~"), ["Home"; 4]);
        assert_eq!(names(b"\x1b[F\x1bOF\x1b[4~\x1b[8~"), ["End"; 4]);
        assert_eq!(names("é\x03\x1a".as_bytes()), ["é", "Ctrl-C", "Ctrl-Z"]);
        assert_eq!(names(b"\x1bx\xff "), ["Alt-x", "?", "Space"]);
        // Not whole: the rest may come.
        assert_eq!(first(b"\x1b"), None);
        assert_eq!(first(b"\x1b[1;"), None);
        assert_eq!(first(b"\xe2\x82"), None);
    }
}
