//! An update of a device's firmware: what is asked next, and what an answer means. Without I/O.

mod abort;
mod resumed;

use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::update::UpdatePhase;
use ztl_link::{DeviceInfo, FirmwareInfo, UpdateAnswer, UpdateFailure, UpdateReply, UpdateRequest};

use crate::gateway::updates::{UpdateOptions, UpdateProblem, Updated};

/// Pause before a device that is busy is asked again.
const AGAIN: Duration = Duration::from_millis(50);
/// How long the link may be lost, and a device may take to restart or to go back.
const PATIENCE: Duration = Duration::from_secs(90);
/// How long a device may verify an image, or its components go to their safe state.
const BUSY: Duration = Duration::from_secs(60);
/// How long an update may take without progress in all, and how often it may begin a step again.
const STUCK: Duration = Duration::from_secs(300);
const ATTEMPTS: u32 = 20;

/// What is added to a failure after which the device may run either image.
const UNCERTAIN: &str = "what the device runs is not certain: `ztl devices` shows it";

/// An image that is sent.
#[derive(Debug)]
pub(super) struct Image {
    pub(super) version: String,
    pub(super) manifest: Vec<u8>,
    pub(super) bytes: Vec<u8>,
}

/// What an update does next.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// Ask the device.
    Ask(UpdateRequest),
    /// Wait for an event or the time.
    Wait,
    /// Run this task: the index of the component, and the goal.
    Test(u8, String),
    /// It has ended.
    End(Outcome),
}

/// How an update has ended.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    Updated(Updated),
    Failed(UpdateProblem, String),
    Aborted(String),
}

/// What was asked for, or is waited for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Asks what runs.
    Read,
    Begin,
    Write,
    Verify,
    Restart,
    /// The device restarts.
    Boot,
    Test,
    Confirm,
    /// A restart ends the trial.
    Revert,
    /// The link is lost.
    Lost,
}

/// An update.
#[derive(Debug)]
pub(super) struct UpdateJob {
    image: Image,
    options: UpdateOptions,
    step: Step,
    /// The device that is to be updated: its boot, and what it ran.
    before: Option<(u32, FirmwareInfo)>,
    /// All bytes before this offset are stored.
    sent: usize,
    /// Whether all bytes are stored and the device verifies them, or did: then a reset runs the image. Some answer nothing
    /// meanwhile.
    verifies: bool,
    /// Whether the device may have been restarted to run the image.
    restarted: bool,
    /// Whether it may have been confirmed.
    confirmed: bool,
    /// Why the device is to go back, or went back.
    unfit: Option<String>,
    aborted: bool,
    /// How far the update was last and at most: bytes that are stored, and then one for each further step.
    last: usize,
    furthest: usize,
    /// How often a step was begun again since then, and until when there must be progress.
    attempts: u32,
    stuck: Instant,
    /// The boot in which the new firmware was seen on trial, and the version that it says.
    trial: Option<(u32, String)>,
    /// How its self-test has ended.
    tested: Option<Result<(), String>>,
    /// Whether an earlier gateway has begun the update; this one does not have the image.
    resumed: bool,
    /// When to ask again.
    again: Option<(Instant, UpdateRequest)>,
    /// When the step has taken too long.
    deadline: Instant,
}

impl UpdateJob {
    /// An update that has asked for nothing.
    pub(super) fn new(now: Instant, image: Image, options: UpdateOptions) -> Self {
        Self {
            image,
            options,
            step: Step::Read,
            before: None,
            sent: 0,
            verifies: false,
            restarted: false,
            confirmed: false,
            unfit: None,
            aborted: false,
            last: 0,
            furthest: 0,
            attempts: 0,
            stuck: now + STUCK,
            trial: None,
            tested: None,
            resumed: false,
            again: None,
            deadline: now + PATIENCE,
        }
    }

