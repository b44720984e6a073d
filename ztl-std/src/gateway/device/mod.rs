//! A device: a thread with its session, its line and its tasks.

mod backpressure;
mod input;
mod line_reader;
mod parameters;
mod status;
mod worker;

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::thread::JoinHandle;

use ztl_core::TaskId;
use ztl_link::bus::Boards;
use ztl_link::{Restored, Session};

pub(super) use input::shown;
use input::{DeviceRequest, Input};
pub(super) use line_reader::{LineEvent, run_line};
use status::SharedStatus;
pub(super) use worker::OwnTasksCell;
use worker::Worker;

use super::journal::{DECIDED, DeviceJournal, JournalFile, UNWRITTEN, UnendedUpdate};
use super::logs::DeviceLog;
use super::opener::Opener;
use super::parameters::PARAMETERS;
use super::readings::Observers;
use super::updates::UPDATES;
use crate::random;
use crate::server::TaskReporter;
use crate::task_request::TaskRequest;

/// A device's thread. Dropping it aborts the tasks and ends the thread.
#[derive(Debug)]
pub(super) struct Device {
    opener: Option<Opener>,
    inputs: Sender<Input>,
    status: SharedStatus,
    log: DeviceLog,
    has_journal: bool,
    unused: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Device {
    /// Starts the thread. It opens the line after `awaited` tasks from before a restart have been resumed.
    /// Without an opener the device never answers.
    pub(super) fn spawn(
        name: &str,
        opener: Option<Opener>,
        gateway: u64,
        journal: Option<DeviceJournal<JournalFile>>,
        awaited: usize,
        observers: Observers,
        own_tasks: OwnTasksCell,
    ) -> io::Result<Self> {
        let (inputs, inbox) = channel();
        let baud = opener.as_ref().and_then(|opener| opener.baud);
        let has_journal = journal.is_some();
        let boards = journal.as_ref().map(DeviceJournal::boards);
        let session = Session::with_journal(journal, gateway, baud, random::nonzero);
        let sender = inputs.clone();
        let line = opener.clone();
        let mut worker = Worker::new(name, line, session, sender, awaited, observers, own_tasks);
        worker.boards = Boards::of_journal(&boards.unwrap_or_default());
        let (status, log) = (worker.status(), worker.log());
        let unused = worker.unused();
        let thread = std::thread::Builder::new()
            .name(format!("ztl-device-{name}"))
            .spawn(move || worker.run(&inbox))?;
        Ok(Self {
            opener,
            inputs,
            status,
            log,
            has_journal,
            unused,
            thread: Some(thread),
        })
    }

    pub(super) fn url(&self) -> String {
        let opener = self.opener.as_ref();
        opener.map_or_else(String::new, Opener::url)
    }

    pub(super) fn log(&self) -> DeviceLog {
        self.log.clone()
    }

    pub(super) fn status(&self) -> SharedStatus {
        self.status.clone()
    }

    pub(super) fn start(&self, task: TaskReporter, request: &TaskRequest) {
        let mut device_request = DeviceRequest::from(request);
        device_request.claim = self
            .has_journal
            .then(|| task.reject_unless_claimed(DECIDED, UNWRITTEN));
        let input = match request.component.as_str() {
            PARAMETERS => Input::Parameters,
            UPDATES => Input::Update,
            _ => Input::Start,
        };
        // If the thread has ended, dropping the reporter informs the client.
        let _ = self.inputs.send(input(task, device_request));
    }

    /// Resumes a task from before a restart.
    pub(super) fn resume(&self, task: TaskReporter, known: Restored) {
        let _ = self.inputs.send(Input::Resume(task, known));
    }

    /// Goes on with an update from before a restart.
    pub(super) fn resume_update(&self, task: TaskReporter, update: UnendedUpdate) {
        let _ = self.inputs.send(Input::ResumeUpdate(task, update));
    }

    pub(super) fn abort(&self, id: TaskId) {
        let _ = self.inputs.send(Input::Abort(id));
    }

    /// Aborts all tasks and rejects new ones. The device is unused when all have ended.
    pub(super) fn retire(&self) {
        let _ = self.inputs.send(Input::Retire);
    }

    /// Serves it again after [`retire`](Self::retire), or after it was spawned without an opener.
    pub(super) fn serve(&mut self, opener: Opener) {
        self.opener = Some(opener.clone());
        let _ = self.inputs.send(Input::Serve(opener));
    }

    /// Whether the device has neither a line nor tasks.
    pub(super) fn is_unused(&self) -> bool {
        self.unused.load(Ordering::Acquire)
    }

    /// Begins to end the thread; dropping the device waits for it.
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
