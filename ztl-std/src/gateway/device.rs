//! A device's thread: its session, its line, and the clients' tasks on it.

use std::collections::HashMap;
use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use tracing::{info, warn};
use ztl_core::repr::put_quoted;
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId, TaskSpec};

use super::endpoint::{Endpoint, is_pause};
use super::journal::FileBook;
use super::report::Window;
use super::session::{Event, Restored, Session};
use crate::clock::now;
use crate::random;
use crate::server::TaskReporter;

/// Pause before a line is opened again: at first, and at most.
const RETRY: (Duration, Duration) = (Duration::from_millis(50), Duration::from_millis(500));
/// How long a gateway that ends waits for its tasks to be stopped.
const STOP: Duration = Duration::from_secs(1);
/// Longest part of a request that is repeated in a reason, in bytes.
const SHOWN: usize = 100;
/// Inputs taken before the time is looked at.
const BATCH: usize = 64;
/// Pieces of at most 1 KiB that a line may be ahead of its device's thread.
const AHEAD: usize = 64;
/// Name under which the gateway logs.
const LOG: &str = "gateway";

enum Input {
    Start(TaskReporter, Request),
    Resume(TaskReporter, Restored),
    Abort(TaskId),
    /// The line of this number is open.
    Opened(u64, Box<dyn Write + Send>),
    /// The permit goes back to the line when the bytes have been taken.
    Bytes(u64, Vec<u8>, Permit),
    Closed(u64, io::Error),
    Stop,
}

/// One of the pieces that a line may be ahead; counted down when dropped.
struct Permit(Arc<Ahead>);

/// How far a line is ahead of its device's thread.
#[derive(Default)]
struct Ahead {
    pieces: Mutex<usize>,
    fewer: Condvar,
}

impl Ahead {
    /// Waits until the line may go on; `None` when it does not within a moment.
    fn permit(self: &Arc<Self>) -> Option<Permit> {
        let pieces = self.pieces.lock().unwrap_or_else(PoisonError::into_inner);
        let full = |pieces: &mut usize| *pieces >= AHEAD;
        let waited = self
            .fewer
            .wait_timeout_while(pieces, Duration::from_millis(50), full);
        let (mut pieces, timeout) = waited.unwrap_or_else(PoisonError::into_inner);
        if timeout.timed_out() {
            return None;
        }
        *pieces += 1;
        Some(Permit(Arc::clone(self)))
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut pieces = self.0.pieces.lock().unwrap_or_else(PoisonError::into_inner);
        *pieces = pieces.saturating_sub(1);
        self.0.fewer.notify_one();
    }
}

struct Request {
    component: String,
    goal: String,
    /// The whole, as a client wrote it, for reasons.
    spec: String,
    /// The text of the INIT's answer.
    reply: String,
}

/// One device; its thread ends when this is dropped, after its tasks have been aborted.
#[derive(Debug)]
pub struct Device {
    url: String,
    inputs: Sender<Input>,
    window: Window,
    thread: Option<JoinHandle<()>>,
}

impl Device {
    /// Its line is opened when as many tasks from before a restart as are `awaited` have been
    /// resumed. Without an endpoint it never answers.
    pub(super) fn spawn(
        name: &str,
        endpoint: Option<Endpoint>,
        gateway: u64,
        book: Option<FileBook>,
        awaited: usize,
    ) -> io::Result<Self> {
        let (inputs, inbox) = channel();
        let baud = endpoint.as_ref().and_then(Endpoint::baud);
        let session = Session::with_book(book, gateway, baud, random::nonzero);
        let mut worker = Worker {
            name: name.to_owned(),
            endpoint,
            session,
            inputs: inputs.clone(),
            line: Wire::None { retry: now() },
            number: 0,
            pause: RETRY.0,
            trouble: None,
            tasks: HashMap::new(),
            awaited,
            stopping: None,
            window: Window::default(),
        };
        let (url, window) = (worker.url(), worker.window.clone());
        let thread = std::thread::Builder::new()
            .name(format!("ztl-device-{name}"))
            .spawn(move || worker.run(&inbox))?;
        Ok(Self {
            url,
            inputs,
            window,
            thread: Some(thread),
        })
    }

    pub(super) fn url(&self) -> String {
        self.url.clone()
    }

    pub(super) fn window(&self) -> Window {
        self.window.clone()
    }

    pub(super) fn start(&self, task: TaskReporter, spec: &TaskSpec<'_>) {
        let request = request(task.id(), spec);
        // If the thread is gone, dropping the reporter tells the client.
        let _ = self.inputs.send(Input::Start(task, request));
    }

    /// Takes up a task from before a restart.
    pub(super) fn resume(&self, task: TaskReporter, known: Restored) {
        let _ = self.inputs.send(Input::Resume(task, known));
    }

