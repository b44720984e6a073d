//! Messages that arrive late, or not at all while a session begins.

use super::*;

/// A device with a running task that has refused another one, and what the gateway has received so far.
fn pair_with_a_refused_task() -> (Pair, TaskId, Vec<u8>) {
    let mut lab = Pair::new(1);
    lab.pass(Duration::from_millis(300));
    let id = lab.ask("arm", 600_000);
    lab.ask("arm", 1);
    lab.pass(Duration::from_millis(300));
    assert_eq!(lab.rejected.len(), 1);
    let heard = lab.heard.clone();
    (lab, id, heard)
}

#[test]
fn an_answer_that_arrives_255_commands_later_rejects_no_task() {
    let (mut lab, id, late) = pair_with_a_refused_task();
    // Pings use up most numbers, Starts the rest.
    lab.pass(Duration::from_secs(60));
    let sessions = lab.session.counters().sessions;
    for _ in 0..40 {
        lab.ask("belt", 1);
        lab.session.handle_bytes(lab.now, &late);
        lab.pass(Duration::from_millis(30));
    }
    assert_eq!(lab.rejected.len(), 1, "{:?}", lab.rejected);
    assert_eq!(lab.session.counters().sessions, sessions + 1);
    assert!(!lab.ended.contains_key(&id), "the new session ended a task");
    assert_eq!(lab.ended.len(), 40);
    assert_eq!(lab.session.counters().lost, 0);
    lab.abort(id);
    lab.pass(Duration::from_millis(300));
    lab.check();
}

#[test]
fn an_answer_that_arrives_255_commands_later_answers_no_abort() {
    for pings in 0..20 {
        let (mut lab, id, late) = pair_with_a_refused_task();
        lab.pass(Duration::from_millis(60_000 + 250 * pings));
        lab.abort(id);
        lab.session.handle_bytes(lab.now, &late);
        lab.pass(Duration::from_millis(300));
        assert_eq!(ended(&lab, id).0, State::Aborted);
    }
}

#[test]
fn a_link_that_is_lost_while_a_session_begins_is_told() {
    for is_unplugged in [false, true] {
        let mut lab = Pair::new(1);
        lab.pass(Duration::from_secs(1));
        lab.ask("belt", 600_000);
        lab.pass(Duration::from_millis(100));
        let sessions = lab.session.counters().sessions;
        while lab.session.counters().sessions == sessions {
            lab.settle();
            lab.now = lab.now + Duration::from_micros(50);
        }
        lab.down.lose();
        lab.up.lose();
        lab.trace.clear();
        if is_unplugged {
            lab.session.handle_disconnected();
        }
        for _ in 0..5000 {
            lab.session.handle_timeout(lab.now);
            // The device is off: what the gateway sends is dropped.
            lab.session.poll_transmit();
            while let Some(event) = lab.session.poll_event() {
                lab.note(format!("{event:?}"));
            }
            lab.now = lab.now + Duration::from_millis(2);
        }
        assert_eq!(lab.session.counters().lost, 1, "{is_unplugged}");
        let told = |line: &String| line.contains("not answering");
        assert!(lab.trace.iter().any(told), "{:?}", lab.trace);
    }
}

/// Seed 10733 of the simulation: the gateway took the reset device for the earlier one, and later
/// reported `device was reset` for a running task.
#[test]
fn a_welcome_from_before_a_reset_opens_no_session() {
    let mut lab = Pair::new(1);
    // The device's messages are delayed; it is reset meanwhile.
    lab.up.hold_until(lab.now + Duration::from_millis(800));
    lab.pass(Duration::from_millis(200));
    lab.reset();
    // Its announcement is lost.
    lab.up.cut(lab.now..lab.now + Duration::from_millis(150));
    lab.pass(Duration::from_millis(3000));
    let id = lab.ask("belt", 5000);
    lab.pass(Duration::from_millis(500));
    assert_eq!(lab.accepted.get(&id), Some(&1));
    lab.replug();
    lab.pass(Duration::from_secs(8));
    assert_eq!(ended(&lab, id).0, State::Completed);
    lab.check();
}
