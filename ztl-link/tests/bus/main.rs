//! Sessions and real nodes on one shared line, byte by byte on virtual time.
#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    reason = "helpers of tests may panic"
)]

mod ids;
mod lab;

use std::collections::BTreeMap;
use std::time::Duration;

use lab::{IMAGE, Lab, Trouble};
use ztl_core::link::{BusMessage, Turn};
use ztl_core::{Instant, State};
use ztl_link::bus::{Bus, BusEvent, TURNAROUND};

const SECOND: Duration = Duration::from_secs(1);

/// Starts an endless task on each node, and waits until all run.
fn all_busy(lab: &mut Lab, nodes: u8) {
    lab.until(10 * SECOND, "all are up", |lab| {
        (1..=nodes).all(|at| lab.is_up(at))
    });
    for address in 1..=nodes {
        lab.start(address, u32::from(address), "1 600000");
    }
    lab.until(5 * SECOND, "all tasks run", |lab| {
        (1..=nodes).all(|at| lab.nodes[usize::from(at) - 1].moves())
    });
}

#[test]
fn sixteen_nodes_with_tasks_have_their_turn_every_50_ms() {
    let mut lab = Lab::new(16, 1);
    all_busy(&mut lab, 16);
    // Until all descriptions are read.
    lab.run(SECOND);
    lab.forget_turns();
    lab.run(10 * SECOND);
    for address in 1..=16 {
        let pause = lab.longest_pause(address);
        assert!(pause <= Duration::from_millis(50), "{address}: {pause:?}");
    }
    // All tasks still run: no link was lost.
    for address in 1..=16 {
        assert!(lab.nodes[address - 1].moves(), "{address}");
    }
}

#[test]
fn a_search_leaves_sixteen_nodes_with_tasks_their_turns() {
    let mut lab = Lab::new(16, 4);
    all_busy(&mut lab, 16);
    lab.run(SECOND);
    lab.forget_turns();
    lab.bus_search();
    lab.run(Duration::from_millis(1800));
    for address in 1..=16 {
        let pause = lab.longest_pause(address);
        assert!(pause <= Duration::from_millis(50), "{address}: {pause:?}");
    }
}

#[test]
fn an_update_of_a_node_leaves_fifteen_others_with_tasks_their_turns() {
    let mut lab = Lab::new(16, 7);
    all_busy(&mut lab, 15);
    lab.until(5 * SECOND, "all are up", |lab| lab.is_up(16));
    lab.run(SECOND);
    lab.forget_turns();
    let begin = lab.now();
    lab.update(16);
    lab.until(600 * SECOND, "the image is stored", |lab| {
        lab.stored == IMAGE
    });
    let took = lab.now().since(begin);
    println!("an image of {IMAGE} bytes: {took:?}");
    for address in 1..=15 {
        let pause = lab.longest_pause(address);
        assert!(pause <= Duration::from_millis(50), "{address}: {pause:?}");
        assert!(lab.nodes[usize::from(address) - 1].moves());
    }
    assert!(took < 60 * SECOND, "{took:?}");
}

#[test]
fn an_abort_goes_before_all_polls() {
    let mut lab = Lab::new(16, 2);
    all_busy(&mut lab, 16);
    let mut longest = Duration::ZERO;
    for address in 1..=16u8 {
        // At any phase of the round.
        lab.run(Duration::from_micros(1_234 * u64::from(address)));
        let before = lab.now();
        lab.abort(address, u32::from(address));
        lab.until(SECOND, "it stops", |lab| {
            !lab.nodes[usize::from(address) - 1].moves()
        });
        longest = longest.max(lab.now().since(before));
        lab.until(SECOND, "the outcome", |lab| {
            lab.outcome(u32::from(address)) == Some(State::Aborted)
        });
    }
    // One question that is under way, and its answer.
    assert!(longest <= Duration::from_millis(20), "{longest:?}");
}

