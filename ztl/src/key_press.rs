//! Key presses: their names, and which of them are repeats of a key that is held down.

use std::time::{Duration, Instant};

use ztl_script::event::{Question, RunCommand};

/// A key that is pressed again sooner than this is held down: keyboards start to repeat a key within this time.
const FIRST_REPEAT: Duration = Duration::from_millis(700);
/// The same for further repeats. Keyboards send one every 30 to 50 ms; a busy machine reads them late.
const NEXT_REPEAT: Duration = Duration::from_millis(250);

/// A write to the terminal that takes longer is stalled: the operator does not see its text until it ends.
pub(crate) const STALLED: Duration = Duration::from_secs(1);

/// A key that was pressed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct KeyPress {
    /// Its name: `Enter`, `s`, `Ctrl-C`.
    pub(crate) key: String,
    /// What it means for what the operator saw; `None` if nothing.
    pub(crate) command: Option<RunCommand>,
    /// The cue that it starts.
    pub(crate) cue: Option<usize>,
    /// The question that the operator saw.
    pub(crate) question: Option<Question>,
}

/// When a key was pressed last, to find out whether it is held down.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LastPress {
    at: Instant,
    repeated: bool,
}

impl LastPress {
    /// A press of the same key, `late` if it may have been read later than it was pressed.
    pub(crate) fn after(last: Option<Self>, now: Instant, late: Duration) -> Self {
        let limit = |last: &Self| match last.repeated {
            true => NEXT_REPEAT,
            false => FIRST_REPEAT,
        };
        let repeated = last
            .is_some_and(|last| now.saturating_duration_since(last.at) < limit(&last).max(late));
        Self { at: now, repeated }
    }

    /// Whether the key is held down.
    pub(crate) const fn is_repeat(&self) -> bool {
        self.repeated
    }
}

/// The name of input that is not a key.
pub(crate) const UNKNOWN: &str = "an unknown key";

/// The name and length of the first key in terminal input; `None` if its bytes are incomplete.
pub(crate) fn first_key(bytes: &[u8]) -> Option<(String, usize)> {
    let (&byte, rest) = bytes.split_first()?;
    let name = |name: &str, length: usize| Some((name.to_owned(), length));
    match byte {
        b'\r' | b'\n' => name("Enter", 1),
        b'\t' => name("Tab", 1),
        b' ' => name("Space", 1),
        0x7f | 0x08 => name("Backspace", 1),
        0x1b => escape_sequence(rest),
        // The other control characters have names of their own.
        0..=0x1f => Some((format!("Ctrl-{}", char::from(byte | 0x40)), 1)),
        0x21..=0x7e => Some((char::from(byte).to_string(), 1)),
        _ => {
            let start = bytes.get(..4).unwrap_or(bytes);
            let (valid, invalid) = match std::str::from_utf8(start) {
                Ok(text) => (text, None),
                Err(error) => {
                    let valid = start.get(..error.valid_up_to()).unwrap_or_default();
                    let valid = std::str::from_utf8(valid).unwrap_or_default();
                    (valid, error.error_len())
                }
            };
            match valid.chars().next() {
                Some(char) => Some((char.to_string(), char.len_utf8())),
                None => name(UNKNOWN, invalid?),
            }
        }
    }
}

/// The key of an escape sequence, without its ESC. A byte that cannot belong to the sequence ends it, so that an
/// incomplete one never swallows Ctrl-C.
fn escape_sequence(rest: &[u8]) -> Option<(String, usize)> {
    let name = |name: &str, length: usize| Some((name.to_owned(), length));
    match rest {
        [] => None,
        [b'[' | b'O', sequence @ ..] => {
            let is_parameter = |byte: &u8| (0x20..=0x3f).contains(byte);
            let end = sequence.iter().position(|byte| !is_parameter(byte))?;
            let key = match sequence.get(..=end).unwrap_or_default() {
                [.., ..=0x1f | 0x7f..] => return name(UNKNOWN, end + 2),
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
        // A slow connection may deliver Esc and a stop key together. The stop key must still stop, so this is not Alt-x.
        [b'c' | b'C' | b'x' | b'X', ..] => name("Esc", 1),
        [other @ 0x20..=0x7e, ..] => Some((format!("Alt-{}", char::from(*other)), 2)),
        _ => name("Esc", 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(bytes: &[u8]) -> Vec<String> {
        let mut rest = bytes;
        let mut names = Vec::new();
        while let Some((name, length)) = first_key(rest) {
            names.push(name);
            rest = &rest[length..];
        }
        names
    }

    #[test]
    fn keys_of_every_length_are_parsed() {
        assert_eq!(names(b"\x1b[A"), ["Up"]);
        assert_eq!(names(b"\x1bOB\r"), ["Down", "Enter"]);
        assert_eq!(names(b"\x1b[15;2~s"), ["a function key", "s"]);
        assert_eq!(names(b"\x1b[5~\x1b[6~"), ["PageUp", "PageDown"]);
        // Terminals send different sequences for these.
        assert_eq!(names(b"\x1b[H\x1bOH\x1b[1~\x1b[7~"), ["Home"; 4]);
        assert_eq!(names(b"\x1b[F\x1bOF\x1b[4~\x1b[8~"), ["End"; 4]);
        assert_eq!(names("é\x03\x1a".as_bytes()), ["é", "Ctrl-C", "Ctrl-Z"]);
        assert_eq!(names(b"\x1bq\xff "), ["Alt-q", UNKNOWN, "Space"]);
        // Incomplete.
        assert_eq!(first_key(b"\x1b"), None);
        assert_eq!(first_key(b"\x1b[1;"), None);
        assert_eq!(first_key(b"\xe2\x82"), None);
    }

    #[test]
    fn an_incomplete_key_swallows_no_other_key() {
        assert_eq!(names(b"\x1b\x03"), ["Esc", "Ctrl-C"]);
        assert_eq!(names(b"\x1b\x1b[A"), ["Esc", "Up"]);
        assert_eq!(names(b"\x1bx\x1bC"), ["Esc", "x", "Esc", "C"]);
        assert_eq!(names(b"\x1b[1;\x03"), [UNKNOWN, "Ctrl-C"]);
        assert_eq!(names(b"\x1bO\x1b[A"), [UNKNOWN, "Up"]);
        assert_eq!(names(b"\xe2\x82x"), [UNKNOWN, "x"]);
        assert_eq!(names(b"\xf0\x03"), [UNKNOWN, "Ctrl-C"]);
    }
}
