//! Trees, places, and what people are shown.

use ztl_tests::garbage::Garbage;

use super::*;

#[track_caller]
fn document(text: &str) -> Document {
    Document::parse("f", text.as_bytes()).expect("YAML")
}

/// The output for the mistakes of a file that is refused before its values are read.
#[track_caller]
fn refused(text: &str) -> String {
    let parsed = Document::parse("f", text.as_bytes());
    let mistakes = parsed.and_then(|document| document.reading().finish(Some(())));
    mistakes.expect_err(text).to_string()
}

fn scalar(node: &Node) -> &str {
    match &node.value {
        NodeValue::Scalar { text, .. } => text,
        other => panic!("{other:?}"),
    }
}

fn map(node: &Node) -> &[(Node, Node)] {
    match &node.value {
        NodeValue::Map(pairs) => pairs,
        other => panic!("{other:?}"),
    }
}

/// Where it begins and ends: line, column, line, column.
fn places(node: &Node) -> [usize; 4] {
    let Span { start, end } = node.span;
    [start.line, start.column, end.line, end.column]
}

#[test]
fn every_value_has_its_place() {
    let document = document("port: 12345 # here\nnäme: \"a b\"\nlist:\n  - x\n  - [1, ~]\n");
    let pairs = map(document.root());
    let [(port, number), (name, text), (_, list)] = pairs else {
        panic!("{pairs:?}");
    };
    assert_eq!((scalar(port), places(port)), ("port", [1, 1, 1, 5]));
    assert_eq!((scalar(number), places(number)), ("12345", [1, 7, 1, 12]));
    assert_eq!((scalar(name), places(name)), ("näme", [2, 1, 2, 5]));
    assert_eq!((scalar(text), places(text)), ("a b", [2, 7, 2, 12]));
    let NodeValue::List(items) = &list.value else {
        panic!("{list:?}");
    };
    assert_eq!(places(&items[0]), [4, 5, 4, 6]);
    assert_eq!(places(&items[1])[..2], [5, 5]);
}

#[test]
fn an_empty_file_is_an_empty_mapping() {
    for text in ["", "\n", "# nothing\n", "---\n", "\u{feff}", "~"] {
        assert_eq!(map(document(text).root()), [], "{text:?}");
    }
}

#[test]
fn a_document_returns_the_bytes_of_its_file() {
    for text in ["\u{feff}a: 1\r\n", "a: 1\n"] {
        assert_eq!(document(text).bytes(), text.as_bytes());
    }
}

#[test]
fn an_alias_has_the_value_of_its_anchor_and_cannot_expand_without_limit() {
    let document = document("a: &x {b: 1}\nc: *x\n");
    let pairs = map(document.root());
    assert_eq!(pairs[0].1.value, pairs[1].1.value);
    assert_eq!(places(&pairs[1].1), [2, 4, 2, 6]);

    let mut laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n".to_owned();
    for level in 1..12 {
        let below = format!("*a{}, ", level - 1).repeat(10);
        laughs += &format!("a{level}: &a{level} [{below}]\n");
    }
    assert!(refused(&laughs).contains("more than 100000 values"));
    assert!(refused("a: *b\n").contains("f:1:"));
    assert!(refused("a: &a [*a]\n").contains("'*a' stands within itself"));
}

