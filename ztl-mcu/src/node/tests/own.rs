//! Tasks that the firmware starts itself, its events, and long results.

use super::*;
use crate::{Acting, Reason};

type Own<'t> = Acting<[Motor<'t>; 3]>;

/// Runs `play` against a node whose firmware acts, with three motors: abort, hold and carry on when the link is lost.
fn with_acting(play: impl FnOnce(&mut TestGateway<'_, Own<'_>, 2>, &Trace)) {
    let trace = Trace::default();
    let components = Acting::new([
        motor("a", Loss::Abort, &trace),
        motor("h", Loss::Hold, &trace),
        motor("c", Loss::CarryOn, &trace),
    ]);
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), components);
    play(&mut gateway(&mut node), &trace);
}

const FIRST: LinkId = LinkId::local(1);

impl<C: Components, const TASKS: usize> TestGateway<'_, C, TASKS> {
    fn start_here(&mut self, component: u8, goal: &str) -> Result<u32, Reason> {
        let started = self.node.start_here(self.now, component, goal);
        started.map(|id| id.0)
    }

    fn loose(&mut self, body: Body<'_>) -> Grown<String> {
        self.send(key(self.session), NO_SEQ, body)
    }

    /// All that is said until nothing is due.
    fn heard(&mut self) -> Grown<String> {
        self.pass(0)
    }
}

fn begun(task: u32, component: u8, goal: &str) -> String {
    format!(
        "{:?}",
        Body::Begun {
            task: LinkId(task),
            component,
            goal
        }
    )
}

#[test]
fn a_task_is_announced_until_it_is_noted_and_its_end_until_it_is_acknowledged() {
    with_acting(|gateway, trace| {
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        let id = gateway.start_here(0, "30").unwrap();
        assert_eq!(id, 0x8000_0001);
        assert_eq!(trace.borrow().as_slice(), ["a 30"]);
        let announced = begun(id, 0, "30");
        assert_eq!(gateway.heard()[0], announced);
        assert_eq!(
            gateway
                .pass(99)
                .iter()
                .filter(|line| **line == announced)
                .count(),
            0
        );
        let again = gateway.pass(1);
        assert!(again.contains(&announced), "{again:?}");
        // Noted: its progress or its outcome answers, and a duplicate changes nothing else.
        for _ in 0..2 {
            gateway.loose(Body::Noted { task: LinkId(id) });
            let heard = gateway.pass(100);
            assert!(!heard.contains(&announced), "{heard:?}");
            assert!(
                heard
                    .iter()
                    .any(|line| line.starts_with(&format!("Ended {id} COMPLETED")))
            );
        }
        gateway.loose(Body::Ack { task: LinkId(id) });
        assert_eq!(gateway.pass(500), [""; 0]);
        // Not held any more.
        let gone = gateway.loose(Body::Noted { task: LinkId(id) });
        assert_eq!(
            gone,
            [format!(
                "Ended {id} FAILED the device no longer holds the task"
            )]
        );
        // Nor a task that came from a gateway.
        assert_eq!(gateway.loose(Body::Noted { task: LinkId(3) }), [""; 0]);
    });
}

#[test]
fn an_own_task_is_neither_listed_nor_counted_and_each_session_hears_of_it() {
    with_acting(|gateway, _| {
        gateway.hello(5, 1);
        gateway.start(1, 7, 0, "50000");
        let id = gateway.start_here(2, "50000").unwrap();
        gateway.loose(Body::Noted { task: LinkId(id) });
        assert_eq!(gateway.command(2, Body::Ping)[0], "2 Pong 1");
        let heard = gateway.hello(6, 1);
        assert_eq!(heard[0], "Welcome boot 77 replaces 5 highest 7 [7]");
        assert!(heard.contains(&begun(id, 2, "50000")), "{heard:?}");
        // No gateway can use its number.
        let stale = "a task of this or a later id was started already";
        assert_eq!(
            gateway.start(1, FIRST.0 + 9, 1, "1")[0],
            format!("1 Refused {stale}")
        );
        assert_eq!(
            gateway.command(2, Body::Abort { task: LinkId(id) })[0],
            format!("2 Aborting {id}")
        );
        let heard = gateway.pass(0);
        assert!(
            heard.contains(&format!("Ended {id} ABORTED moving")),
            "{heard:?}"
        );
    });
}