    /// The update is as far as this. Returns `false` if it begins the same again too often.
    fn reaches(&mut self, now: Instant, far: usize) -> bool {
        let last = std::mem::replace(&mut self.last, far);
        if far > self.furthest {
            (self.furthest, self.attempts, self.stuck) = (far, 0, now + STUCK);
        } else if far <= last {
            self.attempts += 1;
        }
        self.attempts < ATTEMPTS
    }

    /// How far the update is after the image is complete.
    fn after_image(&self, steps: usize) -> usize {
        self.image.bytes.len() + steps
    }

    /// It begins the same again and again.
    fn give_up(&self) -> Next {
        let text = format!(
            "no progress in {ATTEMPTS} attempts ({}); {UNCERTAIN}",
            self.progress(false)
        );
        fail(UpdateProblem::Other, text)
    }

    /// The first request.
    pub(super) fn begin(&mut self, now: Instant) -> Next {
        self.step = Step::Read;
        self.deadline = now + PATIENCE;
        self.again = None;
        Next::Ask(UpdateRequest::Read)
    }

    /// How far it is, for people. `waits` says whether the device answers, but a search must say first which board it is.
    pub(super) fn progress(&self, waits: bool) -> String {
        let length = self.image.bytes.len();
        // It was seen on trial, so its restart is over.
        let back = !self.restarted || self.trial.is_some();
        match self.step {
            Step::Lost if waits => "waits for a search that says which board answers".to_owned(),
            Step::Lost | Step::Read if self.unfit.is_some() => "the device goes back".to_owned(),
            Step::Read if back => "asks what runs".to_owned(),
            Step::Begin => "waits until all components are safe".to_owned(),
            Step::Write => format!("sent {} of {length} bytes", self.sent),
            Step::Verify => "the device verifies the image".to_owned(),
            Step::Test => "the device tests itself".to_owned(),
            Step::Confirm => "confirms the new firmware".to_owned(),
            Step::Revert => "the device goes back".to_owned(),
            Step::Lost if back => "device is not answering".to_owned(),
            Step::Lost | Step::Read | Step::Restart | Step::Boot => {
                "the device restarts".to_owned()
            }
        }
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    pub(super) fn poll_timeout(&self) -> Instant {
        let again = self.again.as_ref().map_or(Instant::NEVER, |(at, _)| *at);
        again.min(self.deadline).min(self.stuck)
    }

    /// Asks again, or gives up.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Next {
        // A self-test takes as long as the trial lets it.
        if now >= self.stuck && self.step == Step::Test {
            self.stuck = now + STUCK;
        }
        if now >= self.deadline.min(self.stuck) {
            let what = match self.step {
                Step::Lost | Step::Read | Step::Test => "the device has not answered",
                Step::Boot | Step::Restart | Step::Revert => "the device has not restarted",
                _ => "the device has not finished",
            };
            let known = match self.restarted || self.verifies {
                true => format!("; {UNCERTAIN}"),
                false => String::new(),
            };
            return fail(UpdateProblem::Other, format!("{what} in time{known}"));
        }
        match self.again.take_if(|(at, _)| now >= *at) {
            Some((_, request)) => Next::Ask(request),
            None => Next::Wait,
        }
    }

    /// Whether the device is to be told that no more will be sent.
    pub(super) const fn is_sending(&self) -> bool {
        matches!(self.step, Step::Begin | Step::Write | Step::Verify) && !self.restarted
    }

    /// The link is lost.
    pub(super) fn on_lost(&mut self, now: Instant) {
        // The session learns how a test ends, if the device answers again.
        if self.step == Step::Test {
            self.deadline = self.deadline.min(now + PATIENCE);
            return;
        }
        if self.step != Step::Lost {
            self.step = Step::Lost;
            self.deadline = now + PATIENCE;
        }
        self.again = None;
    }

