//! The link: any bytes into the decoder; any message through it and back, intact or with a flipped bit.

use ztl_core::link::{
    ADDR_ONLY_NODE, Body, BodyError, Decoder, Frame, FrameError, NO_SESSION, encode, session_key,
    session_number,
};

/// The sessions of the example in `docs/link.md`, so that its frames can be a corpus.
const SESSIONS: [u32; 3] = [
    NO_SESSION,
    0x1122_3344,
    session_key(0x1122_3344, 0xcafe_0001),
];

/// Room for every frame of the second target: more than two COBS blocks.
const ROOM: usize = 600;

/// In frames up to this length every bit is flipped; in longer ones, every 13th.
const EVERY_BIT: usize = 40;

/// Feeds `stream` to a large and a small decoder, and compares with a second implementation.
pub fn stream(stream: &[u8]) {
    feed::<24>(stream);
    feed::<300>(stream);
}

fn feed<const N: usize>(stream: &[u8]) {
    let mut decoder = Decoder::<N>::new();
    let mut chunk = Vec::new();
    for &byte in stream {
        let pushed = decoder.push(byte);
        if byte != 0 {
            assert_eq!(pushed, Ok(false), "a frame ends with its delimiter");
            chunk.push(byte);
            continue;
        }
        match unstuffed(&chunk, N) {
            _ if chunk.is_empty() => assert_eq!(pushed, Ok(false)),
            Err(error) => assert_eq!(pushed, Err(error)),
            Ok(whole) => {
                assert_eq!(pushed, Ok(true));
                assert_frame(&decoder, &whole);
            }
        }
        chunk.clear();
    }
    // After a delimiter, a valid frame is always read.
    let good = wire(
        7,
        &Frame {
            addr: ADDR_ONLY_NODE,
            seq: 3,
            body: Body::Ping,
        },
    );
    let _ = decoder.push(0);
    let (last, before) = good.split_last().expect("a delimiter");
    for &byte in before {
        assert_eq!(decoder.push(byte), Ok(false));
    }
    assert_eq!(decoder.push(*last), Ok(true));
    let (_, frame) = decoder.frame(&[7]).expect("a good frame");
    assert_eq!(frame.body, Body::Ping);
}

fn assert_frame<const N: usize>(decoder: &Decoder<N>, whole: &[u8]) {
    let read = decoder.frame(&SESSIONS);
    let Some((covered, check)) = whole.split_last_chunk::<4>().filter(|(c, _)| c.len() >= 2) else {
        assert_eq!(read, Err(FrameError::Truncated));
        return;
    };
    let check = u32::from_le_bytes(*check);
    let session = SESSIONS
        .iter()
        .position(|session| check == crc(*session, covered));
    match (session, read) {
        (None, read) => assert_eq!(read, Err(FrameError::Check)),
        (Some(_), Err(error)) => {
            let cause = Body::parse(&covered[2..]).expect_err("no message");
            assert_eq!(error, FrameError::Body(cause));
        }
        (Some(expected), Ok((place, frame))) => {
            assert_eq!(place, expected);
            assert_eq!([frame.addr, frame.seq], covered[..2]);
            assert_eq!(written(&frame.body), canonical(&covered[2..]));
        }
    }
}

/// A straightforward COBS decoder.
fn unstuffed(chunk: &[u8], room: usize) -> Result<Vec<u8>, FrameError> {
    let mut whole = Vec::new();
    let mut rest = chunk;
    let mut cut = false;
    while let Some((code, after)) = rest.split_first() {
        let len = usize::from(*code) - 1;
        cut = after.len() < len;
        let (block, after) = after.split_at(len.min(after.len()));
        whole.extend_from_slice(block);
        if *code != 0xff && !after.is_empty() {
            whole.push(0);
        }
        rest = after;
    }
    match (whole.len() > room, cut) {
        (true, _) => Err(FrameError::TooLong),
        (false, true) => Err(FrameError::Truncated),
        (false, false) => Ok(whole),
    }
}

