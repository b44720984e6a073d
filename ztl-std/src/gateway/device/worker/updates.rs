//! Requests of clients about the firmware of a device: uploads, and one update at a time.

use std::collections::VecDeque;
use std::time::Duration;

use tracing::{info, warn};
use ztl_core::manifest::{MANIFEST_LEN, Manifest};
use ztl_core::{Instant, State, TaskId};
use ztl_link::{
    Entry, SessionJournal as _, UpdateAnswer, UpdateFailure, UpdateReply, UpdateRequest,
};

use super::Worker;
use super::update_job::{Image, Next, Outcome, UpdateJob};
use crate::gateway::device::input::{DeviceRequest, Input};
use crate::gateway::journal::UNWRITTEN;
use crate::gateway::updates::{
    LONGEST_IMAGE, LONGEST_PART, Note, RunningFirmware, UPDATES, UpdateGoal, UpdateOptions,
    UpdateProblem, bytes_of,
};
use crate::log_targets::GATEWAY;
use crate::server::{ReservedId, TaskReporter};
use crate::task_request::{TaskRequest, encoded};
use crate::terminal::quoted;
use crate::time::now;

/// How long the parts of a file are kept after the last one.
const KEPT: Duration = Duration::from_secs(30);
/// How long after a part no other file is taken: its client sends the next one at once.
const OWNED: Duration = Duration::from_secs(3);
/// Longest text that says which file a part is of, in bytes.
const LONGEST_NAME: usize = 128;

/// A file that is uploaded. Any client with the same file may go on with it.
struct Upload {
    file: String,
    bytes: Vec<u8>,
    /// When the last part has arrived.
    latest: Instant,
}

/// An update that runs.
pub(super) struct Running {
    pub(super) task: TaskReporter,
    pub(super) goal: String,
    pub(super) job: UpdateJob,
    /// The number of the last request.
    asked: u64,
    /// The id of the board on a shared line, and whether a search must say first which one answers.
    pub(super) board: Option<String>,
    pub(super) waits: bool,
    /// The task that tests the firmware, or has tested it.
    pub(super) test: Option<TaskId>,
    /// Whether a gateway has stopped meanwhile: if that task ends as ABORTED, this says nothing about the firmware.
    pub(super) stopped: bool,
    /// Whether a client has aborted that task.
    pub(super) test_refused: bool,
    /// What the journal has for the next gateway.
    pub(super) noted: Option<Note>,
    /// The component and the goal of the next test, until it has an id.
    pub(super) next_test: Option<(u8, String)>,
}

impl Running {
    pub(super) fn new(task: TaskReporter, goal: String, job: UpdateJob) -> Self {
        Self {
            task,
            goal,
            job,
            asked: 0,
            board: None,
            waits: false,
            test: None,
            stopped: false,
            test_refused: false,
            noted: None,
            next_test: None,
        }
    }
}

/// The requests about firmware of a device.
#[derive(Default)]
pub(super) struct Updates {
    upload: Option<Upload>,
    pub(super) running: Option<Box<Running>>,
    /// Questions for what runs, each with its number.
    questions: VecDeque<(u64, TaskReporter, DeviceRequest)>,
    /// The number of the last request to the session.
    asked: u64,
}

impl Updates {
    pub(super) fn is_empty(&self) -> bool {
        self.running.is_none() && self.questions.is_empty()
    }

