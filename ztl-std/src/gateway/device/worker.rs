//! What a device's thread does: runs the session, the line and the clients' tasks.

mod boards;
mod handover;
mod own;
mod requests;
mod stop;
mod update_job;
mod updates;

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::time::Duration;

use tracing::info;
use ztl_core::link::ADDR_ONLY_NODE;
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId};

use ztl_link::bus::Boards;
use ztl_link::{LinkEvent, Session};

use super::input::{DeviceRequest, Input};
use super::line_reader::{LineEvent, run_line};
use super::parameters::Parameters;
use super::status::SharedStatus;
use crate::gateway::endpoint::{READ_TIMEOUT, is_pause};
use crate::gateway::journal::{DeviceJournal, JournalFile};
use crate::gateway::logs::DeviceLog;
use crate::gateway::opener::Opener;
use crate::gateway::rate_limited_log::{RateLimitedLog, Severity};
use crate::gateway::readings::Observers;
use crate::gateway::seat::Seat;
use crate::log_targets::GATEWAY;
use crate::rate_limit::RateLimit;
use crate::server::TaskReporter;
use crate::task_request::TaskRequest;
use crate::time::now;
pub(in crate::gateway) use own::OwnTasksCell;
use own::{EventLog, NextId, STARTS};
use updates::Updates;

/// First and longest pause before a line is reopened. Looking for a port is cheap, and a person who plugs a
/// device in wants it at once.
const RETRY: (Duration, Duration) = (Duration::from_millis(50), Duration::from_millis(500));
/// Longest pause before a TCP line is reopened.
const RETRY_HALF_OPEN: Duration = Duration::from_secs(2);
/// Link timeouts without an answer after which a line that may be half open is reopened.
const SILENCES: u32 = 5;
/// Log a warning if opening a line takes longer.
const OPENING: Duration = Duration::from_secs(3);
/// What is wrong with a device that does not answer.
const NOT_ANSWERING: &str = "device is not answering";
/// How long a stopping gateway waits for its tasks to stop.
const STOP: Duration = Duration::from_secs(1);
/// Inputs handled before deadlines are checked.
const BATCH: usize = 64;

/// The state of the line.
enum LineState {
    /// Closed; opened again at `retry`.
    Closed { retry: Instant },
    /// A thread is opening it.
    Opening {
        stop: Arc<AtomicBool>,
        since: Instant,
    },
    Open {
        writer: Box<dyn Write + Send>,
        stop: Arc<AtomicBool>,
    },
}

/// A device's thread.
pub(super) struct Worker {
    pub(super) name: String,
    opener: Option<Opener>,
    pub(super) session: Session<Option<DeviceJournal<JournalFile>>>,
    pub(super) inputs: Sender<Input>,
    line: LineState,
    /// Number of the current line. Inputs of earlier ones are ignored.
    number: u64,
    pause: Duration,
    /// Consecutive `Hello`s without an answer.
    silences: u32,
    /// The target of the line's path when it was opened.
    target: Option<PathBuf>,
    /// What is wrong with the line or the device, for reasons and the log.
    problem: Option<String>,
    /// Whether the device was ready and nothing has been wrong since. The new session that follows 255 commands changes
    /// nothing.
    ready: bool,
    pub(super) log: RateLimitedLog,
    /// The boards at its address of a shared line, how many searches were taken into account, and why the device takes no tasks.
    pub(super) boards: Boards,
    pub(super) searches: u64,
    pub(super) conflict: Option<String>,
    pub(super) tasks: HashMap<TaskId, (TaskReporter, DeviceRequest)>,
    pub(super) own_tasks: OwnTasksCell,
    next_id: NextId,
    /// Limits the tasks of the firmware.
    pub(super) starts: RateLimit,
    parameters: Parameters,
    updates: Updates,
    /// Tasks from before a restart that must be resumed before the line is opened.
    awaited: usize,
    /// Deadline for the tasks to stop, if the thread is to end.
    pub(super) stopping: Option<Instant>,
    /// Rejects tasks, and closes the line when all have ended.
    retired: bool,
    /// The line at which the device is served again after that.
    next: Option<Opener>,
    unused: Arc<AtomicBool>,
    status: SharedStatus,
    pub(super) observers: Observers,
    event_log: EventLog,
    firmware_log: DeviceLog,
}

