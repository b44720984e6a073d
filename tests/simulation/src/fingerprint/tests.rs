//! Tests of fingerprints.

use super::*;

#[derive(Debug)]
struct Shown {
    session: u32,
    seq: u8,
    #[expect(dead_code, reason = "only shown")]
    bytes: [u8; 2],
    at: Option<Instant>,
    clock: Option<(u64, Instant)>,
    text: &'static str,
}

fn shown() -> Shown {
    Shown {
        session: 0x0501,
        seq: 17,
        bytes: [1, 2],
        at: Some(Instant::from_millis(900)),
        clock: Some((400, Instant::from_millis(1000))),
        text: "a \"seq: 7\"",
    }
}

fn of(parts: &[&Shown], now: u64) -> u64 {
    let origin = Origin {
        now: Instant::from_millis(now),
        node: Instant::from_millis(now - 500),
    };
    let mut print = Fingerprint::new(origin);
    for part in parts {
        print.add(part);
    }
    print.finish()
}

#[test]
fn the_fingerprint_ignores_completed_pings() {
    let before = shown();
    let after = Shown {
        session: 0x0901,
        seq: 43,
        bytes: [3, 4],
        at: Some(Instant::from_millis(5900)),
        // Heard later, and as right as before.
        clock: Some((4900, Instant::from_millis(5500))),
        text: before.text,
    };
    assert_eq!(of(&[&before], 1000), of(&[&after], 6000));
}

/// The fingerprint of parts with these sessions and sequence numbers.
fn numbered<const PARTS: usize>(numbers: [(u32, u8); PARTS]) -> u64 {
    let parts = numbers.map(|(session, seq)| Shown {
        session,
        seq,
        ..shown()
    });
    of(&parts.each_ref(), 1000)
}

#[test]
fn the_fingerprint_compares_sequence_numbers_of_a_session() {
    let (one, two) = (0x0501, 0x0601);
    let same = numbered([(one, 17), (one, 16), (two, 90), (two, 91)]);
    assert_eq!(numbered([(one, 57), (one, 56), (two, 30), (two, 31)]), same);
    assert_ne!(numbered([(one, 57), (one, 57), (two, 30), (two, 31)]), same);
    assert_ne!(numbered([(one, 57), (one, 56), (two, 30), (two, 30)]), same);
    // Long ago.
    assert_eq!(
        numbered([(one, 57), (one, 40)]),
        numbered([(one, 57), (one, 30)])
    );
    // First and last ones, even of another session.
    assert_ne!(numbered([(two, 1)]), numbered([(two, 2)]));
    assert_ne!(numbered([(two, 254)]), numbered([(two, 255)]));
    assert_ne!(
        numbered([(one, 57), (one, 1)]),
        numbered([(one, 57), (one, 2)])
    );
    // The numbers of a faulty gateway begin again.
    assert_ne!(
        numbered([(one, 255), (one, 1)]),
        numbered([(one, 255), (one, 2)])
    );
}

#[test]
fn the_fingerprint_includes_relevant_fields() {
    let same = of(&[&shown()], 1000);
    let differ = |change: fn(&mut Shown)| {
        let mut other = shown();
        change(&mut other);
        assert_ne!(of(&[&other], 1000), same, "{other:?}");
    };
    differ(|s| s.seq = 0);
    differ(|s| s.seq = 2);
    differ(|s| s.session = 0x0502);
    differ(|s| s.session = 0);
    differ(|s| s.at = None);
    differ(|s| s.at = Some(Instant::from_millis(901)));
    differ(|s| s.clock = Some((401, Instant::from_millis(1000))));
    differ(|s| s.clock = Some((400, Instant::from_millis(1001))));
    differ(|s| s.text = "a \"seq: 8\"");
    // Two parts of one session, and of two.
    let (one, mut two) = (shown(), shown());
    two.session = 0x0601;
    assert_ne!(of(&[&one, &one], 1000), of(&[&one, &two], 1000));
}

