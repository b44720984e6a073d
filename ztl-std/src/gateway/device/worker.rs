//! A device's thread: its session, its line, and the clients' tasks on it.

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::time::Duration;

use tracing::{info, warn};
use ztl_core::link::Loss;
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId, TaskSpec};

use super::super::endpoint::{READ_TIMEOUT, is_pause};
use super::super::journal::FileBook;
use super::super::logs::DeviceLog;
use super::super::reader::{Opener, read_line};
use super::super::readings::Observers;
use super::super::report::Window;
use super::super::voice::{Grave, LOG, Voice};
use super::{Input, Request, request};
use crate::server::TaskReporter;
use crate::time::now;
use ztl_link::{LinkEvent, Session};

/// Pause before a line is opened again: at first, and at most. Looking for a port is cheap, and whoever
/// has plugged a device in wants it now.
const RETRY: (Duration, Duration) = (Duration::from_millis(50), Duration::from_millis(500));
/// The longest such pause where it costs others something: a connection is made.
const RETRY_HALF_OPEN: Duration = Duration::from_secs(2);
/// After so many link timeouts without a word a line that may be half open is opened anew.
const SILENCES: u32 = 5;
/// Opening a line that takes longer is worth a word.
const OPENING: Duration = Duration::from_secs(3);
/// How long a gateway that ends waits for its tasks to be stopped.
const STOP: Duration = Duration::from_secs(1);
/// Inputs taken before the time is looked at.
const BATCH: usize = 64;

/// The line, as the device's thread has it.
enum Wire {
    /// To be opened at this time.
    None { retry: Instant },
    /// A thread opens it, since then.
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
    name: String,
    opener: Option<Opener>,
    session: Session<Option<FileBook>>,
    inputs: Sender<Input>,
    line: Wire,
    /// Of the present line; what an earlier one still says is not heard.
    number: u64,
    pause: Duration,
    /// How often in a row the greeting was not answered.
    silences: u32,
    /// Where the line's name led to when it was opened.
    leads_to: Option<PathBuf>,
    /// What is wrong with the line or the device, for reasons; said once in the log.
    trouble: Option<String>,
    voice: Voice,
    tasks: HashMap<TaskId, (TaskReporter, Request)>,
    /// Tasks from before a restart that are still to be resumed, before the line is opened.
    awaited: usize,
    /// Until when the tasks may take to stop.
    stopping: Option<Instant>,
    /// Takes no tasks, and closes its line when all have ended.
    retired: bool,
    /// The line at which it is served again then.
    next: Option<Opener>,
    idle: Arc<AtomicBool>,
    window: Window,
    observers: Observers,
    log: DeviceLog,
}

impl Worker {
    /// As [`Device::spawn`](super::Device::spawn) says.
    pub(super) fn new(
        name: &str,
        opener: Option<Opener>,
        session: Session<Option<FileBook>>,
        inputs: Sender<Input>,
        awaited: usize,
        observers: Observers,
    ) -> Self {
        Self {
            name: name.to_owned(),
            opener,
            session,
            inputs,
            line: Wire::None { retry: now() },
            number: 0,
            pause: RETRY.0,
            silences: 0,
            leads_to: None,
            trouble: None,
            voice: Voice::new(name, now()),
            tasks: HashMap::new(),
            awaited,
            stopping: None,
            retired: false,
            next: None,
            idle: Arc::default(),
            window: Window::default(),
            observers,
            log: DeviceLog::default(),
        }
    }

    pub(super) fn window(&self) -> Window {
        self.window.clone()
    }

    pub(super) fn log(&self) -> DeviceLog {
        self.log.clone()
    }

