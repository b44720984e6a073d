//! Keys from the terminal's bytes, also when the bytes of one key arrive separately.

use std::time::{Duration, Instant};

use crate::key_press::{UNKNOWN, first_key};

/// A lone ESC that nothing follows within this time is the key Esc.
const ESCAPE: Duration = Duration::from_millis(500);
/// Bytes that follow ESC later than this were typed after it. Alt with a key sends both together.
const TOGETHER: Duration = Duration::from_millis(40);
/// How long to wait for the next byte of any other key. A slow connection resends lost bytes within this time.
const REST: Duration = Duration::from_secs(1);

const ESC: u8 = 0x1b;

/// Splits input into keys. It has no clock; the caller passes the time.
#[derive(Debug, Default)]
pub(super) struct KeyDecoder {
    /// The bytes of an incomplete key.
    pending: Vec<u8>,
    /// When the last input was received.
    received: Option<Instant>,
    /// Whether that input ended with an ESC that was reported as Esc.
    reported: bool,
}

impl KeyDecoder {
    /// The incomplete key, if it is certain that `typed`, received now, does not complete it. Call this before
    /// [`complete`](Self::complete).
    pub(super) fn given_up(&mut self, now: Instant, typed: &[u8]) -> Option<String> {
        let passed = now.saturating_duration_since(self.received?);
        let name = match (self.pending.as_slice(), typed) {
            ([], _) => return None,
            ([ESC], [b'[' | b'O', ..]) if passed < REST => return None,
            ([ESC], [_, ..]) if passed < TOGETHER => return None,
            ([ESC], []) if passed < ESCAPE => return None,
            ([ESC], _) => "Esc",
            _ if passed < REST => return None,
            _ => UNKNOWN,
        };
        self.reported = name == "Esc" && typed.is_empty();
        self.pending.clear();
        Some(name.to_owned())
    }

    /// The complete keys, with these bytes received now.
    pub(super) fn complete(&mut self, now: Instant, typed: &[u8]) -> Vec<String> {
        let Some(first) = typed.first() else {
            return Vec::new();
        };
        let last = self.received.replace(now);
        // The rest of a sequence whose ESC was reported must not become letters.
        let recent = last.is_some_and(|last| now.saturating_duration_since(last) < REST);
        if std::mem::take(&mut self.reported) && recent && matches!(first, b'[' | b'O') {
            self.pending.push(ESC);
        }
        self.pending.extend(typed);
        let mut keys = Vec::new();
        let mut at = 0;
        while let Some((key, length)) = first_key(self.pending.get(at..).unwrap_or_default()) {
            keys.push(key);
            at += length;
        }
        self.pending.drain(..at);
        keys
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The keys of input at these times in milliseconds; the view looks for input every 40 ms.
    fn keys(typed: &[(u64, &str)], until: u64) -> Vec<String> {
        let start = Instant::now();
        let mut decoder = KeyDecoder::default();
        let mut keys = Vec::new();
        let looks = (0..until).step_by(40).map(|at| (at, ""));
        let mut all: Vec<(u64, &str)> = typed.iter().copied().chain(looks).collect();
        all.sort_by_key(|(at, _)| *at);
        for (at, bytes) in all {
            let now = start + Duration::from_millis(at);
            keys.extend(decoder.given_up(now, bytes.as_bytes()));
            keys.extend(decoder.complete(now, bytes.as_bytes()));
        }
        keys
    }

    #[test]
    fn a_key_in_pieces_is_that_key() {
        let right = |pause| [(0, "\x1b"), (pause, "["), (2 * pause, "C")];
        for pause in [1, 39, 100, 250, 460] {
            assert_eq!(keys(&right(pause), 5000), ["Right"], "{pause}");
        }
        let end = [(0, "\x1b["), (900, "4"), (1800, "~x")];
        assert_eq!(keys(&end, 5000), ["End", "x"]);
        let upper = [(0, "\x1b"), (400, "O"), (800, "H")];
        assert_eq!(keys(&upper, 5000), ["Home"]);
    }

    #[test]
    fn the_rest_of_a_sequence_after_a_reported_esc_is_not_read_as_letters() {
        let right = [(0, "\x1b"), (900, "["), (1700, "C")];
        assert_eq!(keys(&right, 5000), ["Esc", "Right"]);
    }

    #[test]
    fn a_lone_esc_is_a_key_and_not_a_part_of_the_next() {
        assert_eq!(keys(&[(0, "\x1b")], 5000), ["Esc"]);
        assert_eq!(keys(&[(0, "\x1b")], 400), Vec::<String>::new());
        assert_eq!(keys(&[(0, "\x1b"), (100, "x")], 5000), ["Esc", "x"]);
        assert_eq!(keys(&[(0, "\x1b"), (100, "\x1b")], 5000), ["Esc", "Esc"]);
        assert_eq!(keys(&[(0, "\x1b"), (5, "q")], 5000), ["Alt-q"]);
        assert_eq!(keys(&[(0, "\x1b"), (2500, "[")], 5000), ["Esc", "["]);
    }

    #[test]
    fn an_incomplete_key_is_given_up_and_stop_keys_work_at_once() {
        assert_eq!(keys(&[(0, "\x1b[1")], 5000), [UNKNOWN]);
        assert_eq!(keys(&[(0, "\x1b[1"), (1500, "x")], 5000), [UNKNOWN, "x"]);
        assert_eq!(
            keys(&[(0, "\x1b[1"), (100, "\x03")], 101),
            [UNKNOWN, "Ctrl-C"]
        );
        assert_eq!(keys(&[(0, "\x1b"), (5, "\x03")], 6), ["Esc", "Ctrl-C"]);
        assert_eq!(keys(&[(0, "\x1b"), (5, "x")], 6), ["Esc", "x"]);
        assert_eq!(keys(&[(0, "\x1bc")], 1), ["Esc", "c"]);
    }
}
