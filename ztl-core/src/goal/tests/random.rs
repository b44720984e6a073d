use std::string::String;
use std::vec::Vec;

use serde::de::IgnoredAny;

use super::{Move, Pose, any};
use crate::goal::{from_str, from_str_with, to_slice};

/// A simple generator of random numbers (xorshift64*).
pub(super) struct Random(u64);

impl Random {
    /// Takes the seed from `ZTL_SEED`; otherwise it is constant.
    pub(super) fn seeded() -> Self {
        let named = std::env::var("ZTL_SEED")
            .ok()
            .and_then(|seed| seed.parse().ok());
        let seed: u64 = named.unwrap_or(0x5a54_4c00);
        std::println!("ZTL_SEED={seed}");
        Self(seed.wrapping_mul(2) | 1)
    }

    pub(super) fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    pub(super) fn below(&mut self, limit: usize) -> usize {
        (((self.next() >> 32) * limit as u64) >> 32) as usize
    }

    pub(super) fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }
}

const TOKENS: &[&str] = &[
    "[",
    "]",
    "(",
    ")",
    "{",
    "}",
    ",",
    ":",
    ": ",
    ", ",
    " ",
    "\n",
    "\t",
    "\r\n",
    "'",
    "\"",
    "''",
    "\\",
    "\\'",
    "\\\"",
    "\\n",
    "\\x4",
    "\\x41",
    "\\u00e9",
    "\\ud83d",
    "\\ude00",
    "\\U0001F600",
    "\\N",
    "\\0",
    "#",
    " #",
    "&",
    "*",
    "!",
    "- ",
    "? ",
    "b'",
    "~",
    "None",
    "True",
    "no",
    "x",
    "y",
    "theta",
    "stop",
    "turn",
    "drive",
    "to",
    "0",
    "1",
    "-",
    "+",
    ".",
    "_",
    "e",
    "E",
    "0x",
    "0b1",
    "inf",
    ".nan",
    "1e999",
    "99999999999999999999",
    "1e-400",
    "é",
    "😀",
    "\u{85}",
    "\u{2028}",
    "\u{feff}",
    "\0",
    "a b",
    "it's",
];

#[test]
fn any_text_gives_a_value_or_an_error_within_the_text() {
    let mut random = Random::seeded();
    let (mut good, mut bad) = (0, 0);
    for round in 0..100_000 {
        let count = random.below(24);
        let mut text: String = match round % 4 {
            0 => (0..count).map(|_| random.pick(TOKENS)).collect(),
            // Mostly well formed, with random tokens inserted.
            1 | 2 => grown(&mut random, 4),
            _ => {
                let bytes: Vec<u8> = (0..count).map(|_| random.next() as u8).collect();
                String::from_utf8_lossy(&bytes).into_owned()
            }
        };
        if round % 4 == 2 {
            let places: Vec<usize> = text.char_indices().map(|(at, _)| at).collect();
            if !places.is_empty() {
                text.insert_str(random.pick(&places), random.pick(TOKENS));
            }
        }
        let check = |error: Option<crate::goal::GoalError>| {
            let at = error.map_or(0, |error| error.at);
            assert!(text.is_char_boundary(at), "{text:?} {error:?}");
        };
        let mut scratch = [0xA5; 64];
        let small = random.below(64);
        let value = any(&text);
        match &value {
            Ok(_) => good += 1,
            Err(_) => bad += 1,
        }
        check(value.err());
        check(from_str_with::<Move>(&text, &mut scratch[..small]).err());
        check(from_str_with::<Pose>(&text, &mut scratch).err());
        check(from_str::<IgnoredAny>(&text).err());
        check(from_str::<f32>(&text).err());
        check(from_str::<i8>(&text).err());
        check(from_str::<Option<bool>>(&text).err());
        check(from_str::<(Option<&str>, &[u8], char)>(&text).err());
        check(from_str::<&str>(&text).err());
    }
    // Make sure that both outcomes are tested.
    assert!(good > 10_000 && bad > 10_000, "{good} good, {bad} bad");
}

/// A value's text in a random style.
fn grown(random: &mut Random, depth: usize) -> String {
    let kinds = if depth == 0 { 1 } else { 3 };
    let count = random.below(4);
    let space = random.pick(&["", " ", "\n "]);
    match random.below(kinds) {
        0 => random
            .pick(&[
                "7",
                "-1.5e3",
                "None",
                "True",
                "left",
                "'it\\'s'",
                "'it''s'",
                "\"a\\u00e9\"",
                "''",
                "~",
                "stop",
                "0x1F",
                "say it's (me)",
            ])
            .into(),
        1 => {
            let (open, close) = random.pick(&[("[", "]"), ("(", ",)")]);
            let items: Vec<String> = (0..=count).map(|_| grown(random, depth - 1)).collect();
            std::format!(
                "{open}{space}{}{close}",
                items.join(&std::format!(",{space}"))
            )
        }
        _ => {
            let pairs: Vec<String> = (0..count)
                .map(|_| {
                    let key = random.pick(&["x", "'y'", "\"theta\"", "turn", "1", "a b"]);
                    std::format!("{key}{space}: {}", grown(random, depth - 1))
                })
                .collect();
            std::format!("{{{}{space}}}", pairs.join(&std::format!(", {space}")))
        }
    }
}

#[test]
fn written_values_read_back() {
    let mut random = Random::seeded();
    let mut buffer = [0xA5; 1024];
    for _ in 0..20_000 {
        let Ok(value) = any(&grown(&mut random, 3)) else {
            continue;
        };
        if value.is_string() {
            continue;
        }
        let text = to_slice(&value, &mut buffer).unwrap();
        assert_eq!(any(text), Ok(value), "{text}");
    }
}
