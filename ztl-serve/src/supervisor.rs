//! The thread that looks after all tasks of a scope: it reads what programs say, learns of their ends,
//! and does what their [`Run`]s want. Nothing that it does can block: what could has a thread of its own.

mod launch;
mod watch;

use std::collections::BTreeMap;
use std::io;
use std::process::{Child, ChildStderr, ChildStdout};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::io::ioctl_fionbio;
use signal_hook::consts::SIGCHLD;
use signal_hook::low_level::{pipe, unregister};
use tracing::{debug, info, warn};
use ztl_core::{TaskId, TaskSpec};

use super::desk::{Admitted, Desk};
use super::forward::Told;
use super::link::{Inbox, Link};
use super::program::{Launch, Program};
use super::rule::Goal;
use super::run::{Act, End, Run, Why};
use super::template::Call;
use super::{Entry, Groups, LOG, Room, Work, group};
use watch::READ;
use ztl_std::server::TaskReporter;

/// How long a task that another server does is waited for when this one stops.
pub(super) const LEAVING: Duration = Duration::from_millis(1500);
/// How long the watchdog may take to confirm that it knows of a program. Less than the 1.5 s after which an INIT is
/// answered with an id.
const CONFIRM: Duration = Duration::from_millis(1200);
/// What the supervisor is told.
#[derive(Debug)]
pub(super) enum Message {
    Start {
        task: TaskReporter,
        entry: usize,
        handler: String,
        component: String,
        goal: String,
    },
    Abort(TaskId),
    /// The watchdog knows of a task's program.
    Confirmed(TaskId),
    /// A program was started, or could not be.
    Started(TaskId, Result<Child, String>),
    /// The same of a program that aborts one.
    Helper(TaskId, Result<Child, String>),
    /// A thread says what becomes of its task.
    Told(TaskId, Told),
    /// All tasks are to be stopped, and no more taken.
    Stop,
}

/// A task that has not ended.
struct Task {
    reporter: TaskReporter,
    call: Arc<Call>,
    entry: usize,
    accepted: bool,
    doing: Doing,
}

enum Doing {
    /// Others are before it.
    Waiting,
    /// The watchdog is to confirm that it knows of its program.
    Announced(Box<Announced>),
    /// Its program is being started; what is to be done with it then.
    Starting(Option<Why>),
    Program(Box<Running>),
    Sleeping(Option<Instant>),
    /// A thread does it; until when it is waited for, once the server stops.
    Thread(Arc<AtomicBool>, Option<Instant>),
}

/// A program that the watchdog is told of.
struct Announced {
    number: u64,
    launch: Launch,
    /// When the task is refused instead.
    until: Option<Instant>,
}

struct Running {
    run: Run,
    program: Arc<Program>,
    child: Child,
    group: i32,
    out: Option<ChildStdout>,
    err: Option<ChildStderr>,
    /// Whether its first process has ended.
    ended: bool,
}

/// A program that aborts another.
struct Helper {
    child: Child,
    group: i32,
    /// When it is killed.
    until: Option<Instant>,
    place: String,
}

pub(super) struct Supervisor {
    scope: String,
    inbox: Inbox<Message>,
    link: Link<Message>,
    on_child: signal_hook::SigId,
    entries: Vec<Arc<Entry>>,
    desks: Vec<Desk>,
    tasks: BTreeMap<TaskId, Task>,
    helpers: Vec<Helper>,
    groups: Groups,
    room: Room,
    /// Shared by all clients of other servers; costs nothing before the first.
    context: zmq::Context,
    stopping: bool,
}

impl Supervisor {
    pub(super) fn new(
        scope: &str,
        entries: Vec<Arc<Entry>>,
        room: Room,
        groups: Groups,
    ) -> io::Result<(Link<Message>, Self)> {
        let (link, inbox) = Link::new()?;
        // Also where whoever started this process had it ignored: then nobody could be waited for.
        let on_child = pipe::register(SIGCHLD, link.ringer()?)?;
        let desks = entries
            .iter()
            .map(|entry| Desk::new(entry.at_once, entry.busy));
        let supervisor = Self {
            scope: scope.to_owned(),
            desks: desks.collect(),
            inbox,
            link: link.clone(),
            on_child,
            entries,
            tasks: BTreeMap::new(),
            helpers: Vec::new(),
            groups,
            room,
            context: zmq::Context::new(),
            stopping: false,
        };
        Ok((link, supervisor))
    }

