//! Quoted text, as Python's `repr` writes it (`docs/protocol.md` [5.4]).

mod printable;

use crate::sink::Sink;
use printable::is_printable;

/// Writes `text` in quotes: `'...'`, or `"..."` if it contains `'` but no `"`. Escapes the quote in use, the
/// backslash and unprintable characters.
pub fn put_quoted(text: &str, sink: &mut (impl Sink + ?Sized)) {
    let quote = char::from(quote(text));
    put_char(quote, sink);
    for c in text.chars() {
        let (prefix, digits) = match c {
            '\\' => (&b"\\\\"[..], 0),
            '\n' => (&b"\\n"[..], 0),
            '\r' => (&b"\\r"[..], 0),
            '\t' => (&b"\\t"[..], 0),
            _ if c == quote => {
                sink.put(b"\\");
                put_char(c, sink);
                continue;
            }
            _ if is_printable(c) => {
                put_char(c, sink);
                continue;
            }
            ..='\u{ff}' => (&b"\\x"[..], 2),
            ..='\u{ffff}' => (&b"\\u"[..], 4),
            _ => (&b"\\U"[..], 8),
        };
        sink.put(prefix);
        put_hex(u32::from(c), digits, sink);
    }
    put_char(quote, sink);
}

/// Like [`put_quoted`], but escapes only unprintable ASCII: the table of other unprintable characters takes
/// 2 KiB of flash. Works on bytes, which saves 0.3 KiB on a Cortex-M0.
pub(crate) fn put_quoted_small(text: &str, sink: &mut (impl Sink + ?Sized)) {
    put_in_quotes(text, quote(text), sink);
}

/// Like [`put_quoted_small`], in double quotes. Also valid YAML if the text beyond ASCII is printable.
pub(crate) fn put_yaml_small(text: &str, sink: &mut (impl Sink + ?Sized)) {
    put_in_quotes(text, b'"', sink);
}

fn put_in_quotes(text: &str, quote: u8, sink: &mut (impl Sink + ?Sized)) {
    sink.put(&[quote]);
    // Start of the part that is not written yet.
    let mut plain = 0;
    for (at, byte) in text.bytes().enumerate() {
        let letter = match byte {
            b'\n' => b'n',
            b'\r' => b'r',
            b'\t' => b't',
            ..b' ' | 0x7f => b'x',
            b'\\' => byte,
            _ if byte == quote => byte,
            _ => continue,
        };
        sink.put(text.as_bytes().get(plain..at).unwrap_or_default());
        plain = at + 1;
        // An escaped byte has the high digit 0, 1 or 7.
        let code = [b'\\', letter, b'0' + (byte >> 4), hex(byte & 0xf)];
        sink.put(
            code.get(..if letter == b'x' { 4 } else { 2 })
                .unwrap_or_default(),
        );
    }
    sink.put(text.as_bytes().get(plain..).unwrap_or_default());
    sink.put(&[quote]);
}

/// The quote to use for `text`.
fn quote(text: &str) -> u8 {
    // `contains` is faster on long texts, but takes more flash.
    let has = |mark| text.bytes().any(|byte| byte == mark);
    if has(b'\'') && !has(b'"') {
        b'"'
    } else {
        b'\''
    }
}

/// Writes `text` as a YAML string in double quotes. Escapes the quote, the backslash and everything except
/// printable ASCII.
pub fn put_yaml(text: &str, sink: &mut (impl Sink + ?Sized)) {
    sink.put(b"\"");
    let mut code = 0;
    for (at, byte) in text.bytes().enumerate() {
        // `chars` takes more flash.
        code = match byte {
            0x80..0xc0 => code << 6 | u32::from(byte & 0x3f),
            0xc0..0xf0 => u32::from(byte & 0x1f),
            // The first byte of four: keeps more bits than needed, which shift out.
            _ => u32::from(byte & 0x7f),
        };
        if !text.is_char_boundary(at + 1) {
            continue;
        }
        match byte {
            b'"' | b'\\' => sink.put(&[b'\\', byte]),
            b' '..=b'~' => sink.put(&[byte]),
            _ => {
                sink.put(b"\\U");
                put_hex(code & 0x1f_ffff, 8, sink);
            }
        }
    }
    sink.put(b"\"");
}