    pub(super) fn abort(&self, id: TaskId) {
        let _ = self.inputs.send(Input::Abort(id));
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        let _ = self.inputs.send(Input::Stop);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The line, as the device's thread has it.
enum Wire {
    /// To be opened at this time.
    None { retry: Instant },
    /// A thread opens it.
    Opening { stop: Arc<AtomicBool> },
    Open {
        writer: Box<dyn Write + Send>,
        stop: Arc<AtomicBool>,
    },
}

struct Worker {
    name: String,
    endpoint: Option<Endpoint>,
    session: Session<Option<FileBook>>,
    inputs: Sender<Input>,
    line: Wire,
    /// Of the present line; what an earlier one still says is not heard.
    number: u64,
    pause: Duration,
    /// What is wrong with the line or the device, for reasons; said once in the log.
    trouble: Option<String>,
    tasks: HashMap<TaskId, (TaskReporter, Request)>,
    /// Tasks from before a restart that are still to be resumed, before the line is opened.
    awaited: usize,
    /// Until when the tasks may take to stop.
    stopping: Option<Instant>,
    window: Window,
}

impl Worker {
    fn run(&mut self, inbox: &Receiver<Input>) {
        loop {
            if let Wire::None { retry } = self.line
                && let Some(endpoint) = &self.endpoint
                && self.awaited == 0
                && now() >= retry
            {
                let endpoint = endpoint.clone();
                self.open(endpoint);
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
            self.window
                .show(now(), &self.session, self.trouble.as_ref());
            if let Some(end) = self.stopping
                && (self.tasks.is_empty() || now() >= end)
            {
                self.say_what_is_left();
                break;
            }
        }
        self.close();
        if self.session.book_mut().is_some() {
            // They may run: the next start of the gateway learns their ends.
            for (_, (task, _)) in self.tasks.drain() {
                task.leave();
            }
        }
    }

    fn url(&self) -> String {
        let endpoint = self.endpoint.as_ref();
        endpoint.map_or_else(|| "nowhere".to_owned(), Endpoint::to_string)
    }

    fn say_what_is_left(&self) {
        let left: Vec<&str> = self.tasks.values().map(|(_, r)| r.spec.as_str()).collect();
        if !left.is_empty() {
            warn!(
                target: LOG,
                "Device '{}' has not confirmed that it stopped: {}; it acts by itself when it hears nothing for its link timeout.",
                self.name,
                left.join(", ")
            );
        }
    }

    fn until_wake(&self) -> Duration {
        let open = match self.line {
            Wire::None { retry } if self.awaited == 0 && self.endpoint.is_some() => Some(retry),
            _ => None,
        };
        let wake = earliest(earliest(self.session.poll_timeout(), open), self.stopping);
        wake.map_or(Duration::from_secs(60), |wake| wake.since(now()))
    }

    fn open(&mut self, endpoint: Endpoint) {
        self.number += 1;
        let (number, inputs) = (self.number, self.inputs.clone());
        let stop = Arc::new(AtomicBool::new(false));
        self.line = Wire::Opening {
            stop: Arc::clone(&stop),
        };
        let spawned = std::thread::Builder::new()
            .name(format!("ztl-line-{}", self.name))
            .spawn(move || {
                let error = read_line(number, &endpoint, &inputs, &stop);
                let _ = inputs.send(Input::Closed(number, error));
            });
        if let Err(error) = spawned {
            self.on_closed(&error);
        }
    }

    fn close(&mut self) {
        if let Wire::Opening { stop } | Wire::Open { stop, .. } = &self.line {
            stop.store(true, Ordering::Release);
        }
        self.line = Wire::None { retry: now() };
    }

    fn on_input(&mut self, input: Input) {
        match input {
            Input::Start(task, request) => {
                if self.stopping.is_some() {
                    return task.rejected("the gateway is stopping");
                }
                let id = task.id();
                if let (Some(book), Some(client)) = (self.session.book_mut(), task.client()) {
                    book.asked_by(id, client);
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
                if let Wire::Opening { stop } = &self.line {
                    let stop = Arc::clone(stop);
                    self.line = Wire::Open { writer, stop };
                    self.session.handle_connected(now());
                }
            }
            Input::Bytes(number, bytes, _permit) if number == self.number => {
                self.session.handle_bytes(now(), &bytes);
            }
            Input::Closed(number, error) if number == self.number => self.on_closed(&error),
            Input::Opened(..) | Input::Bytes(..) | Input::Closed(..) => {}
            Input::Stop => {
                self.stopping = Some(now() + STOP);
                for id in self.tasks.keys() {
                    self.session.abort(now(), *id);
                }
            }
        }
    }

    fn on_closed(&mut self, error: &io::Error) {
        self.close();
        self.session.handle_disconnected();
        self.line = Wire::None {
            retry: now() + self.pause,
        };
        self.pause = (self.pause * 2).min(RETRY.1);
        self.set_trouble(format!("{}: {error}", self.url()));
    }

    fn set_trouble(&mut self, trouble: String) {
        if self.trouble.as_ref() != Some(&trouble) {
            warn!(target: LOG, device = self.name, "Device '{}': {trouble}", self.name);
            self.trouble = Some(trouble);
        }
    }

    fn transmit(&mut self) {
        let bytes = self.session.poll_transmit();
        if bytes.is_empty() {
            return;
        }
        if let Wire::Open { writer, .. } = &mut self.line
            && let Err(error) = writer.write_all(&bytes).and_then(|()| writer.flush())
        {
            self.on_closed(&error);
        }
    }

    fn on_event(&mut self, event: Event) {
        match event {
            Event::Accepted(id) => {
                if let Some((task, request)) = self.tasks.get(&id) {
                    task.accepted(&request.reply);
                }
            }
            Event::Rejected(id, reason) => {
                if let Some(book) = self.session.book_mut() {
                    book.forget(id);
                }
                if let Some((task, request)) = self.tasks.remove(&id) {
                    let trouble = match &self.trouble {
                        Some(trouble) if !self.session.is_up() => format!(" ({trouble})"),
                        _ => String::new(),
                    };
                    task.rejected(format!("{} refused: {reason}{trouble}", request.spec));
                }
            }
            Event::Progress(id, text) => {
                if let Some((task, _)) = self.tasks.get(&id) {
                    task.progress(text);
                }
            }
            Event::Ended(id, state, text) => {
                if let Some((task, _)) = self.tasks.remove(&id) {
                    match state {
                        State::Completed => task.completed(text),
                        State::Aborted => task.aborted(text),
                        _ => task.failed(text),
                    }
                }
            }
            Event::Up => {
                self.pause = RETRY.0;
                self.trouble = None;
                if let Some(device) = self.session.device() {
                    let names: Vec<&str> =
                        device.components.iter().map(|c| c.name.as_str()).collect();
                    info!(
                        target: LOG,
                        device = self.name,
                        "Device '{}' is ready at {}: {} {}, components: {}",
                        self.name, self.url(), device.name, device.firmware, names.join(", ")
                    );
                }
            }
            Event::Silent => {
                let trouble = format!("{}: nothing there answers", self.url());
                self.set_trouble(trouble);
            }
            Event::Lost => self.set_trouble("it no longer answers".to_owned()),
            Event::Reset => {
                warn!(target: LOG, device = self.name, "Device '{}' was reset.", self.name)
            }
            Event::Refused(reason) => self.set_trouble(reason),
        }
    }
}

fn request(id: TaskId, spec: &TaskSpec<'_>) -> Request {
    let mut reply = Vec::new();
    spec.put_initiated(id, &mut |bytes: &[u8]| reply.extend_from_slice(bytes));
    Request {
        component: spec.component.to_owned(),
        goal: spec.goal.to_owned(),
        spec: shown(spec),
        reply: String::from_utf8_lossy(&reply).into_owned(),
    }
}

/// A request as it is shown to people: in quotes, and not at any length.
pub(super) fn shown(spec: &TaskSpec<'_>) -> String {
    let mut text = spec.to_string();
    if text.len() > SHOWN {
        text.truncate(text.floor_char_boundary(SHOWN));
        text.push('…');
    }
    let mut quoted = Vec::new();
    put_quoted(&text, &mut |bytes: &[u8]| quoted.extend_from_slice(bytes));
    String::from_utf8_lossy(&quoted).into_owned()
}

/// Opens the line and passes on what arrives, until it breaks or is no longer wanted.
fn read_line(
    number: u64,
    endpoint: &Endpoint,
    inputs: &Sender<Input>,
    stop: &AtomicBool,
) -> io::Error {
    let ended = || io::Error::new(io::ErrorKind::UnexpectedEof, "the other end has closed it");
    let mut line = match endpoint.open() {
        Ok(line) => line,
        Err(error) => return error,
    };
    let writer = std::mem::replace(&mut line.writer, Box::new(io::sink()));
    if inputs.send(Input::Opened(number, writer)).is_err() {
        return ended();
    }
    let mut buffer = [0; 1024];
    let ahead = Arc::default();
    let mut next = None;
    while !stop.load(Ordering::Acquire) {
        let Some(permit) = next.take().or_else(|| Ahead::permit(&ahead)) else {
            continue;
        };
        match line.reader.read(&mut buffer) {
            Ok(0) => return ended(),
            Ok(count) => {
                let bytes = buffer.get(..count).unwrap_or_default().to_vec();
                if inputs.send(Input::Bytes(number, bytes, permit)).is_err() {
                    break;
                }
            }
            Err(error) if is_pause(&error) => next = Some(permit),
            Err(error) => return error,
        }
    }
    ended()
}
