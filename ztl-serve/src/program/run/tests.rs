//! Traces on virtual time.

use super::super::launch::Invocation;
use super::super::settings::Abort;
use super::*;

/// A program with a grace of 2 s.
fn program(change: impl FnOnce(&mut Program)) -> Arc<Program> {
    let run = Invocation {
        arguments: Vec::new(),
        directory: "/".into(),
        environment: Vec::new(),
        user: None,
        place: "robot.yaml:9".to_owned(),
    };
    let mut program = Program {
        run: Arc::new(run),
        marker: Some("@ ".to_owned()),
        result: ResultKind::LastLine,
        output: 1024,
        rejected_by: Vec::new(),
        decide: Duration::from_millis(300),
        limit: None,
        abort: Abort {
            allowed: true,
            by: AbortBy::Signal("INT", Signal::INT),
            grace: Duration::from_secs(2),
        },
        kills_left_behind: true,
    };
    change(&mut program);
    Arc::new(program)
}

/// A run, and what it wanted since it was last asked.
struct Stage {
    run: Run,
    start: Instant,
    now: Instant,
    actions: Vec<Action>,
}

impl Stage {
    fn new(change: impl FnOnce(&mut Program)) -> Self {
        let now = Instant::now();
        let mut actions = Vec::new();
        let run = Run::new(now, program(change), &mut actions);
        Self {
            run,
            start: now,
            now,
            actions,
        }
    }

    fn says(&mut self, text: &str) {
        self.run.handle_output(text.as_bytes(), &mut self.actions);
    }

    fn stop(&mut self, why: StopReason) {
        self.run.stop(self.now, why, &mut self.actions);
    }

    /// Lets time pass until so many milliseconds after the start, with each wake-up on its way.
    fn until(&mut self, millis: u64) {
        let end = self.start + Duration::from_millis(millis);
        while let Some(wake) = self.run.poll_timeout().filter(|wake| *wake <= end) {
            self.now = self.now.max(wake);
            let before = self.run.poll_timeout();
            self.run.handle_timeout(self.now, &mut self.actions);
            if self.run.poll_timeout() == before {
                break;
            }
        }
        self.now = end;
    }

    #[track_caller]
    fn wants(&mut self, actions: &[Action]) {
        assert_eq!(self.actions, actions);
        self.actions.clear();
    }

    fn ends(mut self, raw: i32) -> (Outcome, Vec<Action>) {
        self.actions.clear();
        let status = Some(ExitStatus::from_raw(raw));
        let end = self.run.end(status, &mut self.actions);
        (end, self.actions)
    }
}

/// As the system encodes an exit code.
const fn code(code: i32) -> i32 {
    code << 8
}

#[test]
fn a_program_that_cannot_reject_is_accepted_when_it_starts() {
    let mut stage = Stage::new(|_| {});
    stage.wants(&[Action::Accept]);
    stage.says("@ 10 percent\n@ 20 percent\nhello\n");
    stage.wants(&[Action::Progress("20 percent".to_owned())]);
    assert_eq!(stage.run.poll_timeout(), None);
    assert_eq!(
        stage.ends(code(0)),
        (Outcome::Completed("hello".to_owned()), vec![])
    );
}

#[test]
fn a_program_that_can_reject_is_accepted_at_its_first_progress_or_in_time() {
    let rejects = |program: &mut Program| program.rejected_by = vec![2];
    let mut stage = Stage::new(rejects);
    stage.wants(&[]);
    stage.says("no progress\n");
    stage.wants(&[]);
    stage.says("@ on my way\n");
    stage.wants(&[Action::Accept, Action::Progress("on my way".to_owned())]);
    assert_eq!(
        stage.ends(code(2)).0,
        Outcome::Failed("exit code 2: no progress".to_owned())
    );

    let mut stage = Stage::new(rejects);
    stage.until(299);
    stage.wants(&[]);
    stage.until(300);
    stage.wants(&[Action::Accept]);

    let mut stage = Stage::new(rejects);
    stage
        .run
        .handle_error_output(b"the arm is locked\n", |_| {});
    assert_eq!(
        stage.ends(code(2)),
        (Outcome::Rejected("the arm is locked".to_owned()), vec![])
    );
    let stage = Stage::new(rejects);
    assert_eq!(
        stage.ends(code(2)).0,
        Outcome::Rejected("rejected (exit code 2)".to_owned())
    );
    let stage = Stage::new(rejects);
    assert_eq!(
        stage.ends(code(0)),
        (Outcome::Completed(String::new()), vec![Action::Accept])
    );
}

