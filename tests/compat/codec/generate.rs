//! Random messages, tasks and numbers: mostly unusual ones, some ordinary.

use ztl_core::TaskSpec;
use ztl_core::base64::Encoder;
use ztl_core::sink::Sink;
use ztl_tests::lab::Random;

/// Decimal digits: ASCII, Arabic, Devanagari, fullwidth, mathematical; and some characters that are not digits.
const DIGITS: [&str; 8] = ["0", "7", "٣", "९", "５", "𝟗", "²", "Ⅷ"];

/// Blanks to Python, inside ASCII and beyond; and some characters that are not blanks.
const BLANKS: [&str; 16] = [
    " ", "\t", "\n", "\x0b", "\x0c", "\r", "\x1c", "\x1f", "\u{85}", "\u{a0}", "\u{1680}",
    "\u{2028}", "\u{3000}", "\u{200b}", "\u{feff}", "\0",
];

/// Text that has caused bugs elsewhere.
const TEXTS: [&str; 16] = [
    "",
    "/test",
    "cob",
    "left",
    "it's \"so\"",
    "l1\nl2",
    "grüße",
    "世界",
    "🤖",
    "e\u{301}",
    "\0",
    "\u{feff}",
    "\u{fffd}",
    "\u{10ffff}",
    "a;b",
    "a:b:c",
];

/// Bytes that are not UTF-8: lone and missing continuations, overlong forms, surrogates, too large.
const BROKEN: [&[u8]; 12] = [
    b"\x80",
    b"\xbf\xbf",
    b"\xc3",
    b"\xc0\xaf",
    b"\xe2\x82",
    b"\xe0\x80\xaf",
    b"\xed\xa0\x80",
    b"\xed\xb0\x80",
    b"\xf0\x9f\xa4",
    b"\xf4\x90\x80\x80",
    b"\xf8\x88\x80\x80\x80",
    b"\xff\xfe",
];

/// Characters that a base64 decoder must skip, stop at, or reject.
const JUNK: [&str; 14] = [
    "=", "=", "==", "===", "-", "_", " ", "\n", "!", ".", "\0", "ü", "🤖", "A",
];

/// A field that should be a number.
pub fn number(random: &mut Random) -> String {
    let mut text = String::new();
    for _ in 0..random.below(3) {
        text.push_str(if random.once_in(2) {
            " "
        } else {
            random.pick(&BLANKS)
        });
    }
    if random.once_in(3) {
        text.push_str(random.pick(&["+", "-", "-", "--", "−", "_"]));
    }
    let digits = match random.below(200) {
        0 => 4297 + random.below(6),
        1..80 => 1,
        _ => random.below(22),
    };
    let foreign = random.once_in(6);
    for place in 0..digits {
        let ascii = ["0", "1", "2", "3", "4", "5", "6", "7", "8", "9"];
        text.push_str(if foreign {
            random.pick(&DIGITS)
        } else {
            random.pick(&ascii)
        });
        // One underscore between digits is valid; more, or one at an end, is not.
        if random.once_in(9) && place + 1 < digits || random.once_in(60) {
            text.push_str(if random.once_in(20) { "__" } else { "_" });
        }
    }
    if random.once_in(20) {
        text.push_str(random.pick(&[".0", "e3", "x", "_", "L", " 1", ";"]));
    }
    for _ in 0..random.below(3) {
        text.push_str(if random.once_in(2) {
            " "
        } else {
            random.pick(&BLANKS)
        });
    }
    text
}

/// A text for any field.
pub fn text(random: &mut Random) -> String {
    let mut text = String::new();
    for _ in 0..random.below(4) {
        text.push_str(random.pick(&TEXTS));
    }
    if random.once_in(5) {
        let code = random.below(0x11_0000) as u32;
        text.extend(char::from_u32(code));
    }
    text
}

/// The bytes of a message, well formed or not.
pub fn wire(random: &mut Random) -> Vec<u8> {
    let fields = match random.below(10) {
        0 => random.below(4),
        1 => 5,
        _ => 4,
    };
    let mut wire = Vec::new();
    for place in 0..fields {
        if place > 0 {
            wire.push(b';');
        }
        let field = match place {
            1 | 2 => number(random),
            3 if random.once_in(3) => payload(random),
            _ => text(random),
        };
        wire.extend_from_slice(field.as_bytes());
    }
    damage(random, &mut wire);
    wire
}

/// In one of five cases: inserted bytes, a flipped bit, or a truncated end.
fn damage(random: &mut Random, bytes: &mut Vec<u8>) {
    if !random.once_in(5) {
        return;
    }
    let place = random.below(bytes.len() + 1);
    match random.below(4) {
        0 => bytes.truncate(place),
        1 if place < bytes.len() => bytes[place] ^= 1 << random.below(8),
        _ => {
            let broken = random.pick(&BROKEN);
            bytes.splice(place..place, broken.iter().copied());
        }
    }
}

/// An INIT's payload: a task in base64, possibly damaged.
pub fn payload(random: &mut Random) -> String {
    let mut plain = Vec::new();
    for part in 0..random.below(5) {
        if part > 0 {
            plain.push(b':');
        }
        plain.extend_from_slice(text(random).as_bytes());
    }
    damage(random, &mut plain);
    let mut encoded = Vec::new();
    let mut sink = |bytes: &[u8]| encoded.extend_from_slice(bytes);
    let mut encoder = Encoder::new(&mut sink);
    encoder.put(&plain);
    encoder.finish();
    let mut payload: Vec<char> = encoded.iter().copied().map(char::from).collect();
    if random.once_in(4) {
        return payload.into_iter().collect();
    }
    for _ in 0..random.below(6) {
        let place = random.below(payload.len() + 1);
        match random.below(4) {
            0 if place < payload.len() => {
                payload.remove(place);
            }
            1 => payload.truncate(payload.len() - random.below(3).min(payload.len())),
            _ => {
                let junk = random.pick(&JUNK).chars();
                payload.splice(place..place, junk);
            }
        }
    }
    if random.once_in(8) {
        // The alphabet for URLs, which the original does not accept.
        for c in &mut payload {
            *c = match *c {
                '+' => '-',
                '/' => '_',
                c => c,
            };
        }
    }
    payload.into_iter().collect()
}

/// The parts of a task; a handler or component with a `:` is split elsewhere when read again.
pub fn task(random: &mut Random) -> [String; 3] {
    [text(random), text(random), text(random)]
}

/// The parts of a task in our representation.
pub fn spec(parts: &[String; 3]) -> TaskSpec<'_> {
    let [handler, component, goal] = parts;
    TaskSpec {
        handler,
        component,
        goal,
    }
}