#[test]
fn the_rules_of_a_start_hold_and_without_a_link_only_carry_on_starts() {
    with_acting(|gateway, trace| {
        let no = |refused: Result<u32, Reason>| refused.unwrap_err().as_str().to_string();
        assert_eq!(no(gateway.start_here(0, "30")), "no link");
        assert_eq!(no(gateway.start_here(1, "30")), "no link");
        assert_eq!(no(gateway.start_here(9, "30")), "no such component");
        gateway.node.stop_everything(gateway.now);
        assert_eq!(no(gateway.start_here(0, "30")), "emergency stop");
        gateway.node.clear_stop();
        gateway.node.handle_timeout(gateway.now);
        assert_eq!(no(gateway.start_here(2, "x")), "a number of ms");
        assert_eq!(
            no(gateway.start_here(2, &"1".repeat(49))),
            "the goal is too long: more than 48 bytes"
        );
        assert_eq!(no(gateway.start_here(2, "13")), "not the 13");
        trace.borrow_mut().clear();
        assert_eq!(gateway.start_here(2, "30"), Ok(FIRST.0));
        assert_eq!(no(gateway.start_here(2, "30")), "busy with another task");
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        assert_eq!(gateway.start_here(0, "30"), Ok(FIRST.0 + 1));
        assert_eq!(
            no(gateway.start_here(1, "30")),
            "too many tasks are running"
        );
        assert_eq!(
            gateway.start(2, 1, 1, "30")[0],
            "2 Refused too many tasks are running"
        );
        gateway.pass(30);
        assert_eq!(no(gateway.start_here(1, "30")), "ends not yet acknowledged");
        // The link is lost before the turn that would notice it.
        gateway.now = gateway.now + Duration::from_secs(1);
        assert_eq!(no(gateway.start_here(0, "30")), "no link");
        assert_eq!(trace.borrow().as_slice()[..2], ["c 30", "a 30"]);
    });
}

#[test]
fn a_refusal_here_leaves_the_answer_to_the_gateway_as_it_was() {
    with_acting(|gateway, _| {
        gateway.hello(5, 1);
        let answer = gateway.start(1, 7, 0, "x");
        assert_eq!(answer[0], "1 Refused a number of ms");
        gateway.start_here(1, "30").unwrap();
        assert_eq!(gateway.start(1, 7, 0, "x")[0], answer[0]);
    });
}

#[test]
fn without_a_gateway_ended_tasks_give_up_their_places_and_with_one_they_do_not() {
    with_acting(|gateway, _| {
        for count in 1..20 {
            assert_eq!(gateway.start_here(2, "30"), Ok(FIRST.0 + count - 1));
            gateway.pass(30);
        }
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        let heard = gateway.heard();
        let ended: Grown<&String> = heard
            .iter()
            .filter(|line| line.starts_with("Ended"))
            .collect();
        assert_eq!(ended.len(), 0, "{heard:?}");
        let heard = gateway.pass(100);
        let announced = heard
            .iter()
            .filter(|line| line.starts_with("Begun"))
            .count();
        assert_eq!(announced, 1, "one at a time, in their order: {heard:?}");
        assert_eq!(
            gateway.start_here(2, "30").unwrap_err(),
            "ends not yet acknowledged"
        );
    });
}

#[test]
fn tasks_are_announced_one_at_a_time_in_their_order() {
    with_acting(|gateway, _| {
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        let first = gateway.start_here(0, "50000").unwrap();
        let second = gateway.start_here(1, "50000").unwrap();
        for _ in 0..3 {
            let heard = gateway.pass(100);
            assert!(heard.contains(&begun(first, 0, "50000")), "{heard:?}");
            assert!(!heard.contains(&begun(second, 1, "50000")), "{heard:?}");
        }
        let heard = gateway.loose(Body::Noted {
            task: LinkId(first),
        });
        assert!(heard.contains(&begun(second, 1, "50000")), "{heard:?}");
    });
}