    /// Until it is told to stop and nothing runs any more.
    pub(super) fn run(mut self) {
        let mut buffer = vec![0; READ];
        while !(self.stopping && self.tasks.is_empty() && self.helpers.is_empty()) {
            let ready = self.wait();
            for id in ready.talking {
                self.read(id, &mut buffer);
            }
            if ready.rung {
                self.inbox.silence();
            }
            while let Some(message) = self.inbox.next() {
                self.handle(message);
            }
            let now = Instant::now();
            self.handle_timeouts(now);
            if ready.rung || ready.idle {
                self.look_for_ends();
            }
            self.finish_ended(now, &mut buffer);
        }
    }

    fn handle(&mut self, message: Message) {
        match message {
            Message::Start {
                task,
                entry,
                handler,
                component,
                goal,
            } => self.start(task, entry, (handler, component), &goal),
            Message::Abort(id) => self.stop_task(id, Why::Client),
            Message::Confirmed(id) => self.on_confirmed(id),
            Message::Started(id, Ok(child)) => self.on_started(id, child),
            Message::Started(id, Err(reason)) => self.finish(id, End::Rejected(reason)),
            Message::Helper(id, child) => self.on_helper(id, child),
            Message::Told(id, told) => self.on_told(id, told),
            Message::Stop => {
                self.stopping = true;
                let ids: Vec<TaskId> = self.tasks.keys().copied().collect();
                for id in ids {
                    self.stop_task(id, Why::Server);
                }
            }
        }
    }

    /// A client asks for a task.
    fn start(
        &mut self,
        reporter: TaskReporter,
        place: usize,
        (handler, component): (String, String),
        goal: &str,
    ) {
        let id = reporter.id();
        let Some(entry) = self.entries.get(place) else {
            return reporter.rejected("there is no such component");
        };
        if self.stopping {
            return reporter.rejected("the server is stopping");
        }
        let goal: Goal = match entry.rule.check(goal, entry.wants_fields) {
            Ok(goal) => goal,
            Err(reason) => {
                return reporter.rejected(format!("{handler}:{component}: {reason}"));
            }
        };
        if !self.room.take() {
            let most = self.room.most;
            return reporter.rejected(format!(
                "{most} tasks are under way, and more are not allowed (at-once)"
            ));
        }
        let admitted = match self.desks.get_mut(place) {
            Some(desk) => desk.admit(id),
            None => Admitted::Now,
        };
        if let Admitted::Refused(other) = admitted {
            self.room.leave();
            return reporter.rejected(format!("{handler}:{component} is busy with task {other}"));
        }
        if let Some(silence) = entry.needs_client {
            reporter.needs_client(silence);
        }
        let task = Task {
            reporter,
            call: Arc::new(Call {
                id,
                scope: self.scope.clone(),
                handler,
                component,
                goal,
            }),
            entry: place,
            accepted: false,
            doing: Doing::Waiting,
        };
        self.tasks.insert(id, task);
        let progress = match admitted {
            Admitted::Waits(others) => format!("waiting, {others} before it"),
            Admitted::Replaces(other, _) => format!("waiting for task {other} to stop"),
            _ => return self.begin(id),
        };
        if let Some(task) = self.tasks.get_mut(&id) {
            task.accept();
            task.reporter.progress(progress);
        }
        if let Admitted::Replaces(other, unwanted) = admitted {
            if let Some(unwanted) = unwanted {
                self.stop_task(unwanted, Why::Replaced(id));
            }
            self.stop_task(other, Why::Replaced(id));
        }
    }

    fn on_started(&mut self, id: TaskId, mut child: Child) {
        let group = group::of(&child);
        let task = self.tasks.get_mut(&id);
        let Some((task, stop)) = task.and_then(|task| match task.doing {
            Doing::Starting(stop) => Some((task, stop)),
            _ => None,
        }) else {
            // Its task is gone; that does not happen.
            let _ = self.groups.end(group, true, || child.wait());
            return;
        };
        let work = self.entries.get(task.entry).map(|entry| &entry.work);
        let Some(Work::Program(program)) = work else {
            let _ = self.groups.end(group, true, || child.wait());
            return;
        };
        let program = Arc::clone(program);
        let out = child
            .stdout
            .take()
            .filter(|out| ioctl_fionbio(out, true).is_ok());
        let err = child
            .stderr
            .take()
            .filter(|err| ioctl_fionbio(err, true).is_ok());
        let mut acts = Vec::new();
        let now = Instant::now();
        let mut run = Run::new(now, Arc::clone(&program), &mut acts);
        if let Some(why) = stop {
            run.stop(now, why, &mut acts);
        }
        task.doing = Doing::Program(Box::new(Running {
            run,
            program,
            child,
            group,
            out,
            err,
            ended: false,
        }));
        self.act(id, acts);
        // It may have ended before it was known here.
        self.look_for_end(id);
    }

