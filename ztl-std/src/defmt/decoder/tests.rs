//! Input that is not a log, or not of this firmware. `tests/gateway/logs.rs` decodes a real log.

use super::*;
use ztl_tests::garbage::Garbage;

fn decoder(encoding: Encoding, texts: &[(bool, &str)]) -> Decoder {
    Decoder {
        table: Arc::new(Table::of_texts(encoding, texts)),
        waiting: Vec::new(),
        skipping: false,
    }
}

fn all(decoder: &mut Decoder, bytes: &[u8]) -> Vec<Result<String, Malformed>> {
    let mut texts = Vec::new();
    decoder.push(bytes, &mut |message| {
        texts.push(message.map(|message| message.text))
    });
    texts
}

/// Encodes bytes as a frame; any seven of them must contain a 0.
fn framed(bytes: &[u8]) -> Vec<u8> {
    let mut frame = Vec::new();
    for group in bytes.chunks(7) {
        let mut mark = 0;
        for place in 0..7 {
            match group.get(place) {
                Some(0) | None => mark |= 1 << place,
                Some(byte) => frame.push(*byte),
            }
        }
        frame.push(mark);
    }
    frame.push(0);
    frame
}

#[test]
fn a_message_is_decoded_however_it_is_split_and_after_damage() {
    let mut log = decoder(Encoding::Rzcobs, &[(true, "{=[u8;6]:a}")]);
    let frame = framed(&[1, 0, b'a', b'b', b'c', b'd', b'e', b'f']);
    let text = Ok("b\"abcdef\"".to_owned());
    for cut in 0..frame.len() {
        let (one, other) = frame.split_at(cut);
        let mut texts = all(&mut log, one);
        texts.extend(all(&mut log, other));
        assert_eq!(texts, std::slice::from_ref(&text), "cut at {cut}");
    }
    // The damaged message is reported, and the next one is decoded.
    for lost in 0..frame.len() - 1 {
        let mut bytes = frame.clone();
        bytes.remove(lost);
        bytes.extend_from_slice(&frame);
        let texts = all(&mut log, &bytes);
        assert_eq!(texts.len(), 2, "without {lost}");
        assert_eq!(texts[1], text, "without {lost}");
    }
    let (one, other) = frame.split_at(4);
    assert_eq!(all(&mut log, one), []);
    log.skip();
    let after = [other, &frame].concat();
    assert_eq!(all(&mut log, &after), [Err(Malformed), text]);
    // A message that never ends is dropped, not stored.
    assert_eq!(all(&mut log, &vec![1; 3 * LONGEST]), []);
    assert!(log.waiting.len() <= LONGEST);
    assert_eq!(all(&mut log, &[0]), [Err(Malformed)]);
}

#[test]
fn messages_without_frame_ends_are_decoded() {
    let mut log = decoder(Encoding::Raw, &[(true, "{=u8} of {=str}"), (true, "done")]);
    let bytes = [1, 0, 7, 3, 0, 0, 0, b'a', b'b', b'c', 2, 0, 1];
    let (first, rest) = bytes.split_at(6);
    assert_eq!(all(&mut log, first), []);
    let both = [Ok("7 of abc".to_owned()), Ok("done".to_owned())];
    assert_eq!(all(&mut log, rest), both);
}

#[test]
fn a_message_that_claims_more_data_than_it_has_is_malformed() {
    let texts = [
        (true, "{=[?]}"),
        (false, "nothing"),
        (true, "{=?}"),
        (false, "{=?}"),
        (true, "{=[?;4000000000]}"),
        (true, "{=[u8;4000000000]}"),
        (true, "{5=u8}"),
    ];
    let log = decoder(Encoding::Raw, &texts);
    let huge = [0xff, 0xff, 0xff, 0xff];
    for bytes in [
        // A list of four billion empty values.
        [&[1, 0][..], &huge, &[2, 0]].concat(),
        // A value that contains itself endlessly.
        [&[3, 0][..], &[4, 0].repeat(100)].concat(),
        vec![5, 0, 2, 0],
        vec![6, 0, 1, 2, 3],
        vec![7, 0, 1, 2, 3, 4, 5, 6, 7],
        vec![9, 0],
        vec![1],
        vec![],
    ] {
        assert_eq!(decode(&log.table, &bytes), None, "{bytes:?}");
    }
}

#[test]
fn no_bytes_cause_a_panic() {
    let kinds = [
        "u8",
        "u16",
        "u32",
        "u64",
        "u128",
        "usize",
        "i8",
        "i16",
        "i32",
        "i64",
        "i128",
        "isize",
        "f32",
        "f64",
        "bool",
        "char",
        "str",
        "istr",
        "[u8]",
        "[u8;3]",
        "?",
        "[?]",
        "[?;2]",
        "0..7",
        "3..20",
        "120..128",
        "0..128",
        "__internal_Debug",
        "__internal_Display",
        "__internal_FormatSequence",
    ];
    let hints = [
        "",
        ":?",
        ":x",
        ":#010X",
        ":b",
        ":#o",
        ":08",
        ":0999999",
        ":a",
        ":us",
        ":ms",
        ":tus",
        ":tms",
        ":ts",
        ":iso8601ms",
        ":iso8601s",
        ":cbor",
        ":unknown",
        ":__internal_bitflags_A@b@c@d",
    ];
    let mut texts = Vec::new();
    for kind in kinds {
        for hint in hints {
            texts.push((texts.len() % 3 > 0, format!("<{{={kind}{hint}}}>")));
        }
    }
    texts.push((false, "A|B({=?})|C {{ x: {=[?]} }}".to_owned()));
    let texts: Vec<(bool, &str)> = texts
        .iter()
        .map(|(message, text)| (*message, text.as_str()))
        .collect();
    let mut numbers = Garbage::new(0x0123_4567_89ab_cdef);
    for encoding in [Encoding::Raw, Encoding::Rzcobs] {
        let mut log = decoder(encoding, &texts);
        for _ in 0..20_000 {
            let message = u16::try_from(1 + numbers.below(texts.len())).expect("few");
            let mut bytes = message.to_le_bytes().to_vec();
            for _ in 0..numbers.below(40) {
                let small = numbers.below(3) > 0;
                let byte = numbers.below(if small { 4 } else { 256 });
                bytes.push(u8::try_from(byte).expect("a byte"));
            }
            let _ = decode(&log.table, &bytes);
            let _ = all(&mut log, &bytes);
        }
    }
}

#[test]
fn other_files_are_rejected() {
    assert_eq!(Decoder::of_elf(b"text").map(|_| ()), Err(ElfError::NotElf));
    // A truncated file must not cause a panic.
    let own = std::env::current_exe()
        .and_then(std::fs::read)
        .expect("this program");
    assert_eq!(Decoder::of_elf(&own).map(|_| ()), Err(ElfError::NoLog));
    for cut in [0, 1, 63, 64, 65, 1000, own.len() / 2, own.len() - 1] {
        let _ = Decoder::of_elf(own.get(..cut).unwrap_or_default());
    }
}