    /// The device answers, for the first time or again. A new session alone changes nothing.
    pub(super) fn on_up(&mut self, now: Instant, boot: u32) -> Next {
        let other_boot = self.before.as_ref().is_some_and(|(it, _)| *it != boot);
        let begins = match self.step {
            Step::Lost | Step::Revert => true,
            Step::Test => {
                if self.trial.as_ref().is_some_and(|(it, _)| *it == boot) {
                    self.deadline = Instant::NEVER;
                }
                false
            }
            // It was reset.
            Step::Begin | Step::Write | Step::Verify | Step::Restart | Step::Boot => other_boot,
            _ => false,
        };
        if !begins {
            return Next::Wait;
        }
        // A new session alone is no progress.
        if !self.reaches(now, 0) {
            return self.give_up();
        }
        self.begin(now)
    }

    /// The task that tests the firmware has ended.
    pub(super) fn on_tested(&mut self, now: Instant, result: Result<(), String>) -> Next {
        if self.step != Step::Test {
            // Of an earlier gateway; the device has not been asked yet.
            self.tested = Some(result);
            return Next::Wait;
        }
        self.on_test_result(now, result)
    }

    /// The task that tests the firmware was aborted because its gateway stopped, so another one tests it.
    pub(super) fn on_test_cut(&mut self, now: Instant) -> Next {
        match self.step {
            Step::Test => self.begin(now),
            _ => Next::Wait,
        }
    }

    fn on_test_result(&mut self, now: Instant, result: Result<(), String>) -> Next {
        self.tested = Some(result.clone());
        match result {
            Ok(()) => self.confirm(now),
            Err(reason) => self.revert(now, test_failed(&reason)),
        }
    }

    /// The answer to the last request.
    pub(super) fn on_answer(
        &mut self,
        now: Instant,
        device: &DeviceInfo,
        answer: UpdateAnswer,
    ) -> Next {
        match answer {
            Err(UpdateFailure::Lost) => {
                self.on_lost(now);
                Next::Wait
            }
            Err(UpdateFailure::NoUpdates) => fail(
                UpdateProblem::Other,
                "its firmware takes no updates, or is older than updates".to_owned(),
            ),
            Err(UpdateFailure::TooLong) => fail(
                UpdateProblem::Manifest,
                "the manifest is longer than the device takes".to_owned(),
            ),
            Err(UpdateFailure::Refused(_)) if self.step == Step::Begin && self.aborted => {
                self.end_marked()
            }
            Err(UpdateFailure::Refused(reason)) => {
                let problem = match self.step {
                    Step::Begin => UpdateProblem::Busy,
                    _ => UpdateProblem::Other,
                };
                fail(problem, format!("the device refuses: {reason}"))
            }
            Ok(UpdateReply::Firmware(firmware)) => self.on_firmware(now, device, firmware),
            Ok(UpdateReply::Phase(UpdatePhase::Failed(error))) => {
                fail(error.into(), error.to_string())
            }
            Ok(UpdateReply::Phase(phase)) => self.on_phase(now, device, phase),
        }
    }

    fn on_firmware(&mut self, now: Instant, device: &DeviceInfo, firmware: FirmwareInfo) -> Next {
        let other_boot = self
            .before
            .as_ref()
            .is_some_and(|(it, _)| *it != device.boot);
        // Any reset after the verification runs the image.
        self.restarted |= self.verifies && other_boot && !firmware.confirmed;
        if !self.restarted || !other_boot {
            let version = firmware.version.clone();
            if !firmware.confirmed {
                let reason = format!(
                    "{version} is on trial and not confirmed yet; wait until the device has gone back"
                );
                return fail(UpdateProblem::Busy, reason);
            }
            // What it ran before counts, also if it was reset while it received.
            let before = self.before.take().map_or(firmware, |(_, before)| before);
            self.before = Some((device.boot, before));
            if self.verifies && !other_boot {
                self.step = Step::Verify;
                self.deadline = now + BUSY;
                return Next::Ask(UpdateRequest::Ask);
            }
            return self.ask_to_begin(now);
        }
        if !firmware.confirmed {
            return self.on_trial(now, device.boot, firmware);
        }
        let version = firmware.version;
        // In the boot of the trial, or with a version that only the new firmware has: otherwise the device went back.
        let stays = self.trial.as_ref().filter(|_| self.confirmed);
        let same_boot = stays.is_some_and(|(boot, _)| *boot == device.boot);
        let same_version = stays.is_some_and(|(_, on_trial)| *on_trial == version);
        let had_same = self.version_before() == version;
        // An earlier gateway may have confirmed it.
        let by_other = self.resumed && self.image.version == version;
        if same_boot || (same_version || by_other) && !had_same {
            let signed = Some(self.image.version.clone()).filter(|signed| *signed != version);
            return Next::End(Outcome::Updated(Updated {
                before: self.version_before(),
                after: version,
                signed,
            }));
        }
        if self.aborted {
            let text = format!("aborted; the device went back to {version}");
            return Next::End(Outcome::Aborted(text));
        }
        if same_version {
            let text = format!(
                "the device was reset after the confirmation was sent; it runs {version}, which both images say they are"
            );
            return fail(UpdateProblem::Other, text);
        }
        let why = self.unfit.take();
        let why = why.unwrap_or_else(|| match self.trial {
            None if !self.resumed => {
                "it was reset before it answered with the new firmware".to_owned()
            }
            _ => "it was not confirmed in time".to_owned(),
        });
        let text = format!(
            "the device went back from {} to {version}: {why}",
            self.image.version
        );
        fail(UpdateProblem::Reverted, text)
    }

