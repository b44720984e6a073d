//! defmt's macros (of the level that is on by default) write whole records into the queue that the node sends, without the reader's help.
#![cfg(feature = "defmt")]

use ztl_mcu::log::{LogQueue, LogSource};

static LOG: LogQueue<64> = LogQueue::new();
ztl_mcu::defmt_logger!(LOG);
defmt::timestamp!("{=u8}", 7);

fn read() -> Vec<u8> {
    let mut buffer = vec![0xA5; 64];
    let count = LOG.read(&mut buffer);
    buffer.truncate(count);
    buffer
}

/// Formats itself by logging, which is not heard.
struct Chatty;

impl defmt::Format for Chatty {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::error!("within");
        defmt::write!(f, "{=u8}", 0x11);
    }
}

/// reverse zero-compressing COBS, as defmt's specification has it, of one frame without its end.
fn decoded(frame: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut bytes = frame.iter().rev().copied();
    while let Some(code) = bytes.next() {
        match code {
            // Seven bytes, of which those with a set bit are zero.
            0x01..=0x7f => {
                for place in 0..7 {
                    let zero = code & (1 << (6 - place)) != 0;
                    out.extend(if zero { Some(0) } else { bytes.next() });
                }
            }
            0x80..=0xfe => {
                let count = usize::from(code & 0x7f) + 7;
                out.push(0);
                out.extend(bytes.by_ref().take(count));
            }
            0xff => out.extend(bytes.by_ref().take(134)),
            // Ends a frame.
            0x00 => break,
        }
    }
    out.reverse();
    out
}

#[test]
fn records_are_whole_and_those_that_do_not_fit_are_counted() {
    defmt::error!("a number: {=u32}", 0x1122_3344);
    defmt::error!("formatted: {}", Chatty);
    let bytes = read();
    let frames: Vec<&[u8]> = bytes
        .split(|byte| *byte == 0)
        .filter(|f| !f.is_empty())
        .collect();
    let [number, chatty] = frames[..] else {
        panic!("two records: {bytes:02x?}");
    };
    let contains = |frame, part: &[u8]| decoded(frame).windows(part.len()).any(|w| w == part);
    assert!(contains(number, &[0x44, 0x33, 0x22, 0x11]), "{bytes:02x?}");
    assert!(contains(number, &[7]), "the timestamp");
    assert!(contains(chatty, &[0x11]), "{bytes:02x?}");
    assert_eq!(LOG.lost(), 0);

    for number in 0..20u32 {
        defmt::error!("a number: {=u32}", 0x0101_0101 * number + 0x2020_2020);
    }
    let lost = LOG.lost();
    let bytes = read();
    assert_eq!(bytes.last(), Some(&0), "the last record is whole");
    // All are of one length, which depends on where the linker puts the text.
    let records = bytes.split(|byte| *byte == 0).filter(|f| !f.is_empty());
    let len = bytes.len() / records.count();
    assert!(bytes.len() + len > 64, "as many as fit are kept");
    assert_eq!(bytes.len() + lost as usize, 20 * len);
    let mut again = bytes.split(|byte| *byte == 0).filter(|f| !f.is_empty());
    assert!(again.all(|frame| decoded(frame).len() >= 7));
    // There is room again.
    defmt::error!("a number: {=u32}", 5);
    assert_eq!(LOG.lost(), lost);
    assert!(!read().is_empty());
}
