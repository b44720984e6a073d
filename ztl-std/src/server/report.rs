//! How a handler tells its server what became of a task, from any thread.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, TryIter, channel};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use tracing::error;
use ztl_core::TaskId;
use ztl_core::dispatcher::TaskEvent;
use ztl_core::envelope::ClientId;

/// What a handler says, on its way to the server's thread.
#[derive(Debug)]
pub(super) enum Report {
    Accepted(String),
    Rejected(String),
    Threw(String),
    /// There is progress in the task's slot.
    Progress(Slot),
    Completed(String),
    Failed(String),
    Aborted(String),
    AbortRefused,
    /// To be aborted when this client is silent for so long.
    NeedsClient(ClientId, Duration),
}

/// A task's latest progress that the server has not taken yet. However often a task reports, one
/// report at a time is on its way.
type Slot = Arc<Mutex<Option<String>>>;

impl Report {
    /// Hands over what it says.
    pub(super) fn tell(self, tell: impl FnOnce(TaskEvent<'_>)) {
        match self {
            Self::Accepted(reply) => tell(TaskEvent::Accepted { reply: &reply }),
            Self::Rejected(reason) => tell(TaskEvent::Rejected { reason: &reason }),
            Self::Threw(message) => tell(TaskEvent::Threw { message: &message }),
            Self::Progress(slot) => {
                let latest = slot.lock().unwrap_or_else(PoisonError::into_inner).take();
                if let Some(text) = latest {
                    tell(TaskEvent::Progress { text: &text });
                }
            }
            Self::Completed(result) => tell(TaskEvent::Completed { result: &result }),
            Self::Failed(reason) => tell(TaskEvent::Failed { reason: &reason }),
            Self::Aborted(result) => tell(TaskEvent::Aborted { result: &result }),
            Self::AbortRefused => tell(TaskEvent::AbortRefused),
            // The dispatcher knows no such rule.
            Self::NeedsClient(..) => {}
        }
    }
}

/// Reports for the server's thread; wakes it when it sleeps in its poll.
#[derive(Clone)]
pub(super) struct Mailbox {
    reports: Sender<(TaskId, Report)>,
    waker: Arc<Waker>,
}

/// Ends the server's poll from another thread.
pub(super) struct Waker {
    /// A wake-up is on its way and has not been taken.
    pending: AtomicBool,
    stop: AtomicBool,
    bell: Mutex<zmq::Socket>,
    /// How often the server has taken a wake-up.
    turns: Mutex<u64>,
    turned: Condvar,
}

impl Waker {
    pub(super) fn new(bell: zmq::Socket) -> Arc<Self> {
        Arc::new(Self {
            pending: AtomicBool::new(false),
            stop: AtomicBool::new(false),
            bell: Mutex::new(bell),
            turns: Mutex::new(0),
            turned: Condvar::new(),
        })
    }

    fn wake(&self) {
        if !self.pending.swap(true, Ordering::AcqRel) {
            let bell = self.bell.lock().unwrap_or_else(PoisonError::into_inner);
            // The queue cannot be full: one wake-up is pending at a time.
            let _ = bell.send(&b""[..], zmq::DONTWAIT);
        }
    }

    /// The wake-up has been taken: what comes from now on rings again. To be called before the
    /// mailbox is emptied.
    pub(super) fn taken(&self) {
        self.pending.store(false, Ordering::Release);
        let mut turns = self.turns.lock().unwrap_or_else(PoisonError::into_inner);
        *turns = turns.wrapping_add(1);
        self.turned.notify_all();
    }

    /// Whether the server takes a wake-up within `limit`.
    pub(super) fn is_taken(&self, limit: Duration) -> bool {
        let turns = self.turns.lock().unwrap_or_else(PoisonError::into_inner);
        let before = *turns;
        self.wake();
        let waited = self
            .turned
            .wait_timeout_while(turns, limit, |turns| *turns == before);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    pub(super) fn stop(&self) {
        self.stop.store(true, Ordering::Release);
        self.wake();
    }

    pub(super) fn stopped(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }
}

impl Mailbox {
    pub(super) fn new(waker: Arc<Waker>) -> (Self, Inbox) {
        let (reports, inbox) = channel();
        (Self { reports, waker }, Inbox(inbox))
    }

