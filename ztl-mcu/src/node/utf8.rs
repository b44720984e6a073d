//! Validates UTF-8.

use heapless::string::StringView;

/// Appends these bytes to `text`; `None` if they are not UTF-8 or do not fit, and then only part is appended.
///
/// It works character by character, because `core::str::from_utf8` takes 560 bytes on a Cortex-M0, 256 of them for
/// its table.
pub(crate) fn push_utf8(text: &mut StringView, mut bytes: &[u8]) -> Option<()> {
    while let [first, behind @ ..] = bytes {
        bytes = behind;
        // The number of leading ones is the length of the character, or 0 for ASCII.
        let mut code = u32::from(*first);
        let (mut len, mut bit) = (0, 0x80);
        while code & bit != 0 {
            bit >>= 1;
            len += 1;
        }
        code &= bit.wrapping_sub(1);
        for _ in 1..len {
            let [next @ 0x80..=0xbf, behind @ ..] = bytes else {
                return None;
            };
            bytes = behind;
            code = code << 6 | u32::from(next & 0x3f);
        }
        let mut buffer = [0; 4];
        let character = char::from_u32(code)?.encode_utf8(&mut buffer);
        // Rejects overlong encodings and stray continuation bytes.
        if len
            != if character.len() == 1 {
                0
            } else {
                character.len()
            }
        {
            return None;
        }
        text.push_str(character).ok()?;
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[track_caller]
    fn check(bytes: &[u8]) {
        let mut text = heapless::String::<64>::new();
        let ours = push_utf8(&mut text, bytes).map(|()| text.as_str());
        assert_eq!(ours, core::str::from_utf8(bytes).ok());
    }

    #[test]
    fn characters_are_accepted_and_invalid_bytes_are_not() {
        for letter in [
            '\0',
            'a',
            '\x7f',
            '\u{80}',
            'ä',
            '\u{7ff}',
            '\u{800}',
            '…',
            '\u{d7ff}',
            '\u{e000}',
            '\u{ffff}',
            '🤖',
            char::MAX,
        ] {
            let mut bytes = [0xA5; 4];
            let len = letter.encode_utf8(&mut bytes).len();
            for len in 0..=len {
                check(&bytes[..len]);
            }
        }
        for bytes in [
            &b"\x80"[..],
            b"\xc0\x80",             // overlong
            b"\xe0\x80\x80",         // overlong
            b"\xf0\x8f\xbf\xbf",     // overlong
            b"\xed\xa0\x80",         // a surrogate
            b"\xf4\x90\x80\x80",     // above the last character
            b"\xf8\x88\x80\x80\x80", // five bytes
            b"\xff",
        ] {
            check(bytes);
        }
        let mut short = heapless::String::<3>::new();
        assert_eq!(push_utf8(&mut short, b"abcd"), None);
    }

    proptest! {
        #[test]
        fn agrees_with_core(
            bytes in proptest::collection::vec(any::<u8>(), 0..8),
            starts in "\\PC{0,8}",
            cut in 0..40usize,
        ) {
            check(&bytes);
            check(starts.as_bytes().get(..cut).unwrap_or(starts.as_bytes()));
        }
    }
}