    /// When there is something to do.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let upload = self.upload.as_ref().map(|upload| upload.latest + KEPT);
        let job = self.running.as_ref().map(|it| it.job.poll_timeout());
        ztl_core::time::earliest(upload, job.filter(|at| *at != Instant::NEVER))
    }

    /// Keeps a part of a file.
    fn add(
        &mut self,
        now: Instant,
        file: String,
        offset: usize,
        base64: &str,
    ) -> Result<usize, String> {
        if file.len() > LONGEST_NAME {
            return Err(format!("FILE is longer than {LONGEST_NAME} bytes"));
        }
        let bytes = bytes_of(base64).filter(|bytes| bytes.len() <= LONGEST_PART);
        let bytes = bytes.ok_or_else(|| {
            format!("the part is not base64, or is longer than {LONGEST_PART} bytes")
        })?;
        let other = self.upload.as_ref().filter(|upload| upload.file != file);
        if other.is_some_and(|other| now < other.latest + OWNED) {
            return Err("another image is being sent to this device; try again".to_owned());
        }
        if other.is_some() && offset > 0 {
            return Err("another image was sent to this device meanwhile; try again".to_owned());
        }
        let upload = match &mut self.upload {
            Some(upload) if upload.file == file => upload,
            place => place.insert(Upload {
                file,
                bytes: Vec::new(),
                latest: now,
            }),
        };
        let has = upload.bytes.len();
        let known = upload.bytes.get(offset..);
        let Some(known) = known else {
            return Err(format!("the part begins at {offset}, expected {has}"));
        };
        // Of what another client, or an earlier attempt, has sent already.
        let same = known.len().min(bytes.len());
        if known.get(..same) != bytes.get(..same) {
            self.upload = None;
            return Err("the part differs from what was sent before as the same file".to_owned());
        }
        let new = bytes.get(same..).unwrap_or_default();
        if has + new.len() > LONGEST_IMAGE {
            self.upload = None;
            return Err(format!("the image is longer than {LONGEST_IMAGE} bytes"));
        }
        upload.bytes.extend_from_slice(new);
        upload.latest = now;
        Ok(upload.bytes.len())
    }

    /// The uploaded image.
    fn image(&mut self, options: &UpdateOptions) -> Result<Image, (UpdateProblem, String)> {
        if self.running.is_some() {
            let text = "another update of this device is in progress".to_owned();
            return Err((UpdateProblem::Busy, text));
        }
        let uploaded = self.upload.as_ref();
        let uploaded = uploaded.filter(|upload| upload.file == options.file);
        let has = uploaded.map_or(0, |upload| upload.bytes.len());
        if has != options.length {
            let length = options.length;
            let text = format!("the gateway has {has} bytes of an image of {length}");
            return Err((UpdateProblem::Other, text));
        }
        let uploaded = self.upload.take();
        let file = uploaded.map(|upload| upload.bytes).unwrap_or_default();
        let parsed = Manifest::parse(&file);
        let parsed = parsed.map_err(|error| (UpdateProblem::Manifest, error.to_string()))?;
        let (length, has) = (parsed.manifest.length, parsed.image.len());
        if usize::try_from(length) != Ok(has) {
            let text = format!("the file has {has} bytes of an image of {length}");
            return Err((UpdateProblem::Manifest, text));
        }
        Ok(Image {
            version: parsed.manifest.version.to_string(),
            manifest: file.get(..MANIFEST_LEN).unwrap_or_default().to_vec(),
            bytes: parsed.image.to_vec(),
        })
    }
}

impl Worker {
    /// Takes a request of a client about firmware.
    pub(super) fn on_update_request(&mut self, task: TaskReporter, request: DeviceRequest) {
        match UpdateGoal::parse(&request.goal) {
            Err(reason) => task.rejected(reason),
            Ok(UpdateGoal::Status) => {
                if let Some(task) = self.begin_own(task, &request) {
                    let number = self.next_update();
                    self.updates.questions.push_back((number, task, request));
                    self.session
                        .request_update(now(), number, UpdateRequest::Read);
                }
            }
            // The journal has no parts: they move nothing, and are answered at once.
            Ok(UpdateGoal::Part(..))
                if request.claim.as_ref().is_some_and(|claim| !claim.take()) =>
            {
                task.rejected(UNWRITTEN);
            }
            Ok(UpdateGoal::Part(file, offset, base64)) => {
                match self.updates.add(now(), file, offset, &base64) {
                    Ok(length) => task.completed(length.to_string()),
                    Err(reason) => task.failed(reason),
                }
            }
            Ok(UpdateGoal::Run(options)) => {
                if let Some(task) = self.begin_own(task, &request) {
                    self.run_update(task, request, options);
                }
            }
        }
    }

