//! How a handler tells its server what became of a task, from any thread.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use tracing::error;
use ztl_core::TaskId;
use ztl_core::dispatcher::TaskEvent;
use ztl_core::envelope::ClientId;

use crate::frames;

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
    /// To be refused for this reason if nobody claims it within that time.
    NeedsClaim(Claim, Duration, &'static str),
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
            // The dispatcher knows no such rules.
            Self::NeedsClient(..) | Self::NeedsClaim(..) => {}
        }
    }
}

/// Reports for the server's thread; wakes it when it sleeps in its poll.
#[derive(Clone)]
pub(super) struct Mailbox {
    post: Arc<Post>,
    waker: Arc<Waker>,
}

/// Reports on their way, in their order; `None` when the server is gone, which needs none.
type Post = Mutex<Option<VecDeque<(TaskId, Report)>>>;

/// Wakes the server's thread from its poll, where it sleeps.
pub(super) struct Waker {
    /// The server's thread is in its poll, or about to be, and was not woken.
    asleep: AtomicBool,
    /// Something has been posted since it looked last.
    posted: AtomicBool,
    /// Those who will wake it when something was posted.
    hushed: AtomicUsize,
    stop: AtomicBool,
    bell: Mutex<zmq::Socket>,
    /// Somebody feels the pulse.
    felt: AtomicBool,
    /// How often the server has beaten for somebody who felt.
    beats: Mutex<u64>,
    beaten: Condvar,
}

/// What the bell says. A client that says the same is heard as little.
const RING: &[u8] = b"bell";

/// Whether a message, with its sender's identity, is a ring of the bell.
pub(super) fn is_ring(frames: &[zmq::Message]) -> bool {
    matches!(frames, [_, body] if **body == *RING)
}

impl Waker {
    pub(super) fn new(bell: zmq::Socket) -> Arc<Self> {
        Arc::new(Self {
            asleep: AtomicBool::new(false),
            posted: AtomicBool::new(false),
            hushed: AtomicUsize::new(0),
            stop: AtomicBool::new(false),
            bell: Mutex::new(bell),
            felt: AtomicBool::new(false),
            beats: Mutex::new(0),
            beaten: Condvar::new(),
        })
    }

    /// Something was posted. The thread is woken, unless somebody will do it in a moment.
    pub(super) fn on_posted(&self) {
        self.posted.store(true, Ordering::SeqCst);
        if self.hushed.load(Ordering::SeqCst) == 0 {
            self.wake();
        }
    }

    fn wake(&self) {
        if self.asleep.swap(false, Ordering::SeqCst) {
            let bell = self.bell.lock().unwrap_or_else(PoisonError::into_inner);
            // The queue cannot be full: it rings once for each sleep. An empty frame would be taken for the
            // delimiter of a request without a body.
            let _ = frames::send(&bell, &[RING]);
        }
    }

    /// The server's thread is about to poll: says whether it may sleep, which is so when nothing was
    /// posted since it was [awake](Self::awake).
    pub(super) fn may_sleep(&self) -> bool {
        self.asleep.store(true, Ordering::SeqCst);
        if self.posted.load(Ordering::SeqCst) {
            self.asleep.store(false, Ordering::SeqCst);
        }
        self.asleep.load(Ordering::SeqCst)
    }

    /// It has woken up, and looks at all that was posted before.
    pub(super) fn awake(&self) {
        self.asleep.store(false, Ordering::SeqCst);
        self.posted.store(false, Ordering::SeqCst);
        if self.felt.swap(false, Ordering::SeqCst) {
            let mut beats = self.beats.lock().unwrap_or_else(PoisonError::into_inner);
            *beats = beats.wrapping_add(1);
            self.beaten.notify_all();
        }
    }

