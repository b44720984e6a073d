use ztl_core::link::update::UpdateError;

use super::*;
use crate::gateway::updates::Note;

const LENGTH: usize = 2000;

fn device(boot: u32) -> DeviceInfo {
    DeviceInfo {
        name: "hand".to_owned(),
        firmware: "1.0.0".to_owned(),
        boot,
        max_body: 120,
        link_timeout: Duration::from_secs(1),
        count: 0,
        components: Vec::new(),
        parameters: 0,
        known_parameters: Vec::new(),
        shared: false,
        updates: true,
    }
}

fn runs(version: &str, confirmed: bool) -> UpdateAnswer {
    let self_test = (!confirmed).then(|| (0, "20".to_owned()));
    Ok(UpdateReply::Firmware(FirmwareInfo {
        board: "desk".to_owned(),
        version: version.to_owned(),
        confirmed,
        self_test,
    }))
}

fn phase(phase: UpdatePhase) -> UpdateAnswer {
    Ok(UpdateReply::Phase(phase))
}

/// An update, the time, and the device's boot.
struct Rig {
    job: UpdateJob,
    now: Instant,
    boot: u32,
    tests: u32,
}

impl Rig {
    fn new() -> Self {
        let image = Image {
            version: "1.1.0".to_owned(),
            manifest: vec![0; 104],
            bytes: vec![7; LENGTH],
        };
        let now = Instant::from_millis(1000);
        let mut job = UpdateJob::new(now, image, UpdateOptions::default());
        job.begin(now);
        let (boot, tests) = (1, 0);
        Self {
            job,
            now,
            boot,
            tests,
        }
    }

    fn answer(&mut self, answer: UpdateAnswer) -> Next {
        self.now = self.now + Duration::from_millis(10);
        self.job.on_answer(self.now, &device(self.boot), answer)
    }

    /// Another boot answers.
    fn reboot(&mut self) -> Next {
        self.boot += 1;
        self.job.on_lost(self.now);
        self.job.on_up(self.now, self.boot)
    }

    /// Plays a device until the end, or for an hour.
    fn run(
        &mut self,
        mut next: Next,
        mut play: impl FnMut(&UpdateRequest) -> UpdateAnswer,
    ) -> Outcome {
        let end = self.now + Duration::from_secs(3600);
        while self.now < end {
            next = match next {
                Next::Ask(request) => {
                    let answer = play(&request);
                    self.answer(answer)
                }
                Next::Wait => {
                    if self.job.step == Step::Lost {
                        self.now = self.now + Duration::from_secs(1);
                        self.job.on_up(self.now, self.boot)
                    } else {
                        self.now = self.now.max(self.job.poll_timeout());
                        self.job.handle_timeout(self.now)
                    }
                }
                Next::Test(..) => {
                    self.tests += 1;
                    self.job.on_tested(self.now, Ok(()))
                }
                Next::End(outcome) => return outcome,
            };
        }
        panic!("it never ends");
    }

    /// Up to the restart: the new boot is asked what runs.
    fn restarted() -> Self {
        let mut rig = Self::new();
        rig.answer(runs("1.0.0", true));
        let offset = LENGTH as u32;
        rig.answer(phase(UpdatePhase::Receiving { offset }));
        rig.answer(phase(UpdatePhase::Verifying));
        assert_eq!(
            rig.answer(phase(UpdatePhase::Ready)),
            Next::Ask(UpdateRequest::Restart)
        );
        assert_eq!(rig.answer(phase(UpdatePhase::Restarting)), Next::Wait);
        assert_eq!(rig.reboot(), Next::Ask(UpdateRequest::Read));
        rig
    }
}