impl Worker {
    /// Opens the line after `awaited` tasks have been resumed.
    pub(super) fn new(
        name: &str,
        opener: Option<Opener>,
        session: Session<Option<DeviceJournal<JournalFile>>>,
        inputs: Sender<Input>,
        awaited: usize,
        observers: Observers,
        own_tasks: OwnTasksCell,
    ) -> Self {
        Self {
            name: name.to_owned(),
            opener,
            session,
            inputs,
            line: LineState::Closed { retry: now() },
            number: 0,
            pause: RETRY.0,
            silences: 0,
            target: None,
            problem: None,
            ready: false,
            log: RateLimitedLog::new(name, now()),
            boards: Boards::default(),
            searches: 0,
            conflict: None,
            tasks: HashMap::new(),
            own_tasks,
            next_id: NextId::default(),
            starts: RateLimit::new(STARTS.0, STARTS.1, now()),
            parameters: Parameters::default(),
            updates: Updates::default(),
            awaited,
            stopping: None,
            retired: false,
            next: None,
            unused: Arc::default(),
            status: SharedStatus::default(),
            observers,
            event_log: EventLog::new(),
            firmware_log: DeviceLog::default(),
        }
    }

    pub(super) fn status(&self) -> SharedStatus {
        self.status.clone()
    }

    pub(super) fn log(&self) -> DeviceLog {
        self.firmware_log.clone()
    }

