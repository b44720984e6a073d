//! How a handler reports to its server what became of a task, from any thread.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use tracing::error;
use ztl_core::dispatcher::TaskEvent;
use ztl_core::envelope::ClientId;
use ztl_core::memory::Scope;
use ztl_core::{Instant, TaskId};

#[cfg(feature = "gateway")]
use super::clock::now;
use super::waker::{WakeBatch, Waker};

/// A handler's report, on its way to the server's thread.
#[derive(Debug)]
pub(super) enum Report {
    Accepted(String),
    Rejected(String),
    Threw(String),
    /// The task's slot holds new progress.
    Progress(Slot),
    Completed(String),
    Failed(String),
    Aborted(String),
    AbortRejected,
    /// Abort the task when this client is silent for so long.
    NeedsClient(ClientId, Duration),
    /// Reserve an id for a task of a handler itself.
    Reserve(Ready),
    /// A task of this scope's handler itself runs; its payload.
    Begun(Scope, String, bool),
}

/// Longest progress that is kept, in bytes.
const LONGEST_PROGRESS: usize = 4096;

/// Gets a reserved id.
pub(super) struct Ready(pub(super) Box<dyn FnOnce(TaskId) + Send>);

impl std::fmt::Debug for Ready {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Ready")
    }
}

/// A task's latest progress that the server has not taken yet, so that at most one progress report per task
/// is on its way.
type Slot = Arc<Mutex<Option<String>>>;

impl Report {
    /// Passes the report to the dispatcher.
    pub(super) fn handle(self, tell: impl FnOnce(TaskEvent<'_>)) {
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
            Self::AbortRejected => tell(TaskEvent::AbortRejected),
            // The server itself applies these.
            Self::NeedsClient(..) | Self::Reserve(..) | Self::Begun(..) => {}
        }
    }
}

/// Takes reports for the server's thread, and wakes it.
#[derive(Clone)]
pub(super) struct Mailbox {
    queue: Arc<Queue>,
    waker: Arc<Waker>,
}

/// `None` when the server is gone.
type Queue = Mutex<Option<Posted>>;

/// What the server has not taken yet.
#[derive(Default)]
struct Posted {
    /// In order.
    reports: VecDeque<(TaskId, Report)>,
    claims: Vec<NeededClaim>,
}

/// A task that is rejected unless it is claimed in time.
pub(super) struct NeededClaim {
    pub(super) id: TaskId,
    pub(super) claim: Claim,
    pub(super) until: Instant,
    pub(super) reason: &'static str,
}

impl Mailbox {
    pub(super) fn new(waker: Arc<Waker>) -> (Self, Inbox) {
        let queue = Arc::new(Mutex::new(Some(Posted::default())));
        let inbox = Inbox {
            queue: Arc::clone(&queue),
            taken: VecDeque::new(),
        };
        (Self { queue, waker }, inbox)
    }

    pub(super) fn post(&self, id: TaskId, report: Report) {
        self.put(|posted| posted.reports.push_back((id, report)));
    }

    fn put(&self, put: impl FnOnce(&mut Posted)) {
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(posted) = queue.as_mut() else {
            return;
        };
        put(posted);
        drop(queue);
        self.waker.on_posted();
    }
}

/// Capacity in reports that the inbox keeps.
const KEPT_CAPACITY: usize = 1024;

/// The server's end of the mailbox.
pub(super) struct Inbox {
    queue: Arc<Queue>,
    /// Reports taken from the queue together.
    taken: VecDeque<(TaskId, Report)>,
}

impl Inbox {
    /// The next report, if there is one.
    pub(super) fn next(&mut self) -> Option<(TaskId, Report)> {
        if self.taken.is_empty() {
            self.taken.shrink_to(KEPT_CAPACITY);
            let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(posted) = queue.as_mut() {
                std::mem::swap(&mut posted.reports, &mut self.taken);
            }
        }
        self.taken.pop_front()
    }

    /// All claims since the last call. They do not wait behind reports: under a flood, these may be late.
    pub(super) fn take_claims(&mut self) -> Vec<NeededClaim> {
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let posted = queue.as_mut();
        posted.map_or_else(Vec::new, |posted| std::mem::take(&mut posted.claims))
    }
}

impl Drop for Inbox {
    fn drop(&mut self) {
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let unread = queue.take();
        drop(queue);
        // Dropping reports may drop more reporters.
        drop(unread);
    }
}

/// Decides once whether a task may start or its server rejects it, whichever is first.
#[derive(Debug, Clone, Default)]
pub(crate) struct Claim(Arc<OnceLock<bool>>);

impl Claim {
    /// Claims the task; returns whether it may start. If not, the client has received the rejection.
    #[cfg(feature = "gateway")]
    pub(crate) fn take(&self) -> bool {
        *self.0.get_or_init(|| true)
    }

