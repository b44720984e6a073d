//! `ztl abort`: aborts tasks of a server.

use std::collections::HashSet;

use ztl_std::{RemoteId, RequestError, ServerTask, ServerTasks, Status, scope};

use crate::exit::{Done, Misuse};
use crate::server_query::{QueriedServer, QueryOptions, all_named, code};
use crate::terminal::{error_line, flat, line};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 every task has ended, 1 at least one is unknown or may still run."
)]
pub(crate) struct Abort {
    #[command(flatten)]
    server: QueryOptions,

    /// Ids of the tasks to abort
    #[arg(value_name = "ID", required_unless_present = "all", value_parser = id)]
    ids: Vec<RemoteId>,

    /// Abort every running task
    #[arg(long, conflicts_with = "ids")]
    all: bool,

    /// The tasks' scope; needed only if the server does not list its tasks, as the original
    /// [default: the configuration file's, else $ZTL_SCOPE; with --all every scope]
    #[arg(short, long)]
    scope: Option<String>,
}

/// A task to abort.
struct Wanted {
    scope: String,
    id: RemoteId,
    /// `handler:component:goal`, if it is known.
    task: String,
}

impl Wanted {
    fn of(task: &ServerTask) -> Self {
        Self {
            scope: task.scope.clone(),
            id: task.id.clone(),
            task: task.task().to_owned(),
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
        if let Some(mistake) = self.scope.as_deref().and_then(scope::cannot_be_asked) {
            return Err(Misuse(mistake).into());
        }
        let all_ended = match self.all {
            true => abort_all(&server, self.scope.as_deref())?,
            false => abort_these(&server, &self.ids, self.scope)?,
        };
        Ok(code(all_ended))
    }
}

/// Aborts every task that may run. Returns whether all have ended.
fn abort_all(
    server: &QueriedServer,
    scope: Option<&str>,
) -> Result<bool, Box<dyn std::error::Error>> {
    let mut tried = HashSet::new();
    let mut all_ended = true;
    loop {
        let known = server.tasks()?;
        let here =
            |task: &&ServerTask| task.may_run && scope.is_none_or(|scope| scope == task.scope);
        let mut is_new = |task: &&ServerTask| tried.insert((task.scope.clone(), task.id.clone()));
        let found = known.tasks.iter().filter(here).filter(&mut is_new);
        let found: Vec<Wanted> = found.map(Wanted::of).collect();
        all_ended &= abort(server, &found)?;
        // The list may have room for others now.
        if !found.is_empty() && !known.gaps.is_empty() {
            continue;
        }
        let all_named = all_named(&known);
        if tried.is_empty() && all_named {
            if let Some(scope) = scope {
                server.demand_scope(scope)?;
            }
            line("No task is running.");
        }
        return Ok(all_named && all_ended);
    }
}

/// Aborts the tasks with these ids. Returns whether all have ended.
fn abort_these(
    server: &QueriedServer,
    ids: &[RemoteId],
    scope: Option<String>,
) -> Result<bool, Box<dyn std::error::Error>> {
    let known = match scope {
        Some(_) => None,
        None => server.tasks_if_any()?,
    };
    let scope = match (scope, &known) {
        (Some(scope), _) => Some(scope),
        (None, Some(known)) if known.gaps.is_empty() => None,
        (None, Some(_)) => server.address.scope(None).ok().flatten(),
        (None, None) => server.address.scope(None)?,
    };
    if known.is_none() && scope.is_none() {
        return Err(format!("{}; give --scope", server.original()).into());
    }
    let mut all_known = known.as_ref().is_none_or(|known| {
        let found = |id: &RemoteId| known.tasks.iter().any(|task| task.id == *id);
        ids.iter().all(found) || all_named(known)
    });
    let mut all = Vec::new();
    for id in ids {
        let wanted = find(known.as_ref(), id);
        match &scope {
            _ if !wanted.is_empty() => all.extend(wanted),
            Some(scope) => all.push(Wanted {
                scope: scope.clone(),
                id: id.clone(),
                task: String::new(),
            }),
            // Aborts the others even if one is unknown.
            None => {
                unknown(server, id, false);
                all_known = false;
            }
        }
    }
    Ok(abort(server, &all)? && all_known)
}

/// The tasks with this id that may run, in all scopes; otherwise one that has ended.
fn find(known: Option<&ServerTasks>, id: &RemoteId) -> Vec<Wanted> {
    let tasks = known.into_iter().flat_map(|known| &known.tasks);
    let all: Vec<&ServerTask> = tasks.filter(|task| task.id == *id).collect();
    let running = all.iter().filter(|task| task.may_run).count();
    let all = all.into_iter().take(running.max(1));
    all.map(Wanted::of).collect()
}

fn unknown(server: &QueriedServer, id: &RemoteId, is_original: bool) {
    let endpoint = server.endpoint();
    let advice = match is_original {
        true => "an original ztl does not list its tasks, and forgets them when it restarts",
        false => "`ztl ps --all` lists them",
    };
    error_line(format_args!(
        "ztl: no task {id} is known at {endpoint}; {advice}"
    ));
}

/// Aborts tasks at the same time, and prints what became of each. Returns whether all have certainly ended.
fn abort(server: &QueriedServer, wanted: &[Wanted]) -> Result<bool, Box<dyn std::error::Error>> {
    let tasks = wanted
        .iter()
        .map(|task| (task.scope.clone(), task.id.clone()));
    let tasks: Vec<_> = tasks.collect();
    let mut all_ended = true;
    let mut missing = Vec::new();
    let mut remote = server.connect("$ztl")?;
    remote.abort_all(&tasks, |at, answer| {
        let Some(wanted) = wanted.get(at) else {
            return;
        };
        let Some((ended, said)) = outcome(&wanted.scope, &answer) else {
            return missing.push(&wanted.id);
        };
        let name = format!("{} {}", wanted.id, wanted.task);
        line(format_args!("{}: {said}", flat(name.trim_end())));
        all_ended &= ended;
    });
    if !missing.is_empty() {
        let is_original = matches!(remote.server_info(false), Ok(None));
        for id in &missing {
            unknown(server, id, is_original);
        }
    }
    Ok(all_ended && missing.is_empty())
}

/// Whether a task has certainly ended, and its outcome for people. `None` if the server does not know the task.
fn outcome(scope: &str, answer: &Result<Status, RequestError>) -> Option<(bool, String)> {
    Some(match answer {
        Ok(Status { state, text }) if state.is_final() => {
            (true, format!("{}, {}", state.name(), flat(text)))
        }
        Ok(Status { text, .. }) => (false, format!("not stopped yet: {}", flat(text))),
        Err(RequestError::UnknownTask { .. }) => return None,
        Err(error) if error.is_no_scope() => {
            (false, format!("the server has no scope '{}'", flat(scope)))
        }
        Err(error) => {
            let why = error.to_string();
            (false, format!("it may still run: {}", flat(&why)))
        }
    })
}
