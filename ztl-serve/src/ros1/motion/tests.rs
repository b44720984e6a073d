use super::*;

const TICK: Duration = Duration::from_millis(20);

/// A motion of two joints to 1 and 2, on virtual time.
struct Bench {
    now: Instant,
    motion: Motion,
    seen: Seen,
    is_heard: bool,
    /// Whether the controller acknowledges what is sent to it.
    acknowledges: bool,
    actions: Vec<Action>,
}

impl Bench {
    fn new() -> Self {
        let now = Instant::now();
        let target = Target {
            joints: vec!["a".to_owned(), "b".to_owned()],
            positions: vec![1.0, 2.0],
            tolerance: 0.05,
            limit: Duration::from_secs(5),
        };
        Self {
            now,
            motion: Motion::new(now, target),
            seen: vec![None, None],
            is_heard: true,
            acknowledges: true,
            actions: Vec::new(),
        }
    }

    fn heard(&self) -> Result<bool, &'static str> {
        match self.is_heard {
            true => Ok(self.acknowledges),
            false => Err("the controller has left the topic"),
        }
    }

    /// Lets this time pass, with joints that stay where they are if they are heard.
    fn pass(&mut self, time: Duration, places: Option<[f64; 2]>) {
        let end = self.now + time;
        while self.now < end {
            self.now += TICK;
            if let Some(places) = places {
                self.seen = places.map(|place| Some((self.now, place))).to_vec();
            }
            let (now, seen) = (self.now, self.seen.clone());
            self.motion
                .handle(now, self.heard(), &seen, &|| None, &mut self.actions);
        }
    }

    /// What was done since the last call, without progress.
    fn done(&mut self) -> Vec<Action> {
        let mut actions = std::mem::take(&mut self.actions);
        actions.retain(|action| !matches!(action, Action::Progress(_)));
        actions
    }

    fn end(&mut self) -> Outcome {
        let actions = self.done();
        match actions.last() {
            Some(Action::End(outcome)) => outcome.clone(),
            _ => panic!("not ended: {actions:?}"),
        }
    }
}

const SECOND: Duration = Duration::from_secs(1);

#[test]
fn a_motion_ends_when_all_joints_have_been_at_their_positions_for_a_moment() {
    let mut bench = Bench::new();
    bench.pass(TICK, Some([0.0, 0.0]));
    assert_eq!(bench.done(), [Action::Begin]);
    bench.pass(SECOND, Some([1.0, 0.5]));
    // It passes.
    bench.pass(3 * TICK, Some([1.01, 1.99]));
    bench.pass(SECOND, Some([1.0, 2.5]));
    assert_eq!(bench.done(), []);
    bench.pass(TICK, Some([1.01, 1.99]));
    // One joint state alone may be of joints that pass.
    bench.pass(SECOND, None);
    assert_eq!(bench.done(), []);
    bench.acknowledges = false;
    bench.pass(SECOND, Some([1.01, 1.99]));
    assert_eq!(bench.done(), []);
    bench.acknowledges = true;
    bench.pass(TICK, Some([1.01, 1.99]));
    assert_eq!(
        bench.end(),
        Outcome::Completed("[1.0100, 1.9900]".to_owned())
    );
    bench.pass(SECOND, Some([0.0, 0.0]));
    assert_eq!(bench.done(), []);
}

#[test]
fn nothing_moves_without_a_controller_and_joint_states() {
    let mut bench = Bench::new();
    bench.is_heard = false;
    bench.pass(2 * SECOND + TICK, Some([0.0, 0.0]));
    let rejected = |reason: &str| Action::End(Outcome::Rejected(reason.to_owned()));
    let reason = "no controller receives the topic within 1500 ms";
    assert_eq!(bench.done(), [Action::Explain, rejected(reason)]);

    let mut bench = Bench::new();
    bench.is_heard = false;
    bench.pass(BEGIN + TICK, Some([0.0, 0.0]));
    let reason = "the master does not answer";
    bench
        .motion
        .explained(reason.to_owned(), &mut bench.actions);
    assert_eq!(bench.done(), [Action::Explain, rejected(reason)]);

    let mut bench = Bench::new();
    bench.seen = vec![Some((bench.now, 0.0)), None];
    bench.pass(2 * SECOND, None);
    let reason = "no joint state of b within 1500 ms, so nothing was moved".to_owned();
    assert_eq!(bench.done(), [Action::End(Outcome::Rejected(reason))]);
}

#[test]
fn an_abort_tells_the_controller_three_times_and_waits_until_the_joints_are_still() {
    let mut bench = Bench::new();
    bench.pass(TICK, Some([0.0, 0.0]));
    bench.done();
    bench
        .motion
        .stop(bench.now, StopReason::Client, &mut bench.actions);
    for step in 0..20 {
        // They slow down.
        bench.pass(TICK, Some([0.1 + f64::from(step) * 0.01, 0.0]));
    }
    assert_eq!(bench.done(), [Action::Stop, Action::Stop, Action::Stop]);
    bench.pass(STILL + 2 * TICK, Some([0.3, 0.0]));
    assert_eq!(bench.end(), Outcome::Aborted("aborted".to_owned()));
    let mut waiting = Bench::new();
    waiting
        .motion
        .stop(waiting.now, StopReason::Client, &mut waiting.actions);
    assert_eq!(
        waiting.end(),
        Outcome::Aborted("aborted before it began".to_owned())
    );
}

