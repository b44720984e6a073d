//! A server's tasks: its answers to `probe` and `tasks`, merged.

use std::collections::HashSet;

use ztl_core::client::Server;

use super::description::Description;
use super::error::RequestError;
use super::remote_task::RemoteTask;
use crate::remote_id::RemoteId;
use crate::task_list::{ListedTask, TaskList};
use crate::terminal::quoted;

/// The tasks of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerTasks {
    /// Differs after each restart of the server; `None` if it is unreadable.
    pub boot: Option<u32>,
    /// Each task once, by scope and id; first those that run or may run.
    pub tasks: Vec<ServerTask>,
    /// How many more tasks the server keeps.
    pub more: usize,
    /// Why other tasks than these may run. Empty if every running task is included.
    pub gaps: Vec<String>,
}

/// A task of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerTask {
    /// Its id.
    pub id: RemoteId,
    /// Its scope.
    pub scope: String,
    /// Its entry in the answer to `tasks`; `None` if only the answer to `probe` names it.
    pub listed: Option<ListedTask>,
    /// Whether it may run: one of the answers says that it runs, or the server could not learn its end.
    pub may_run: bool,
}

impl ServerTask {
    /// `handler:component:goal`; empty if the server does not report it.
    #[must_use]
    pub fn task(&self) -> &str {
        self.listed.as_ref().map_or("", |listed| &listed.task)
    }
}

impl RemoteTask {
    /// Asks the server for its tasks in every scope; `None` if it is not one of this project. The answer to `probe`
    /// names every running task, the one to `tasks` describes up to 1,000 tasks.
    ///
    /// # Errors
    /// [`RequestError`] if neither question has a readable answer.
    pub fn tasks(&mut self) -> Result<Option<ServerTasks>, RequestError> {
        let described = match self.describe() {
            Err(error) if error.nothing_was_sent() => return Err(error),
            described => described,
        };
        let listing = self.ask_server("tasks");
        let tasks = ServerTasks::merged(self.endpoint(), described, listing)?;
        let known = match self.connection.server() {
            Server::Ours { boot } => Some(boot),
            _ => None,
        };
        Ok(tasks.map(|tasks| ServerTasks {
            boot: tasks.boot.or(known),
            ..tasks
        }))
    }
}

impl ServerTasks {
    /// Merges a server's answers to `probe` and to `tasks`, which was asked after it; `None` if it knows neither, as the
    /// original's.
    ///
    /// # Errors
    /// If neither is readable.
    pub fn merged(
        endpoint: &str,
        described: Result<Option<Description>, RequestError>,
        listing: Result<Option<String>, RequestError>,
    ) -> Result<Option<Self>, RequestError> {
        let mut gaps = Vec::new();
        let listing = match listing {
            Ok(None) => match &described {
                Ok(None) => return Ok(None),
                Ok(Some(_)) => None,
                Err(error) => return Err(error.clone()),
            },
            Ok(Some(json)) => match serde_json::from_str::<TaskList>(&json) {
                Ok(listing) => Some(listing),
                Err(error) => {
                    let error = error.to_string();
                    gaps.push(format!(
                        "cannot read the server's list of tasks: {}; other tasks may run",
                        quoted(&error)
                    ));
                    None
                }
            },
            Err(error) => {
                if described.is_err() {
                    return Err(error);
                }
                gaps.push(format!(
                    "no list of tasks from the server: {error}; other tasks may run"
                ));
                None
            }
        };
        if let Err(error) = &described
            && listing.is_none()
        {
            gaps.push(error.to_string());
        }
        let described = described.ok().flatten();
        let boot = described.as_ref().map(|described| described.boot);
        let mut tasks = merge(described, listing, endpoint, gaps);
        tasks.boot = boot;
        Ok(Some(tasks))
    }
}

fn merge(
    described: Option<Description>,
    listing: Option<TaskList>,
    endpoint: &str,
    mut gaps: Vec<String>,
) -> ServerTasks {
    let (running, probe_unread) = match described {
        Some(described) => (described.running, described.unread),
        None => (None, 0),
    };
    if running.is_none() && listing.is_none() && gaps.is_empty() {
        gaps.push(format!(
            "the server at {endpoint} does not tell which tasks run"
        ));
    }
    let elsewhere = listing.as_ref().map_or(0, |listing| listing.elsewhere);
    if elsewhere > 0 {
        gaps.push(format!(
            "{elsewhere} more run in scopes that this client may not use"
        ));
    }
    let list_unread = listing.as_ref().map_or(0, |listing| listing.unread);
    let unread = list_unread.max(probe_unread);
    if unread > 0 {
        gaps.push(format!(
            "{unread} of the tasks that the server lists cannot be read; they may run"
        ));
    }
    let probe_is_complete =
        probe_unread == 0 && running.as_ref().is_some_and(|all| !all.is_empty());
    let running = running.unwrap_or_default();
    let named: HashSet<(&RemoteId, &str)> = running
        .iter()
        .map(|(id, scope)| (id, scope.as_str()))
        .collect();
    let (listed, more) = listing.map_or((Vec::new(), Some(0)), |listing| {
        (listing.tasks, listing.more)
    });
    let shows_an_end = listed.iter().any(|task| !task.may_run());
    let mut seen = HashSet::new();
    let mut tasks = Vec::new();
    for task in listed {
        let (id, scope) = (task.id.clone(), task.scope.clone());
        let may_run = task.may_run() || named.contains(&(&id, scope.as_str()));
        seen.insert((id.clone(), scope.clone()));
        tasks.push(ServerTask {
            id,
            scope,
            listed: Some(task),
            may_run,
        });
    }
    let listed = tasks.len();
    for (id, scope) in &running {
        if seen.insert((id.clone(), scope.clone())) {
            tasks.push(ServerTask {
                id: id.clone(),
                scope: scope.clone(),
                listed: None,
                may_run: true,
            });
        }
    }
    let more = more.map(|more| more.saturating_sub(tasks.len() - listed));
    // The list begins with the running tasks: if it reaches an ended one, it includes all running ones.
    match more {
        Some(0) => {}
        Some(_) if shows_an_end || probe_is_complete => {}
        Some(more) => gaps.push(format!(
            "{more} more tasks may run that the server does not list"
        )),
        None => gaps.push("more tasks may run: the server's count of them cannot be read".into()),
    }
    tasks.sort_by_key(|task| !task.may_run);
    ServerTasks {
        boot: None,
        tasks,
        more: more.unwrap_or(0),
        gaps,
    }
}