    /// Whether the server's thread goes its rounds within `limit`.
    pub(super) fn beats(&self, limit: Duration) -> bool {
        let beats = self.beats.lock().unwrap_or_else(PoisonError::into_inner);
        let before = *beats;
        self.felt.store(true, Ordering::SeqCst);
        self.on_posted();
        let waited = self
            .beaten
            .wait_timeout_while(beats, limit, |beats| *beats == before);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    pub(super) fn stop(&self) {
        self.stop.store(true, Ordering::SeqCst);
        self.posted.store(true, Ordering::SeqCst);
        self.wake();
    }

    pub(super) fn stopped(&self) -> bool {
        self.stop.load(Ordering::SeqCst)
    }
}

/// As long as one of them is there, reports do not wake the server; the last one does, if there were
/// any. For a task that waits for a thread: in the meantime others' reports gather, and all are taken
/// at once.
#[must_use = "dropped, it wakes the server"]
pub(crate) struct Hush(Arc<Waker>);

impl Drop for Hush {
    fn drop(&mut self) {
        let last = self.0.hushed.fetch_sub(1, Ordering::SeqCst) == 1;
        if last && self.0.posted.load(Ordering::SeqCst) {
            self.0.wake();
        }
    }
}

impl Mailbox {
    pub(super) fn new(waker: Arc<Waker>) -> (Self, Inbox) {
        let post = Arc::new(Mutex::new(Some(VecDeque::new())));
        let inbox = Inbox {
            post: Arc::clone(&post),
            taken: VecDeque::new(),
        };
        (Self { post, waker }, inbox)
    }

    fn post(&self, id: TaskId, report: Report) {
        let mut post = self.post.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(reports) = post.as_mut() else {
            return;
        };
        reports.push_back((id, report));
        drop(post);
        self.waker.on_posted();
    }
}

/// For how many reports there is always room, once it was needed.
const KEPT: usize = 1024;

/// The server's end.
pub(super) struct Inbox {
    post: Arc<Post>,
    /// Those that it has taken all at once and not looked at.
    taken: VecDeque<(TaskId, Report)>,
}

impl Inbox {
    /// The next report, if there is one.
    pub(super) fn next(&mut self) -> Option<(TaskId, Report)> {
        if self.taken.is_empty() {
            self.taken.shrink_to(KEPT);
            let mut post = self.post.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(reports) = post.as_mut() {
                std::mem::swap(reports, &mut self.taken);
            }
        }
        self.taken.pop_front()
    }
}

impl Drop for Inbox {
    fn drop(&mut self) {
        let never = self
            .post
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take();
        drop(never);
    }
}

/// Whether a task may be begun, or is refused by its server: whichever comes first.
#[derive(Debug, Clone, Default)]
pub struct Claim(Arc<OnceLock<bool>>);

impl Claim {
    /// Takes it, and says whether the task may be begun. If not, its client was told that it is refused.
    #[must_use]
    pub fn take(&self) -> bool {
        *self.0.get_or_init(|| true)
    }