/// A motion that has begun and is aborted.
fn aborted() -> Bench {
    let mut bench = Bench::new();
    bench.pass(TICK, Some([0.0, 0.0]));
    bench
        .motion
        .stop(bench.now, StopReason::Client, &mut bench.actions);
    bench
}

#[test]
fn joints_are_still_when_states_after_the_acknowledged_stop_show_it() {
    // Old states, of a time when the joints may have moved, show nothing.
    let mut bench = aborted();
    bench.pass(STOP_TIME + SECOND, None);
    let unknown =
        |reason: &str| Outcome::Unknown(format!("the controller was told to stop, {reason}"));
    let reason = "and no states of all joints came within 3 s";
    assert_eq!(bench.end(), unknown(reason));

    // One a second.
    let mut bench = aborted();
    for _ in 0..3 {
        bench.pass(SECOND, None);
        bench.pass(TICK, Some([0.3, 0.0]));
    }
    assert_eq!(bench.end(), Outcome::Aborted("aborted".to_owned()));
    let mut bench = aborted();
    for step in 0..4 {
        bench.pass(SECOND, None);
        bench.pass(TICK, Some([f64::from(step), 0.0]));
    }
    let reason = "and after 3 s joint states do not show that the joints are still";
    assert_eq!(bench.end(), unknown(reason));

    // The joints rest, and the controller may begin at any time.
    let mut bench = aborted();
    bench.acknowledges = false;
    bench.pass(STOP_TIME + SECOND, Some([0.0, 0.0]));
    let reason = "and it has not acknowledged that within 3 s";
    assert_eq!(bench.end(), unknown(reason));
    let mut bench = aborted();
    bench.is_heard = false;
    bench.pass(SECOND, Some([0.0, 0.0]));
    let reason = "but the controller has left the topic";
    assert_eq!(bench.end(), unknown(reason));

    // At the limit, shortly after the network was cut.
    let mut bench = Bench::new();
    bench.pass(5 * SECOND - 10 * TICK, Some([0.0, 0.0]));
    bench.acknowledges = false;
    bench.pass(5 * SECOND, None);
    let reason = "and it has not acknowledged that within 3 s";
    assert_eq!(bench.end(), unknown(reason));
}

#[test]
fn joints_that_go_on_after_the_stop_are_an_unknown_outcome() {
    let mut bench = Bench::new();
    bench.pass(TICK, Some([0.0, 0.0]));
    bench
        .motion
        .stop(bench.now, StopReason::Client, &mut bench.actions);
    for step in 0..180 {
        bench.pass(TICK, Some([f64::from(step) * 0.01, 0.0]));
    }
    let Outcome::Unknown(reason) = bench.end() else {
        panic!("it moves");
    };
    assert!(
        reason.ends_with("joint states do not show that the joints are still"),
        "{reason}"
    );
}

#[test]
fn a_motion_that_takes_too_long_or_is_not_seen_is_stopped_and_fails() {
    let mut bench = Bench::new();
    bench.pass(7 * SECOND, Some([1.0, 0.5]));
    let actions = bench.done();
    let reason = "b is 1.500 from its position after 5 s".to_owned();
    let stops = [Action::Begin, Action::Stop, Action::Stop, Action::Stop];
    assert_eq!(actions[..4], stops);
    assert_eq!(actions[4..], [Action::End(Outcome::Failed(reason))]);
    let mut bench = Bench::new();
    bench.pass(TICK, Some([0.0, 0.0]));
    bench.pass(5 * SECOND, None);
    let reason = "no joint state of a for 2 s; the controller was told to stop".to_owned();
    assert_eq!(
        bench.done().last(),
        Some(&Action::End(Outcome::Unknown(reason)))
    );
    let mut bench = Bench::new();
    bench.pass(SECOND, Some([1.0, f64::NAN]));
    assert_eq!(
        bench.done(),
        [Action::Begin],
        "a position that is no number is nowhere near"
    );
    bench.is_heard = false;
    bench.pass(5 * SECOND, Some([0.0, 0.0]));
    let reason = "the controller has left the topic".to_owned();
    assert_eq!(bench.end(), Outcome::Unknown(reason));
}

#[test]
fn a_motion_that_is_not_seen_says_whether_the_controller_was_told_to_stop() {
    let unseen = |acknowledges: bool, is_heard: bool, places: Option<[f64; 2]>| {
        let mut bench = Bench::new();
        bench.pass(TICK, Some([0.0, 0.0]));
        bench.pass(2 * SECOND, None);
        (bench.acknowledges, bench.is_heard) = (acknowledges, is_heard);
        bench.pass(4 * SECOND, places);
        match bench.end() {
            Outcome::Unknown(reason) => reason,
            other => panic!("{other:?}"),
        }
    };
    let reason = |then: &str| format!("no joint state of a for 2 s; the controller {then}");
    assert_eq!(unseen(true, true, None), reason("was told to stop"));
    assert_eq!(
        unseen(true, true, Some([0.5, 0.5])),
        reason("was told to stop, and the joints are still")
    );
    assert_eq!(
        unseen(false, true, None),
        reason("has not acknowledged that it must stop")
    );
    assert_eq!(
        unseen(true, false, None),
        reason("was not stopped: the controller has left the topic")
    );
}