    /// Prevents the claim; returns `false` if the task is claimed already.
    pub(super) fn reject(&self) -> bool {
        !*self.0.get_or_init(|| false)
    }
}

/// Reports what becomes of one task. Exactly one end is reported: a reporter that is dropped before ends the
/// task as FAILED.
pub struct TaskReporter {
    id: TaskId,
    mailbox: Mailbox,
    /// Created when first needed.
    progress: OnceLock<Slot>,
    ended: bool,
    client: Option<ClientId>,
    /// Whether the client sends requests after its INIT.
    pub(super) can_be_missed: bool,
}

impl TaskReporter {
    pub(super) fn new(id: TaskId, mailbox: Mailbox, client: Option<ClientId>) -> Self {
        Self {
            id,
            client,
            can_be_missed: client.is_some(),
            mailbox,
            progress: OnceLock::new(),
            ended: false,
        }
    }

    /// The task's id, as its client knows it.
    #[must_use]
    pub const fn id(&self) -> TaskId {
        self.id
    }

    /// The client that asked for it, if it identifies itself.
    #[must_use]
    pub const fn client(&self) -> Option<ClientId> {
        self.client
    }

    /// Reports nothing more: the task continues without this process, and the next process learns its outcome.
    pub fn leave(mut self) {
        self.ended = true;
    }

    /// The task is accepted; `reply` is the text that answers the INIT.
    pub fn accepted(&self, reply: impl Into<String>) {
        self.post(Report::Accepted(reply.into()));
    }

    /// The task's progress; a newer text replaces an older one. Of a text of more than 4 KiB, the rest is left out: each of
    /// many tasks may keep one.
    pub fn progress(&self, text: impl Into<String>) {
        let mut text = text.into();
        if text.len() > LONGEST_PROGRESS {
            text.truncate(text.floor_char_boundary(LONGEST_PROGRESS));
            text.push('…');
            text.shrink_to_fit();
        }
        let slot = self.progress.get_or_init(Slot::default);
        let mut latest = slot.lock().unwrap_or_else(PoisonError::into_inner);
        let on_its_way = latest.replace(text).is_some();
        drop(latest);
        if !on_its_way {
            self.post(Report::Progress(Arc::clone(slot)));
        }
    }

    /// Aborts the task when its client is gone: when nothing has arrived from the client for `silence` since the
    /// answer to the INIT. Choose 5 s or more, since a waiting client asks every second and networks stall. A clone of a
    /// client is another client.
    ///
    /// Has no effect for clients that do not identify themselves, such as the original's.
    pub fn needs_client(&self, silence: Duration) {
        if let Some(client) = self.client.filter(|_| self.can_be_missed) {
            self.post(Report::NeedsClient(client, silence));
        }
    }

    /// Rejects the task, without telling its client an id, unless it is claimed `within` this time. For a
    /// handler that must write a journal entry before any client learns the id: an undecided INIT is answered
    /// with the id after 1.5 s.
    #[cfg(feature = "gateway")]
    #[must_use = "an unclaimed task is rejected"]
    pub(crate) fn reject_unless_claimed(&self, within: Duration, reason: &'static str) -> Claim {
        let claim = Claim::default();
        let needed = NeededClaim {
            id: self.id,
            claim: claim.clone(),
            until: now() + within,
            reason,
        };
        self.mailbox.put(|posted| posted.claims.push(needed));
        claim
    }

    /// Answers an ABORT: the task cannot be stopped and continues.
    pub fn abort_rejected(&self) {
        self.post(Report::AbortRejected);
    }

    /// The task is rejected; nothing was done.
    pub fn rejected(self, reason: impl Into<String>) {
        self.end(Report::Rejected(reason.into()));
    }

    /// The task is rejected in the form in which the original reports an exception of its controller.
    pub fn threw(self, message: impl Into<String>) {
        let message = message.into();
        // The original's server logs the exception's message, too, with this logger.
        error!(target: "root", "{message}");
        self.end(Report::Threw(message));
    }

    /// The task reached its goal.
    pub fn completed(self, result: impl Into<String>) {
        self.end(Report::Completed(result.into()));
    }

    /// The task did not reach its goal.
    pub fn failed(self, reason: impl Into<String>) {
        self.end(Report::Failed(reason.into()));
    }

    /// The task was stopped on request.
    pub fn aborted(self, result: impl Into<String>) {
        self.end(Report::Aborted(result.into()));
    }

    /// Batches the server's wake-ups while this task waits for a thread, which must be short.
    pub(crate) fn wake_batch(&self) -> WakeBatch {
        self.mailbox.waker.batch()
    }