#[test]
fn a_node_that_floods_is_silent_or_resets_does_not_stop_the_others() {
    for trouble in [
        Trouble::Floods,
        Trouble::Silent,
        Trouble::Resets,
        Trouble::Babbles,
    ] {
        let mut lab = Lab::new(8, 3);
        all_busy(&mut lab, 7);
        lab.nodes[7].trouble = Some(trouble);
        lab.run(2 * SECOND);
        lab.forget_turns();
        lab.run(5 * SECOND);
        for address in 1..=7u8 {
            let pause = lab.longest_pause(address);
            // Noise takes up to 17 ms, and what it damages is asked again.
            let most = if trouble == Trouble::Babbles { 100 } else { 50 };
            assert!(
                pause <= Duration::from_millis(most),
                "{trouble:?} {address}: {pause:?}"
            );
            assert!(
                lab.nodes[usize::from(address) - 1].moves(),
                "{trouble:?} {address}"
            );
            lab.abort(address, u32::from(address));
            lab.until(3 * SECOND, "the outcome", |lab| {
                lab.outcome(u32::from(address)) == Some(State::Aborted)
            });
        }
        lab.nodes[7].trouble = None;
        lab.until(10 * SECOND, "it serves again", |lab| lab.is_up(8));
    }
}

/// A board is switched on at the address of one that moves.
fn second_board(carries_on: bool) -> Lab {
    let mut lab = Lab::new(2, 5);
    for node in &lab.nodes {
        node.world.borrow_mut().carries_on = carries_on;
    }
    all_busy(&mut lab, 2);
    lab.run(SECOND);
    lab.add_node(1);
    lab.nodes[2].world.borrow_mut().carries_on = carries_on;
    lab
}

#[test]
fn a_second_board_at_the_address_of_a_moving_one_ends_no_task_and_an_abort_stops_it() {
    let mut lab = second_board(false);
    lab.run(10 * SECOND);
    assert_eq!(lab.outcome(1), None);
    assert!(lab.nodes[0].moves());
    // The answers to polls collide.
    assert!(lab.bus_events.contains(&BusEvent::Garbled(1)));
    lab.abort(1, 1);
    lab.until(SECOND, "it stops", |lab| !lab.nodes[0].moves());
    // Its outcome arrives when the other board is gone.
    lab.nodes[2].trouble = Some(Trouble::Silent);
    lab.until(5 * SECOND, "the outcome", |lab| {
        lab.outcome(1) == Some(State::Aborted)
    });
}

#[test]
fn a_board_that_answers_for_an_unreachable_one_ends_its_tasks_only_when_they_must_have_ended() {
    let mut lab = second_board(false);
    // The wires of the one that moves are broken; the other one has the line for itself.
    lab.nodes[0].trouble = Some(Trouble::Cut);
    lab.until(5 * SECOND, "the other one serves", |lab| {
        assert!(lab.outcome(1).is_none() || !lab.nodes[0].moves());
        lab.outcome(1) == Some(State::Failed) && lab.is_up(1)
    });
    // Two searches that find another board prove nothing about the first one.
    let mut lab = second_board(true);
    lab.nodes[0].trouble = Some(Trouble::Cut);
    lab.until(5 * SECOND, "the other one serves", |lab| {
        lab.other_boards > 0 && lab.is_up(1)
    });
    lab.abort(1, 1);
    for _ in 0..4 {
        lab.found(1, false);
        lab.run(SECOND);
    }
    assert_eq!(lab.outcome(1), None);
    assert!(lab.nodes[0].moves());
    // The other one takes tasks of its own, and no Abort of another board's.
    lab.start(1, 77, "2 100");
    lab.until(5 * SECOND, "it ends", |lab| {
        lab.outcome(77) == Some(State::Completed)
    });
    // The first one is reached again: only then is it stopped.
    lab.nodes[0].trouble = None;
    lab.nodes[2].trouble = Some(Trouble::Silent);
    lab.until(10 * SECOND, "it is stopped", |lab| {
        lab.outcome(1) == Some(State::Aborted)
    });
    assert!(!lab.nodes[0].moves());
}