#[test]
fn a_failure_has_the_exit_code_and_the_last_line() {
    let failed = |raw, errors: &str, out: &str| {
        let mut stage = Stage::new(|_| {});
        stage.says(out);
        stage.run.handle_error_output(errors.as_bytes(), |_| {});
        match stage.ends(raw).0 {
            Outcome::Failed(reason) => reason,
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(
        failed(code(1), "one\n  two  \n\n", "out\n"),
        "exit code 1: two"
    );
    assert_eq!(failed(code(1), "", "out"), "exit code 1: out");
    assert_eq!(failed(code(127), "", ""), "exit code 127");
    assert_eq!(failed(11, "", ""), "ended by SIGSEGV");
    assert_eq!(failed(64, "x", ""), "ended by signal 64: x");
}

#[test]
fn an_aborted_program_is_aborted_once_its_whole_group_has_ended() {
    let mut stage = Stage::new(|_| {});
    stage.wants(&[Action::Accept]);
    stage.stop(StopReason::Client);
    stage.wants(&[Action::Signal(Signal::INT)]);
    stage.stop(StopReason::Server);
    stage.wants(&[]);
    // Its child takes a moment longer.
    assert!(!stage.run.is_over(stage.now, || true));
    assert!(
        !stage
            .run
            .is_over(stage.now, || panic!("not looked for again at once"))
    );
    stage.until(20);
    assert!(stage.run.is_over(stage.now, || false));
    assert!(!stage.run.leaves_behind());
    assert_eq!(
        stage.ends(code(0)).0,
        Outcome::Aborted("aborted".to_owned())
    );
}

#[test]
fn the_group_is_killed_after_its_grace_and_abandoned_a_second_later() {
    let mut stage = Stage::new(|_| {});
    stage.says("at 3\n");
    stage.stop(StopReason::Client);
    stage.actions.clear();
    stage.until(1999);
    stage.wants(&[]);
    assert!(!stage.run.is_over(stage.now, || true));
    stage.until(2000);
    stage.wants(&[Action::Signal(Signal::KILL)]);
    stage.now += CHECK;
    assert!(!stage.run.is_over(stage.now, || true));
    stage.now = stage.start + Duration::from_secs(3);
    assert!(stage.run.is_over(stage.now, || true));
    let text = "at 3 (killed: not ended within 2 s of SIGINT)";
    assert_eq!(stage.ends(9).0, Outcome::Aborted(text.to_owned()));
}

#[test]
fn a_time_limit_stops_the_program_and_fails_the_task() {
    let mut stage = Stage::new(|program| program.limit = Some(Duration::from_secs(30)));
    stage.wants(&[Action::Accept]);
    stage.until(30_000);
    stage.wants(&[Action::Signal(Signal::INT)]);
    stage.until(32_000);
    stage.wants(&[Action::Signal(Signal::KILL)]);
    let text = "not done within 30 s (killed: not ended within 2 s of SIGINT)";
    assert_eq!(stage.ends(9).0, Outcome::Failed(text.to_owned()));
}

#[test]
fn each_kind_of_result() {
    let ends = |kind: ResultKind, out: &str| {
        let mut stage = Stage::new(|program| {
            program.result = kind;
            program.output = 32;
        });
        stage.says(out);
        stage.ends(code(0)).0
    };
    let completed = |text: &str| Outcome::Completed(text.to_owned());
    let out = "one\n@ half\ntwo\n\n";
    assert_eq!(ends(ResultKind::LastLine, out), completed("two"));
    assert_eq!(ends(ResultKind::All, out), completed("one\ntwo"));
    assert_eq!(ends(ResultKind::Nothing, out), completed("None"));
    let json = "{\"a\":\n [1, null]}\n";
    assert_eq!(ends(ResultKind::Json, json), completed("{'a': [1, None]}"));
    assert_eq!(ends(ResultKind::Json, "log\n[true]\n"), completed("[True]"));
    for (json, part) in [
        ("nothing", "its output is not JSON: "),
        ("", "its output is not JSON: "),
        ("[[[[[[[[[[1]]]]]]]]]]", "its result cannot be sent: "),
        ("[1111111111111111111111111111111111]", "exceeds 32 bytes"),
    ] {
        let Outcome::Failed(reason) = ends(ResultKind::Json, json) else {
            panic!("{json}");
        };
        assert!(reason.contains(part), "{json}: {reason}");
    }
    let long = "x".repeat(40);
    let cut = format!("{} … (cut at 32 bytes)", "x".repeat(32));
    assert_eq!(ends(ResultKind::LastLine, &long), completed(&cut));
    assert_eq!(ends(ResultKind::All, &long), completed(&cut));
}

#[test]
fn a_stream_s_program_that_has_closed_its_output_is_stopped_soon() {
    let mut stage = Stage::new(|program| program.result = ResultKind::Stream);
    stage.run.on_closed_output(stage.now);
    stage.until(999);
    stage.wants(&[Action::Accept]);
    stage.until(1000);
    stage.wants(&[Action::Signal(Signal::INT)]);
    let said = "it closed its output, ran on and was stopped";
    assert_eq!(stage.ends(2).0, Outcome::Failed(said.to_owned()));
    // One that ends.
    let mut stage = Stage::new(|program| program.result = ResultKind::Stream);
    stage.run.on_closed_output(stage.now);
    let end = Outcome::Failed("exit code 3".to_owned());
    assert_eq!(stage.ends(code(3)).0, end);
}
