//! Programs as handlers: the scripts and command-line tools that a robot has, as the tasks of a server.
//! `docs/serve.md` describes the file that says which.
//!
//! A thread of its own looks after all programs of a scope: it starts none itself, since that may take
//! time, and waits for none. How the programs of one file are served:
//!
//! ```no_run
//! use std::path::Path;
//! use ztl_std::TaskServer;
//! use ztl_serve::{Config, Groups};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let config = Config::load(Path::new("robot.yaml"))?;
//! let mut server = TaskServer::bind("tcp://127.0.0.1:12345")?;
//! for (scope, programs) in config.programs(&Groups::default())? {
//!     server.register_handler(&scope, programs);
//! }
//! server.listen()?;
//! # Ok(())
//! # }
//! ```

#![cfg(unix)]

mod config;
mod desk;
mod forward;
mod group;
mod ignored;
mod link;
mod output;
mod program;
mod rule;
mod run;
mod supervisor;
mod template;
mod value;
mod watchdog;

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_core::TaskSpec;

pub use config::{Config, Scope};
use desk::Busy;
use forward::Forward;
pub use group::Groups;
pub use ignored::ignored_signals;
use link::Link;
use program::Program;
use rule::{Rule, shown};
use supervisor::{Message, Supervisor};
use template::Call;
pub use watchdog::watchdog;

use ztl_std::TaskRequest;
use ztl_std::server::{Answers, TaskHandler, TaskReporter, offered, would_take};

/// Name under which it logs.
const LOG: &str = "serve";

/// An id for a task that is not there: no goal is unfit because of it.
const TASK: ztl_core::TaskId = match ztl_core::TaskId::new(1) {
    Some(id) => id,
    None => unreachable!(),
};

/// Stands for every handler or component that has no entry of its own.
const WILD: &str = "*";

/// What does the tasks of one component, and under which rules.
#[derive(Debug)]
struct Entry {
    work: Work,
    rule: Rule,
    /// Whether fields of the goal are needed.
    wants_fields: bool,
    at_once: usize,
    busy: Busy,
    /// It is aborted when its client is silent for so long.
    needs_client: Option<Duration>,
}

#[derive(Debug, Clone)]
enum Work {
    Program(Arc<Program>),
    /// Ends at once, with its goal.
    Echo,
    /// Prints its component and its goal.
    Print,
    /// Lasts as many seconds as its goal says.
    Sleep,
    Forward(Arc<Forward>),
}

/// How many more tasks there may be, in all scopes together.
#[derive(Debug, Clone)]
struct Room {
    taken: Arc<AtomicUsize>,
    most: usize,
}

impl Room {
    fn new(most: usize) -> Self {
        Self {
            taken: Arc::default(),
            most,
        }
    }

    fn take(&self) -> bool {
        let one_more = |taken| (taken < self.most).then_some(taken + 1);
        let (set, fetch) = (Ordering::Relaxed, Ordering::Relaxed);
        self.taken.fetch_update(set, fetch, one_more).is_ok()
    }

    fn leave(&self) {
        self.taken.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Places of entries, by handler and component.
type Places = BTreeMap<String, BTreeMap<String, usize>>;

/// The handlers of a scope, as [`Config`] says.
#[derive(Debug)]
pub struct Programs {
    /// Places of entries, by handler and component.
    places: Arc<Places>,
    entries: Arc<[Arc<Entry>]>,
    scope: Arc<str>,
    link: Link<Message>,
    thread: Option<JoinHandle<()>>,
    /// How long stopping may take.
    stopping: Duration,
}

impl Programs {
    fn new(scope: &Scope, room: Room, groups: Groups) -> io::Result<Self> {
        let mut places = Places::new();
        let mut longest = Duration::ZERO;
        for (place, (handler, component, entry)) in scope.entries().enumerate() {
            let components = places.entry(handler.to_owned()).or_default();
            components.insert(component.to_owned(), place);
            if let Work::Program(program) = &entry.work {
                longest = longest.max(program.abort.grace);
            }
        }
        let entries: Vec<Arc<Entry>> = scope
            .entries()
            .map(|(_, _, entry)| Arc::clone(entry))
            .collect();
        let (link, supervisor) = Supervisor::new(scope.name(), entries.clone(), room, groups)?;
        let thread = std::thread::Builder::new()
            .name("ztl-serve".to_owned())
            .spawn(move || supervisor.run())?;
        Ok(Self {
            places: Arc::new(places),
            entries: entries.into(),
            scope: scope.name().into(),
            link,
            thread: Some(thread),
            stopping: longest + run::GOING + supervisor::LEAVING,
        })
    }
}

/// The entry for a task, or why there is none.
fn find(places: &Places, spec: &TaskSpec<'_>) -> Result<usize, String> {
    let (handler, component) = (spec.handler, spec.component);
    let named = |names: Vec<&String>| {
        let names: Vec<&str> = names.into_iter().map(String::as_str).collect();
        names.join(", ")
    };
    let Some(components) = places.get(handler).or_else(|| places.get(WILD)) else {
        let handler = shown(handler);
        let there = named(places.keys().collect());
        return Err(format!("no handler '{handler}'; there are: {there}"));
    };
    let place = components.get(component).or_else(|| components.get(WILD));
    place.copied().ok_or_else(|| {
        let (handler, component) = (shown(handler), shown(component));
        let there = named(components.keys().collect());
        format!("no component '{component}' on '{handler}'; it has: {there}")
    })
}

impl TaskHandler for Programs {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        let found = find(&self.places, &request.spec());
        match found {
            Ok(entry) => self.link.send(Message::Start {
                task,
                entry,
                handler: request.handler,
                component: request.component,
                goal: request.goal,
            }),
            Err(reason) => task.rejected(reason),
        }
    }

    fn abort(&mut self, id: ztl_core::TaskId) {
        self.link.send(Message::Abort(id));
    }

    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        let handlers = self
            .places
            .iter()
            .map(|(handler, components)| (handler.as_str(), components.keys().map(String::as_str)));
        let all = offered(handlers);
        Box::new(move || all.clone())
    }

    fn answers(&self) -> Answers {
        let (places, entries) = (Arc::clone(&self.places), Arc::clone(&self.entries));
        let scope = Arc::clone(&self.scope);
        would_take(move |spec| {
            let place = find(&places, spec)?;
            let Some(entry) = entries.get(place) else {
                return Ok(());
            };
            let goal = entry.rule.check(spec.goal, entry.wants_fields)?;
            let Work::Program(program) = &entry.work else {
                return Ok(());
            };
            // Any id: none makes a goal unfit.
            let call = Call {
                id: TASK,
                scope: scope.to_string(),
                handler: spec.handler.to_owned(),
                component: spec.component.to_owned(),
                goal,
            };
            program.run.launch(&call).map(drop)
        })
    }

    fn stop(&mut self) -> Duration {
        self.link.send(Message::Stop);
        self.stopping
    }
}

impl Drop for Programs {
    fn drop(&mut self) {
        self.link.send(Message::Stop);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}