#[test]
fn an_event_is_sent_until_it_is_acknowledged_or_given_up() {
    with_acting(|gateway, _| {
        assert!(gateway.node.report_event(gateway.now, "lid open"));
        gateway.hello(5, 1);
        assert_eq!(gateway.pass(100), [""; 0], "not before the first command");
        let event = |number, text: &str| format!("{:?}", Body::Event { number, text });
        let heard = gateway.command(1, Body::Ping);
        assert_eq!(heard[1..], [event(1, "lid open")]);
        for number in 2..=4 {
            assert!(
                gateway
                    .node
                    .report_event(gateway.now, &format!("event {number}"))
            );
        }
        assert!(!gateway.node.report_event(gateway.now, "no room"));
        assert_eq!(gateway.pass(100), [event(1, "lid open")]);
        // Another one's, an early one's, and its own twice.
        for number in [0, 2, 9] {
            assert_eq!(gateway.loose(Body::EventAck { number }), [""; 0]);
        }
        assert_eq!(
            gateway.loose(Body::EventAck { number: 1 }),
            [event(2, "event 2")]
        );
        assert_eq!(gateway.loose(Body::EventAck { number: 1 }), [""; 0]);
        // An old gateway.
        let mut seq = 1;
        let mut sent = 1;
        for _ in 0..49 {
            gateway.now = gateway.now + Duration::from_millis(100);
            seq += 1;
            sent += gateway
                .command(seq, Body::Ping)
                .iter()
                .filter(|line| **line == event(2, "event 2"))
                .count();
        }
        assert_eq!(sent, 50);
        gateway.now = gateway.now + Duration::from_millis(100);
        assert_eq!(
            gateway.command(seq + 1, Body::Ping)[1..],
            [event(3, "event 3")]
        );
        assert_eq!(gateway.node.events_lost(), 2);
        gateway.node.report_event(gateway.now, &"x".repeat(60));
        gateway.loose(Body::EventAck { number: 3 });
        let last = gateway.loose(Body::EventAck { number: 4 });
        assert_eq!(last, [event(5, &format!("{}…", "x".repeat(48)))]);
    });
}

#[test]
fn a_node_that_waits_as_long_as_it_may_sends_all_in_time() {
    with_acting(|gateway, _| {
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        gateway.node.report_event(gateway.now, "here");
        gateway.start_here(2, "50000").unwrap();
        let (end, mut heard) = (gateway.now + Duration::from_millis(450), Grown::new());
        while gateway.now < end {
            heard.extend(gateway.pass(0));
            gateway.now = gateway.node.poll_timeout(gateway.now).min(end);
        }
        let count = |kind: &str| heard.iter().filter(|line| line.starts_with(kind)).count();
        assert_eq!((count("Begun"), count("Event")), (5, 5), "{heard:?}");
    });
}

/// Completes at once, with a result of any length.
struct Teller {
    told: String,
    next: String,
    busy: Busy,
}

impl Component for Teller {
    fn offer(&self) -> Offer<'_> {
        Offer::new("teller").with_busy(self.busy)
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.told.clear();
        Ok(())
    }

    fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run {
        report.text("short");
        self.told = self.next.clone();
        Run::Completed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}

    fn result(&self) -> &str {
        &self.told
    }
}

fn teller(busy: Busy, next: &str) -> Teller {
    Teller {
        told: String::new(),
        next: next.to_string(),
        busy,
    }
}

fn with_teller(
    busy: Busy,
    next: &str,
    play: impl FnOnce(&mut TestGateway<'_, Acting<[Teller; 1]>, 2>),
) {
    let components = Acting::new([teller(busy, next)]);
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), components);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    play(&mut gateway);
}

