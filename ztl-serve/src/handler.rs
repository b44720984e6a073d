//! The handler of a scope: finds the entry for a task and passes the task to the supervisor.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_core::{TaskId, TaskSpec};
use ztl_std::TaskRequest;
use ztl_std::server::{Answers, TaskHandler, TaskReporter, offered, would_take};

use crate::call::Call;
use crate::entry::{Entry, TotalLimit};
use crate::goal_rule::shown;
use crate::kind::Message;
use crate::mailbox::Mailbox;
use crate::program::processes::ProcessRegistry;
use crate::supervisor::Supervisor;

/// Stands for each handler or component without an entry of its own.
pub(crate) const WILDCARD: &str = "*";

/// A task id for checks without a task.
const NO_TASK: TaskId = match TaskId::new(1) {
    Some(id) => id,
    None => unreachable!(),
};

/// Time for the outcomes to be reported once the server stops.
const REPORTING: Duration = Duration::from_secs(1);

/// The entries of a scope.
#[derive(Debug, Default)]
struct Entries {
    all: Vec<Arc<Entry>>,
    /// Indices in `all` by handler and component.
    by_name: BTreeMap<String, BTreeMap<String, usize>>,
}

impl Entries {
    /// The index of the entry for a task, or why there is none.
    fn find(&self, spec: &TaskSpec<'_>) -> Result<usize, String> {
        let (handler, component) = (spec.handler, spec.component);
        let named = |names: Vec<&String>| {
            let names: Vec<&str> = names.into_iter().map(String::as_str).collect();
            names.join(", ")
        };
        let handlers = &self.by_name;
        let components = handlers.get(handler).or_else(|| handlers.get(WILDCARD));
        let components = components.ok_or_else(|| {
            let handler = shown(handler);
            let there = named(handlers.keys().collect());
            format!("no handler '{handler}'; there are: {there}")
        })?;
        let index = components
            .get(component)
            .or_else(|| components.get(WILDCARD));
        index.copied().ok_or_else(|| {
            let (handler, component) = (shown(handler), shown(component));
            let there = named(components.keys().collect());
            format!("no component '{component}' on '{handler}'; it has: {there}")
        })
    }

    /// Returns, without starting anything, whether a task would be rejected.
    fn check(&self, scope: &str, spec: &TaskSpec<'_>) -> Result<(), String> {
        let Some(entry) = self.all.get(self.find(spec)?) else {
            return Ok(());
        };
        let goal = entry.rule.check(spec.goal, entry.kind.needs_fields())?;
        entry.kind.check(&Call {
            id: NO_TASK,
            scope: scope.to_owned(),
            handler: spec.handler.to_owned(),
            component: spec.component.to_owned(),
            goal,
        })
    }
}

/// The handler of a scope, as [`Config::handlers`](crate::Config::handlers) makes it.
#[derive(Debug)]
pub struct ScopeHandler {
    entries: Arc<Entries>,
    scope: Arc<str>,
    supervisor: Mailbox<Message>,
    thread: Option<JoinHandle<()>>,
    stop_time: Duration,
}

impl ScopeHandler {
    pub(crate) fn new<'e>(
        scope: &str,
        components: impl Iterator<Item = (&'e str, &'e str, &'e Arc<Entry>)>,
        total: TotalLimit,
        processes: ProcessRegistry,
    ) -> io::Result<Self> {
        let mut entries = Entries::default();
        for (handler, component, entry) in components {
            let components = entries.by_name.entry(handler.to_owned()).or_default();
            components.insert(component.to_owned(), entries.all.len());
            entries.all.push(Arc::clone(entry));
        }
        let stop_times = entries.all.iter().map(|entry| entry.kind.stop_time());
        let stop_time = stop_times.max().unwrap_or_default() + REPORTING;
        let (mailbox, supervisor) = Supervisor::new(scope, &entries.all, total, processes)?;
        let thread = std::thread::Builder::new()
            .name("ztl-serve".to_owned())
            .spawn(move || supervisor.run())?;
        Ok(Self {
            entries: Arc::new(entries),
            scope: scope.into(),
            supervisor: mailbox,
            thread: Some(thread),
            stop_time,
        })
    }
}

impl TaskHandler for ScopeHandler {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        match self.entries.find(&request.spec()) {
            Ok(entry) => self.supervisor.send(Message::Start {
                task,
                entry,
                handler: request.handler,
                component: request.component,
                goal: request.goal,
            }),
            Err(reason) => task.rejected(reason),
        }
    }

    fn abort(&mut self, id: TaskId) {
        self.supervisor.send(Message::Abort(id));
    }

    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        let handlers = self.entries.by_name.iter();
        let handlers = handlers
            .map(|(handler, components)| (handler.as_str(), components.keys().map(String::as_str)));
        let all = offered(handlers);
        Box::new(move || all.clone())
    }

    fn answers(&self) -> Answers {
        let (entries, scope) = (Arc::clone(&self.entries), Arc::clone(&self.scope));
        would_take(move |spec| entries.check(&scope, spec))
    }

    fn stop(&mut self) -> Duration {
        self.supervisor.send(Message::Stop);
        self.stop_time
    }
}

impl Drop for ScopeHandler {
    fn drop(&mut self) {
        self.supervisor.send(Message::Stop);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}