    /// The image runs, and is not confirmed. Only this tells it from the one before: its version is what it says itself.
    fn on_trial(&mut self, now: Instant, boot: u32, firmware: FirmwareInfo) -> Next {
        if !self.reaches(now, self.after_image(2)) {
            return self.give_up();
        }
        if self.trial.as_ref().is_some_and(|(known, _)| *known != boot) {
            self.tested = None;
        }
        self.trial = Some((boot, firmware.version));
        if self.aborted || self.unfit.is_some() {
            let why = self.unfit.take();
            return self.revert(now, why.unwrap_or_else(|| abort::ABORTED.to_owned()));
        }
        if let Some(result) = self.tested.clone() {
            return self.on_test_result(now, result);
        }
        match firmware.self_test {
            Some((component, goal)) => {
                self.step = Step::Test;
                // The device ends its trial by itself.
                self.deadline = Instant::NEVER;
                Next::Test(component, goal)
            }
            None => self.confirm(now),
        }
    }

    fn ask_to_begin(&mut self, now: Instant) -> Next {
        if self.resumed && self.aborted {
            return self.end_aborted();
        }
        if self.resumed {
            return fail(
                UpdateProblem::Other,
                format!(
                    "the gateway ended before the device had restarted; it runs {}",
                    self.version_before()
                ),
            );
        }
        self.restarted = false;
        if self.step != Step::Begin {
            self.step = Step::Begin;
            self.deadline = now + BUSY;
        }
        Next::Ask(UpdateRequest::Begin {
            now: self.options.now,
            downgrade: self.options.downgrade,
            manifest: self.image.manifest.clone(),
        })
    }

    fn confirm(&mut self, now: Instant) -> Next {
        self.step = Step::Confirm;
        self.confirmed = true;
        self.deadline = now + PATIENCE;
        Next::Ask(UpdateRequest::Confirm)
    }

    /// Ends the trial.
    fn revert(&mut self, now: Instant, why: String) -> Next {
        if self.step != Step::Revert {
            self.step = Step::Revert;
            self.deadline = now + PATIENCE;
        }
        self.unfit = Some(why);
        Next::Ask(UpdateRequest::Restart)
    }