    fn next_update(&mut self) -> u64 {
        self.updates.asked += 1;
        self.updates.asked
    }

    fn run_update(&mut self, task: TaskReporter, request: DeviceRequest, options: UpdateOptions) {
        let image = match self.updates.image(&options) {
            Ok(image) => image,
            Err((problem, text)) => {
                let text = format!("{problem}: {text}");
                return self.end_own(task, &request, Err(text));
            }
        };
        let (name, version) = (&self.name, quoted(&image.version).into_owned());
        info!(target: GATEWAY, device = name, "Device '{name}': an update to {version} begins.");
        task.accepted(&request.reply);
        let job = UpdateJob::new(now(), image, options);
        self.updates.running = Some(Box::new(Running::new(task, request.goal, job)));
        match self.is_board_of_update() {
            true => self.step(|job| job.begin(now())),
            false => self.on_update_lost(),
        }
    }

    /// Lets the running update do something, and carries out what follows.
    pub(super) fn step(&mut self, act: impl FnOnce(&mut UpdateJob) -> Next) {
        // The next gateway goes on.
        if self.stopping.is_some() {
            return;
        }
        if let Some(running) = &mut self.updates.running {
            let next = act(&mut running.job);
            self.go_on(next);
        }
    }

    fn go_on(&mut self, next: Next) {
        if !matches!(next, Next::End(_)) {
            self.note_update();
        }
        let number = self.updates.asked + 1;
        let Some(running) = &mut self.updates.running else {
            return;
        };
        let waits = running.waits && self.session.is_up();
        running.task.progress(running.job.progress(waits));
        match next {
            Next::Wait => {}
            Next::Ask(request) => {
                running.asked = number;
                self.updates.asked = number;
                self.session.request_update(now(), number, request);
            }
            // One that an earlier gateway has begun.
            Next::Test(..) if running.test.is_some_and(|id| self.tasks.contains_key(&id)) => {}
            Next::Test(component, goal) => {
                running.next_test = Some((component, goal));
                match self.own_tasks.get() {
                    Some(tasks) => {
                        let inputs = self.inputs.clone();
                        tasks.reserve(move |id| {
                            let _ = inputs.send(Input::TestReserved(id));
                        });
                    }
                    None => self.step(|job| {
                        job.on_tested(now(), Err("the gateway has no server".to_owned()))
                    }),
                }
            }
            Next::End(outcome) => self.end_update(outcome),
        }
    }

    /// There is an id for the task that tests the new firmware.
    pub(super) fn on_test_reserved(&mut self, id: ReservedId) {
        let Some(running) = &mut self.updates.running else {
            return;
        };
        let Some((component, goal)) = running.next_test.take() else {
            return;
        };
        let device = self.session.device();
        let component = device.and_then(|it| it.components.get(usize::from(component)));
        let Some(component) = component.map(|component| component.name.clone()) else {
            return self.step(|job| job.on_tested(now(), Err("no such component".to_owned())));
        };
        let request = TaskRequest {
            id: id.id(),
            handler: self.name.clone(),
            component,
            goal,
        };
        running.test = Some(request.id);
        (running.stopped, running.test_refused) = (false, false);
        // A client must not see an id before the journal has it: after a restart, another task could get it.
        if !self.note_update() && self.session.journal_mut().is_some() {
            if let Some(running) = &mut self.updates.running {
                running.test = None;
            }
            let why = Err("the journal cannot be written".to_owned());
            return self.step(|job| job.on_tested(now(), why));
        }
        let shown = DeviceRequest::from(&request);
        self.log_task(request.id, &shown, "tests the new firmware");
        let task = id.begin_here(encoded(&request.handler, &request.component, &request.goal));
        self.tasks.insert(request.id, (task, shown));
        self.session
            .start(now(), request.id, &request.component, &request.goal);
    }

