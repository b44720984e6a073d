//! What is shown of a text, and how wide it is.

use super::*;

const PLAIN: Capabilities = Capabilities {
    colour: false,
    utf8: false,
};
const FULL: Capabilities = Capabilities {
    colour: true,
    utf8: true,
};

#[test]
fn a_line_is_never_wider_than_its_limit() {
    for most in 0..12 {
        for text in [
            "plain text",
            "日本語のテキスト",
            "a\u{301}b\u{301}c\u{301}defghijkl",
            "\u{644}\u{627}\u{644}\u{627} 👍\u{1f3fd}👍\u{1f3fd} ❤\u{fe0f}❤\u{fe0f} 🇩🇪🇩🇪",
            "",
        ] {
            assert!(columns(&clip(text, most)) <= most, "{text} in {most}");
            let mut line = Line::new(most).and(Style::Good, text).and(Style::Bar, text);
            line.put_right(Style::Plain, "right");
            assert!(line.width() <= most);
        }
    }
}

#[test]
fn text_is_wrapped_at_blanks_and_cut_after_the_last_line() {
    assert_eq!(wrap("one line", 20, 3), ["one line"]);
    assert_eq!(
        wrap("  two lines of this", 11, 3),
        ["  two lines", "    of this"]
    );
    assert_eq!(wrap("a b c d e f g h", 5, 2), ["a b c", "  d …"]);
    assert_eq!(wrap("unbreakable", 5, 9), ["unbre", "  aka", "  ble"]);
    assert_eq!(wrap("unbreakable", 5, 2), ["unbre", "  ak…"]);
    assert_eq!(wrap("too narrow", 0, 3), ["", "", ""]);
    assert_eq!(wrap("", 5, 3), [""]);
}

#[test]
fn a_huge_text_takes_few_lines_and_says_that_it_was_cut() {
    let zeros = "\u{301}".repeat(500_000);
    let blanks = format!("a{}b", " ".repeat(500_000));
    for text in [
        "x".repeat(500_000),
        "word ".repeat(100_000),
        "日".repeat(500_000),
        blanks,
        zeros,
    ] {
        let lines = wrap(&text, 79, 40);
        assert!(lines.len() <= 40, "{}", lines.len());
        assert!(lines.iter().all(|line| columns(line) <= 79));
        assert!(lines.iter().all(|line| line.len() < 2000));
        assert!(lines.last().unwrap().ends_with('…'), "{lines:?}");
    }
    let whole = wrap(&"word ".repeat(1000), 79, usize::MAX);
    assert!(!whole.concat().contains('…') && whole.len() > 60);
}

#[test]
fn text_cannot_control_the_terminal() {
    let evil = "\x1b[2J\u{9b}31m\u{202e}\u{61c}\u{2028}\u{2029}\r\n\x07";
    let line = Line::new(80).and(Style::Plain, evil).encoded(FULL);
    let escaped = r"\u001b[2J\u009b31m\u202e\u061c\u2028\u2029\r\n\u0007";
    assert_eq!(line, escaped);
    assert_eq!(wrap(evil, 80, 9), [escaped]);
    // Columns stay aligned.
    let joined = Line::new(80).and(Style::Plain, "a\u{200d}\u{200b}b\u{2060}");
    assert_eq!(joined.encoded(FULL), "a\u{fffd}\u{fffd}b\u{fffd}");
    assert_eq!(joined.width(), 5);
}

#[test]
fn signs_and_attributes_follow_the_capabilities() {
    let line = Line::new(80)
        .and(Style::Bad, "✗ bad")
        .and(Style::Good, "ok");
    assert_eq!(line.encoded(PLAIN), "\x1b[1m! bad\x1b[0mok");
    assert_eq!(
        line.encoded(FULL),
        "\x1b[1;31m✗ bad\x1b[0m\x1b[32mok\x1b[0m"
    );
}

/// What a terminal gets of this text in a line of 20 columns, and the width that is counted for it.
fn in_a_line(text: &str, capabilities: Capabilities) -> (String, usize) {
    let line = Line::new(20).and(Style::Plain, text);
    (line.encoded(capabilities), line.width())
}

#[test]
fn no_text_is_wider_than_it_is_counted() {
    let marks = "\u{301}".repeat(100);
    let (line, width) = in_a_line(&marks, PLAIN);
    assert_eq!((line.len(), width), (20, 20), "{line}");
    let (line, width) = in_a_line(&format!("a{marks}"), PLAIN);
    assert_eq!((line.len(), width), (20, 20), "{line}");
    assert_eq!(in_a_line("日本", PLAIN), ("????".to_owned(), 4));
    assert_eq!(in_a_line("a\u{301}\u{301}b", PLAIN), ("ab".to_owned(), 2));
    // Marks stay on their character.
    for text in ["a\u{301}b", "ค\u{e37}", "\u{1112}\u{1161}\u{11ab}"] {
        assert_eq!(in_a_line(text, FULL).0, text);
    }
    for (text, shown, width) in [
        // Terminals that do not join them show each.
        ("\u{644}\u{627}", "\u{644}\u{627}", 2),
        ("👍\u{1f3fd}", "👍\u{1f3fd}", 4),
        ("❤\u{fe0f}", "❤", 1),
        ("\u{3164}\u{ffa0}\u{ad}", "\u{fffd}\u{fffd}\u{fffd}", 3),
        ("\u{301}a", "\u{fffd}a", 2),
    ] {
        assert_eq!(in_a_line(text, FULL), (shown.to_owned(), width), "{text:?}");
    }
}