#[test]
fn invalid_yaml_is_reported_at_its_cause() {
    for (text, shown) in [
        // An open bracket with any amount of text after it.
        (
            "a: 1\n\ns: {a: {b: 1}\n\nc: 3\nd: 4\n",
            "f:3:4: this '{' is not closed, or a ',' is missing before line 5",
        ),
        (
            "a: 1\nb: [1, 2\nc: 3\n",
            "f:2:4: this '[' is not closed, or a ',' is missing before line 3",
        ),
        ("a: {b: [1, 2", "f:1:8: this '[' is never closed"),
        ("a: {b: 1,\n", "f:1:4: this '{' is never closed"),
        ("a: {b:\n", "f:1:4: this '{' is never closed"),
        (
            "a: [{b: 1]\n",
            "f:1:10: expected '}' for the '{' in line 1, found ']'",
        ),
        ("a: [1, 2]]\n", "f:1:10: ']' without a '[' before it"),
        ("a: [1, , 2]\n", "f:1:8: a value is missing before this ','"),
        (
            "a: {b: c: d}\n",
            "f:1:9: a second ':'; put a text with ': ' in it in quotes",
        ),
        ("a: {b: 'c' d}\n", "f:1:12: a text behind the closing quote"),
        ("a: {- b}\n", "f:1:5: a '- ' cannot stand between brackets"),
        // Quotes.
        ("a: 'b\nc: d\n", "f:1:4: this quote is never closed"),
        (
            "a: 'it's'\n",
            "f:1:8: a text behind the closing quote; within '…' write an apostrophe as ''",
        ),
        (
            "a: \"C:\\win\"\n",
            "f:1:7: unknown escape in \"…\"; write a backslash as \\\\",
        ),
        // A quote that is not closed swallows what follows, up to the next quote.
        (
            "a:\n  say: \"hello\n  tell: \"x\"\n",
            "f:2:8: perhaps this quote is not closed (3:10: a text behind the closing quote; within",
        ),
        (
            "a: {say: \"hello}\nb: {say: \"bye\"}\n",
            "f:1:10: perhaps this quote is not closed (2:11: a text behind the closing quote; within",
        ),
        (
            "a: {say: 'tis fine}\nb: {say: 'x'}\n",
            "f:1:10: perhaps this quote is not closed (2:",
        ),
        (
            "a:\n  say: \"hello\n  tell: \"\"\n",
            "f:2:8: perhaps this quote is not closed (3:10: this quote is never closed)",
        ),
        (
            "\"a: 1\n\"b\": 2\n",
            "f:1:1: perhaps this quote is not closed (",
        ),
        // Not the fault of a text on two lines.
        (
            "a: {say: \"hello\n  you\"\nb: 3\n",
            "f:1:4: this '{' is not closed, or a ',' is missing before line 3",
        ),
        (
            "a: \"hello\n  you\"\nb: c: 3\n",
            "f:3:5: a second ':' in one line; put a text with ': ' in it in quotes",
        ),
        // Indentation and colons.
        (
            "a: 1\n\tb: 2\n",
            "f:2:1: found a tab; indent with spaces, never with the tab key",
        ),
        ("a:\n\tb: 2\n", "f:2:1: found a tab"),
        ("a\n  b: 1\n", "f:1:1: the ':' is missing behind this"),
        ("s:\n  a\n  b: 1\n", "f:2:3: the ':' is missing behind this"),
        (
            "a: b: c\n",
            "f:1:5: a second ':' in one line; put a text with ': ' in it in quotes",
        ),
        (
            "a:\n  b: 1\n c: 2\n",
            "f:3:2: this line begins in column 2, and what it belongs to in column 1 (line 1)",
        ),
        (
            "a: - b\n",
            "f:1:4: a list cannot begin here; write each '- ' on its own line",
        ),
        // Characters that a plain text cannot start with.
        (
            "a: *hi\n",
            "f:1:4: there is no '&hi' before this; a text that begins with '*' needs quotes",
        ),
        ("a: *!\n", "f:1:4: a text that begins with '*' needs quotes"),
        (
            "a: @home\n",
            "f:1:4: a text that begins with '@' needs quotes",
        ),
        ("a: | b\n", "f:1:4: the text of '|' begins in the next line"),
        (
            "%a\tb\n",
            "f:1:1: a line that begins with '%' is a directive of YAML",
        ),
        ("a: 1\n---\nb: 2\n", "f:2:1: a second document begins"),
        ("a: !robot 1\n", "f:1:4: the tag '!robot' is not known here"),
        (
            "a: &x 1\nb: &x 2\n",
            "f:2:4: '&x' stands for something else since line 1",
        ),
        (
            "a: \u{1b}\n",
            "f:1:4: the character U+001B cannot stand in a file",
        ),
        (
            "a: 1\na: 2\n",
            "f:2:1: duplicate key 'a'\n  2 | a: 2\n    | ^\n",
        ),
    ] {
        let said = refused(text);
        assert!(said.starts_with(shown), "{text:?}: {said}");
    }
    let deep = "- ".repeat(100);
    assert!(refused(&deep).contains("f:1:129: nested deeper than 64"));
    assert!(refused(&"[".repeat(100_000)).contains("f:1:"));
    let mistakes = Document::parse("f", b"a: 1\nb: x\xffy\n").expect_err("no UTF-8");
    let shown =
        "f:2:5: the file is not UTF-8; save it as UTF-8\n  2 | b: x\u{fffd}y\n    |     ^\n";
    assert_eq!(mistakes.to_string(), shown);
}

#[test]
fn lines_end_at_every_line_break_of_yaml() {
    let shown = "f:3:4: there is no '&x' before this; a text that begins with '*' needs quotes\n  3 | b: *x\n    |    ^^\n";
    for end in ["\n", "\r\n", "\r", "\u{85}", "\u{2028}"] {
        let text = ["a: 1", "", "b: *x", "c: 1"].join(end);
        assert_eq!(refused(&text), shown, "{end:?}");
        let text = ["a: 1", "", "b: \u{1}"].join(end);
        assert!(
            refused(&text).starts_with("f:3:4: the character U+0001"),
            "{end:?}"
        );
    }
}

