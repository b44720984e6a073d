//! How a task begins: programs are started on threads, and what blocks is done by threads.

use std::io::{self, Write};
use std::process::Child;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use tracing::{debug, warn};
use ztl_core::TaskId;

use super::super::forward::Told;
use super::super::program::{AbortBy, Launch, Program};
use super::super::run::End;
use super::super::template::Call;
use super::super::watchdog::Charge;
use super::super::{LOG, Work, group};
use super::{Announced, CONFIRM, Doing, Helper, Message, Supervisor};
use ztl_std::terminal::flat;

impl Supervisor {
    /// It is a task's turn.
    pub(super) fn begin(&mut self, id: TaskId) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        let Some(entry) = self.entries.get(task.entry) else {
            return;
        };
        debug!(target: LOG, "Task {id}, {}, begins.", task.name());
        match entry.work.clone() {
            Work::Echo => {
                let goal = task.call.goal.text.clone();
                self.finish(id, End::Completed(goal));
            }
            Work::Sleep => {
                task.accept();
                let seconds = task.call.goal.text.parse().unwrap_or_default();
                let time = Duration::try_from_secs_f64(seconds).unwrap_or_default();
                task.doing = Doing::Sleeping(Instant::now().checked_add(time));
            }
            Work::Program(program) => match program.run.launch(&task.call) {
                Ok(launch) => {
                    let charge = Charge::of(&program, &task.call);
                    let link = self.link.clone();
                    let number = self
                        .groups
                        .announce(charge, move || link.send(Message::Confirmed(id)));
                    task.doing = Doing::Announced(Box::new(Announced {
                        number,
                        launch,
                        until: Instant::now().checked_add(CONFIRM),
                    }));
                }
                Err(reason) => self.finish(id, End::Rejected(reason)),
            },
            Work::Print => self.delegate(id, |_, call, _, _| {
                // Whatever a client sends, its goal is one line of a log.
                let (component, goal) = (flat(&call.component), flat(&call.goal.text));
                let mut out = io::stdout().lock();
                let printed = writeln!(out, "component: {component}\ngoal: {goal}");
                match printed.and_then(|()| out.flush()) {
                    Ok(()) => End::Completed("True".to_owned()),
                    Err(error) => End::Failed(format!("cannot print: {error}")),
                }
            }),
            Work::Forward(forward) => self.delegate(id, move |context, call, abort, tell| {
                forward.run(context, call, abort, tell)
            }),
        }
    }

    /// The watchdog knows of a program: it may be started.
    pub(super) fn on_confirmed(&mut self, id: TaskId) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        match std::mem::replace(&mut task.doing, Doing::Starting(None)) {
            // One that comes too late is refused by its timeout.
            Doing::Announced(announced)
                if announced.until.is_none_or(|until| Instant::now() < until) =>
            {
                let Announced { number, launch, .. } = *announced;
                self.launch(id, launch, number, Message::Started);
            }
            doing => task.doing = doing,
        }
    }

    /// Has an announced program started, on a thread of its own.
    fn launch(
        &mut self,
        id: TaskId,
        launch: Launch,
        number: u64,
        message: fn(TaskId, Result<Child, String>) -> Message,
    ) {
        let Some(task) = self.tasks.get(&id) else {
            return;
        };
        let heard = matches!(task.doing, Doing::Starting(_));
        let (groups, link) = (self.groups.clone(), self.link.clone());
        let thread = std::thread::Builder::new().name(format!("ztl-start-{id}"));
        let spawned = thread.spawn(move || {
            let started = groups.start(number, &launch, heard);
            if let Some(Message::Started(_, Ok(mut child)) | Message::Helper(_, Ok(mut child))) =
                link.try_send(message(id, started))
            {
                let _ = groups.end(group::of(&child), true, || child.wait());
            }
        });
        if let Err(error) = spawned {
            self.groups.withdraw(number);
            self.handle(message(
                id,
                Err(format!("the system gives no more threads: {error}")),
            ));
        }
    }

    /// Has a task done by a thread.
    fn delegate(
        &mut self,
        id: TaskId,
        work: impl FnOnce(zmq::Context, &Call, &AtomicBool, &dyn Fn(Told)) -> End + Send + 'static,
    ) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        let abort = Arc::new(AtomicBool::new(false));
        task.doing = Doing::Thread(Arc::clone(&abort), None);
        let (call, context) = (Arc::clone(&task.call), self.context.clone());
        let link = self.link.clone();
        let thread = std::thread::Builder::new().name(format!("ztl-task-{id}"));
        let spawned = thread.spawn(move || {
            let tell = |told| link.send(Message::Told(id, told));
            let end = work(context, &call, &abort, &tell);
            tell(Told::End(end));
        });
        if let Err(error) = spawned {
            let reason = format!("the system gives no more threads: {error}");
            self.finish(id, End::Rejected(reason));
        }
    }

    pub(super) fn on_helper(&mut self, id: TaskId, child: Result<Child, String>) {
        let running = self.tasks.get(&id).and_then(|task| match &task.doing {
            Doing::Program(running) => Some(running),
            _ => None,
        });
        match child {
            Ok(child) => {
                let grace = running.map_or(Duration::ZERO, |running| running.program.abort.grace);
                let place = running.map(|running| running.program.run.place.clone());
                self.helpers.push(Helper {
                    group: group::of(&child),
                    child,
                    until: Instant::now().checked_add(grace),
                    place: place.unwrap_or_default(),
                });
            }
            Err(reason) => {
                warn!(target: LOG, "Task {id} is stopped by SIGTERM, for its abort program cannot be started: {reason}");
                if let Some(running) = running {
                    group::signal(running.group, Signal::TERM);
                }
            }
        }
    }

    pub(super) fn run_abort(&mut self, id: TaskId, program: Arc<Program>) {
        let Some(task) = self.tasks.get(&id) else {
            return;
        };
        let AbortBy::Program(invocation) = &program.abort.by else {
            return;
        };
        match invocation.launch(&task.call) {
            Ok(launch) => {
                // It stops something, so it waits for nobody.
                let charge = Charge::of_helper(id, program.abort.grace);
                let number = self.groups.announce(charge, || {});
                self.launch(id, launch, number, Message::Helper);
            }
            Err(reason) => self.on_helper(id, Err(reason)),
        }
    }
}
