//! A device, as the rest of the gateway holds it; its thread is in [`worker`].

mod worker;

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::thread::JoinHandle;

use ztl_core::repr::put_quoted;
use ztl_core::{TaskId, TaskSpec};

use super::journal::{DECIDED, FileBook, UNWRITTEN};
use super::logs::DeviceLog;
use super::reader::{Opener, Permit};
use super::readings::Observers;
use super::report::Window;
use crate::random;
use crate::server::{Claim, TaskReporter};
use worker::Worker;
use ztl_link::{Restored, Session};

/// Longest part of a request that is repeated in a reason, in bytes.
const SHOWN: usize = 100;
/// What a device's thread is told.
pub(super) enum Input {
    Start(TaskReporter, Request),
    Resume(TaskReporter, Restored),
    Abort(TaskId),
    /// The line of this number is open.
    Opened(u64, Box<dyn Write + Send>),
    /// The permit goes back to the line when the bytes have been taken.
    Bytes(u64, Vec<u8>, Permit),
    Closed(u64, io::Error),
    /// Aborts its tasks, takes no more, and closes the line when all have ended.
    Retire,
    /// Serves the device again, at this line.
    Serve(Opener),
    /// Ends the thread. With `true` its tasks are left as they are, else they are aborted first.
    Stop(bool),
}

/// What a client wants.
pub(super) struct Request {
    component: String,
    goal: String,
    /// The whole, as a client wrote it, for reasons.
    spec: String,
    /// The text of the INIT's answer.
    reply: String,
    /// Where there is a journal: to be taken before the task is started.
    claim: Option<Claim>,
}

/// One device; its thread ends when this is dropped, after its tasks have been aborted.
#[derive(Debug)]
pub struct Device {
    url: String,
    inputs: Sender<Input>,
    window: Window,
    log: DeviceLog,
    has_journal: bool,
    idle: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Device {
    /// Its line is opened when as many tasks from before a restart as are `awaited` have been
    /// resumed. Without an opener it never answers.
    pub(super) fn spawn(
        name: &str,
        opener: Option<Opener>,
        gateway: u64,
        book: Option<FileBook>,
        awaited: usize,
        observers: Observers,
    ) -> io::Result<Self> {
        let (inputs, inbox) = channel();
        let baud = opener.as_ref().and_then(|opener| opener.baud);
        let has_journal = book.is_some();
        let session = Session::with_journal(book, gateway, baud, random::nonzero);
        let mut worker = Worker::new(name, opener, session, inputs.clone(), awaited, observers);
        let (url, window, log) = (worker.url().to_owned(), worker.window(), worker.log());
        let idle = worker.idle();
        let thread = std::thread::Builder::new()
            .name(format!("ztl-device-{name}"))
            .spawn(move || worker.run(&inbox))?;
        Ok(Self {
            url,
            inputs,
            window,
            log,
            has_journal,
            idle,
            thread: Some(thread),
        })
    }

    pub(super) fn url(&self) -> String {
        self.url.clone()
    }

    pub(super) fn log(&self) -> DeviceLog {
        self.log.clone()
    }

    pub(super) fn window(&self) -> Window {
        self.window.clone()
    }

    pub(super) fn start(&self, task: TaskReporter, spec: &TaskSpec<'_>) {
        let mut request = request(task.id(), spec);
        request.claim = self
            .has_journal
            .then(|| task.refuse_unless_claimed(DECIDED, UNWRITTEN));
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

impl Device {
    /// Aborts its tasks and takes no more; it is idle when all have ended.
    pub(super) fn retire(&self) {
        let _ = self.inputs.send(Input::Retire);
    }

    /// Serves it again after [`retire`](Self::retire), or after it was spawned without an opener.
    pub(super) fn serve(&mut self, opener: Opener) {
        self.url.clone_from(&opener.label);
        let _ = self.inputs.send(Input::Serve(opener));
    }

    /// Whether it has neither a line nor tasks.
    pub(super) fn is_idle(&self) -> bool {
        self.idle.load(Ordering::Acquire)
    }

    /// Begins to end it; dropping it waits for that.
    pub(super) fn stop(&self, leave_running: bool) {
        let _ = self.inputs.send(Input::Stop(leave_running));
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        self.stop(false);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
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
        claim: None,
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