#[test]
fn merged_keys_come_first_and_are_overridden() {
    let text = "
base: &base {host: h, port: 1}
other: &other {port: 2, scope: /o}
a: {scope: /a, <<: *base}
b: {<<: [*base, *other], host: b}
c: &c {<<: *base, port: 3}
d: {<<: *c}
e: {<<: [], '<<': text}
f: {<<: *base, 'host': f}
g: {<<: [{'host': g, !!str port: 5}, *base]}
";
    let document = document(text);
    let shown: Vec<String> = map(document.root())
        .iter()
        .skip(2)
        .map(|(_, entry)| {
            let pairs = map(entry).iter();
            let pairs = pairs.map(|(key, value)| format!("{}={}", scalar(key), scalar(value)));
            pairs.collect::<Vec<_>>().join(" ")
        })
        .collect();
    assert_eq!(
        shown,
        [
            "host=h port=1 scope=/a",
            "port=1 scope=/o host=b",
            "host=h port=3",
            "host=h port=3",
            "<<=text",
            "host=f port=1",
            "host=g port=5",
        ]
    );
    // A mapping's own keys stand there once.
    assert!(
        refused("a: &a {x: 1}\nb: {<<: *a, x: 2, x: 3}\n").contains("f:2:19: duplicate key 'x'")
    );
    for wrong in ["a: {<<: 1}", "a: {<<: [{b: 1}, 2]}", "a: {<<: }"] {
        let said = refused(wrong);
        assert!(
            said.contains("'<<' takes a mapping or a list of mappings"),
            "{wrong}: {said}"
        );
    }
}

#[test]
fn all_mistakes_are_reported_together_in_order() {
    let document = document("prot: 1\nlevel: lud\nport: 70000\nlist: 3\nempty:\n");
    let mut reading = document.reading();
    let mut fields = reading.fields(document.root(), "it").expect("a mapping");
    let port = fields.optional("port").expect("it is there");
    assert_eq!(reading.whole::<u16>(port, "a port, 0 to 65535"), None);
    let level = fields.optional("level").expect("it is there");
    assert_eq!(reading.one_of(level, &[("loud", 1), ("low", 2)]), None);
    let list = fields.optional("list").expect("it is there");
    assert_eq!(reading.list(list, "- word"), None);
    assert_eq!(fields.required("proto", "proto: name"), None);
    assert_eq!(fields.required("crew", "crew: 3"), None);
    assert_eq!(fields.required("empty", "empty: bottle"), None);
    fields.finish(&mut reading);
    let shown = "\
f:1:1: unknown key 'prot'; did you mean 'proto'?
  1 | prot: 1
    | ^^^^
f:1:1: 'crew' is missing; write crew: 3
  1 | prot: 1
    | ^
f:2:8: 'lud' is not known here; did you mean 'loud'?
  2 | level: lud
    |        ^^^
f:3:7: '70000' is not a port, 0 to 65535
  3 | port: 70000
    |       ^^^^^
f:4:7: found a single value; expected a list: - word
  4 | list: 3
    |       ^
f:5:1: 'empty' has no value; write empty: bottle
  5 | empty:
    | ^^^^^
";
    let said = reading.finish(Some(())).expect_err("mistakes").to_string();
    assert_eq!(said, shown);
}

#[test]
fn a_long_line_is_cut_around_the_mistake() {
    let text = format!("{{k: {}, \u{1b}[31m: 1, \tx: 2}}\n", "v".repeat(300));
    let parsed = Document::parse("f", text.as_bytes());
    let mistake = match &parsed {
        Ok(document) => {
            let last = &map(document.root()).last().expect("a key").0;
            document.mistake(last.span, "here").to_string()
        }
        Err(mistakes) => mistakes.to_string(),
    };
    assert!(
        mistake.lines().all(|line| line.chars().count() < 120),
        "{mistake}"
    );
    assert!(!mistake.contains('\u{1b}'), "{mistake:?}");
}

#[test]
fn only_a_probably_meant_word_is_suggested() {
    let known = ["port", "scope", "devices", "log-format", "elf"];
    for (written, meant) in [
        ("prot", Some("port")),
        ("device", Some("devices")),
        ("log_format", Some("log-format")),
        ("Scope", Some("scope")),
        ("journal", None),
        ("x", None),
    ] {
        assert_eq!(closest(written, known), meant, "{written}");
    }
}

#[test]
fn no_input_makes_the_parser_panic() {
    let mut numbers = Garbage::new(0x9e37_79b9_7f4a_7c15);
    let rounds = std::env::var("ZTL_ROUNDS")
        .ok()
        .and_then(|n| n.parse().ok());
    for _ in 0..rounds.unwrap_or(20_000) {
        let bytes = numbers.bytes();
        match Document::parse("f", &bytes) {
            Ok(document) => {
                let mut reading = document.reading();
                if let Some(fields) = reading.fields(document.root(), "it") {
                    fields.finish(&mut reading);
                }
                let _ = reading
                    .finish(Some(()))
                    .map_err(|mistakes| mistakes.to_string());
            }
            Err(mistakes) => assert!(mistakes.to_string().starts_with("f:"), "{bytes:?}"),
        }
    }
}
