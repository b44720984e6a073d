//! Waiting for what programs say and for their ends.

use std::io::{self, Read};
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::Signal;
use tracing::{debug, warn};
use ztl_core::TaskId;

use super::super::run::{Act, End, time};
use super::super::{LOG, group};
use super::{CONFIRM, Doing, Running, Supervisor, Task};

/// Longest sleep while programs run, should the system not tell that one has ended.
const DOUBT: Duration = Duration::from_secs(1);
/// Most bytes that are taken of a program at a time, so that each has its turn.
pub(super) const READ: usize = 16 * 1024;
/// Most bytes that are taken after its end, from what it left behind.
const LAST_READS: usize = 64;

/// What has happened.
pub(super) struct Ready {
    /// A message or a signal may be there.
    pub(super) rung: bool,
    /// Nothing at all within the time.
    pub(super) idle: bool,
    /// Programs that have said something.
    pub(super) talking: Vec<TaskId>,
}

impl Supervisor {
    fn running(&self) -> impl Iterator<Item = (TaskId, &Running)> {
        self.tasks
            .iter()
            .filter_map(|(id, task)| match &task.doing {
                Doing::Program(running) => Some((*id, running.as_ref())),
                _ => None,
            })
    }

    /// When something is due.
    fn poll_timeout(&self) -> Option<Instant> {
        let tasks = self.tasks.values().filter_map(|task| match &task.doing {
            Doing::Program(running) => running.run.poll_timeout(),
            Doing::Announced(announced) => announced.until,
            Doing::Sleeping(until) | Doing::Thread(_, until) => *until,
            _ => None,
        });
        let helpers = self.helpers.iter().filter_map(|helper| helper.until);
        tasks.chain(helpers).min()
    }

    /// Until something happens.
    pub(super) fn wait(&self) -> Ready {
        let doubt = (!self.helpers.is_empty() || self.running().next().is_some()).then_some(DOUBT);
        let left = self
            .poll_timeout()
            .map(|due| due.saturating_duration_since(Instant::now()));
        let left = left.into_iter().chain(doubt).min();
        // A time beyond what the system can count is for ever.
        let left = left.and_then(|left| Timespec::try_from(left).ok());
        let mut polled = vec![PollFd::new(&self.inbox, PollFlags::IN)];
        let mut whose = Vec::new();
        for (id, running) in self.running() {
            let out = running
                .out
                .as_ref()
                .map(|out| PollFd::new(out, PollFlags::IN));
            let err = running
                .err
                .as_ref()
                .map(|err| PollFd::new(err, PollFlags::IN));
            for fd in out.into_iter().chain(err) {
                polled.push(fd);
                whose.push(id);
            }
        }
        // An interrupted wait is as one that has ended.
        let count = poll(&mut polled, left.as_ref()).unwrap_or_default();
        let mut happened = polled.iter().map(|fd| !fd.revents().is_empty());
        let rung = count > 0 && happened.next().unwrap_or_default();
        let mut talking: Vec<TaskId> = whose
            .iter()
            .zip(happened)
            .filter(|(_, happened)| count > 0 && *happened)
            .map(|(id, _)| *id)
            .collect();
        talking.dedup();
        Ready {
            rung,
            idle: count == 0,
            talking,
        }
    }

    /// Takes what a program has said; says whether there was anything.
    pub(super) fn read(&mut self, id: TaskId, buffer: &mut [u8]) -> bool {
        let Some(task) = self.tasks.get_mut(&id) else {
            return false;
        };
        let Doing::Program(running) = &mut task.doing else {
            return false;
        };
        let mut acts = Vec::new();
        let out = read(&mut running.out, buffer);
        if let Some(bytes) = &out {
            running.run.handle_output(bytes, &mut acts);
        }
        let err = read(&mut running.err, buffer);
        if let Some(bytes) = &err {
            running.run.handle_error_output(bytes, |line| {
                debug!(target: LOG, "Task {id} says: {line}");
            });
        }
        let any = out.is_some() || err.is_some();
        self.act(id, acts);
        any
    }