fn put_char(c: char, sink: &mut (impl Sink + ?Sized)) {
    sink.put(c.encode_utf8(&mut [0; 4]).as_bytes());
}

fn put_hex(code: u32, digits: u32, sink: &mut (impl Sink + ?Sized)) {
    for place in (0..digits).rev() {
        sink.put(&[hex((code >> (4 * place)) as u8 & 0xf)]);
    }
}

const fn hex(digit: u8) -> u8 {
    digit + if digit < 10 { b'0' } else { b'a' - 10 }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use super::*;

    #[test]
    fn text_is_quoted_as_in_the_original() {
        for (text, quoted) in [
            ("hi", "'hi'"),
            ("it's", "\"it's\""),
            ("say \"hi\"", "'say \"hi\"'"),
            ("'\"", "'\\'\"'"),
            ("l1\nl2\\", "'l1\\nl2\\\\'"),
            ("\0\x7f\u{a0}", "'\\x00\\x7f\\xa0'"),
            ("\u{200b}\u{2028}", "'\\u200b\\u2028'"),
            ("\u{e0001}", "'\\U000e0001'"),
            ("Grüße 世界 🤖", "'Grüße 世界 🤖'"),
            ("e\u{301}\u{301}", "'e\u{301}\u{301}'"),
        ] {
            let mut out = std::vec::Vec::new();
            put_quoted(text, &mut |bytes: &[u8]| out.extend_from_slice(bytes));
            assert_eq!(std::str::from_utf8(&out), Ok(quoted));
        }
    }

    #[test]
    fn without_the_table_only_characters_beyond_ascii_differ() {
        let quoted = |put: fn(&str, &mut dyn Sink), text: &str| {
            let mut out = std::vec::Vec::new();
            put(text, &mut |bytes: &[u8]| out.extend_from_slice(bytes));
            std::string::String::from_utf8(out).unwrap()
        };
        let ascii = |c: u8| char::from(c).to_string();
        for text in (0..128)
            .map(ascii)
            .chain(["it's".into(), "'\"".into(), "ä 🤖".into()])
        {
            let small = quoted(|text, sink| put_quoted_small(text, sink), &text);
            assert_eq!(small, quoted(|text, sink| put_quoted(text, sink), &text));
        }
        let small = quoted(|text, sink| put_quoted_small(text, sink), "\u{200b}");
        assert_eq!(small, "'\u{200b}'");
    }

    #[test]
    fn a_device_scope_name_cannot_close_its_quotes() {
        let mut out = std::vec::Vec::new();
        put_yaml_small("it's \"a\"\n\\\x7fü", &mut |bytes: &[u8]| {
            out.extend_from_slice(bytes)
        });
        let quoted = r#""it's \"a\"\n\\\x7fü""#;
        assert_eq!(std::str::from_utf8(&out), Ok(quoted));
    }

    #[test]
    fn yaml_text_is_ascii_and_cannot_close_its_quotes() {
        for (text, quoted) in [
            ("/base", r#""/base""#),
            (r#"say "hi" \n"#, r#""say \"hi\" \\n""#),
            ("\0\n~\x7f", r#""\U00000000\U0000000a~\U0000007f""#),
            ("ü\u{2028}🤖", r#""\U000000fc\U00002028\U0001f916""#),
        ] {
            let mut out = std::vec::Vec::new();
            put_yaml(text, &mut |bytes: &[u8]| out.extend_from_slice(bytes));
            assert_eq!(std::str::from_utf8(&out), Ok(quoted));
        }
    }
}