    fn on_phase(&mut self, now: Instant, device: &DeviceInfo, phase: UpdatePhase) -> Next {
        match (self.step, phase) {
            // The image is not marked to run any more.
            (Step::Begin | Step::Verify, UpdatePhase::Receiving { .. })
                if self.aborted && !self.resumed =>
            {
                self.end_aborted()
            }
            (Step::Begin | Step::Write, UpdatePhase::Receiving { offset }) => {
                self.verifies = false;
                self.write(now, device, offset)
            }
            // The question was lost with its session.
            (Step::Verify, UpdatePhase::Stopping) if !self.resumed => self.ask_to_begin(now),
            (Step::Verify, UpdatePhase::Verifying) if self.aborted && !self.resumed => {
                Next::Ask(UpdateRequest::Cancel)
            }
            // It restarts soon.
            (Step::Begin, UpdatePhase::Stopping | UpdatePhase::Restarting) => {
                let Next::Ask(request) = self.ask_to_begin(now) else {
                    return Next::Wait;
                };
                self.ask_again(now, request)
            }
            // It waits for the command to restart, which is not sent any more. Only another beginning takes the mark away.
            (Step::Verify | Step::Restart, UpdatePhase::Ready) if self.aborted && !self.resumed => {
                self.ask_to_begin(now)
            }
            // Another gateway sends an image meanwhile.
            (Step::Verify, UpdatePhase::Receiving { .. } | UpdatePhase::Verifying)
                if self.resumed =>
            {
                self.ask_to_begin(now)
            }
            // The session was lost, so the device has given up.
            (Step::Write | Step::Verify | Step::Restart, UpdatePhase::Idle) => {
                if !self.reaches(now, 0) {
                    return self.give_up();
                }
                self.ask_to_begin(now)
            }
            // The command to verify was lost with its session.
            (Step::Verify, UpdatePhase::Receiving { offset }) => self.write(now, device, offset),
            (Step::Verify, UpdatePhase::Verifying) => self.ask_again(now, UpdateRequest::Ask),
            (Step::Verify, UpdatePhase::Ready) => {
                self.reaches(now, self.after_image(1));
                self.step = Step::Restart;
                self.restarted = true;
                Next::Ask(UpdateRequest::Restart)
            }
            (Step::Verify | Step::Restart, UpdatePhase::Restarting) => {
                self.step = Step::Boot;
                self.deadline = now + PATIENCE;
                Next::Wait
            }
            (Step::Revert, UpdatePhase::Restarting) => Next::Wait,
            // It has gone back already.
            (Step::Revert, _) => self.ask_again(now, UpdateRequest::Read),
            (Step::Confirm, _) => {
                self.step = Step::Read;
                Next::Ask(UpdateRequest::Read)
            }
            (_, phase) => {
                let text = format!("the device answered {phase:?} out of turn");
                fail(UpdateProblem::Other, text)
            }
        }
    }

    /// Sends the next piece, or the end.
    fn write(&mut self, now: Instant, device: &DeviceInfo, offset: u32) -> Next {
        let at = usize::try_from(offset).unwrap_or(usize::MAX);
        let length = self.image.bytes.len();
        self.sent = at;
        // Also the first byte is progress.
        if !self.reaches(now, at.saturating_add(1).min(length)) {
            return self.give_up();
        }
        if at == length {
            self.step = Step::Verify;
            self.verifies = true;
            self.deadline = now + BUSY;
            return Next::Ask(UpdateRequest::Finish);
        }
        self.step = Step::Write;
        self.deadline = now + BUSY;
        let end = at.saturating_add(device.longest_piece()).min(length);
        match self.image.bytes.get(at..end) {
            Some(bytes) if !bytes.is_empty() => Next::Ask(UpdateRequest::Write {
                offset,
                bytes: bytes.to_vec(),
            }),
            _ => {
                let text = format!("the device asks for byte {offset} of {length}");
                fail(UpdateProblem::Other, text)
            }
        }
    }

    fn ask_again(&mut self, now: Instant, request: UpdateRequest) -> Next {
        self.again = Some((now + AGAIN, request));
        Next::Wait
    }

    fn version_before(&self) -> String {
        let before = self.before.as_ref();
        before.map_or_else(|| "what it runs".to_owned(), |(_, it)| it.version.clone())
    }
}

fn test_failed(reason: &str) -> String {
    format!("the self-test failed: {reason}")
}

fn fail(problem: UpdateProblem, text: String) -> Next {
    Next::End(Outcome::Failed(problem, text))
}

#[cfg(test)]
mod tests;