#[test]
fn a_reset_on_a_shared_line_is_told_when_it_is_certain() {
    let mut lab = Lab::new(2, 6);
    all_busy(&mut lab, 2);
    lab.reset(0, 1);
    lab.until(3 * SECOND, "it has failed", |lab| {
        lab.outcome(1) == Some(State::Failed)
    });
    lab.until(SECOND, "it serves", |lab| lab.is_up(1));
    let mut lab = Lab::new(2, 6);
    lab.nodes[0].world.borrow_mut().carries_on = true;
    all_busy(&mut lab, 2);
    lab.reset(0, 1);
    lab.run(4 * SECOND);
    assert!(lab.is_up(1));
    // The first of two searches may have begun before the reset.
    lab.found(1, true);
    lab.run(SECOND);
    assert_eq!(lab.outcome(1), None);
    lab.found(1, false);
    lab.found(1, true);
    lab.run(SECOND);
    assert_eq!(lab.outcome(1), None);
    // Meanwhile the session has had all its commands; the next one is with the same boot.
    let (sessions, told) = (lab.sessions(1), lab.other_boards);
    while lab.sessions(1) == sessions {
        lab.update(1);
        lab.run(SECOND);
    }
    assert_eq!((lab.outcome(1), lab.other_boards), (None, told));
    lab.found(1, true);
    lab.until(SECOND, "it has failed", |lab| {
        lab.outcome(1) == Some(State::Failed)
    });
}

#[test]
fn on_a_bad_line_every_task_is_begun_once_and_its_outcome_is_true() {
    for seed in 0..8 {
        let mut lab = Lab::new(4, seed);
        lab.until(10 * SECOND, "all are up", |lab| {
            (1..=4).all(|at| lab.is_up(at))
        });
        lab.corrupt_one_in(200);
        for task in 0..40u32 {
            let address = (task % 4 + 1) as u8;
            lab.start(address, 100 + task, &format!("{task} 60"));
            lab.run(Duration::from_millis(u64::from(task * 7 % 90)));
            if task % 5 == 0 {
                lab.abort(address, 100 + task);
            }
        }
        lab.corrupt_one_in(0);
        lab.until(20 * SECOND, "all have ended", |lab| {
            (0..40).all(|task| lab.outcome(100 + task).is_some())
        });
        for task in 0..40 {
            lab.judge(100 + task, &format!("{task} 60"));
        }
    }
}

#[test]
fn a_search_finds_all_nodes_gives_addresses_and_names_two_with_one_address() {
    for seed in 0..4 {
        let mut lab = Lab::empty(seed);
        // 12 with addresses, of which two are equal, and 20 without.
        let mut ids = Vec::new();
        for number in 0..32u8 {
            let address = match number {
                0..12 => number.max(1),
                _ => 0,
            };
            ids.push(lab.add_node(address));
        }
        lab.corrupt_one_in(if seed % 2 == 0 { 0 } else { 3000 });
        lab.bus_search();
        let mut found = Vec::new();
        lab.until(60 * SECOND, "the search ends", |lab| {
            match lab
                .bus_events
                .iter()
                .find(|event| matches!(event, BusEvent::Found(_)))
            {
                Some(BusEvent::Found(all)) => {
                    found.clone_from(all);
                    true
                }
                _ => false,
            }
        });
        let mut addresses: Vec<u8> = found.iter().map(|node| node.address).collect();
        addresses.sort_unstable();
        if seed % 2 == 0 {
            assert_eq!(found.len(), 32, "{seed}: {found:?}");
            for id in ids {
                let node = found.iter().find(|node| node.id == id).unwrap();
                assert_eq!(lab.address_of(id), node.address);
            }
            assert_eq!(addresses.iter().filter(|&&at| at == 1).count(), 2);
            addresses.dedup();
            // The nodes without an address have the highest ones.
            let all: Vec<u8> = (1..=11).chain(13..=32).collect();
            assert_eq!(addresses, all);
        } else {
            // Noise hides a node at worst; another search finds it.
            assert!(found.len() >= 28, "{}", found.len());
        }
    }
}

/// What the next search finds, by ids.
fn searched(lab: &mut Lab) -> BTreeMap<u64, u8> {
    lab.bus_events.clear();
    lab.bus_search();
    lab.until(10 * SECOND, "the search ends", |lab| {
        !lab.bus_events.is_empty()
    });
    let events = lab.bus_events.iter();
    let found = events.filter_map(|event| match event {
        BusEvent::Found(found) => Some(found),
        _ => None,
    });
    let nodes = found.flatten().map(|node| (node.id, node.address));
    nodes.collect()
}

