//! Bytes as a text.

use heapless::string::StringView;

/// Adds the text that these bytes are; `None` when they are not UTF-8, or more than fit. What came before is added.
///
/// Letter by letter: `core::str::from_utf8` takes 560 bytes of a Cortex-M0, of which its table has 256.
#[cfg_attr(target_os = "none", inline(never))]
pub(crate) fn push_bytes(text: &mut StringView, mut bytes: &[u8]) -> Option<()> {
    while let [first, behind @ ..] = bytes {
        bytes = behind;
        // It begins with as many bits as the letter has bytes, or with none, and then a zero.
        let mut letter = u32::from(*first);
        let (mut len, mut bit) = (0, 0x80);
        while letter & bit != 0 {
            bit >>= 1;
            len += 1;
        }
        letter &= bit.wrapping_sub(1);
        for _ in 1..len {
            let [next @ 0x80..=0xbf, behind @ ..] = bytes else {
                return None;
            };
            bytes = behind;
            letter = letter << 6 | u32::from(next & 0x3f);
        }
        let mut buffer = [0; 4];
        let letter = char::from_u32(letter)?.encode_utf8(&mut buffer);
        // Else it was written longer than it has to be, or this was no letter's first byte.
        if len != if letter.len() == 1 { 0 } else { letter.len() } {
            return None;
        }
        text.push_str(letter).ok()?;
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
        let ours = push_bytes(&mut text, bytes).map(|()| text.as_str());
        assert_eq!(ours, core::str::from_utf8(bytes).ok());
    }

    #[test]
    fn each_letter_is_read_and_what_is_none_is_not() {
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
            b"\xc0\x80",             // longer than it has to be
            b"\xe0\x80\x80",         // the same
            b"\xf0\x8f\xbf\xbf",     // the same
            b"\xed\xa0\x80",         // half of a pair
            b"\xf4\x90\x80\x80",     // above the last
            b"\xf8\x88\x80\x80\x80", // five bytes
            b"\xff",
        ] {
            check(bytes);
        }
        let mut short = heapless::String::<3>::new();
        assert_eq!(push_bytes(&mut short, b"abcd"), None);
    }

    proptest! {
        #[test]
        fn bytes_are_a_text_where_they_are_one_for_core(
            bytes in proptest::collection::vec(any::<u8>(), 0..8),
            starts in "\\PC{0,8}",
            cut in 0..40usize,
        ) {
            check(&bytes);
            check(starts.as_bytes().get(..cut).unwrap_or(starts.as_bytes()));
        }
    }
}
