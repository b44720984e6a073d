//! Waiting for jobs.

use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use ztl_core::TaskId;

use crate::kind::{Job, Message};
use crate::mailbox::Inbox;

/// Longest wait while programs run, in case the system has not reported that one has ended.
const CHECK: Duration = Duration::from_secs(1);

/// What `poll` has reported.
pub(crate) struct Ready {
    /// A message or a signal may have come.
    pub(crate) woken: bool,
    /// Nothing has happened in time.
    pub(crate) timed_out: bool,
    /// Jobs whose pipes can be read.
    pub(crate) readable: Vec<TaskId>,
}

/// Waits until a message comes, a pipe of a job can be read, or something is due. `reads`: whether to wait for pipes.
pub(crate) fn wait<'j>(
    inbox: &Inbox<Message>,
    jobs: impl Iterator<Item = (TaskId, &'j dyn Job)> + Clone,
    background: &[Box<dyn Job>],
    due: Option<Instant>,
    reads: bool,
) -> Ready {
    let background = background.iter().map(AsRef::as_ref);
    let all = || jobs.clone().map(|(_, job)| job).chain(background.clone());
    let due = all().filter_map(Job::poll_timeout).chain(due).min();
    let left = due.map(|due| due.saturating_duration_since(Instant::now()));
    let check = all().any(Job::has_process).then_some(CHECK);
    let left = left.into_iter().chain(check).min();
    // No timeout if the time is beyond what the system can count.
    let left = left.and_then(|left| Timespec::try_from(left).ok());
    let mut polled = vec![PollFd::new(inbox, PollFlags::IN)];
    let mut whose = Vec::new();
    for (id, job) in jobs.filter(|_| reads) {
        for pipe in job.pipes() {
            polled.push(PollFd::from_borrowed_fd(pipe, PollFlags::IN));
            whose.push(id);
        }
    }
    // An interrupted wait counts as one in which nothing has happened.
    let count = poll(&mut polled, left.as_ref()).unwrap_or_default();
    let mut happened = polled
        .iter()
        .map(|fd| count > 0 && !fd.revents().is_empty());
    let woken = happened.next().unwrap_or_default();
    let mut readable: Vec<TaskId> = whose
        .iter()
        .zip(happened)
        .filter_map(|(id, happened)| happened.then_some(*id))
        .collect();
    readable.dedup();
    Ready {
        woken,
        timed_out: count == 0,
        readable,
    }
}

/// Does what is due for jobs that outlive their tasks, and drops those that have ended. `check`: a process may have
/// ended.
pub(crate) fn tend(background: &mut Vec<Box<dyn Job>>, now: Instant, check: bool) {
    background.retain_mut(|job| {
        let mut effects = Vec::new();
        job.turn(now, check, &mut effects);
        effects.is_empty()
    });
}