    pub(super) fn handle_timeouts(&mut self, now: Instant) {
        let is_due = |time: Option<Instant>| time.is_some_and(|time| time <= now);
        let mut acts = Vec::new();
        let mut over = Vec::new();
        for (id, task) in &mut self.tasks {
            match &mut task.doing {
                Doing::Program(running) => {
                    let mut wanted = Vec::new();
                    running.run.handle_timeout(now, &mut wanted);
                    if !wanted.is_empty() {
                        acts.push((*id, wanted));
                    }
                }
                Doing::Announced(announced) if is_due(announced.until) => over.push(*id),
                Doing::Sleeping(until) | Doing::Thread(_, until) if is_due(*until) => {
                    over.push(*id);
                }
                _ => {}
            }
        }
        for (id, acts) in acts {
            self.act(id, acts);
        }
        for id in over {
            match self.tasks.get(&id).map(|task| &task.doing) {
                Some(Doing::Announced(_)) => {
                    let reason = format!(
                        "not started: the watchdog has not confirmed within {}; try again",
                        time(CONFIRM)
                    );
                    self.finish(id, End::Rejected(reason));
                }
                Some(Doing::Sleeping(_)) => self.finish(id, End::Completed("True".to_owned())),
                _ => self.leave(id),
            }
        }
        for helper in self
            .helpers
            .iter_mut()
            .filter(|helper| is_due(helper.until))
        {
            helper.until = None;
            group::signal(helper.group, Signal::KILL);
        }
    }

    /// A task that is done elsewhere is left as it is: how it ends is unknown, and so not told.
    fn leave(&mut self, id: TaskId) {
        if let Some(task) = self.tasks.remove(&id) {
            warn!(target: LOG, "Task {id}, {}, has not confirmed that it has stopped.", task.name());
            task.reporter.leave();
            self.free(id, task.entry);
        }
    }

    /// Finds the programs that have ended.
    pub(super) fn look_for_ends(&mut self) {
        let ids: Vec<TaskId> = self.running().map(|(id, _)| id).collect();
        for id in ids {
            self.look_for_end(id);
        }
        let groups = &self.groups;
        self.helpers.retain_mut(|helper| {
            let ended = group::has_ended(helper.group).unwrap_or(true);
            if ended {
                let status = groups.end(helper.group, true, || helper.child.wait());
                if !status.as_ref().is_ok_and(ExitStatus::success) {
                    let how = status.map_or_else(|error| error.to_string(), |status| status.to_string());
                    warn!(target: LOG, "The abort program at {} has ended with: {how}", helper.place);
                }
            }
            !ended
        });
    }

    pub(super) fn look_for_end(&mut self, id: TaskId) {
        if let Some(task) = self.tasks.get_mut(&id)
            && let Doing::Program(running) = &mut task.doing
            && !running.ended
        {
            // One that somebody else has reaped is over, too.
            running.ended = group::has_ended(running.group).unwrap_or(true);
        }
    }

    /// Ends the tasks whose programs are over.
    pub(super) fn finish_ended(&mut self, now: Instant, buffer: &mut [u8]) {
        let mut over = Vec::new();
        for (id, task) in &mut self.tasks {
            if let Doing::Program(running) = &mut task.doing
                && running.ended
                && running.run.is_over(now, || group::is_alive(running.group))
            {
                over.push(*id);
            }
        }
        for id in over {
            let groups = self.groups.clone();
            let Some(Task {
                doing: Doing::Program(running),
                ..
            }) = self.tasks.get_mut(&id)
            else {
                continue;
            };
            let kill = !running.run.leaves_behind();
            let status = groups.end(running.group, kill, || running.child.wait());
            // What it said before it ended; what it left behind may go on talking for ever.
            for _ in 0..LAST_READS {
                if !self.read(id, buffer) {
                    break;
                }
            }
            self.finish_program(id, status);
        }
    }

    fn finish_program(&mut self, id: TaskId, status: io::Result<ExitStatus>) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        let Doing::Program(running) = std::mem::replace(&mut task.doing, Doing::Waiting) else {
            return;
        };
        let mut acts = Vec::new();
        let end = running.run.end(status.ok(), &mut acts);
        for act in acts {
            match act {
                Act::Accept => task.accept(),
                Act::Progress(text) => task.reporter.progress(text),
                Act::Signal(_) | Act::RunAbort => {}
            }
        }
        self.finish(id, end);
    }
}

/// What has come; `None` when there is nothing now. At its end the pipe is closed.
fn read(from: &mut Option<impl Read>, buffer: &mut [u8]) -> Option<Vec<u8>> {
    let count = match from.as_mut()?.read(buffer) {
        Ok(0) => 0,
        Ok(count) => count,
        Err(error) => match error.kind() {
            io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted => return None,
            _ => 0,
        },
    };
    if count == 0 {
        *from = None;
        return None;
    }
    buffer.get(..count).map(<[u8]>::to_vec)
}