#[test]
fn a_long_result_is_the_same_until_it_is_acknowledged_and_delays_the_next_task() {
    let long = "0123456789".repeat(8);
    with_teller(Busy::Queue(1), &long, |gateway| {
        gateway.start(1, 1, 0, "x");
        let ended = format!("Ended 1 COMPLETED {long}");
        assert_eq!(gateway.pass(0), [ended.as_str()]);
        assert_eq!(gateway.start(2, 2, 0, "x")[0], "2 Started 2");
        let heard = gateway.pass(100);
        assert!(heard.contains(&ended), "{heard:?}");
        assert!(
            !heard.iter().any(|line| line.starts_with("Ended 2")),
            "{heard:?}"
        );
        gateway.loose(Body::Ack { task: LinkId(1) });
        assert_eq!(gateway.pass(0), ["Progress 2 "]);
        assert_eq!(gateway.pass(0), [format!("Ended 2 COMPLETED {long}")]);
    });
    with_teller(Busy::Refuse, &long, |gateway| {
        gateway.start(1, 1, 0, "x");
        gateway.pass(0);
        assert_eq!(
            gateway.start(2, 2, 0, "x")[0],
            "2 Refused busy with another task"
        );
        gateway.loose(Body::Ack { task: LinkId(1) });
        assert_eq!(gateway.start(3, 2, 0, "x")[0], "3 Started 2");
    });
}

#[test]
fn a_result_longer_than_a_frame_is_cut_at_a_character_and_marked() {
    let most = Node::<[Teller; 1], 2, 128>::LONGEST_RESULT;
    for (text, told) in [
        ("x".repeat(most), "x".repeat(most)),
        ("x".repeat(most + 1), "x".repeat(most - 3) + "…"),
        ("ä".repeat(most), "ä".repeat((most - 3) / 2) + "…"),
        (String::new(), "short".to_string()),
    ] {
        with_teller(Busy::Refuse, &text, |gateway| {
            gateway.start(1, 1, 0, "x");
            assert_eq!(gateway.pass(0), [format!("Ended 1 COMPLETED {told}")]);
        });
    }
}

#[test]
fn components_without_a_long_result_wait_for_nothing() {
    with_teller(Busy::Refuse, "", |gateway| {
        gateway.start(1, 1, 0, "x");
        assert_eq!(gateway.pass(0), ["Ended 1 COMPLETED short"]);
        assert_eq!(gateway.start(2, 2, 0, "x")[0], "2 Started 2");
    });
}

#[test]
fn components_of_any_collection_have_long_results() {
    #[track_caller]
    fn assert_long(components: impl Components) {
        let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), components);
        let mut gateway = gateway(&mut node);
        gateway.hello(5, 1);
        gateway.start(1, 1, 0, "x");
        assert_eq!(gateway.pass(0), ["Ended 1 COMPLETED long"]);
        let refused = "2 Refused busy with another task";
        assert_eq!(gateway.start(2, 2, 0, "x")[0], refused);
    }
    let long = || teller(Busy::Refuse, "long");
    assert_long([long(), long()]);
    assert_long((long(), long()));
    assert_long(&mut [long()]);
    assert_long((&mut long(), long()));
    let (mut one, mut other) = (long(), long());
    let mut list: [&mut dyn Component; 2] = [&mut one, &mut other];
    assert_long(list.as_mut_slice());
}

#[test]
fn an_old_gateway_acknowledges_ends_and_notes_nothing() {
    with_acting(|gateway, _| {
        gateway.hello(5, 1);
        for seq in 1..20 {
            gateway.command(seq, Body::Ping);
            let id = gateway.start_here(0, "0").unwrap();
            let heard = gateway.pass(0);
            let ended = format!("Ended {id} COMPLETED moving");
            assert!(heard.contains(&ended), "{heard:?}");
            gateway.loose(Body::Ack { task: LinkId(id) });
            assert_eq!(gateway.pass(100), [""; 0]);
        }
    });
}