    fn on_told(&mut self, id: TaskId, told: Told) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        match told {
            Told::Accepted => task.accept(),
            Told::Progress(text) => task.reporter.progress(text),
            Told::AbortRefused => task.reporter.abort_refused(),
            Told::End(end) => self.finish(id, end),
        }
    }

    /// A task is to end before its time.
    fn stop_task(&mut self, id: TaskId, why: Why) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        let now = Instant::now();
        let mut acts = Vec::new();
        match &mut task.doing {
            Doing::Waiting | Doing::Announced(_) => {
                let text = match why {
                    Why::Server => "the server was stopped before it began".to_owned(),
                    Why::Replaced(by) => format!("replaced by task {by} before it began"),
                    Why::Client | Why::Limit => "aborted before it began".to_owned(),
                };
                return self.finish(id, End::Aborted(text));
            }
            Doing::Sleeping(_) => {
                return self.finish(id, End::Aborted("aborted".to_owned()));
            }
            Doing::Thread(abort, until) => {
                abort.store(true, Ordering::Relaxed);
                if why == Why::Server {
                    *until = now.checked_add(LEAVING);
                }
            }
            Doing::Starting(stop) => *stop = stop.or(Some(why)),
            Doing::Program(running) => {
                if why == Why::Client && !running.program.abort.allowed {
                    return task.reporter.abort_refused();
                }
                running.run.stop(now, why, &mut acts);
            }
        }
        self.act(id, acts);
    }

    /// Does what a program's run wants.
    fn act(&mut self, id: TaskId, acts: Vec<Act>) {
        for act in acts {
            let Some(task) = self.tasks.get_mut(&id) else {
                return;
            };
            let Doing::Program(running) = &task.doing else {
                return;
            };
            match act {
                Act::Signal(signal) => group::signal(running.group, signal),
                Act::RunAbort => {
                    let program = Arc::clone(&running.program);
                    self.run_abort(id, program);
                }
                Act::Accept => task.accept(),
                Act::Progress(text) => task.reporter.progress(text),
            }
        }
    }

    /// A task has ended, and another may begin.
    fn finish(&mut self, id: TaskId, end: End) {
        let Some(mut task) = self.tasks.remove(&id) else {
            return;
        };
        if let Doing::Announced(announced) = &task.doing {
            self.groups.withdraw(announced.number);
        }
        let name = task.name();
        // What was said to be taken cannot be refused any more.
        let end = match end {
            End::Rejected(reason) if task.accepted => End::Failed(reason),
            end => end,
        };
        match &end {
            End::Rejected(reason) => debug!(target: LOG, "Task {id}, {name}, is refused: {reason}"),
            End::Completed(_) => debug!(target: LOG, "Task {id}, {name}, has ended as COMPLETED."),
            End::Failed(text) => {
                warn!(target: LOG, "Task {id}, {name}, has ended as FAILED: {text}")
            }
            End::Aborted(text) => {
                info!(target: LOG, "Task {id}, {name}, has ended as ABORTED: {text}")
            }
        }
        if !matches!(end, End::Rejected(_)) {
            task.accept();
        }
        let reporter = task.reporter;
        match end {
            End::Rejected(text) => reporter.rejected(text),
            End::Completed(text) => reporter.completed(text),
            End::Failed(text) => reporter.failed(text),
            End::Aborted(text) => reporter.aborted(text),
        }
        self.free(id, task.entry);
    }

    /// A task's place is free for another.
    fn free(&mut self, id: TaskId, entry: usize) {
        self.room.leave();
        let next = self.desks.get_mut(entry).and_then(|desk| desk.ended(id));
        if let Some(next) = next {
            self.begin(next);
        }
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        unregister(self.on_child);
    }
}

impl Task {
    /// Tells the client that it is taken, as the original's standard controller does.
    fn accept(&mut self) {
        if std::mem::replace(&mut self.accepted, true) {
            return;
        }
        let spec = TaskSpec {
            handler: &self.call.handler,
            component: &self.call.component,
            goal: &self.call.goal.text,
        };
        let mut reply = Vec::new();
        spec.put_initiated(self.call.id, &mut |bytes: &[u8]| {
            reply.extend_from_slice(bytes)
        });
        self.reporter.accepted(String::from_utf8_lossy(&reply));
    }

    /// As people say it.
    fn name(&self) -> String {
        format!("{}:{}", self.call.handler, self.call.component)
    }
}