    /// Whether it has neither a line nor tasks.
    pub(super) fn idle(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.idle)
    }

    /// Until it is told to stop.
    pub(super) fn run(&mut self, inbox: &Receiver<Input>) {
        loop {
            if let Wire::None { retry } = self.line
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
            // A line that never pauses must not keep the clock from being looked at.
            for input in inbox.try_iter().take(BATCH) {
                self.on_input(input);
            }
            self.session.handle_timeout(now());
            self.transmit();
            while let Some(event) = self.session.poll_event() {
                self.on_event(event);
            }
            if self.retired && self.tasks.is_empty() {
                self.on_settled();
            }
            self.look_at_opening();
            self.voice.handle_timeout(now());
            self.window
                .show(now(), &self.session, self.trouble.as_ref());
            let idle = self.opener.is_none() && self.awaited == 0 && self.tasks.is_empty();
            self.idle.store(idle, Ordering::Release);
            if let Some(end) = self.stopping
                && (self.tasks.is_empty() || now() >= end)
            {
                self.say_what_is_left();
                break;
            }
        }
        self.close();
    }

    pub(super) fn url(&self) -> &str {
        let opener = self.opener.as_ref();
        opener.map_or("nowhere", |opener| opener.label.as_str())
    }

    /// What is not confirmed is unknown, and nobody is told that it failed.
    fn say_what_is_left(&mut self) {
        let left = std::mem::take(&mut self.tasks);
        for (task, request) in left.into_values() {
            warn!(
                target: LOG,
                device = self.name,
                "Device '{}' has not confirmed that {} stopped; it acts by itself when it hears nothing for its link timeout.",
                self.name,
                request.spec
            );
            task.leave();
        }
    }

    fn on_stop(&mut self, leave_running: bool, end: Instant) {
        if self.stopping.is_some_and(|before| before <= end) {
            return;
        }
        self.stopping = Some(end);
        for id in self.tasks.keys().copied().collect::<Vec<_>>() {
            match self.session.policy(id) {
                Some(policy) if leave_running => self.leave(id, policy),
                _ => self.session.abort(now(), id),
            }
        }
    }

    /// A task goes on, or not, without this gateway.
    fn leave(&mut self, id: TaskId, policy: Loss) {
        let Some((task, request)) = self.tasks.remove(&id) else {
            return;
        };
        let what = match policy {
            Loss::Abort => "stops by itself when it has heard nothing for its link timeout (abort)",
            Loss::Hold => {
                "stops by itself when it has heard nothing for its link timeout, and keeps its position (hold)"
            }
            Loss::CarryOn => "carries on",
        };
        let (name, spec) = (&self.name, &request.spec);
        info!(target: LOG, device = name, "Device '{name}': {spec} is left running; it {what}.");
        task.leave();
    }

    fn until_wake(&self) -> Duration {
        let line = match &self.line {
            Wire::None { retry } => {
                Some(*retry).filter(|_| self.awaited == 0 && self.opener.is_some())
            }
            Wire::Opening { since, .. } => {
                Some(*since + OPENING).filter(|_| self.trouble.is_none())
            }
            Wire::Open { .. } => None,
        };
        let wake = earliest(earliest(self.session.poll_timeout(), line), self.stopping);
        let wake = earliest(wake, self.voice.poll_timeout());
        wake.map_or(Duration::from_secs(60), |wake| wake.since(now()))
    }

    /// A driver may keep whoever opens its port for as long as it likes.
    fn look_at_opening(&mut self) {
        if let Wire::Opening { since, .. } = &self.line
            && now() >= *since + OPENING
            && self.trouble.is_none()
        {
            self.set_trouble(format!("{}: opening it takes long", self.url()));
        }
    }

    fn open(&mut self, opener: Opener) {
        self.number += 1;
        let (number, inputs) = (self.number, self.inputs.clone());
        let stop = Arc::new(AtomicBool::new(false));
        self.line = Wire::Opening {
            stop: Arc::clone(&stop),
            since: now(),
        };
        let spawned = std::thread::Builder::new()
            .name(format!("ztl-line-{}", self.name))
            .spawn(move || {
                let error = read_line(number, &opener, &inputs, &stop);
                let _ = inputs.send(Input::Closed(number, error));
            });
        if let Err(error) = spawned {
            self.on_closed(&error);
        }
    }

    fn close(&mut self) {
        if let Wire::Opening { stop, .. } | Wire::Open { stop, .. } = &self.line {
            stop.store(true, Ordering::Release);
        }
        self.line = Wire::None { retry: now() };
    }

    fn on_input(&mut self, input: Input) {
        match input {
            Input::Start(task, request) => {
                if let Some(reason) = self.takes_none() {
                    return task.rejected(reason);
                }
                let id = task.id();
                if let (Some(book), Some(claim)) =
                    (self.session.journal_mut(), request.claim.clone())
                {
                    book.asked(id, task.client(), claim);
                }
                self.session
                    .start(now(), id, &request.component, &request.goal);
                self.tasks.insert(id, (task, request));
            }
            Input::Resume(task, known) => {
                self.awaited = self.awaited.saturating_sub(1);
                let spec = TaskSpec {
                    handler: &self.name,
                    component: &known.component,
                    goal: &known.goal,
                };
                let request = request(task.id(), &spec);
                self.tasks.insert(task.id(), (task, request));
                self.session.restore(now(), known);
            }
            Input::Abort(id) => self.session.abort(now(), id),
            Input::Opened(number, writer) if number == self.number => {
                if let Wire::Opening { stop, .. } = &self.line {
                    let stop = Arc::clone(stop);
                    self.line = Wire::Open { writer, stop };
                    self.leads_to = self.opener.as_ref().and_then(Opener::leads_to);
                    self.session.handle_connected(now());
                }
            }
            Input::Bytes(number, bytes, _permit) if number == self.number => {
                self.session.handle_bytes(now(), &bytes);
            }
            Input::Closed(number, error) if number == self.number => self.on_closed(&error),
            Input::Opened(..) | Input::Bytes(..) | Input::Closed(..) => {}
            Input::Retire => {
                self.voice
                    .say(now(), Grave::Info, " is not served any more.".to_owned());
                (self.retired, self.next) = (true, None);
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

    /// Why it takes no tasks, if so.
    fn takes_none(&self) -> Option<&'static str> {
        match (self.stopping, self.retired, &self.next) {
            (Some(_), _, _) => Some("the gateway is stopping"),
            (None, true, None) => Some("the device is not served any more"),
            (None, true, Some(_)) => Some("the device's tasks from before have not stopped yet"),
            (None, false, _) => None,
        }
    }

    /// The tasks of a device that is not served any more have ended.
    fn on_settled(&mut self) {
        if self.opener.take().is_some() {
            self.close();
            // What the line still says is not heard.
            self.number += 1;
            self.session.handle_disconnected();
            // Until the thread that reads has let go of the line, it is not free.
            let retry = now() + READ_TIMEOUT * 2;
            self.line = Wire::None { retry };
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
        self.trouble = None;
    }

    fn on_closed(&mut self, error: &io::Error) {
        self.close();
        self.session.handle_disconnected();
        self.silences = 0;
        // Until the thread that reads has let go of the line, it is not free.
        self.line = Wire::None {
            retry: now() + self.pause.max(READ_TIMEOUT * 2),
        };
        let opener = self.opener.as_ref();
        let longest = if opener.is_some_and(|opener| opener.may_be_half_open) {
            RETRY_HALF_OPEN
        } else {
            RETRY.1
        };
        self.pause = (self.pause * 2).min(longest);
        self.set_trouble(format!("{}: {error}", self.url()));
    }

    fn set_trouble(&mut self, trouble: String) {
        if self.trouble.as_ref() != Some(&trouble) {
            self.voice.say(now(), Grave::Warn, format!(": {trouble}"));
            self.trouble = Some(trouble);
        }
    }

    fn transmit(&mut self) {
        let bytes = self.session.poll_transmit();
        if bytes.is_empty() {
            return;
        }
        if let Wire::Open { writer, .. } = &mut self.line
            && let Err(error) = writer.write_all(&bytes)
        {
            if is_pause(&error) {
                let kind = io::ErrorKind::TimedOut;
                return self.on_closed(&io::Error::new(kind, "it takes no bytes"));
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
            LinkEvent::Rejected(id, reason) => {
                if let Some(book) = self.session.journal_mut() {
                    book.forget(id);
                }
                if let Some((task, request)) = self.tasks.remove(&id) {
                    let trouble = match &self.trouble {
                        Some(trouble) if !self.session.is_up() => format!(" ({trouble})"),
                        _ => String::new(),
                    };
                    self.log_task(id, &request, &format!("was refused: {reason}{trouble}"));
                    task.rejected(format!("{} refused: {reason}{trouble}", request.spec));
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
                    match state {
                        State::Completed => task.completed(text),
                        State::Aborted => task.aborted(text),
                        _ => task.failed(text),
                    }
                }
            }
            LinkEvent::Up => self.on_up(),
            LinkEvent::Silent => {
                self.silences += 1;
                let trouble = "nothing there answers";
                let opener = self.opener.as_ref();
                let half_open = opener.is_some_and(|opener| opener.may_be_half_open);
                // Unplugged and plugged in again, while what was opened is another's now.
                let now_leads_to = opener.and_then(Opener::leads_to);
                let moved = now_leads_to.is_some() && now_leads_to != self.leads_to;
                if moved || (half_open && self.silences >= SILENCES) {
                    let kind = io::ErrorKind::TimedOut;
                    return self.on_closed(&io::Error::new(kind, trouble));
                }
                self.set_trouble(format!("{}: {trouble}", self.url()));
            }
            LinkEvent::Lost => self.set_trouble("it no longer answers".to_owned()),
            LinkEvent::Reset => self.voice.say(now(), Grave::Warn, " was reset.".to_owned()),
            LinkEvent::Refused(reason) => self.set_trouble(reason),
            LinkEvent::Log { lost, bytes } => {
                let boot = self.session.device().map_or(0, |device| device.boot);
                self.log.put(boot, lost, bytes);
            }
            LinkEvent::Reading(topic, bytes) => {
                let device = self.session.device();
                // Before the device has described itself nobody knows what it is.
                if let Some((component, topic)) = device.and_then(|device| device.topic(topic)) {
                    let topic = || format!("{}/{component}/{topic}", self.name);
                    self.observers.tell(topic, &bytes);
                }
            }
        }
    }

    fn log_task(&self, id: TaskId, request: &Request, what: &str) {
        let (name, spec) = (&self.name, &request.spec);
        let task = id.get();
        info!(target: LOG, device = name, task, "Device '{name}': task {task} {spec} {what}");
    }

    fn on_up(&mut self) {
        self.pause = RETRY.0;
        self.silences = 0;
        self.trouble = None;
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
        self.voice.say(now(), Grave::Info, text);
    }
}