#[test]
fn the_fingerprint_ignores_the_distant_past() {
    let past = |millis| {
        let mut state = shown();
        state.at = Some(Instant::from_millis(millis));
        state.clock = None;
        of(&[&state], 100_000)
    };
    assert_eq!(past(0), past(97_000));
    assert_ne!(past(97_000), past(97_500));
}

#[derive(Debug, Clone, Copy)]
enum Phase {
    Greeting,
    Up,
}

#[derive(Debug, Clone, Copy)]
enum Stage {
    Waiting,
    Running(#[expect(dead_code, reason = "only shown")] u32),
}

#[derive(Debug, Clone)]
#[expect(dead_code, reason = "only shown")]
struct ShownSession {
    phase: Phase,
    sent: Instant,
    tasks: Vec<(&'static str, ShownTask)>,
    clock: Option<(u64, Instant)>,
    commanded: Instant,
    heard: Instant,
}

#[derive(Debug, Clone)]
#[expect(dead_code, reason = "only shown")]
struct ShownTask {
    deadline: Instant,
    stage: Stage,
}

const fn millis(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn session(phase: Phase) -> ShownSession {
    ShownSession {
        phase,
        sent: millis(9500),
        tasks: Vec::new(),
        clock: Some((9500, millis(9500))),
        commanded: millis(9500),
        heard: millis(9500),
    }
}

fn with_task(stage: Stage, deadline: u64) -> ShownSession {
    let deadline = millis(deadline);
    ShownSession {
        tasks: vec![("task", ShownTask { deadline, stage })],
        ..session(Phase::Up)
    }
}

/// The fingerprint 10 s after the reset.
fn of_session(session: &ShownSession, exact: bool) -> u64 {
    let now = millis(10_000);
    let mut print = Fingerprint::new(Origin { now, node: now });
    if exact {
        print = print.exactly();
    }
    print.add_session(session, !session.tasks.is_empty());
    print.finish()
}

/// Whether the fingerprints are equal. Exact ones never are.
fn alike(one: &ShownSession, two: &ShownSession) -> bool {
    assert_ne!(of_session(one, true), of_session(two, true));
    of_session(one, false) == of_session(two, false)
}

#[test]
fn the_fingerprint_ignores_what_the_answer_to_a_hello_overwrites() {
    let changes: [fn(&mut ShownSession); 3] = [
        |session| session.sent = millis(9250),
        |session| session.commanded = millis(9250),
        |session| session.clock = Some((9400, millis(9500))),
    ];
    for change in changes {
        for (phase, ignored) in [(Phase::Greeting, true), (Phase::Up, false)] {
            let mut other = session(phase);
            change(&mut other);
            assert_eq!(alike(&session(phase), &other), ignored, "{other:?}");
        }
    }
}

#[test]
fn the_fingerprint_ignores_when_the_last_answer_arrived_unless_a_task_runs() {
    let earlier = |session: &ShownSession| ShownSession {
        heard: millis(9250),
        ..session.clone()
    };
    let (idle, busy) = (session(Phase::Up), with_task(Stage::Running(1), 10_500));
    assert!(alike(&idle, &earlier(&idle)));
    assert!(!alike(&busy, &earlier(&busy)));
}

#[test]
fn the_fingerprint_ignores_a_deadline_that_ends_nothing() {
    let running = |deadline| with_task(Stage::Running(1), deadline);
    // The last answer.
    assert!(alike(&running(9_500), &running(9_400)));
    assert!(!alike(&running(9_500), &running(9_501)));
    let waiting = |deadline| with_task(Stage::Waiting, deadline);
    assert!(!alike(&waiting(10_500), &waiting(10_400)));
}

#[test]
fn the_fingerprint_ignores_clocks_of_earlier_boots() {
    let ahead = |millis| ShownSession {
        clock: Some((millis, Instant::from_millis(9500))),
        ..session(Phase::Up)
    };
    assert!(alike(&ahead(9700), &ahead(9900)));
    assert!(!alike(&ahead(9500), &ahead(9900)));
}
