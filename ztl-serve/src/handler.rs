//! The handler of a scope: finds the component for a task and passes the task to the supervisor.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_core::{TaskId, TaskSpec};
use ztl_std::TaskRequest;
use ztl_std::describe::{CheckGoal, Descriptions, shown};
use ztl_std::server::{Answers, TaskHandler, TaskReporter, offered, would_take};

use crate::call::Call;
use crate::component_config::{ComponentConfig, TotalLimit};
use crate::far_descriptions::ScopeDescription;
use crate::kind::Message;
use crate::mailbox::Mailbox;
use crate::program::processes::ProcessRegistry;
use crate::supervisor::Supervisor;

/// Stands for each handler or component that the file does not name.
pub(crate) const WILDCARD: &str = "*";

/// A task id for checks without a task.
const NO_TASK: TaskId = match TaskId::new(1) {
    Some(id) => id,
    None => unreachable!(),
};

/// Time for the outcomes to be reported once the server stops.
const REPORTING: Duration = Duration::from_secs(1);

/// The components of a scope.
#[derive(Debug, Default)]
pub(crate) struct Components {
    all: Vec<Arc<ComponentConfig>>,
    /// Indices in `all` by handler and component.
    by_name: BTreeMap<String, BTreeMap<String, usize>>,
}

impl Components {
    pub(crate) fn new<'e>(
        configs: impl Iterator<Item = (&'e str, &'e str, &'e Arc<ComponentConfig>)>,
    ) -> Self {
        let mut components = Self::default();
        for (handler, name, component) in configs {
            let names = components.by_name.entry(handler.to_owned()).or_default();
            names.insert(name.to_owned(), components.all.len());
            components.all.push(Arc::clone(component));
        }
        components
    }

    /// All components, with handler and name.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, &str, &ComponentConfig)> {
        self.by_name.iter().flat_map(|(handler, components)| {
            components.iter().filter_map(|(name, index)| {
                let config = self.all.get(*index)?;
                Some((handler.as_str(), name.as_str(), &**config))
            })
        })
    }

    /// Whether the file names this handler.
    pub(crate) fn has_handler(&self, handler: &str) -> bool {
        self.by_name.contains_key(handler)
    }

    /// Whether the file names this component of a handler that it names.
    pub(crate) fn has(&self, handler: &str, component: &str) -> bool {
        let components = self.by_name.get(handler);
        components.is_some_and(|components| components.contains_key(component))
    }

    /// The index of the component for a task, or why there is none.
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
        let Some(component) = self.all.get(self.find(spec)?) else {
            return Ok(());
        };
        let goal = component
            .description
            .goal
            .check(spec.goal, component.kind.needs_fields())?;
        component.kind.check(&Call {
            id: NO_TASK,
            scope: scope.to_owned(),
            handler: spec.handler.to_owned(),
            component: spec.component.to_owned(),
            goal,
            answer: None,
        })
    }
}

/// The handler of a scope, as [`Config::handlers`](crate::Config::handlers) makes it.
#[derive(Debug)]
pub struct ScopeHandler {
    components: Arc<Components>,
    description: ScopeDescription,
    scope: Arc<str>,
    supervisor: Mailbox<Message>,
    thread: Option<JoinHandle<()>>,
    stop_time: Duration,
}

impl ScopeHandler {
    pub(crate) fn new<'e>(
        scope: &str,
        configs: impl Iterator<Item = (&'e str, &'e str, &'e Arc<ComponentConfig>)>,
        total: TotalLimit,
        processes: ProcessRegistry,
    ) -> io::Result<Self> {
        let components = Arc::new(Components::new(configs));
        for component in &components.all {
            component.kind.prepare();
        }
        let stop_times = components
            .all
            .iter()
            .map(|component| component.kind.stop_time());
        let stop_time = stop_times.max().unwrap_or_default() + REPORTING;
        let (mailbox, supervisor) = Supervisor::new(scope, &components.all, total, processes)?;
        let thread = std::thread::Builder::new()
            .name("ztl-serve".to_owned())
            .spawn(move || supervisor.run())?;
        Ok(Self {
            description: ScopeDescription::new(&components)?,
            components,
            scope: scope.into(),
            supervisor: mailbox,
            thread: Some(thread),
            stop_time,
        })
    }
}

impl TaskHandler for ScopeHandler {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        match self.components.find(&request.spec()) {
            Ok(component_index) => self.supervisor.send(Message::Start {
                task,
                component_index,
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
        let handlers = self.components.by_name.iter();
        let handlers = handlers
            .map(|(handler, components)| (handler.as_str(), components.keys().map(String::as_str)));
        let all = offered(handlers);
        Box::new(move || all.clone())
    }

    fn describe(&self) -> Descriptions {
        self.description.teller()
    }

    fn answers(&self) -> Answers {
        let (components, scope) = (Arc::clone(&self.components), Arc::clone(&self.scope));
        would_take(move |spec| components.check(&scope, spec))
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