/// CRC-32/ISO-HDLC, bit by bit, over the session and the covered bytes.
fn crc(session: u32, covered: &[u8]) -> u32 {
    let bytes = session.to_le_bytes();
    let mut check = u32::MAX;
    for byte in bytes.iter().chain(covered) {
        check ^= u32::from(*byte);
        for _ in 0..8 {
            let carry = check & 1;
            check >>= 1;
            check ^= 0xedb8_8320 * carry;
        }
    }
    !check
}

/// Reads four bytes as a session, one as a sequence number, and the rest as a body, and sends that over the
/// line.
pub fn frame(bytes: &[u8]) {
    let Some((session, [seq, bytes @ ..])) = bytes.split_first_chunk::<4>() else {
        return;
    };
    let session = u32::from_le_bytes(*session);
    let body = match Body::parse(bytes) {
        Ok(body) => body,
        Err(BodyError::Trailing { extra }) => {
            let whole = bytes.len().checked_sub(extra).expect("within");
            assert!(extra > 0);
            Body::parse(&bytes[..whole]).expect("what is left is a message");
            return;
        }
        Err(BodyError::UnknownTag { tag }) => return assert!(tag > 32),
        Err(_) => return,
    };
    let plain = written(&body);
    assert!(plain.len() <= bytes.len(), "no other encoding is shorter");
    for len in 0..plain.len() {
        assert!(Body::parse(&plain[..len]).is_err(), "cut to {len}");
    }
    if plain.len() > ROOM - 20 {
        return;
    }
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq: *seq,
        body,
    };
    let wire = wire(session, &frame);
    assert!(wire.len() <= plain.len() + 8 + plain.len().saturating_sub(248).div_ceil(254));
    assert_eq!(
        wire.iter().position(|byte| *byte == 0),
        Some(wire.len() - 1)
    );

    let [Ok(read)] = read(session, &wire)[..] else {
        panic!("the frame is lost");
    };
    assert_eq!(read, (ADDR_ONLY_NODE, *seq));
    assert_eq!(self::read(!session, &wire), [Err(FrameError::Check)]);
    flip(session, &wire);
}

/// A flipped bit inside a block is always detected, because the CRC covers it. One that moves the end of a
/// block changes more bits, and is missed once in 2^32. All ones is skipped, because it is not a session
/// (`docs/link.md` 1.5).
fn flip(session: u32, wire: &[u8]) {
    if session != NO_SESSION && session != session_number(session) {
        return;
    }
    let step = if wire.len() <= EVERY_BIT { 1 } else { 13 };
    let mut turned = wire.to_vec();
    turned.push(0);
    for bit in (0..wire.len() * 8).step_by(step) {
        turned[bit / 8] ^= 1 << (bit % 8);
        assert!(
            read(session, &turned).iter().all(Result::is_err),
            "bit {bit}"
        );
        turned[bit / 8] ^= 1 << (bit % 8);
    }
}

/// The frames of a stream, by address and sequence number.
fn read(session: u32, stream: &[u8]) -> Vec<Result<(u8, u8), FrameError>> {
    let mut decoder = Decoder::<ROOM>::new();
    let mut seen = Vec::new();
    for &byte in stream {
        match decoder.push(byte) {
            Ok(false) => {}
            Ok(true) => {
                let frame = decoder.frame(&[session]);
                if let Ok((_, frame)) = &frame {
                    // Writing and parsing it again gives the same.
                    assert_eq!(written(&frame.body), canonical(&written(&frame.body)));
                }
                seen.push(frame.map(|(_, frame)| (frame.addr, frame.seq)));
            }
            Err(error) => seen.push(Err(error)),
        }
    }
    seen
}

fn wire(session: u32, frame: &Frame<'_>) -> Vec<u8> {
    let mut buffer = vec![0xA5; ROOM];
    let len = encode(session, frame, &mut buffer).expect("room");
    let mut tight = vec![0xA5; len];
    assert_eq!(encode(session, frame, &mut tight), Ok(len));
    tight.pop();
    let small = encode(session, frame, &mut tight).expect_err("no room");
    assert_eq!((small.needed, small.available), (len, len - 1));
    buffer.truncate(len);
    buffer
}

fn written(body: &Body<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    body.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}

/// The same message in its shortest form: numbers may have been written with leading zeros.
fn canonical(bytes: &[u8]) -> Vec<u8> {
    written(&Body::parse(bytes).expect("a message"))
}