    fn post(&self, id: TaskId, report: Report) {
        // A server that is gone needs no reports.
        if self.reports.send((id, report)).is_ok() {
            self.waker.wake();
        }
    }
}

pub(super) struct Inbox(Receiver<(TaskId, Report)>);

impl Inbox {
    pub(super) fn waiting(&self) -> TryIter<'_, (TaskId, Report)> {
        self.0.try_iter()
    }
}

/// One task's line to its server. Exactly one of the ends is told: a reporter that is dropped
/// before ends the task as FAILED.
pub struct TaskReporter {
    id: TaskId,
    mailbox: Mailbox,
    progress: Slot,
    ended: bool,
    client: Option<ClientId>,
}

impl TaskReporter {
    pub(super) fn new(id: TaskId, mailbox: Mailbox, client: Option<ClientId>) -> Self {
        Self {
            id,
            client,
            mailbox,
            progress: Slot::default(),
            ended: false,
        }
    }

    /// The task's id, as its client knows it.
    #[must_use]
    pub const fn id(&self) -> TaskId {
        self.id
    }

    /// Who asked for it, where the client says so.
    #[must_use]
    pub const fn client(&self) -> Option<ClientId> {
        self.client
    }

    /// Nothing more is told: the task goes on without this process, and the next one will know its
    /// end.
    pub fn leave(mut self) {
        self.ended = true;
    }

    /// The task is taken; `reply` is the text of the INIT's answer.
    pub fn accepted(&self, reply: impl Into<String>) {
        self.post(Report::Accepted(reply.into()));
    }

    /// Where the task is now; the latest wins.
    pub fn progress(&self, text: impl Into<String>) {
        let mut slot = self.progress.lock().unwrap_or_else(PoisonError::into_inner);
        let on_its_way = slot.replace(text.into()).is_some();
        drop(slot);
        if !on_its_way {
            self.post(Report::Progress(Arc::clone(&self.progress)));
        }
    }

    /// The task is aborted when the client that started it is gone, instead of being carried on:
    /// when nothing has come from it for `silence`, though it had asked for something after the INIT.
    /// Should be 5 s or more, since a client that waits asks every second, and a network may pause.
    ///
    /// Never happens to a client that does not say who it is, as the original's.
    pub fn needs_client(&self, silence: Duration) {
        if let Some(client) = self.client {
            self.post(Report::NeedsClient(client, silence));
        }
    }

    /// The task cannot be stopped and goes on: answers an ABORT.
    pub fn abort_refused(&self) {
        self.post(Report::AbortRefused);
    }

    /// The task is refused, and nothing was done.
    pub fn rejected(self, reason: impl Into<String>) {
        self.end(Report::Rejected(reason.into()));
    }

    /// The task is refused in the form in which the original reports an exception of its
    /// controller.
    pub fn threw(self, message: impl Into<String>) {
        let message = message.into();
        // As the original logs it (wire specification 7.1).
        error!(target: "root", "{message}");
        self.end(Report::Threw(message));
    }

    /// The goal is reached.
    pub fn completed(self, result: impl Into<String>) {
        self.end(Report::Completed(result.into()));
    }

    /// The goal will not be reached.
    pub fn failed(self, reason: impl Into<String>) {
        self.end(Report::Failed(reason.into()));
    }

    /// The task has stopped as asked.
    pub fn aborted(self, result: impl Into<String>) {
        self.end(Report::Aborted(result.into()));
    }

    /// Refuses an ABORT from elsewhere than where the reporter is.
    pub(crate) fn abort_refusal(&self) -> Box<dyn Fn() + Send> {
        let (id, mailbox) = (self.id, self.mailbox.clone());
        Box::new(move || mailbox.post(id, Report::AbortRefused))
    }

    fn post(&self, report: Report) {
        self.mailbox.post(self.id, report);
    }

    fn end(mut self, report: Report) {
        self.ended = true;
        self.post(report);
    }
}

impl Drop for TaskReporter {
    fn drop(&mut self) {
        if !self.ended {
            self.post(Report::Failed("its handler has gone".to_owned()));
        }
    }
}

impl std::fmt::Debug for TaskReporter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("TaskReporter").field(&self.id).finish()
    }
}
