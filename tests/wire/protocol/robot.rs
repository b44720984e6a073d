//! The server of the traces: the document says line by line what its handlers do.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};

use ztl_core::TaskId;
use ztl_std::describe::{Descriptions, ScopeDescriptions, parse};
use ztl_std::server::{TaskHandler, TaskReporter};
use ztl_std::{
    Aborted, ExecutableTask, RunningServer, TaskContext, TaskController, TaskError, TaskRequest,
    TaskServer,
};
use ztl_tests::lab::{PATIENCE, until};

/// The next event for the latest task.
#[derive(Debug, Clone)]
pub(crate) enum Happening {
    Accepted,
    Rejected(String),
    Progress(String),
    Completed(String),
    Failed(String),
    /// As an ABORT wants it.
    Stopped(String),
}

/// A server of `/robot` and `/lamp`.
pub(crate) struct TraceServer {
    pub(crate) server: RunningServer,
    last: Last,
}

type Last = Arc<Mutex<Option<Sender<Happening>>>>;

impl TraceServer {
    pub(crate) fn new() -> Self {
        let last = Last::default();
        let mut server = TaskServer::bind("tcp://127.0.0.1:*").expect("a port");
        server.register("/robot", Robot(Arc::clone(&last)));
        server.register_handler("/lamp", Lamp);
        let server = server.spawn().expect("a thread");
        Self { server, last }
    }

    /// Lets this happen to the task that came last, which may be on its way to its handler.
    #[track_caller]
    pub(crate) fn let_happen(&self, happening: &Happening) {
        until("a task that listens", PATIENCE, || {
            let last = self.last.lock().unwrap();
            last.as_ref()?.send(happening.clone()).ok()
        });
    }
}

struct Robot(Last);

impl TaskController for Robot {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let component = request.component.as_str();
        if !["base", "arm", "torso"].contains(&component) {
            let it_has = "it has: base, arm, torso";
            return Err(format!("no component '{component}'; {it_has}").into());
        }
        let (say, hear) = channel();
        *self.0.lock().unwrap() = Some(say);
        if component == "arm" {
            match hear.recv_timeout(PATIENCE) {
                Ok(Happening::Accepted) => {}
                Ok(Happening::Rejected(reason)) => return Err(reason.into()),
                other => return Err(format!("{other:?} decides nothing").into()),
            }
        }
        let can_abort = component != "torso";
        Ok(Box::new(Movement { hear, can_abort }))
    }
}

struct Movement {
    hear: Receiver<Happening>,
    can_abort: bool,
}

impl ExecutableTask for Movement {
    fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError> {
        loop {
            match self.hear.recv_timeout(PATIENCE) {
                Ok(Happening::Progress(text)) => context.progress(text),
                Ok(Happening::Completed(result)) => return Ok(result),
                Ok(Happening::Failed(reason)) => return Err(reason.into()),
                // The ABORT may still be on its way.
                Ok(Happening::Stopped(place)) => match context.sleep(PATIENCE) {
                    Err(Aborted) => return Err(TaskError::aborted(place)),
                    Ok(()) => return Err("nobody said ABORT".into()),
                },
                other => return Err(format!("{other:?} ends nothing").into()),
            }
        }
    }

    fn can_abort(&self) -> bool {
        self.can_abort
    }
}

/// Completes before its server reads the next request.
struct Lamp;

impl TaskHandler for Lamp {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        task.accepted(request.reply());
        task.completed(request.goal);
    }

    fn abort(&mut self, _id: TaskId) {}

    fn describe(&self) -> Descriptions {
        let led = parse("{goal: {type: text, longest: 20}, about: shows a text, examples: ['on']}");
        let led = [("led".to_owned(), led.expect("a description"))];
        let all = Arc::new(ScopeDescriptions::from([("lamp".to_owned(), led.into())]));
        Box::new(move || Arc::clone(&all))
    }
}
