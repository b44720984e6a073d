//! Ids that several nodes have, and nodes that move.

use std::collections::BTreeMap;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{BusMessage, Decoder, Turn};
use ztl_link::bus::{Bus, BusEvent, TURNAROUND};

use crate::lab::{Lab, Trouble};
use crate::searched;

#[test]
fn several_nodes_with_one_id_are_named() {
    let mut lab = Lab::empty(1);
    let id = lab.add_node(1);
    lab.add_twin(1);
    let found = searched(&mut lab);
    assert_eq!(found, BTreeMap::from([(id, 0)]));
}

/// What a search finds if these nodes have the id 7, and only the one at `first` is heard when both are asked.
fn found(bus: &mut Bus, now: &mut Instant, there: &[u8], first: u8) -> Vec<u8> {
    bus.search(*now);
    let mut is_found = false;
    loop {
        assert!(
            *now < Instant::from_millis(600_000),
            "the search does not end"
        );
        *now = *now + Duration::from_millis(50);
        bus.handle_timeout(*now);
        let mut all = Vec::new();
        while let Some(event) = bus.poll_event() {
            if let BusEvent::Found(found) = event {
                all.extend(found);
                return all.iter().map(|node| node.address).collect();
            }
        }
        let mut decoder = Decoder::<200>::new();
        for byte in bus.poll_transmit(*now).unwrap_or_default() {
            if decoder.push(byte) != Ok(true) {
                continue;
            }
            let asks = match decoder.bus_message() {
                Ok((_, BusMessage::Search { bits, prefix, .. })) => {
                    !is_found && BusMessage::matches(7, bits, prefix)
                }
                Ok((_, BusMessage::Assign { id, .. })) => id == 7,
                _ => false,
            };
            if asks {
                is_found = matches!(decoder.bus_message(), Ok((_, BusMessage::Assign { .. })));
                let mut frame = [0; 32];
                let here = BusMessage::Here { id: 7, name: "arm" };
                let len = here.encode(first, &mut frame).unwrap();
                bus.handle_bytes(*now, &frame[..len]);
            }
            if let Some((address, Turn::Poll)) = decoder.turn()
                && there.contains(&address)
            {
                bus.handle_bytes(*now, &Turn::Idle.encode(address));
            }
        }
    }
}

#[test]
fn a_node_is_found_at_another_address_only_when_the_one_before_is_silent() {
    let mut bus = Bus::new(115_200, TURNAROUND);
    let mut now = Instant::from_millis(1);
    assert_eq!(found(&mut bus, &mut now, &[1, 3], 1), [1]);
    assert!(!bus.doubts(1) && !bus.doubts(3));
    // Both answer: address 0 stands for several nodes. It stays so, whichever of them is heard.
    for first in [3, 3, 1, 1, 3] {
        assert_eq!(found(&mut bus, &mut now, &[1, 3], first), [0], "{first}");
        assert!(bus.doubts(1) && bus.doubts(3));
    }
    bus.reopen();
    assert_eq!(found(&mut bus, &mut now, &[1, 3], 1), [0]);
    assert_eq!(found(&mut bus, &mut now, &[3], 3), [3]);
    assert!(!bus.doubts(1) && !bus.doubts(3));
    assert_eq!(found(&mut bus, &mut now, &[1], 1), [1]);
}

#[test]
fn a_node_that_has_moved_is_found_by_the_first_search() {
    let mut lab = Lab::empty(1);
    let id = lab.add_node(1);
    searched(&mut lab);
    lab.nodes[0].trouble = Some(Trouble::Silent);
    lab.add_twin(3);
    assert_eq!(searched(&mut lab), BTreeMap::from([(id, 3)]));
    // Another node takes its place.
    lab.add_node(1);
    assert_eq!(searched(&mut lab).get(&id), Some(&3));
}
