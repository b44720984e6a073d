//! Runs as traces on virtual time.

use super::*;
use crate::program::{Abort, Invocation};

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
        result: ResultKind::Last,
        output: 1024,
        refused_by: Vec::new(),
        decide: Duration::from_millis(300),
        limit: None,
        abort: Abort {
            allowed: true,
            by: AbortBy::Signal("INT", Signal::INT),
            grace: Duration::from_secs(2),
        },
        tidy: true,
    };
    change(&mut program);
    Arc::new(program)
}

/// A run, and what it wanted since it was last asked.
struct Lab {
    run: Run,
    start: Instant,
    now: Instant,
    acts: Vec<Act>,
}

impl Lab {
    fn new(change: impl FnOnce(&mut Program)) -> Self {
        let now = Instant::now();
        let mut acts = Vec::new();
        let run = Run::new(now, program(change), &mut acts);
        Self {
            run,
            start: now,
            now,
            acts,
        }
    }

    fn says(&mut self, text: &str) {
        self.run.handle_output(text.as_bytes(), &mut self.acts);
    }

    fn stop(&mut self, why: Why) {
        self.run.stop(self.now, why, &mut self.acts);
    }

    /// Lets time pass until so many milliseconds after the start, with each wake-up on its way.
    fn until(&mut self, millis: u64) {
        let end = self.start + Duration::from_millis(millis);
        while let Some(wake) = self.run.poll_timeout().filter(|wake| *wake <= end) {
            self.now = self.now.max(wake);
            let before = self.run.poll_timeout();
            self.run.handle_timeout(self.now, &mut self.acts);
            if self.run.poll_timeout() == before {
                break;
            }
        }
        self.now = end;
    }

    #[track_caller]
    fn wants(&mut self, acts: &[Act]) {
        assert_eq!(self.acts, acts);
        self.acts.clear();
    }

    fn ends(mut self, raw: i32) -> (End, Vec<Act>) {
        self.acts.clear();
        let status = Some(ExitStatus::from_raw(raw));
        let end = self.run.end(status, &mut self.acts);
        (end, self.acts)
    }
}

/// As the system tells an exit code.
const fn code(code: i32) -> i32 {
    code << 8
}

#[test]
fn without_an_exit_code_that_refuses_it_is_taken_as_soon_as_it_runs() {
    let mut lab = Lab::new(|_| {});
    lab.wants(&[Act::Accept]);
    lab.says("@ 10 percent\n@ 20 percent\nhello\n");
    lab.wants(&[Act::Progress("20 percent".to_owned())]);
    assert_eq!(lab.run.poll_timeout(), None);
    assert_eq!(
        lab.ends(code(0)),
        (End::Completed("hello".to_owned()), vec![])
    );
}

#[test]
fn with_one_it_is_taken_at_the_first_progress_or_when_its_time_to_decide_has_passed() {
    let refuses = |program: &mut Program| program.refused_by = vec![2];
    let mut lab = Lab::new(refuses);
    lab.wants(&[]);
    lab.says("no progress\n");
    lab.wants(&[]);
    lab.says("@ on my way\n");
    lab.wants(&[Act::Accept, Act::Progress("on my way".to_owned())]);
    assert_eq!(
        lab.ends(code(2)).0,
        End::Failed("exit code 2: no progress".to_owned())
    );

    let mut lab = Lab::new(refuses);
    lab.until(299);
    lab.wants(&[]);
    lab.until(300);
    lab.wants(&[Act::Accept]);

    let mut lab = Lab::new(refuses);
    lab.run.handle_error_output(b"the arm is locked\n", |_| {});
    assert_eq!(
        lab.ends(code(2)),
        (End::Rejected("the arm is locked".to_owned()), vec![])
    );
    let lab = Lab::new(refuses);
    assert_eq!(
        lab.ends(code(2)).0,
        End::Rejected("refused (exit code 2)".to_owned())
    );
    let lab = Lab::new(refuses);
    assert_eq!(
        lab.ends(code(0)),
        (End::Completed(String::new()), vec![Act::Accept])
    );
}