    /// Rejects an ABORT on behalf of the reporter, which is elsewhere.
    pub(crate) fn abort_rejection(&self) -> AbortRejection {
        AbortRejection(self.id, self.mailbox.clone())
    }

    fn post(&self, report: Report) {
        self.mailbox.post(self.id, report);
    }

    fn end(mut self, report: Report) {
        self.ended = true;
        self.post(report);
    }
}

/// Rejects an ABORT on behalf of a reporter that is elsewhere.
pub(crate) struct AbortRejection(TaskId, Mailbox);

impl AbortRejection {
    /// The task cannot be stopped and continues.
    pub(crate) fn send(&self) {
        self.1.post(self.0, Report::AbortRejected);
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A server's side: where it is woken, and what wakes it.
    fn server() -> (mio::Poll, Arc<Waker>, Mailbox, Inbox) {
        let woken = mio::Poll::new().unwrap();
        let waking = mio::Waker::new(woken.registry(), mio::Token(7)).unwrap();
        let waker = Waker::new(crate::server::waker::Signal::Native(waking));
        let (mailbox, inbox) = Mailbox::new(Arc::clone(&waker));
        (woken, waker, mailbox, inbox)
    }

    fn is_woken(woken: &mut mio::Poll) -> bool {
        let mut events = mio::Events::with_capacity(8);
        woken.poll(&mut events, Some(Duration::ZERO)).unwrap();
        !events.is_empty()
    }

    fn task(mailbox: &Mailbox) -> TaskReporter {
        TaskReporter::new(TaskId::new(1).unwrap(), mailbox.clone(), None)
    }

    #[test]
    fn a_server_is_woken_once_per_sleep_and_never_while_it_is_awake() {
        let (mut woken, waker, mailbox, mut inbox) = server();
        let task = task(&mailbox);
        task.accepted("while awake");
        assert!(!is_woken(&mut woken));
        assert!(!waker.may_sleep(), "something was posted");
        waker.on_awake();
        assert_eq!(std::iter::from_fn(|| inbox.next()).count(), 1);
        assert!(waker.may_sleep());
        task.accepted("while asleep");
        assert!(is_woken(&mut woken));
        task.accepted("and again");
        assert!(!is_woken(&mut woken));
        waker.on_awake();
        assert_eq!(std::iter::from_fn(|| inbox.next()).count(), 2);
        assert!(waker.may_sleep());
        task.leave();
    }

    #[test]
    fn a_long_progress_is_cut_between_characters() {
        let (_woken, _waker, mailbox, mut inbox) = server();
        let task = task(&mailbox);
        for (text, length) in [
            ("x".repeat(LONGEST_PROGRESS), LONGEST_PROGRESS),
            ("ä".repeat(LONGEST_PROGRESS), LONGEST_PROGRESS + "…".len()),
            (
                format!("x{}", "ä".repeat(LONGEST_PROGRESS)),
                LONGEST_PROGRESS - 1 + "…".len(),
            ),
        ] {
            task.progress(text.clone());
            let (_, report) = inbox.next().expect("a report");
            report.handle(|event| {
                let TaskEvent::Progress { text: told } = event else {
                    panic!("{event:?}");
                };
                assert_eq!(told.len(), length);
                assert!(text.starts_with(told.trim_end_matches('…')));
            });
        }
        task.leave();
    }

    #[cfg(feature = "gateway")]
    #[test]
    fn a_claim_counts_from_its_init_and_waits_behind_no_report() {
        let (_woken, _waker, mailbox, mut inbox) = server();
        let (task, others) = (task(&mailbox), task(&mailbox));
        for _ in 0..1000 {
            others.abort_rejected();
        }
        let within = Duration::from_secs(1);
        let claim = task.reject_unless_claimed(within, "late");
        let latest = now() + within;
        let needed = inbox.take_claims();
        assert_eq!(needed.len(), 1);
        assert!(needed[0].until <= latest && needed[0].claim.reject());
        assert!(!claim.take() && inbox.take_claims().is_empty());
        assert!(inbox.next().is_some());
    }

    #[test]
    fn reports_are_batched_while_other_tasks_wait_for_a_thread() {
        let (mut woken, waker, mailbox, _inbox) = server();
        let (task, others) = (task(&mailbox), [task(&mailbox), task(&mailbox)]);
        let [one, two] = [others[0].wake_batch(), others[1].wake_batch()];
        assert!(waker.may_sleep());
        task.completed("done");
        drop(one);
        assert!(!is_woken(&mut woken), "one still waits");
        drop(two);
        assert!(is_woken(&mut woken));

        waker.on_awake();
        assert!(waker.may_sleep());
        drop(others[0].wake_batch());
        assert!(!is_woken(&mut woken), "there is no report");
        others.into_iter().for_each(TaskReporter::leave);
    }
}
