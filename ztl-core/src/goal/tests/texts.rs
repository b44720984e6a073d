use super::{any, read};
use crate::goal::{GoalErrorKind, from_str, from_str_with};
use std::string::String;

/// Decodes a quoted text in a list.
#[track_caller]
fn meant(quoted: &str) -> Result<String, usize> {
    let text = std::format!("[{quoted}]");
    match read::<[String; 1]>(&text) {
        Ok([text]) => Ok(text),
        Err(error) => {
            assert_eq!(error.kind, GoalErrorKind::BadEscape, "{quoted}");
            // The position of the escape, without the bracket.
            Err(error.at - 1)
        }
    }
}

#[test]
fn python_escapes_are_read_in_both_quotes() {
    for (escape, c) in [
        (r"\\", '\\'),
        (r"\'", '\''),
        (r#"\""#, '"'),
        (r"\n", '\n'),
        (r"\r", '\r'),
        (r"\t", '\t'),
        (r"\a", '\x07'),
        (r"\b", '\x08'),
        (r"\f", '\x0c'),
        (r"\v", '\x0b'),
        (r"\x00", '\0'),
        (r"\xe9", 'é'),
        (r"\xE9", 'é'),
        (r"\u20ac", '€'),
        (r"\ufeff", '\u{feff}'),
        (r"\U0001F600", '😀'),
        (r"\U0010ffff", '\u{10ffff}'),
        // As JSON writes characters beyond U+FFFF.
        (r"\ud83d\ude00", '😀'),
    ] {
        let expected = std::format!("a{c}1");
        for quote in ["'", "\""] {
            let quoted = std::format!("{quote}a{escape}1{quote}");
            assert_eq!(meant(&quoted), Ok(expected.clone()), "{quoted}");
        }
    }
}

#[test]
fn yaml_escapes_are_read_in_double_quotes_only() {
    for (escape, double, single) in [
        (r"\0", Ok("\0"), Err(2)),
        (r"\012", Ok("\x0012"), Err(2)),
        (r"\N", Ok("\u{85}"), Err(2)),
        (r"\e", Ok("\x1b"), Ok(r"\e")),
        (r"\/", Ok("/"), Ok(r"\/")),
        (r"\ ", Ok(" "), Ok(r"\ ")),
        (r"\_", Ok("\u{a0}"), Ok(r"\_")),
        (r"\L", Ok("\u{2028}"), Ok(r"\L")),
        (r"\P", Ok("\u{2029}"), Ok(r"\P")),
        // Unknown to both; in single quotes both keep the backslash.
        (r"\d", Err(2), Ok(r"\d")),
        (r"\é", Err(2), Ok(r"\é")),
        (r"\8", Err(2), Ok(r"\8")),
    ] {
        for (quote, expected) in [("\"", double), ("'", single)] {
            let quoted = std::format!("{quote}a{escape}{quote}");
            let expected = expected.map(|text| std::format!("a{text}"));
            assert_eq!(meant(&quoted), expected, "{quoted}");
        }
    }
}

#[test]
fn a_bad_escape_is_reported_at_its_position() {
    for escape in [
        r"\x4",
        r"\xg0",
        r"\u12",
        r"\u12g4",
        r"\ud83d",
        r"\ud83d\n",
        r"\ud83d\u0041",
        r"\ude00",
        r"\U00110000",
        r"\U0000d800",
        "\\\n",
    ] {
        for quote in ["'", "\""] {
            let quoted = std::format!("{quote}é \\n{escape}{quote}");
            assert_eq!(meant(&quoted), Err(6), "{quoted}");
        }
    }
}

#[test]
fn a_single_quote_may_be_doubled_or_escaped() {
    for (quoted, text) in [
        ("''", ""),
        ("''''", "'"),
        ("'it''s'", "it's"),
        (r"'it\'s'", "it's"),
        ("'''a'''", "'a'"),
        (r"'C:\\temp'", r"C:\temp"),
        ("'say \"hi\"'", "say \"hi\""),
        ("\"it's\"", "it's"),
        ("\"\"", ""),
        ("'a, b: [c] #d'", "a, b: [c] #d"),
    ] {
        assert_eq!(meant(quoted).as_deref(), Ok(text), "{quoted}");
    }
    assert_eq!(any("['', '', 'a']"), Ok(serde_json::json!(["", "", "a"])));
}

#[test]
fn line_breaks_in_quotes_fold_as_in_yaml() {
    for (inner, text) in [
        ("a\nb", "a b"),
        ("a  \n\t b", "a b"),
        ("a\r\n\r\nb", "a\nb"),
        ("a\n\n\n  b", "a\n\nb"),
        (" a\n", " a "),
        ("\n", " "),
    ] {
        for quote in ["'", "\""] {
            let quoted = std::format!("{quote}{inner}{quote}");
            assert_eq!(meant(&quoted).as_deref(), Ok(text), "{quoted:?}");
        }
    }
    // Escaped whitespace before a line break is kept.
    assert_eq!(meant("\"a\\t \nb\"").as_deref(), Ok("a\t b"));
    assert_eq!(meant("\"a\\x20\nb\"").as_deref(), Ok("a  b"));
}

#[test]
fn without_scratch_an_escape_is_an_error() {
    assert_eq!(from_str("['plain', \"it's\"]"), Ok(["plain", "it's"]));
    for (text, at) in [
        (r"['plain', 'it\'s']", 13),
        ("['it''s', 'a']", 4),
        ("['a', 'b\nc']", 8),
    ] {
        let error = from_str::<[&str; 2]>(text).unwrap_err();
        assert_eq!(
            (error.at, error.kind),
            (at, GoalErrorKind::NeedsScratch),
            "{text}"
        );
    }
    // A goal that is a text has no escapes.
    assert_eq!(from_str(r"it\'s"), Ok(r"it\'s"));
}

#[test]
fn several_texts_are_borrowed_from_the_scratch() {
    let mut scratch = [0xA5; 8];
    let text = r"['a\n', plain, '', 'b\x41', 'é''']";
    let texts: [&str; 5] = from_str_with(text, &mut scratch).unwrap();
    assert_eq!(texts, ["a\n", "plain", "", "bA", "é'"]);
    assert_eq!(scratch, *b"a\nbA\xc3\xa9'\xA5");
}

#[test]
fn a_scratch_too_small_reports_the_size_needed_so_far() {
    for available in 0..9 {
        let mut scratch = [0xA5; 16];
        let text = r"['\n\n', 'x', '\x41\x42\x43\u00e9', 'y']";
        let read = from_str_with::<[&str; 4]>(text, &mut scratch[..available]);
        let error = match available {
            0 | 1 => Some((1, 2)),
            2..7 => Some((14, 7)),
            _ => None,
        };
        match error {
            None => assert_eq!(read, Ok(["\n\n", "x", "ABCé", "y"])),
            Some((at, needed)) => {
                let error = read.unwrap_err();
                let kind = GoalErrorKind::ScratchTooSmall { needed, available };
                assert_eq!((error.at, error.kind), (at, kind));
            }
        }
        assert_eq!(scratch[available..], [0xA5; 16][available..]);
    }
}
