//! The handler of a scope: finds the component for a task and passes the task to the supervisor.

use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_core::TaskId;
use ztl_std::TaskRequest;
use ztl_std::describe::Descriptions;
use ztl_std::server::{Answers, TaskHandler, TaskReporter, would_take};

use crate::component_config::{ComponentConfig, TotalLimit};
use crate::components::Components;
use crate::far_descriptions::ScopeDescription;
use crate::kind::Message;
use crate::mailbox::Mailbox;
use crate::program::processes::ProcessRegistry;
use crate::supervisor::Supervisor;

/// Time for the outcomes to be reported once the server stops.
const REPORTING: Duration = Duration::from_secs(1);

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
        for component in components.all() {
            component.kind.prepare();
        }
        let stop_times = components
            .all()
            .iter()
            .map(|component| component.kind.stop_time());
        let stop_time = stop_times.max().unwrap_or_default() + REPORTING;
        let (mailbox, supervisor) = Supervisor::new(scope, components.all(), total, processes)?;
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
        let all = self.components.offered();
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