    /// Set while the device has neither a line nor tasks.
    pub(super) fn unused(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.unused)
    }

    /// Runs until it receives the request to stop.
    pub(super) fn run(&mut self, inbox: &Receiver<Input>) {
        loop {
            if let LineState::Closed { retry } = self.line
                && let Some(opener) = &self.opener
                && self.awaited == 0
                && now() >= retry
            {
                let opener = opener.clone();
                self.open(opener);
            }
            match inbox.recv_timeout(self.until_wake()) {
                Ok(input) => self.on_input(input),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            // Bounded, so that a busy line does not delay deadlines.
            for input in inbox.try_iter().take(BATCH) {
                self.on_input(input);
            }
            self.session.handle_timeout(now());
            self.check_board();
            self.on_update_timeout();
            self.transmit();
            while let Some(event) = self.session.poll_event() {
                self.on_event(event);
            }
            // What the events led to.
            self.transmit();
            if self.retired && self.has_no_tasks() {
                self.on_settled();
            }
            self.check_opening();
            self.log.handle_timeout(now());
            self.status
                .update(self.ready, self.problem.as_ref(), &self.session);
            if self.other_board().is_none() {
                self.status.set_device(now(), &self.name, &self.session);
            }
            let unused = self.opener.is_none() && self.awaited == 0 && self.has_no_tasks();
            self.unused.store(unused, Ordering::Release);
            if let Some(end) = self.stopping
                && (self.has_no_tasks() || now() >= end)
            {
                self.leave_unconfirmed();
                break;
            }
        }
        self.close();
    }

    fn has_no_tasks(&self) -> bool {
        self.tasks.is_empty() && self.parameters.is_empty() && self.updates.is_empty()
    }

    pub(super) fn url(&self) -> String {
        let opener = self.opener.as_ref();
        opener.map_or_else(|| "nowhere".to_owned(), Opener::url)
    }

    fn until_wake(&self) -> Duration {
        let line = match &self.line {
            LineState::Closed { retry } => {
                Some(*retry).filter(|_| self.awaited == 0 && self.opener.is_some())
            }
            LineState::Opening { since, .. } => {
                Some(*since + OPENING).filter(|_| self.problem.is_none())
            }
            LineState::Open { .. } => None,
        };
        let wake = earliest(earliest(self.session.poll_timeout(), line), self.stopping);
        let wake = earliest(wake, self.log.poll_timeout());
        let wake = earliest(wake, self.updates.poll_timeout());
        wake.map_or(Duration::from_secs(60), |wake| wake.since(now()))
    }

    /// Reports a line that takes long to open, since a driver may block for any time.
    fn check_opening(&mut self) {
        if let LineState::Opening { since, .. } = &self.line
            && now() >= *since + OPENING
            && self.problem.is_none()
        {
            self.set_problem(format!("{}: opening it takes long", self.url()));
        }
    }

    fn open(&mut self, opener: Opener) {
        self.number += 1;
        let (number, inputs) = (self.number, self.inputs.clone());
        let stop = Arc::new(AtomicBool::new(false));
        self.line = LineState::Opening {
            stop: Arc::clone(&stop),
            since: now(),
        };
        let spawned = std::thread::Builder::new()
            .name(format!("ztl-line-{}", self.name))
            .spawn(move || {
                run_line(&opener, &stop, |event| {
                    inputs.send(Input::Line(number, event)).is_ok()
                });
            });
        if let Err(error) = spawned {
            self.on_closed(&error);
        }
    }

    fn close(&mut self) {
        if let LineState::Opening { stop, .. } | LineState::Open { stop, .. } = &self.line {
            stop.store(true, Ordering::Release);
        }
        // Ignores further inputs of the line: the gateway knows why it closes it.
        self.number += 1;
        self.line = LineState::Closed { retry: now() };
    }

    /// Lets the journal claim a task when its entry is written.
    fn expect_start(&mut self, task: &TaskReporter, request: &DeviceRequest) {
        if let (Some(journal), Some(claim)) = (self.session.journal_mut(), request.claim.clone()) {
            journal.expect_start(task.id(), task.client(), claim);
        }
    }

    fn on_input(&mut self, input: Input) {
        match input {
            Input::Start(task, request) => {
                if let Some(reason) = self.rejects_requests() {
                    return task.rejected(reason);
                }
                let id = task.id();
                self.expect_start(&task, &request);
                self.session
                    .start(now(), id, &request.component, &request.goal);
                self.tasks.insert(id, (task, request));
            }
            Input::Resume(task, known) => {
                self.awaited = self.awaited.saturating_sub(1);
                let request = TaskRequest {
                    id: task.id(),
                    handler: self.name.clone(),
                    component: known.component.clone(),
                    goal: known.goal.clone(),
                };
                let request = DeviceRequest::from(&request);
                self.tasks.insert(task.id(), (task, request));
                self.session.restore(now(), known);
            }
            Input::Reserved(id) => self.on_reserved(id),
            Input::Parameters(task, request) => match self.rejects_requests() {
                Some(reason) => task.rejected(reason),
                None => self.on_parameter_request(task, request),
            },
            Input::Update(task, request) => match self.rejects_requests() {
                Some(reason) => task.rejected(reason),
                None => self.on_update_request(task, request),
            },
            Input::ResumeUpdate(task, update) => {
                self.awaited = self.awaited.saturating_sub(1);
                self.resume_update(task, update);
            }
            Input::TestReserved(id) => self.on_test_reserved(id),
            Input::Abort(id) => {
                self.session.abort(now(), id);
                self.abort_update(Some(id));
            }
            Input::Line(number, event) if number == self.number => self.on_line(event),
            Input::Line(..) => {}
            Input::Retire => {
                self.log
                    .log(now(), Severity::Info, " is not served any more.".to_owned());
                (self.retired, self.next) = (true, None);
                self.stop_update("the device is not served any more");
                for id in self.tasks.keys() {
                    self.session.abort(now(), *id);
                }
            }
            Input::Serve(opener) if self.retired => self.next = Some(opener),
            Input::Serve(opener) => {
                self.serve(opener);
                for (task, _) in self.tasks.values() {
                    task.progress("device is not answering yet");
                }
            }
            Input::Stop(leave_running) => self.on_stop(leave_running, now() + STOP),
        }
    }

    fn on_line(&mut self, event: LineEvent) {
        match event {
            LineEvent::Opened(writer) => {
                if let LineState::Opening { stop, .. } = &self.line {
                    let stop = Arc::clone(stop);
                    self.line = LineState::Open { writer, stop };
                    self.target = self.opener.as_ref().and_then(Opener::target);
                    let address = self.seat().map_or(ADDR_ONLY_NODE, Seat::address);
                    self.session.set_address(address);
                    self.session.handle_connected(now());
                }
            }
            LineEvent::Bytes(bytes, _permit) => self.session.handle_bytes(now(), &bytes),
            LineEvent::Closed(error) => self.on_closed(&error),
        }
    }

    /// All tasks of a retired device have ended.
    fn on_settled(&mut self) {
        if self.opener.take().is_some() {
            self.close();
            self.session.handle_disconnected();
            // The reading thread still holds the line for a moment.
            let retry = now() + READ_TIMEOUT * 2;
            self.line = LineState::Closed { retry };
        }
        if let Some(opener) = self.next.take() {
            self.retired = false;
            self.serve(opener);
        }
    }

    fn serve(&mut self, opener: Opener) {
        self.session.set_baud(opener.baud);
        self.opener = Some(opener);
        self.pause = RETRY.0;
        self.silences = 0;
        (self.problem, self.conflict) = (None, None);
        self.ready = false;
    }

    fn on_closed(&mut self, error: &io::Error) {
        self.close();
        self.session.handle_disconnected();
        self.silences = 0;
        // The reading thread still holds the line for a moment.
        self.line = LineState::Closed {
            retry: now() + self.pause.max(READ_TIMEOUT * 2),
        };
        let opener = self.opener.as_ref();
        let longest = match opener.is_some_and(|opener| opener.may_be_half_open) {
            true => RETRY_HALF_OPEN,
            false => RETRY.1,
        };
        self.pause = (self.pause * 2).min(longest);
        let why = opener.map_or_else(|| error.to_string(), |opener| opener.why_closed(error));
        self.set_problem(format!("{}: {why}", self.url()));
    }

    pub(super) fn set_problem(&mut self, mut problem: String) {
        self.ready = false;
        // Nothing else counts as long as the device takes no tasks for this.
        if let Some(conflict) = &self.conflict {
            problem = format!("{}: {conflict}", self.url());
        }
        if self.problem.as_ref() != Some(&problem) {
            self.log.log(now(), Severity::Warn, format!(": {problem}"));
            self.problem = Some(problem);
        }
    }

    pub(super) fn transmit(&mut self) {
        let bytes = self.session.poll_transmit();
        if let Some(seat) = self.seat() {
            seat.set_needs(self.session.bus_needs());
        }
        if bytes.is_empty() {
            return;
        }
        if let LineState::Open { writer, .. } = &mut self.line
            && let Err(error) = writer.write_all(&bytes)
        {
            if is_pause(&error) {
                let kind = io::ErrorKind::TimedOut;
                return self.on_closed(&io::Error::new(kind, "it accepts no bytes"));
            }
            self.on_closed(&error);
        }
    }

    fn on_event(&mut self, event: LinkEvent) {
        match event {
            LinkEvent::Accepted(id) => {
                if let Some((task, request)) = self.tasks.get(&id) {
                    self.log_task(id, request, "has started");
                    task.accepted(&request.reply);
                }
            }
            LinkEvent::TaskRejected(id, reason) => {
                if let Some(journal) = self.session.journal_mut() {
                    journal.forget(id);
                }
                if let Some((task, request)) = self.tasks.remove(&id) {
                    let reason = match &self.problem {
                        Some(problem) if !self.session.is_up() => {
                            match problem.ends_with(&reason) {
                                true => problem.clone(),
                                false => format!("{reason} ({problem})"),
                            }
                        }
                        _ => reason,
                    };
                    self.log_task(id, &request, &format!("was refused: {reason}"));
                    self.on_task_over(id, State::Rejected, &reason);
                    task.rejected(format!("{} refused: {reason}", request.shown));
                }
            }
            LinkEvent::Progress(id, text) => {
                if let Some((task, _)) = self.tasks.get(&id) {
                    task.progress(text);
                }
            }
            LinkEvent::Ended(id, state, text) => {
                if let Some((task, request)) = self.tasks.remove(&id) {
                    let end = format!("has ended as {}: {text}", state.name());
                    self.log_task(id, &request, &end);
                    self.on_task_over(id, state, &text);
                    match state {
                        State::Completed => task.completed(text),
                        State::Aborted => task.aborted(text),
                        _ => task.failed(text),
                    }
                }
            }
            LinkEvent::Begun => self.on_begun(),
            LinkEvent::Reported(text) => self.on_reported(&text),
            LinkEvent::Up => match self.other_board() {
                Some(other) => {
                    self.on_closed(&io::Error::other(other.clone()));
                    self.end_update_of_other(&other);
                }
                None => {
                    self.on_up();
                    self.on_update_up();
                }
            },
            LinkEvent::Silent => {
                self.silences += 1;
                let opener = self.opener.as_ref();
                let half_open = opener.is_some_and(|opener| opener.may_be_half_open);
                // The device was unplugged and plugged in again, and its path has another target now.
                let target = opener.and_then(Opener::target);
                let moved = target.is_some() && target != self.target;
                if moved || (half_open && self.silences >= SILENCES) {
                    let kind = io::ErrorKind::TimedOut;
                    return self.on_closed(&io::Error::new(kind, NOT_ANSWERING));
                }
                // It is named once.
                if self.problem.as_deref() != Some(NOT_ANSWERING) {
                    self.set_problem(format!("{}: {NOT_ANSWERING}", self.url()));
                }
            }
            LinkEvent::Lost => {
                self.on_update_lost();
                match self.opener {
                    Some(_) if matches!(self.line, LineState::Open { .. }) => {
                        self.set_problem(NOT_ANSWERING.to_owned());
                    }
                    // It was closed, and why is told.
                    _ => self.ready = false,
                }
            }
            LinkEvent::OtherBoard => self.on_other_board(),
            LinkEvent::Reset => self
                .log
                .log(now(), Severity::Warn, " was reset.".to_owned()),
            LinkEvent::DeviceUnusable(reason) => self.set_problem(reason),
            LinkEvent::Log { lost, bytes } => {
                let boot = self.session.device().map_or(0, |device| device.boot);
                self.firmware_log.put(boot, lost, bytes);
            }
            LinkEvent::Parameter(number, answer) => {
                let (name, session) = (&self.name, &mut self.session);
                let parameters = &mut self.parameters;
                parameters.on_answer(now(), name, session, number, answer);
            }
            LinkEvent::Update(number, answer) => self.on_update_answer(number, answer),
            LinkEvent::Reading(topic, bytes) => {
                let device = self.session.device();
                // The topic is unknown until the device has described itself.
                if let Some((component, topic)) = device.and_then(|device| device.topic(topic)) {
                    let topic = || format!("{}/{component}/{topic}", self.name);
                    self.observers.publish(topic, &bytes);
                }
            }
        }
    }

    pub(super) fn log_task(&self, id: TaskId, request: &DeviceRequest, what: &str) {
        let (name, spec) = (&self.name, &request.shown);
        let task = id.get();
        info!(target: GATEWAY, device = name, task, "Device '{name}': task {task} {spec} {what}");
    }

    pub(super) fn on_up(&mut self) {
        self.pause = RETRY.0;
        self.silences = 0;
        if self.conflict.is_some() {
            return;
        }
        self.problem = None;
        if std::mem::replace(&mut self.ready, true) {
            return;
        }
        let Some(device) = self.session.device() else {
            return;
        };
        let names: Vec<&str> = device.components.iter().map(|c| c.name.as_str()).collect();
        let text = format!(
            " is ready at {}: {} {}, components: {}",
            self.url(),
            device.name,
            device.firmware,
            names.join(", ")
        );
        self.log.log(now(), Severity::Info, text);
    }
}
