//! Server-Sent Events (`ztl-serve/src/http/sse.rs`): any bytes that a robot sends.
//!
//! The first byte says how the rest is cut into pieces.

use peak_alloc::PeakAlloc;

#[path = "../../ztl-serve/src/http/sse.rs"]
mod reader;

use reader::{SseEvent, SseReader, TooLong};

/// The most bytes of a line and of an event. Short, so that inputs reach it.
const LONGEST: usize = 64;
/// What the reader may take: a line, a name and data, each in a buffer that doubles.
const MOST: usize = 16 * LONGEST;

/// The name and the data of an event.
type Found = (Option<String>, Vec<u8>);

/// Any input. The allocator is that of the program.
pub fn check(bytes: &[u8], allocator: &PeakAlloc) {
    let Some((cut, bytes)) = bytes.split_first() else {
        return;
    };
    let whole = read(bytes, bytes.len().max(1), allocator);
    let pieces = read(bytes, usize::from(*cut).max(1), allocator);
    assert_eq!(whole, pieces, "it depends on how the bytes are cut");
    if let Ok(events) = &whole {
        // A second reader, of whole texts.
        assert_eq!(*events, simple(bytes));
    }
}

/// The events, or that something is too long.
fn read(bytes: &[u8], step: usize, allocator: &PeakAlloc) -> Result<Vec<Found>, TooLong> {
    let mut reader = SseReader::new(LONGEST);
    let mut events = Vec::new();
    let before = allocator.current_usage();
    allocator.reset_peak_usage();
    let mut kept = 0;
    for piece in bytes.chunks(step) {
        reader.push(piece, |SseEvent { name, data }| {
            assert!(data.len() <= LONGEST, "{} bytes of data", data.len());
            let length = name.as_ref().map_or(0, String::len);
            assert!(length <= LONGEST, "a name of {length} bytes");
            kept += data.capacity() + name.as_ref().map_or(0, String::capacity);
            events.push((name, data));
        })?;
    }
    let listed = 2 * events.capacity() * size_of::<Found>();
    let peak = allocator.peak_usage().saturating_sub(before);
    assert!(peak <= MOST + kept + listed, "it takes {peak} bytes");
    Ok(events)
}

/// The same by the words of the standard: lines first, then fields.
fn simple(bytes: &[u8]) -> Vec<Found> {
    let mut lines = vec![Vec::new()];
    let mut bytes = bytes.iter().peekable();
    while let Some(byte) = bytes.next() {
        if *byte == b'\r' {
            bytes.next_if(|next| **next == b'\n');
        }
        match (byte, lines.last_mut()) {
            (b'\r' | b'\n', _) | (_, None) => lines.push(Vec::new()),
            (byte, Some(line)) => line.push(*byte),
        }
    }
    // The last one has no end.
    lines.pop();
    if let Some(first) = lines.first_mut()
        && first.starts_with(b"\xef\xbb\xbf")
    {
        first.drain(..3);
    }
    let mut events = Vec::new();
    let (mut name, mut data) = (None, Vec::new());
    for line in lines {
        if line.is_empty() {
            if !data.is_empty() {
                events.push((name.take(), data.join(&b'\n')));
            }
            (name, data) = (None, Vec::new());
            continue;
        }
        let mut parts = line.splitn(2, |byte| *byte == b':');
        let field = parts.next().unwrap_or_default();
        let value = parts.next().unwrap_or_default();
        let value = value.strip_prefix(b" ").unwrap_or(value);
        match field {
            b"event" => {
                let text = String::from_utf8_lossy(value).into_owned();
                name = Some(text).filter(|text| !text.is_empty());
            }
            b"data" => data.push(value.to_vec()),
            _ => {}
        }
    }
    events
}