fn failure(outcome: Outcome) -> String {
    match outcome {
        Outcome::Failed(problem, text) => format!("{problem}: {text}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_device_that_makes_no_progress_ends_the_update() {
    // Always the same answer to what is sent.
    for always in [
        UpdatePhase::Idle,
        UpdatePhase::Receiving { offset: 0 },
        UpdatePhase::Receiving { offset: 96 },
        UpdatePhase::Receiving {
            offset: LENGTH as u32,
        },
        UpdatePhase::Stopping,
        UpdatePhase::Verifying,
        UpdatePhase::Ready,
        UpdatePhase::Restarting,
    ] {
        let mut rig = Rig::new();
        let begin = rig.now;
        let next = Next::Ask(UpdateRequest::Read);
        let told = failure(rig.run(next, |request| match request {
            UpdateRequest::Read => runs("1.0.0", true),
            _ => phase(always),
        }));
        assert!(told.starts_with("failed: "), "{always:?}: {told}");
        let took = rig.now.since(begin);
        assert!(took < Duration::from_secs(600), "{always:?}: {took:?}");
    }
    // It forgets what it has.
    let mut rig = Rig::new();
    let mut has = 0;
    let next = Next::Ask(UpdateRequest::Read);
    let told = failure(rig.run(next, |request| match request {
        UpdateRequest::Read => runs("1.0.0", true),
        UpdateRequest::Write { offset, bytes } if has < 900 => {
            has = offset + bytes.len() as u32;
            phase(UpdatePhase::Receiving { offset: has })
        }
        _ => {
            has = 0;
            phase(UpdatePhase::Receiving { offset: 0 })
        }
    }));
    assert!(told.contains("no progress in 20 attempts"), "{told}");
}

#[test]
fn a_link_that_is_lost_at_the_same_command_again_and_again_ends_the_update() {
    let mut rig = Rig::new();
    let next = Next::Ask(UpdateRequest::Read);
    let told = failure(rig.run(next, |request| match request {
        UpdateRequest::Read => runs("1.0.0", true),
        _ => Err(UpdateFailure::Lost),
    }));
    assert!(told.contains("no progress in 20 attempts"), "{told}");
    // An error that only later gateways know is told as such.
    let mut rig = Rig::new();
    let next = Next::Ask(UpdateRequest::Read);
    let told = failure(rig.run(next, |request| match request {
        UpdateRequest::Read => runs("1.0.0", true),
        _ => phase(UpdatePhase::Failed(UpdateError::from_code(200))),
    }));
    assert!(told.contains("error 200"), "{told}");
}

#[test]
fn a_device_that_does_not_confirm_is_not_tested_again() {
    let mut rig = Rig::restarted();
    let next = rig.answer(runs("1.1.0", false));
    let told = failure(rig.run(next, |request| match request {
        UpdateRequest::Read => runs("1.1.0", false),
        _ => phase(UpdatePhase::Idle),
    }));
    assert!(told.contains("no progress in 20 attempts"), "{told}");
    assert_eq!(rig.tests, 1);
}

#[test]
fn a_device_that_goes_on_from_an_earlier_byte_after_each_break_is_updated() {
    let mut rig = Rig::new();
    let (mut has, mut pieces) = (0u32, 0);
    let next = Next::Ask(UpdateRequest::Read);
    let mut verified = false;
    let outcome = rig.run(next, |request| match request {
        UpdateRequest::Read => runs("1.0.0", true),
        UpdateRequest::Begin { .. } => {
            has -= has % 1024;
            phase(UpdatePhase::Receiving { offset: has })
        }
        UpdateRequest::Write { offset, bytes } => {
            pieces += 1;
            if pieces % 14 == 0 {
                return Err(UpdateFailure::Lost);
            }
            has = offset + bytes.len() as u32;
            phase(UpdatePhase::Receiving { offset: has })
        }
        _ => {
            verified = true;
            phase(UpdatePhase::Failed(UpdateError::Signature))
        }
    });
    assert!(failure(outcome).starts_with("signature: "));
    assert!(verified);
}

#[test]
fn an_image_that_says_another_version_than_it_was_signed_for_is_found_by_its_trial() {
    for (says, before_says_too) in [("1.0.7", false), ("1.0.0", true)] {
        let mut rig = Rig::restarted();
        assert_eq!(
            rig.answer(runs(says, false)),
            Next::Test(0, "20".to_owned())
        );
        let confirm = Next::Ask(UpdateRequest::Confirm);
        assert_eq!(rig.job.on_tested(rig.now, Ok(())), confirm);
        let read = Next::Ask(UpdateRequest::Read);
        assert_eq!(rig.answer(phase(UpdatePhase::Idle)), read);
        let updated = Updated {
            before: "1.0.0".to_owned(),
            after: says.to_owned(),
            signed: Some("1.1.0".to_owned()),
        };
        let end = rig.answer(runs(says, true));
        assert_eq!(end, Next::End(Outcome::Updated(updated)));
        // Reset before it could answer: with equal versions nothing tells which one runs.
        let mut rig = Rig::restarted();
        rig.answer(runs(says, false));
        rig.job.on_tested(rig.now, Ok(()));
        assert_eq!(rig.reboot(), read);
        let end = rig.answer(runs("1.0.0", true));
        let Next::End(Outcome::Failed(problem, text)) = end else {
            panic!("{end:?}");
        };
        let wanted = match before_says_too {
            true => (UpdateProblem::Other, "which both images say"),
            false => (UpdateProblem::Reverted, "went back from 1.1.0 to 1.0.0"),
        };
        assert_eq!(problem, wanted.0);
        assert!(text.contains(wanted.1), "{text}");
    }
}

#[test]
fn another_gateway_tests_and_confirms_what_runs_on_trial() {
    let begin = || {
        let rig = Rig::restarted();
        let note = rig.job.note().expect("it was restarted");
        (rig, note)
    };
    let resume = |rig: &mut Rig, note: &Note, tested| {
        rig.job = UpdateJob::resume(rig.now, note, tested);
        rig.job.on_up(rig.now, rig.boot)
    };
    let read = Next::Ask(UpdateRequest::Read);
    let confirm = Next::Ask(UpdateRequest::Confirm);
    let (mut rig, note) = begin();
    assert_eq!(resume(&mut rig, &note, None), read);
    let test = rig.answer(runs("1.1.0", false));
    assert_eq!(test, Next::Test(0, "20".to_owned()));
    assert_eq!(rig.job.on_tested(rig.now, Ok(())), confirm);
    // A test that has ended is not run again.
    let (mut rig, note) = begin();
    resume(&mut rig, &note, Some(Ok(())));
    assert_eq!(rig.answer(runs("1.1.0", false)), confirm);
    let (mut rig, note) = begin();
    resume(&mut rig, &note, Some(Err("stuck".to_owned())));
    let restart = Next::Ask(UpdateRequest::Restart);
    assert_eq!(rig.answer(runs("1.1.0", false)), restart);
    // It has gone back meanwhile, or had not restarted.
    let (mut rig, note) = begin();
    resume(&mut rig, &note, None);
    let Next::End(end) = rig.answer(runs("1.0.0", true)) else {
        panic!("it ends");
    };
    assert!(failure(end).starts_with("reverted: "));
    // It has not restarted yet: it is about to, waits for the command, or has given up.
    let asks = || {
        let (mut rig, note) = begin();
        rig.boot = 1;
        resume(&mut rig, &note, None);
        let ask = Next::Ask(UpdateRequest::Ask);
        assert_eq!(rig.answer(runs("1.0.0", true)), ask);
        rig
    };
    let mut rig = asks();
    assert_eq!(rig.answer(phase(UpdatePhase::Restarting)), Next::Wait);
    assert_eq!(rig.reboot(), read);
    assert_eq!(rig.answer(runs("1.1.0", false)), test);
    assert_eq!(asks().answer(phase(UpdatePhase::Ready)), restart);
    for other in [
        UpdatePhase::Idle,
        UpdatePhase::Receiving { offset: 32 },
        UpdatePhase::Verifying,
    ] {
        let Next::End(end) = asks().answer(phase(other)) else {
            panic!("it ends");
        };
        assert!(failure(end).contains("before the device had restarted"));
    }
}

#[test]
fn an_update_that_is_aborted_before_the_device_has_restarted_sends_nothing_more() {
    // The command to restart is lost with its session, and the client aborts. The image is marked to run: the device takes
    // that back when an update begins.
    for says in [UpdatePhase::Ready, UpdatePhase::Idle] {
        let mut rig = Rig::new();
        rig.answer(runs("1.0.0", true));
        let offset = LENGTH as u32;
        rig.answer(phase(UpdatePhase::Receiving { offset }));
        rig.answer(phase(UpdatePhase::Ready));
        assert_eq!(rig.job.abort(rig.now), Next::Wait);
        rig.job.on_lost(rig.now);
        let read = Next::Ask(UpdateRequest::Read);
        assert_eq!(rig.job.on_up(rig.now, rig.boot), read);
        let ask = Next::Ask(UpdateRequest::Ask);
        assert_eq!(rig.answer(runs("1.0.0", true)), ask);
        let begin = rig.answer(phase(says));
        let is_begin = matches!(begin, Next::Ask(UpdateRequest::Begin { .. }));
        assert!(is_begin, "{begin:?}");
        assert_eq!(rig.job.note(), None);
        let end = rig.answer(phase(UpdatePhase::Receiving { offset }));
        let text = "aborted; the device keeps 1.0.0".to_owned();
        assert_eq!(end, Next::End(Outcome::Aborted(text)));
        assert!(rig.job.is_sending(), "it is cancelled");
    }
}

/// An update whose device verifies.
fn verifying() -> Rig {
    let mut rig = Rig::new();
    rig.answer(runs("1.0.0", true));
    let offset = LENGTH as u32;
    rig.answer(phase(UpdatePhase::Receiving { offset }));
    rig.answer(phase(UpdatePhase::Verifying));
    rig
}

#[track_caller]
fn begins(next: &Next) {
    let begins = matches!(next, Next::Ask(UpdateRequest::Begin { .. }));
    assert!(begins, "{next:?}");
}

#[test]
fn an_update_that_is_aborted_while_the_device_verifies_ends_when_the_image_cannot_run() {
    let cancel = Next::Ask(UpdateRequest::Cancel);
    let receiving = UpdatePhase::Receiving { offset: 0 };
    let keeps = Next::End(Outcome::Aborted(
        "aborted; the device keeps 1.0.0".to_owned(),
    ));
    // The device may have marked the image before it has given up: another beginning takes that back.
    let mut rig = verifying();
    assert_eq!(rig.job.abort(rig.now), cancel);
    begins(&rig.answer(phase(UpdatePhase::Idle)));
    assert_eq!(rig.answer(phase(UpdatePhase::Stopping)), Next::Wait);
    assert_eq!(rig.answer(phase(receiving)), keeps);
    assert!(rig.job.is_sending(), "it is cancelled");
    // The client aborts while the device begins again.
    let mut rig = verifying();
    begins(&rig.answer(phase(UpdatePhase::Idle)));
    assert_eq!(rig.job.abort(rig.now), Next::Wait);
    assert_eq!(rig.answer(phase(receiving)), keeps);
    // The session is lost.
    let mut rig = verifying();
    rig.job.on_lost(rig.now);
    assert_eq!(rig.job.abort(rig.now), Next::Wait);
    let read = Next::Ask(UpdateRequest::Read);
    assert_eq!(rig.job.on_up(rig.now, rig.boot), read);
    let ask = Next::Ask(UpdateRequest::Ask);
    assert_eq!(rig.answer(runs("1.0.0", true)), ask);
    assert_eq!(rig.answer(phase(UpdatePhase::Verifying)), cancel);
    // A task that was started meanwhile keeps the device from beginning.
    begins(&rig.answer(phase(UpdatePhase::Idle)));
    let Next::End(Outcome::Aborted(told)) =
        rig.answer(Err(UpdateFailure::Refused("a task runs".to_owned())))
    else {
        panic!("it ends");
    };
    assert!(
        told.contains("may run 1.1.0 after its next reset"),
        "{told}"
    );
}

#[test]
fn a_device_that_is_reset_after_it_has_verified_runs_the_image() {
    for aborts in [false, true] {
        let mut rig = verifying();
        if aborts {
            rig.job.abort(rig.now);
        }
        assert_eq!(rig.reboot(), Next::Ask(UpdateRequest::Read));
        let next = rig.answer(runs("1.1.0", false));
        if !aborts {
            assert_eq!(next, Next::Test(0, "20".to_owned()));
            continue;
        }
        assert_eq!(next, Next::Ask(UpdateRequest::Restart));
        rig.reboot();
        let text = "aborted; the device went back to 1.0.0".to_owned();
        assert_eq!(
            rig.answer(runs("1.0.0", true)),
            Next::End(Outcome::Aborted(text))
        );
    }
    // If it does not answer, it may run either.
    let mut rig = verifying();
    rig.job.on_lost(rig.now);
    rig.job.abort(rig.now);
    rig.now = rig.job.poll_timeout();
    let Next::End(end) = rig.job.handle_timeout(rig.now) else {
        panic!("it ends");
    };
    let told = failure(end);
    assert!(
        told.contains("what the device runs is not certain"),
        "{told}"
    );
}

#[test]
fn a_device_that_dies_during_its_self_test_ends_the_update() {
    let mut rig = Rig::restarted();
    rig.answer(runs("1.1.0", false));
    // It answers again.
    rig.job.on_lost(rig.now);
    assert_eq!(rig.job.on_up(rig.now, rig.boot), Next::Wait);
    assert_eq!(rig.job.deadline, Instant::NEVER);
    // Its test carries on without a link, so it has no end.
    rig.job.on_lost(rig.now);
    rig.now = rig.job.poll_timeout();
    let Next::End(end) = rig.job.handle_timeout(rig.now) else {
        panic!("it ends");
    };
    let told = failure(end);
    assert!(
        told.contains("not answered in time; what the device runs is not certain"),
        "{told}"
    );
}

#[test]
fn the_next_gateway_knows_whether_the_firmware_was_confirmed_tested_or_refused() {
    let resume = |rig: &mut Rig, tested| {
        let note = rig.job.note().expect("it was restarted");
        rig.job = UpdateJob::resume(rig.now, &note, tested);
        rig.job.on_up(rig.now, rig.boot)
    };
    let updated = |after: &str, signed: Option<&str>| {
        Next::End(Outcome::Updated(Updated {
            before: "1.0.0".to_owned(),
            after: after.to_owned(),
            signed: signed.map(str::to_owned),
        }))
    };
    let read = Next::Ask(UpdateRequest::Read);
    // The gateway ends after it has asked the device to confirm, also one whose firmware says the version before.
    for (says, signed) in [("1.1.0", None), ("1.0.0", Some("1.1.0"))] {
        let mut rig = Rig::restarted();
        rig.answer(runs(says, false));
        assert_eq!(rig.job.note().expect("a note").trial, None);
        let confirm = Next::Ask(UpdateRequest::Confirm);
        assert_eq!(rig.job.on_tested(rig.now, Ok(())), confirm);
        assert_eq!(resume(&mut rig, Some(Ok(()))), read);
        assert_eq!(rig.answer(runs(says, true)), updated(says, signed));
        // It was reset before the question arrived, and went back.
        let mut rig = Rig::restarted();
        rig.answer(runs(says, false));
        rig.job.on_tested(rig.now, Ok(()));
        rig.boot += 1;
        assert_eq!(resume(&mut rig, Some(Ok(()))), read);
        let Next::End(end) = rig.answer(runs("1.0.0", true)) else {
            panic!("it ends");
        };
        let told = failure(end);
        let problem = match signed {
            Some(_) => "failed: the device was reset",
            None => "reverted: ",
        };
        assert!(told.starts_with(problem), "{told}");
    }
    // Whatever the journal has: only the new firmware has another version than the one before.
    let mut rig = Rig::restarted();
    resume(&mut rig, None);
    assert_eq!(rig.answer(runs("1.1.0", true)), updated("1.1.0", None));
    // A client has aborted the update.
    let mut rig = Rig::restarted();
    assert_eq!(rig.job.abort(rig.now), Next::Wait);
    resume(&mut rig, None);
    let restart = Next::Ask(UpdateRequest::Restart);
    assert_eq!(rig.answer(runs("1.1.0", false)), restart);
    // The self-test had failed, and the device has gone back already.
    let mut rig = Rig::restarted();
    resume(&mut rig, Some(Err("stuck".to_owned())));
    let Next::End(end) = rig.answer(runs("1.0.0", true)) else {
        panic!("it ends");
    };
    let told = failure(end);
    assert!(told.contains("the self-test failed: stuck"), "{told}");
    // The self-test was cut by the stop: it runs again.
    let mut rig = Rig::restarted();
    resume(&mut rig, None);
    assert_eq!(rig.job.on_test_cut(rig.now), Next::Wait);
    let test = Next::Test(0, "20".to_owned());
    assert_eq!(rig.answer(runs("1.1.0", false)), test);
    assert_eq!(rig.job.on_test_cut(rig.now), read);
    assert_eq!(rig.answer(runs("1.1.0", false)), test);
}

#[test]
fn the_progress_says_what_the_device_does() {
    let mut rig = Rig::new();
    rig.job.on_lost(rig.now);
    assert_eq!(rig.job.progress(false), "device is not answering");
    let waits = "waits for a search that says which board answers";
    assert_eq!(rig.job.progress(true), waits);
    let mut rig = Rig::restarted();
    assert_eq!(rig.job.progress(false), "the device restarts");
    rig.answer(runs("1.1.0", false));
    assert_eq!(rig.job.progress(false), "the device tests itself");
    let next = rig.job.on_tested(rig.now, Ok(()));
    assert_eq!(next, Next::Ask(UpdateRequest::Confirm));
    rig.answer(phase(UpdatePhase::Idle));
    assert_eq!(rig.job.progress(false), "asks what runs");
    // It is lost after its restart, and when it goes back.
    rig.job.on_lost(rig.now);
    assert_eq!(rig.job.progress(false), "device is not answering");
    let mut rig = Rig::restarted();
    rig.answer(runs("1.1.0", false));
    rig.job.on_tested(rig.now, Err("stuck".to_owned()));
    rig.job.on_lost(rig.now);
    assert_eq!(rig.job.progress(false), "the device goes back");
}
