//! The messages of a shared line, and the gateway's end of it on any bytes.

use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{ADDR_MOST, BusMessage, Decoder, Turn};
use ztl_link::bus::{Bus, BusEvent, TURNAROUND};

/// Longest pause between two pieces, in milliseconds.
const PAUSE: u64 = 20;
/// Questions after which a search must have ended, each with its longest answer.
const SEARCH: u64 = 100_000;

/// Reads the bytes as a message, and then as pieces of a line: the pause before one in milliseconds, its length, its bytes.
pub fn bus(bytes: &[u8]) {
    message(bytes);
    line(bytes);
}

fn message(bytes: &[u8]) {
    let Ok(message) = BusMessage::parse(bytes) else {
        return;
    };
    let mut written = Vec::new();
    message.put(&mut |piece: &[u8]| written.extend_from_slice(piece));
    assert!(written.len() <= bytes.len(), "no other encoding is shorter");
    assert_eq!(BusMessage::parse(&written), Ok(message));
    let mut buffer = vec![0; written.len() + 16 + written.len() / 254];
    let len = message.encode(7, &mut buffer).expect("it fits");
    let mut decoder = Decoder::<600>::new();
    let ends: Vec<_> = buffer[..len]
        .iter()
        .map(|&byte| decoder.push(byte))
        .collect();
    if written.len() + 6 <= 600 {
        assert_eq!(ends.last(), Some(&Ok(true)));
        assert_eq!(decoder.bus_message(), Ok((7, message)));
        assert_eq!(decoder.turn(), None);
    }
}

fn line(mut rest: &[u8]) {
    let mut now = Instant::from_millis(1);
    let mut bus = Bus::new(115_200, TURNAROUND);
    for address in 1..=3 {
        bus.add(now, address);
        bus.queue(now, address, &Turn::Poll.encode(address));
    }
    bus.search(now);
    let mut searching = true;
    while let [pause, len, after @ ..] = rest {
        let (piece, after) = after.split_at(usize::from(*len).min(after.len()));
        rest = after;
        now = now + Duration::from_millis(u64::from(*pause) % PAUSE);
        searching &= !step(&mut bus, now).1;
        bus.handle_bytes(now, piece);
        searching &= !step(&mut bus, now).1;
    }
    // On a silent line the search ends, and each node is asked again.
    let mut asked = [false; 4];
    for _ in 0..SEARCH {
        let (questions, ended) = step(&mut bus, now);
        searching &= !ended;
        let mut decoder = Decoder::<64>::new();
        for byte in questions {
            if decoder.push(byte) == Ok(true)
                && let Some((address, Turn::Poll)) = decoder.turn()
            {
                asked[usize::from(address)] = true;
            }
        }
        if asked[1..] == [true; 3] && !searching {
            return;
        }
        let wake = bus.poll_timeout().expect("nodes are asked for ever");
        now = wake.max(now);
    }
    panic!("asked {asked:?}, searching {searching}");
}

/// Returns what is sent, and whether a search has ended.
fn step(bus: &mut Bus, now: Instant) -> (Vec<u8>, bool) {
    bus.handle_timeout(now);
    while bus.poll_frame().is_some() {}
    let mut ended = false;
    while let Some(event) = bus.poll_event() {
        ended |= event == BusEvent::Noise;
        if let BusEvent::Found(found) = event {
            assert!(found.iter().all(|node| node.name.len() <= 600));
            assert!(
                found
                    .iter()
                    .all(|node| node.address <= ADDR_MOST || !node.name.is_empty())
            );
            ended = true;
        }
    }
    (bus.poll_transmit(now).unwrap_or_default(), ended)
}