    /// A task has ended, or was rejected: perhaps the one that tests the new firmware.
    pub(super) fn on_task_over(&mut self, id: TaskId, state: State, text: &str) {
        let Some(running) = &self.updates.running else {
            return;
        };
        if running.test != Some(id) {
            return;
        }
        if self.stopping.is_some() {
            return self.leave_update();
        }
        let cut = running.stopped;
        self.step(|job| match state {
            State::Completed => job.on_tested(now(), Ok(())),
            State::Aborted if cut => job.on_test_cut(now()),
            _ => job.on_tested(now(), Err(text.to_owned())),
        });
    }

    /// Handles the answer to the request with this number.
    pub(super) fn on_update_answer(&mut self, number: u64, answer: UpdateAnswer) {
        let questions = &mut self.updates.questions;
        if let Some(at) = questions.iter().position(|(asked, ..)| *asked == number) {
            if let Some((_, task, request)) = questions.remove(at) {
                self.end_own(task, &request, running_firmware(answer));
            }
            return;
        }
        let running = self.updates.running.as_ref();
        if running.is_none_or(|running| running.asked != number) {
            return;
        }
        match self.session.device().cloned() {
            Some(device) => self.step(|job| job.on_answer(now(), &device, answer)),
            None => self.on_update_lost(),
        }
    }

    /// The link is lost.
    pub(super) fn on_update_lost(&mut self) {
        self.step(|job| {
            job.on_lost(now());
            Next::Wait
        });
    }

    /// The device answers.
    pub(super) fn on_update_up(&mut self) {
        let goes_on = self.updates.running.is_some() && self.stopping.is_none();
        if !goes_on || !self.is_board_of_update() {
            return;
        }
        if let Some(boot) = self.session.device().map(|device| device.boot) {
            self.step(|job| job.on_up(now(), boot));
        }
    }

    /// Asks again, gives up, and drops an upload that is not used.
    pub(super) fn on_update_timeout(&mut self) {
        let now = now();
        self.updates
            .upload
            .take_if(|upload| now >= upload.latest + KEPT);
        let running = self.updates.running.as_ref();
        if running.is_some_and(|running| now >= running.job.poll_timeout()) {
            self.step(|job| job.handle_timeout(now));
        }
    }

    /// Aborts the update with this id, or any.
    pub(super) fn abort_update(&mut self, id: Option<TaskId>) {
        let Some(running) = &mut self.updates.running else {
            return;
        };
        if id.is_some_and(|id| id != running.task.id()) {
            if id == running.test {
                (running.stopped, running.test_refused) = (false, true);
                self.note_update();
            }
            return;
        }
        running.next_test = None;
        let test = running.test.filter(|id| self.tasks.contains_key(id));
        self.step(|job| job.abort(now()));
        if let Some(test) = test {
            self.session.abort(now(), test);
        }
    }

    /// It cannot go on.
    pub(super) fn stop_update(&mut self, why: &str) {
        if let Some(running) = &self.updates.running {
            let what = match running.job.may_be_marked() {
                true => "may run the new firmware after its next reset",
                false => "keeps the firmware that it runs, or goes back to it",
            };
            let text = format!("{why}; the device {what}");
            self.end_update(Outcome::Failed(UpdateProblem::Other, text));
        }
    }

    /// Tells the device, the journal, the log and the client.
    pub(super) fn end_update(&mut self, outcome: Outcome) {
        let Some(running) = self.updates.running.take() else {
            return;
        };
        if running.job.is_sending() {
            let number = self.next_update();
            self.session
                .request_update(now(), number, UpdateRequest::Cancel);
        }
        let (state, text) = match outcome {
            Outcome::Updated(updated) => match serde_json::to_string(&updated) {
                Ok(json) => (State::Completed, json),
                Err(error) => (State::Failed, error.to_string()),
            },
            Outcome::Failed(problem, text) => (State::Failed, format!("{problem}: {text}")),
            Outcome::Aborted(text) => (State::Aborted, text),
        };
        let (task, name) = (running.task, &self.name);
        let entry = Entry {
            id: task.id(),
            component: UPDATES,
            goal: &running.goal,
            sent: None,
        };
        // The device has acted already, so the client gets the true outcome even if the disk is full.
        let _ = self.session.journal_mut().ended(&entry, state, &text);
        let shown = quoted(&text);
        match state {
            State::Completed => {
                info!(target: GATEWAY, device = name, "Device '{name}': its update has ended: {shown}");
                task.completed(text);
            }
            State::Aborted => {
                warn!(target: GATEWAY, device = name, "Device '{name}': its update was aborted: {shown}");
                task.aborted(text);
            }
            _ => {
                warn!(target: GATEWAY, device = name, "Device '{name}': its update has failed: {shown}");
                task.failed(text);
            }
        }
    }
}

