//! defmt's macros (at the default level) write whole records into the log queue, without the reader's help.
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

/// Logs while it is being formatted; that record is dropped.
struct Chatty;

impl defmt::Format for Chatty {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::error!("within");
        defmt::write!(f, "{=u8}", 0x11);
    }
}

/// Decodes one frame of reverse zero-compressing COBS, as defmt specifies it, without its end mark.
fn decoded(frame: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut bytes = frame.iter().rev().copied();
    while let Some(code) = bytes.next() {
        match code {
            // Seven bytes; those with a set bit are zero.
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
            // End of the frame.
            0x00 => break,
        }
    }
    out.reverse();
    out
}

#[test]
fn records_are_complete_and_dropped_ones_are_counted() {
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
    assert_eq!(bytes.last(), Some(&0), "the last record is complete");
    // All records have the same length, which depends on the address of the format string.
    let records = bytes.split(|byte| *byte == 0).filter(|f| !f.is_empty());
    let len = bytes.len() / records.count();
    assert!(bytes.len() + len > 64, "keeps as many as fit");
    assert_eq!(bytes.len() + lost as usize, 20 * len);
    let mut again = bytes.split(|byte| *byte == 0).filter(|f| !f.is_empty());
    assert!(again.all(|frame| decoded(frame).len() >= 7));
    // There is room again.
    defmt::error!("a number: {=u32}", 5);
    assert_eq!(LOG.lost(), lost);
    assert!(!read().is_empty());
}