    /// Says whether nobody has taken it, and nobody will.
    pub(super) fn refuse(&self) -> bool {
        !*self.0.get_or_init(|| false)
    }
}

/// One task's line to its server. Exactly one of the ends is told: a reporter that is dropped
/// before ends the task as FAILED.
pub struct TaskReporter {
    id: TaskId,
    mailbox: Mailbox,
    /// Made when it is first needed.
    progress: OnceLock<Slot>,
    ended: bool,
    client: Option<ClientId>,
}

impl TaskReporter {
    pub(super) fn new(id: TaskId, mailbox: Mailbox, client: Option<ClientId>) -> Self {
        Self {
            id,
            client,
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
        let slot = self.progress.get_or_init(Slot::default);
        let mut latest = slot.lock().unwrap_or_else(PoisonError::into_inner);
        let on_its_way = latest.replace(text.into()).is_some();
        drop(latest);
        if !on_its_way {
            self.post(Report::Progress(Arc::clone(slot)));
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

    /// The task is refused, and its client never told its id, if nobody takes the claim `within` this time.
    /// For a handler that has to write something down before an id is told: an INIT without a decision is
    /// answered with the id after 1.5 s.
    #[must_use = "a claim that nobody takes refuses the task"]
    pub fn refuse_unless_claimed(&self, within: Duration, reason: &'static str) -> Claim {
        let claim = Claim::default();
        self.post(Report::NeedsClaim(claim.clone(), within, reason));
        claim
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

    /// Lets reports gather for as long as this task waits to be begun, which must be short.
    pub(crate) fn hush(&self) -> Hush {
        let waker = &self.mailbox.waker;
        waker.hushed.fetch_add(1, Ordering::SeqCst);
        Hush(Arc::clone(waker))
    }

    /// Refuses an ABORT from elsewhere than where the reporter is.
    pub(crate) fn abort_refusal(&self) -> AbortRefusal {
        AbortRefusal(self.id, self.mailbox.clone())
    }

    fn post(&self, report: Report) {
        self.mailbox.post(self.id, report);
    }

    fn end(mut self, report: Report) {
        self.ended = true;
        self.post(report);
    }
}

/// Refuses an ABORT of a task from elsewhere than where its reporter is.
pub(crate) struct AbortRefusal(TaskId, Mailbox);

impl AbortRefusal {
    /// The task cannot be stopped and goes on.
    pub(crate) fn tell(&self) {
        self.1.post(self.0, Report::AbortRefused);
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

    /// A server's side: its bell, and what wakes it.
    fn server() -> (zmq::Socket, Arc<Waker>, Mailbox, Inbox) {
        let context = zmq::Context::new();
        let bell = context.socket(zmq::PULL).unwrap();
        bell.bind("inproc://wake").unwrap();
        let ringer = context.socket(zmq::PUSH).unwrap();
        ringer.connect("inproc://wake").unwrap();
        let waker = Waker::new(ringer);
        let (mailbox, inbox) = Mailbox::new(Arc::clone(&waker));
        (bell, waker, mailbox, inbox)
    }

    fn rings(bell: &zmq::Socket) -> usize {
        let rings = std::iter::from_fn(|| bell.recv_msg(zmq::DONTWAIT).ok());
        let no_request = |ring: &zmq::Message| assert!(!ring.is_empty(), "it is a delimiter");
        rings.inspect(no_request).count()
    }

    fn task(mailbox: &Mailbox) -> TaskReporter {
        TaskReporter::new(TaskId::new(1).unwrap(), mailbox.clone(), None)
    }

    #[test]
    fn a_server_is_woken_once_for_each_sleep_and_never_while_it_is_awake() {
        let (bell, waker, mailbox, mut inbox) = server();
        let task = task(&mailbox);
        task.accepted("while awake");
        assert_eq!(rings(&bell), 0);
        assert!(!waker.may_sleep(), "something was posted");
        waker.awake();
        assert_eq!(std::iter::from_fn(|| inbox.next()).count(), 1);
        assert!(waker.may_sleep());
        task.accepted("while asleep");
        task.accepted("and again");
        assert_eq!(rings(&bell), 1);
        waker.awake();
        assert_eq!(std::iter::from_fn(|| inbox.next()).count(), 2);
        assert!(waker.may_sleep());
        task.leave();
    }

    #[test]
    fn reports_gather_while_other_tasks_wait_to_be_begun_and_none_is_left_unheard() {
        let (bell, waker, mailbox, _inbox) = server();
        let (task, others) = (task(&mailbox), [task(&mailbox), task(&mailbox)]);
        let [one, two] = [others[0].hush(), others[1].hush()];
        assert!(waker.may_sleep());
        task.completed("done");
        drop(one);
        assert_eq!(rings(&bell), 0, "one is still to be begun");
        drop(two);
        assert_eq!(rings(&bell), 1);

        waker.awake();
        assert!(waker.may_sleep());
        drop(others[0].hush());
        assert_eq!(rings(&bell), 0, "there is nothing to be heard");
        others.into_iter().for_each(TaskReporter::leave);
    }
}