#[test]
fn how_it_failed_is_told_with_its_last_words() {
    let failed = |raw, errors: &str, out: &str| {
        let mut lab = Lab::new(|_| {});
        lab.says(out);
        lab.run.handle_error_output(errors.as_bytes(), |_| {});
        match lab.ends(raw).0 {
            End::Failed(reason) => reason,
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
fn an_abort_is_its_end_whatever_its_exit_code_and_the_rest_of_its_group_is_waited_for() {
    let mut lab = Lab::new(|_| {});
    lab.wants(&[Act::Accept]);
    lab.stop(Why::Client);
    lab.wants(&[Act::Signal(Signal::INT)]);
    lab.stop(Why::Server);
    lab.wants(&[]);
    // Its child takes a moment longer.
    assert!(!lab.run.is_over(lab.now, || true));
    assert!(
        !lab.run
            .is_over(lab.now, || panic!("not looked for again at once"))
    );
    lab.until(20);
    assert!(lab.run.is_over(lab.now, || false));
    assert!(!lab.run.leaves_behind());
    assert_eq!(lab.ends(code(0)).0, End::Aborted("aborted".to_owned()));
}

#[test]
fn after_its_grace_the_whole_group_is_killed_and_what_the_system_does_not_let_go_is_given_up() {
    let mut lab = Lab::new(|_| {});
    lab.says("at 3\n");
    lab.stop(Why::Client);
    lab.acts.clear();
    lab.until(1999);
    lab.wants(&[]);
    assert!(!lab.run.is_over(lab.now, || true));
    lab.until(2000);
    lab.wants(&[Act::Signal(Signal::KILL)]);
    lab.now += LOOK;
    assert!(!lab.run.is_over(lab.now, || true));
    lab.now = lab.start + Duration::from_secs(3);
    assert!(lab.run.is_over(lab.now, || true));
    let text = "at 3 (killed: not ended within 2 s of SIGINT)";
    assert_eq!(lab.ends(9).0, End::Aborted(text.to_owned()));
}

#[test]
fn a_limit_asks_it_to_end_as_an_abort_does_and_is_its_failure() {
    let mut lab = Lab::new(|program| program.limit = Some(Duration::from_secs(30)));
    lab.wants(&[Act::Accept]);
    lab.until(30_000);
    lab.wants(&[Act::Signal(Signal::INT)]);
    lab.until(32_000);
    lab.wants(&[Act::Signal(Signal::KILL)]);
    let text = "not done within 30 s (killed: not ended within 2 s of SIGINT)";
    assert_eq!(lab.ends(9).0, End::Failed(text.to_owned()));
}

#[test]
fn results_of_each_kind() {
    let ends = |kind: ResultKind, out: &str| {
        let mut lab = Lab::new(|program| {
            program.result = kind;
            program.output = 32;
        });
        lab.says(out);
        lab.ends(code(0)).0
    };
    let completed = |text: &str| End::Completed(text.to_owned());
    let out = "one\n@ half\ntwo\n\n";
    assert_eq!(ends(ResultKind::Last, out), completed("two"));
    assert_eq!(ends(ResultKind::All, out), completed("one\ntwo"));
    assert_eq!(ends(ResultKind::Nothing, out), completed("None"));
    let json = "{\"a\":\n [1, null]}\n";
    assert_eq!(ends(ResultKind::Json, json), completed("{'a': [1, None]}"));
    assert_eq!(ends(ResultKind::Json, "log\n[true]\n"), completed("[True]"));
    for (json, part) in [
        ("nothing", "its output is no JSON: "),
        ("", "its output is no JSON: "),
        ("[[[[[[[[[[1]]]]]]]]]]", "its result cannot be told: "),
        (
            "[1111111111111111111111111111111111]",
            "longer than 32 bytes",
        ),
    ] {
        let End::Failed(reason) = ends(ResultKind::Json, json) else {
            panic!("{json}");
        };
        assert!(reason.contains(part), "{json}: {reason}");
    }
    let long = "x".repeat(40);
    let cut = format!("{} … (cut at 32 bytes)", "x".repeat(32));
    assert_eq!(ends(ResultKind::Last, &long), completed(&cut));
    assert_eq!(ends(ResultKind::All, &long), completed(&cut));
}

#[test]
fn a_number_of_bytes_is_said_in_the_unit_that_it_was_written_in() {
    assert_eq!(size(64 * 1024), "64 KiB");
    assert_eq!(size(1000), "1000 bytes");
    assert_eq!(time(Duration::from_millis(300)), "300 ms");
}