#[test]
fn a_node_that_is_switched_on_later_keeps_its_own_address() {
    // One with a low address, and one with the address that the gateway gives first.
    for own in [1, 32] {
        let mut lab = Lab::empty(u64::from(own));
        let without = lab.add_node(0);
        let first = searched(&mut lab);
        assert_eq!(first, BTreeMap::from([(without, 32)]));
        let strapped = lab.add_node(own);
        let wanted = if own == 32 { 31 } else { 32 };
        // The node with a switch keeps its address, and the other one gives way if need be.
        for _ in 0..2 {
            let found = searched(&mut lab);
            assert_eq!(found, BTreeMap::from([(without, wanted), (strapped, own)]));
        }
        assert_eq!(lab.address_of(without), wanted);
        assert_eq!(lab.address_of(strapped), own);
    }
}

#[test]
fn two_nodes_with_addresses_of_their_own_keep_them() {
    let mut lab = Lab::empty(3);
    let nodes = [lab.add_node(32), lab.add_node(32)];
    let found = searched(&mut lab);
    assert_eq!(found, nodes.into_iter().map(|id| (id, 32)).collect());
}

/// Asks the next question of a search, which this node answers.
fn answered(bus: &mut Bus, now: &mut Instant, id: u64, address: u8) {
    *now = *now + Duration::from_millis(1);
    bus.poll_transmit(*now).unwrap();
    let mut frame = [0; 32];
    let here = BusMessage::Here { id, name: "arm" };
    let len = here.encode(address, &mut frame).unwrap();
    bus.handle_bytes(*now, &frame[..len]);
}

#[test]
fn a_late_answer_to_a_search_lists_no_node_twice() {
    let mut bus = Bus::new(115_200, TURNAROUND);
    let mut now = Instant::from_millis(1);
    bus.search(now);
    // The node answers the first question, and the next two with what was late.
    answered(&mut bus, &mut now, 7, 3);
    answered(&mut bus, &mut now, 7, 3);
    answered(&mut bus, &mut now, 7, 3);
    answered(&mut bus, &mut now, 7, 3);
    let mut event = None;
    for _ in 0..20 {
        now = now + Duration::from_millis(50);
        bus.handle_timeout(now);
        event = event.or_else(|| bus.poll_event());
        bus.poll_transmit(now);
    }
    let Some(BusEvent::Found(found)) = event else {
        panic!("{event:?}");
    };
    assert_eq!(found.len(), 1, "{found:?}");
}

#[test]
fn a_node_that_takes_no_address_ends_no_search_late() {
    let mut bus = Bus::new(115_200, TURNAROUND);
    let mut now = Instant::from_millis(1);
    bus.search(now);
    answered(&mut bus, &mut now, 7, 0);
    answered(&mut bus, &mut now, 7, 0);
    // No other node answers.
    for _ in 0..2 {
        now = now + Duration::from_millis(1);
        bus.poll_transmit(now).unwrap();
        now = now + Duration::from_millis(50);
        bus.handle_timeout(now);
    }
    assert_eq!(bus.poll_event(), None);
    answered(&mut bus, &mut now, 7, 0);
    answered(&mut bus, &mut now, 7, 0);
    let found = bus.poll_event();
    assert!(
        matches!(&found, Some(BusEvent::Found(found)) if found.len() == 1 && found[0].address == 0),
        "{found:?}"
    );
}

#[test]
fn the_answer_to_a_poll_keeps_a_command_that_is_repeated() {
    // The address, a sequence number and a tag that is not urgent.
    let command = [5, 1, 7, 1, 9, 0];
    let mut bus = Bus::new(115_200, TURNAROUND);
    bus.add(Instant::ZERO, 1);
    bus.queue(Instant::ZERO, 1, &command);
    let asked = bus.poll_transmit(Instant::ZERO).unwrap();
    assert!(asked.ends_with(&command));
    // No answer arrives; a poll is due before the repetition.
    let later = Instant::from_millis(300);
    bus.handle_timeout(later);
    bus.queue(later, 1, &command);
    let later = Instant::from_millis(310);
    let asked = bus.poll_transmit(later).unwrap();
    assert!(asked.ends_with(&Turn::Poll.encode(1)));
    bus.handle_bytes(later, &Turn::Idle.encode(1));
    let asked = bus.poll_transmit(Instant::from_millis(320)).unwrap();
    assert!(asked.ends_with(&command), "{asked:?}");
}

