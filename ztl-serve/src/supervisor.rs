//! The life cycle of tasks, the same for all kinds: check the goal, admit or queue, start, report progress, abort,
//! report the outcome. One thread does it for all tasks of a scope, and nothing on it blocks.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::time::Instant;

use signal_hook::consts::SIGCHLD;
use signal_hook::low_level::{pipe, unregister};
use tracing::{debug, info, warn};
use ztl_core::dispatcher::UNKNOWN_OUTCOME;
use ztl_core::{TaskId, TaskSpec};
use ztl_std::describe::CheckGoal;
use ztl_std::server::TaskReporter;

use crate::admission::{Admission, Admitted};
use crate::call::Call;
use crate::component_config::{ComponentConfig, TotalLimit};
use crate::jobs;
use crate::kind::{Effect, Job, JobContext, Message, Outcome, Services, Start, StopReason};
use crate::log::LOG;
use crate::mailbox::{Inbox, Mailbox};
use crate::program::processes::ProcessRegistry;

/// A task that has not ended.
struct Task {
    reporter: TaskReporter,
    call: Arc<Call>,
    component_index: usize,
    accepted: bool,
    /// Whether an abort was rejected.
    abort_rejected: bool,
    /// `None` while the task waits for others.
    job: Option<Box<dyn Job>>,
}

/// All tasks of a scope.
pub(crate) struct Supervisor {
    scope: String,
    inbox: Inbox<Message>,
    mailbox: Mailbox<Message>,
    on_child: signal_hook::SigId,
    components: Vec<(Arc<ComponentConfig>, Admission)>,
    tasks: BTreeMap<TaskId, Task>,
    background: Vec<Box<dyn Job>>,
    services: Services,
    total: TotalLimit,
    stopping: bool,
}

impl Supervisor {
    pub(crate) fn new(
        scope: &str,
        components: &[Arc<ComponentConfig>],
        total: TotalLimit,
        processes: ProcessRegistry,
    ) -> io::Result<(Mailbox<Message>, Self)> {
        let (mailbox, inbox) = Mailbox::new()?;
        // Register even if SIGCHLD was ignored at the start: while it is ignored, the kernel reaps children, and `wait`
        // fails.
        let on_child = pipe::register(SIGCHLD, mailbox.waker()?)?;
        let components = components.iter().map(|component| {
            let admission = Admission::new(component.at_once, component.busy);
            (Arc::clone(component), admission)
        });
        let supervisor = Self {
            scope: scope.to_owned(),
            components: components.collect(),
            inbox,
            mailbox: mailbox.clone(),
            on_child,
            tasks: BTreeMap::new(),
            background: Vec::new(),
            services: Services { processes },
            total,
            stopping: false,
        };
        Ok((mailbox, supervisor))
    }

    /// Runs until it receives the request to stop and all tasks have ended.
    pub(crate) fn run(mut self) {
        while !(self.stopping && self.tasks.is_empty() && self.background.is_empty()) {
            let ready = jobs::wait(&self.inbox, self.jobs(), &self.background, None, true);
            for id in ready.readable {
                self.with_job(id, |job, effects| job.read_pipes(effects));
            }
            if ready.woken {
                self.inbox.clear();
            }
            while let Some(message) = self.inbox.next() {
                self.handle(message);
            }
            let now = Instant::now();
            let check = ready.woken || ready.timed_out;
            let ids: Vec<TaskId> = self.tasks.keys().copied().collect();
            for id in ids {
                self.with_job(id, |job, effects| job.turn(now, check, effects));
            }
            jobs::tend(&mut self.background, now, check);
        }
    }

    fn jobs(&self) -> impl Iterator<Item = (TaskId, &dyn Job)> + Clone {
        let tasks = self.tasks.iter();
        tasks.filter_map(|(id, task)| Some((*id, task.job.as_deref()?)))
    }

    fn handle(&mut self, message: Message) {
        match message {
            Message::Start {
                task,
                component_index,
                handler,
                component,
                goal,
            } => self.start(task, component_index, (handler, component), &goal),
            Message::Abort(id) => self.stop(id, StopReason::Client),
            Message::Event(id, event) => self.with_job(id, |job, effects| {
                job.handle_event(Instant::now(), event, effects);
            }),
            Message::Effect(id, effect) => self.apply(id, effect),
            Message::Stop => {
                self.stopping = true;
                let ids: Vec<TaskId> = self.tasks.keys().copied().collect();
                for id in ids {
                    self.stop(id, StopReason::Server);
                }
            }
        }
    }

    /// Checks and admits a task that a client has asked for.
    fn start(
        &mut self,
        reporter: TaskReporter,
        component_index: usize,
        (handler, name): (String, String),
        goal: &str,
    ) {
        let id = reporter.id();
        let Some((component, admission)) = self.components.get_mut(component_index) else {
            return reporter.rejected("there is no such component");
        };
        if self.stopping {
            return reporter.rejected("the server is stopping");
        }
        let goal = match component
            .description
            .goal
            .check(goal, component.kind.needs_fields())
        {
            Ok(goal) => goal,
            Err(reason) => {
                return reporter.rejected(format!("{handler}:{name}: {reason}"));
            }
        };
        if let Err(most) = self.total.add() {
            return reporter.rejected(format!(
                "{most} tasks are under way, and more are not allowed (at-once)"
            ));
        }
        let admitted = admission.admit(id);
        if let Admitted::Rejected(other) = admitted {
            self.total.remove();
            return reporter.rejected(format!("{handler}:{name} is busy with task {other}"));
        }
        if let Some(silence) = component.needs_client {
            reporter.needs_client(silence);
        }
        let mut task = Task {
            reporter,
            call: Arc::new(Call {
                id,
                scope: self.scope.clone(),
                handler,
                component: name,
                goal,
                answer: None,
            }),
            component_index,
            accepted: false,
            abort_rejected: false,
            job: None,
        };
        let waits_for = match admitted {
            Admitted::Waits(others) => Some(format!("waiting, {others} before it")),
            Admitted::Replaces { running, .. } => {
                Some(format!("waiting for task {running} to stop"))
            }
            Admitted::Now | Admitted::Rejected(_) => None,
        };
        let waits = waits_for.is_some();
        if let Some(text) = waits_for {
            task.accept();
            task.reporter.progress(text);
        }
        self.tasks.insert(id, task);
        if !waits {
            self.begin(id);
        }
        if let Admitted::Replaces { running, waiting } = admitted {
            for replaced in waiting.into_iter().chain([running]) {
                self.stop(replaced, StopReason::Replaced(id));
            }
        }
    }