/// The answer to a question for what runs.
fn running_firmware(answer: UpdateAnswer) -> Result<String, String> {
    match answer {
        Ok(UpdateReply::Firmware(firmware)) => {
            serde_json::to_string(&RunningFirmware::from(&firmware))
                .map_err(|error| error.to_string())
        }
        Ok(UpdateReply::Phase(_)) | Err(UpdateFailure::TooLong) => {
            Err("the device does not answer the question".to_owned())
        }
        Err(UpdateFailure::NoUpdates) => {
            Err("its firmware takes no updates, or is older than updates".to_owned())
        }
        Err(UpdateFailure::Lost) => Err("the device is not answering".to_owned()),
        Err(UpdateFailure::Refused(reason)) => Err(format!("the device refuses: {reason}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(updates: &mut Updates, seconds: u64, file: &str, at: usize) -> Result<usize, String> {
        let now = Instant::from_millis(seconds * 1000);
        let bytes: Vec<u8> = file.bytes().cycle().take(30).collect();
        let UpdateGoal::Part(_, _, base64) = UpdateGoal::part(file, at, &bytes) else {
            panic!("a part");
        };
        updates.add(now, file.to_owned(), at, &base64)
    }

    #[test]
    fn an_upload_has_one_file_and_is_free_soon_after_its_client_has_gone() {
        let mut updates = Updates::default();
        assert_eq!(part(&mut updates, 0, "abc", 0), Ok(30));
        assert_eq!(part(&mut updates, 1, "abc", 30), Ok(60));
        let busy = part(&mut updates, 2, "xyz", 0).expect_err("the other one is there");
        assert!(busy.contains("another image is being sent"), "{busy}");
        // Whoever has the same file goes on with it, from the beginning or from anywhere.
        assert_eq!(part(&mut updates, 2, "abc", 0), Ok(60));
        assert_eq!(part(&mut updates, 2, "abc", 30), Ok(60));
        assert_eq!(part(&mut updates, 2, "abc", 60), Ok(90));
        let gap = part(&mut updates, 2, "abc", 120).expect_err("a part is missing");
        assert!(gap.contains("begins at 120, expected 90"), "{gap}");
        assert_eq!(part(&mut updates, 6, "xyz", 0), Ok(30));
        let late = part(&mut updates, 10, "abc", 90).expect_err("it was replaced");
        assert!(late.contains("another image was sent"), "{late}");
        let options = UpdateOptions {
            file: "abc".to_owned(),
            length: 30,
            ..UpdateOptions::default()
        };
        let other = updates.image(&options).expect_err("another file");
        assert!(other.1.contains("has 0 bytes"), "{other:?}");
        // It was not taken, and is not lost.
        assert_eq!(part(&mut updates, 10, "xyz", 30), Ok(60));
    }

    #[test]
    fn parts_that_differ_are_not_mixed() {
        let mut updates = Updates::default();
        assert_eq!(part(&mut updates, 0, "abc", 0), Ok(30));
        let UpdateGoal::Part(_, _, base64) = UpdateGoal::part("abc", 0, b"abd") else {
            panic!("a part");
        };
        let differs = updates.add(Instant::ZERO, "abc".to_owned(), 0, &base64);
        assert!(differs.is_err_and(|why| why.contains("differs")));
        assert!(updates.upload.is_none());
    }
}