#[test]
fn damaged_answers_of_a_search_take_no_longer_than_none() {
    let none = |bus: &mut Bus| {
        bus.search(Instant::ZERO);
        bus.poll_transmit(Instant::ZERO).unwrap();
        bus.poll_timeout().unwrap()
    };
    let mut bus = Bus::new(115_200, TURNAROUND);
    let silent = none(&mut bus);
    // Two nodes answer at once, half a millisecond after the question, and no byte is a delimiter.
    let mut bus = Bus::new(115_200, TURNAROUND);
    none(&mut bus);
    for millis in 3..6 {
        bus.handle_bytes(Instant::from_millis(millis), &[0x55; 10]);
    }
    assert_eq!(bus.poll_timeout().unwrap(), silent);
}

/// Asks the node at the address 1, which answers like this.
fn polled(bus: &mut Bus, now: &mut Instant, answer: &[u8]) -> Option<BusEvent> {
    *now = *now + SECOND;
    bus.handle_timeout(*now);
    bus.poll_transmit(*now).unwrap();
    bus.handle_bytes(*now, answer);
    *now = *now + SECOND;
    bus.handle_timeout(*now);
    bus.poll_event()
}

#[test]
fn a_bus_is_answered_while_a_node_answers_intact() {
    let mut bus = Bus::new(115_200, TURNAROUND);
    let mut now = Instant::ZERO;
    bus.add(now, 1);
    let idle = Turn::Idle.encode(1);
    assert!(!bus.is_answered());
    for bad in [&[][..], &[7, 7, 0]] {
        polled(&mut bus, &mut now, bad);
        polled(&mut bus, &mut now, &idle);
        assert!(bus.is_answered());
        for _ in 0..2 {
            polled(&mut bus, &mut now, bad);
            assert!(bus.is_answered());
        }
        polled(&mut bus, &mut now, bad);
        assert!(!bus.is_answered(), "{bad:?}");
    }
}

#[test]
fn answers_that_are_damaged_now_and_then_are_told_once() {
    let mut bus = Bus::new(115_200, TURNAROUND);
    let mut now = Instant::ZERO;
    bus.add(now, 1);
    let mut told = Vec::new();
    for _ in 0..10 {
        for answer in [&[7, 7, 0][..]; 4] {
            told.extend(polled(&mut bus, &mut now, answer));
        }
        told.extend(polled(&mut bus, &mut now, &Turn::Idle.encode(1)));
    }
    assert_eq!(told, [BusEvent::Garbled(1)]);
    for _ in 0..30 {
        told.extend(polled(&mut bus, &mut now, &Turn::Idle.encode(1)));
    }
    assert_eq!(told, [BusEvent::Garbled(1), BusEvent::Intact(1)]);
}

#[test]
fn a_node_that_sends_all_the_time_is_noise_and_not_several_nodes_with_one_id() {
    // It begins after a node was found, or from the beginning.
    for named in [true, false] {
        let mut bus = Bus::new(115_200, TURNAROUND);
        let mut now = Instant::from_millis(1);
        bus.search(now);
        if named {
            answered(&mut bus, &mut now, 7, 3);
            answered(&mut bus, &mut now, 7, 3);
        }
        let mut event = None;
        while event.is_none() {
            now = now + Duration::from_millis(50);
            bus.handle_timeout(now);
            bus.poll_transmit(now);
            bus.handle_bytes(now, &[0x55, 0xaa, 0]);
            event = bus.poll_event();
        }
        let found = match event {
            Some(BusEvent::Found(found)) => found.iter().map(|node| node.id).collect(),
            _ => Vec::new(),
        };
        assert_eq!(found, if named { vec![7] } else { vec![] });
    }
}

#[test]
fn a_line_that_is_opened_again_keeps_the_addresses_that_were_given() {
    let mut lab = Lab::empty(32);
    let without = lab.add_node(0);
    assert_eq!(searched(&mut lab), BTreeMap::from([(without, 32)]));
    lab.reopen();
    // Its nodes answer the first search.
    assert_eq!(searched(&mut lab), BTreeMap::from([(without, 32)]));
    let strapped = lab.add_node(32);
    searched(&mut lab);
    let found = searched(&mut lab);
    assert_eq!(found, BTreeMap::from([(without, 31), (strapped, 32)]));
}