    /// Starts an admitted task.
    fn begin(&mut self, id: TaskId) {
        let Some(task) = self.tasks.get_mut(&id) else {
            return;
        };
        let Some((component, _)) = self.components.get(task.component_index) else {
            return;
        };
        debug!(target: LOG, "Task {id}, {}, begins.", task.name());
        let context = JobContext {
            id,
            mailbox: self.mailbox.clone(),
        };
        let call = Arc::clone(&task.call);
        match Arc::clone(&component.kind).start(call, context, &self.services) {
            Start::Running(job) => task.job = Some(job),
            Start::Ended(outcome) => self.finish(id, outcome),
        }
    }

    /// Ends a task early.
    fn stop(&mut self, id: TaskId, why: StopReason) {
        match self.tasks.get(&id).map(|task| task.job.is_some()) {
            Some(true) => {
                self.with_job(id, |job, effects| job.stop(Instant::now(), why, effects));
            }
            Some(false) => self.finish(id, why.before_start()),
            None => {}
        }
    }

    /// Calls a task's job, if it has started, and does what the job wants.
    fn with_job(&mut self, id: TaskId, call: impl FnOnce(&mut dyn Job, &mut Vec<Effect>)) {
        let mut effects = Vec::new();
        if let Some(job) = self.tasks.get_mut(&id).and_then(|task| task.job.as_mut()) {
            call(job.as_mut(), &mut effects);
        }
        for effect in effects {
            self.apply(id, effect);
        }
    }

    fn apply(&mut self, id: TaskId, effect: Effect) {
        let Some(task) = self.tasks.get_mut(&id) else {
            if let Effect::Background(mut job) = effect {
                // The task has ended meanwhile.
                job.stop(Instant::now(), StopReason::Server, &mut Vec::new());
                self.background.push(job);
            }
            return;
        };
        match effect {
            Effect::Accept => task.accept(),
            Effect::Progress(text) => task.reporter.progress(text),
            Effect::Output(_) => {}
            Effect::RejectAbort(reason) => {
                // A client may ask again and again.
                if !std::mem::replace(&mut task.abort_rejected, true) {
                    warn!(target: LOG, "Task {id}, {}, goes on in spite of an abort: {reason}", task.name());
                }
                task.reporter.abort_rejected();
            }
            Effect::Background(job) => self.background.push(job),
            Effect::End(outcome) => self.finish(id, outcome),
            Effect::Leave => {
                if let Some(task) = self.tasks.remove(&id) {
                    warn!(target: LOG, "Task {id}, {}, has not confirmed that it has stopped.", task.name());
                    task.reporter.leave();
                    self.free(id, task.component_index);
                }
            }
        }
    }

    /// Reports an outcome, and starts the next task.
    fn finish(&mut self, id: TaskId, outcome: Outcome) {
        let Some(mut task) = self.tasks.remove(&id) else {
            return;
        };
        let name = task.name();
        // An accepted task cannot be rejected any more.
        let outcome = match outcome {
            Outcome::Rejected(reason) if task.accepted => Outcome::Failed(reason),
            outcome => outcome,
        };
        if !matches!(outcome, Outcome::Rejected(_)) {
            task.accept();
        }
        let reporter = task.reporter;
        match outcome {
            Outcome::Rejected(text) => {
                debug!(target: LOG, "Task {id}, {name}, is rejected: {text}");
                reporter.rejected(text);
            }
            Outcome::Completed(text) => {
                debug!(target: LOG, "Task {id}, {name}, has ended as COMPLETED.");
                reporter.completed(text);
            }
            Outcome::Failed(text) => {
                warn!(target: LOG, "Task {id}, {name}, has ended as FAILED: {text}");
                reporter.failed(text);
            }
            Outcome::Unknown(text) => {
                let text = format!("{UNKNOWN_OUTCOME}{text}");
                warn!(target: LOG, "Task {id}, {name}, has ended as FAILED: {text}");
                reporter.failed(text);
            }
            Outcome::Aborted(text) => {
                info!(target: LOG, "Task {id}, {name}, has ended as ABORTED: {text}");
                reporter.aborted(text);
            }
        }
        self.free(id, task.component_index);
    }

    /// A task no longer counts, so that another may start.
    fn free(&mut self, id: TaskId, component_index: usize) {
        self.total.remove();
        let component = self.components.get_mut(component_index);
        if let Some(next) = component.and_then(|(_, admission)| admission.ended(id)) {
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
    /// Reports the task as accepted, as the original's standard controller does.
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
            reply.extend_from_slice(bytes);
        });
        self.reporter.accepted(String::from_utf8_lossy(&reply));
    }

    fn name(&self) -> String {
        format!("{}:{}", self.call.handler, self.call.component)
    }
}
