//! `ztl abort`: stops tasks of a server, whoever started them.

use std::collections::HashSet;

use ztl_std::{ListedTask, RemoteId, RequestError, State, Status};

use crate::Done;
use crate::ask::{Asking, Server, all_read, code};
use crate::terminal::{error_line, flat, line};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 every task has ended, 1 at least one is not known or may still run."
)]
pub(crate) struct Abort {
    #[command(flatten)]
    server: Asking,

    /// The tasks to stop, by their ids
    #[arg(value_name = "ID", required_unless_present = "all", value_parser = id)]
    ids: Vec<RemoteId>,

    /// Stop every task that runs
    #[arg(long, conflicts_with = "ids")]
    all: bool,

    /// The tasks' scope; needed only for a server that does not tell it, as the original
    /// [default: the configuration file's, else $ZTL_SCOPE; with --all every scope]
    #[arg(short, long)]
    scope: Option<String>,
}

/// A task to be stopped.
struct Wanted {
    scope: String,
    id: RemoteId,
    /// What it is, as far as it is known.
    task: String,
}

impl Wanted {
    fn of(task: &ListedTask) -> Self {
        Self {
            scope: task.scope.clone(),
            id: task.id.clone(),
            task: task.task.clone(),
        }
    }
}

fn id(text: &str) -> Result<RemoteId, &'static str> {
    let id = text.parse().ok().filter(RemoteId::names_task);
    id.ok_or("an id is a whole number above 0, as `ztl ps` shows it")
}

impl Abort {
    pub(crate) fn run(self) -> Done {
        let server = self.server.server()?;
        let all_ended = match self.all {
            true => abort_all(&server, self.scope.as_deref())?,
            false => abort_these(&server, &self.ids, self.scope)?,
        };
        Ok(code(all_ended))
    }
}

/// Stops every task that runs; says whether all have ended.
fn abort_all(server: &Server, scope: Option<&str>) -> Result<bool, Box<dyn std::error::Error>> {
    let mut tried = HashSet::new();
    let mut all_ended = true;
    loop {
        let listing = server.tasks()?;
        let runs = |task: &&ListedTask| {
            task.ended_ms.is_none() && scope.is_none_or(|scope| scope == task.scope)
        };
        let running = listing.tasks.iter().filter(runs).map(Wanted::of);
        let new: Vec<Wanted> = running
            .filter(|task| tried.insert(task.id.clone()))
            .collect();
        for task in &new {
            all_ended &= abort(server, task)?;
        }
        if tried.is_empty() && listing.unread == 0 {
            if let Some(scope) = scope {
                server.demand_scope(scope)?;
            }
            line("No task is running.");
        }
        // The running ones come first; a server with very many tells only some of them.
        let told_all =
            listing.more == 0 || listing.tasks.iter().any(|task| task.ended_ms.is_some());
        if told_all || new.is_empty() {
            return Ok(all_read(listing.unread) && all_ended && told_all);
        }
    }
}

/// Stops the tasks with these ids; says whether all have ended.
fn abort_these(
    server: &Server,
    ids: &[RemoteId],
    scope: Option<String>,
) -> Result<bool, Box<dyn std::error::Error>> {
    let in_scope = |scope: &str| -> Vec<Option<Wanted>> {
        let named = |id: &RemoteId| Wanted {
            scope: scope.to_owned(),
            id: id.clone(),
            task: String::new(),
        };
        ids.iter().map(|id| Some(named(id))).collect()
    };
    let wanted = match scope {
        Some(scope) => in_scope(&scope),
        None => match server.tasks_if_any()? {
            Some(listing) => {
                let find = |id: &RemoteId| {
                    let mut tasks = listing.tasks.iter();
                    tasks.find(|task| task.id == *id).map(Wanted::of)
                };
                ids.iter().map(find).collect()
            }
            None => match server.place.scope(None)? {
                Some(scope) => in_scope(&scope),
                None => return Err(format!("{}; give --scope", server.original()).into()),
            },
        },
    };
    let mut all_ended = true;
    // One that is not known keeps nobody from stopping the others.
    for (id, wanted) in ids.iter().zip(&wanted) {
        all_ended &= match wanted {
            Some(wanted) => abort(server, wanted)?,
            None => {
                unknown(server, id);
                false
            }
        };
    }
    Ok(all_ended)
}

fn unknown(server: &Server, id: &RemoteId) {
    let endpoint = server.endpoint();
    error_line(format_args!(
        "ztl: no task {id} is known at {endpoint}; `ztl ps --all` lists them"
    ));
}

/// Stops a task, and says what became of it; whether it has certainly ended.
fn abort(server: &Server, wanted: &Wanted) -> Result<bool, Box<dyn std::error::Error>> {
    let Wanted { scope, id, task } = wanted;
    let mut remote = server.connect(scope)?;
    let answer = match remote.abort(id) {
        // The answer to an ABORT does not tell the result.
        Ok(aborted) if aborted.state == State::Aborted => remote.status(id).or(Ok(aborted)),
        answer => answer,
    };
    let name = format!("{id} {task}");
    let name = flat(name.trim_end());
    let (ended, said) = match About::of(&answer) {
        About::Task(Status { state, text }) if state.is_final() => {
            (true, format!("{}, {}", state.name(), flat(text)))
        }
        About::Task(Status { text, .. }) => (false, format!("not stopped yet: {}", flat(text))),
        About::NoTask => {
            unknown(server, id);
            return Ok(false);
        }
        About::NoScope => (false, format!("the server has no scope '{}'", flat(scope))),
        About::Nothing(why) => (false, format!("it may still run: {}", flat(&why))),
    };
    line(format_args!("{name}: {said}"));
    Ok(ended)
}

/// What an answer to an ABORT is about.
enum About<'a> {
    Task(&'a Status),
    /// The server does not know the task.
    NoTask,
    /// The server does not serve the scope.
    NoScope,
    /// It says nothing of the task.
    Nothing(String),
}

impl<'a> About<'a> {
    fn of(answer: &'a Result<Status, RequestError>) -> Self {
        match answer {
            Ok(status) => Self::Task(status),
            Err(RequestError::UnknownTask { .. }) => Self::NoTask,
            Err(RequestError::NotTold { text, .. })
                if text.starts_with("No controller for scope: ") =>
            {
                Self::NoScope
            }
            Err(error) => Self::Nothing(error.to_string()),
        }
    }
}
