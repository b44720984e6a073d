//! What a server says of its tasks: its answers to `probe` and `tasks`, merged.

use std::collections::HashSet;

use ztl_core::State;
use ztl_core::client::Server;
use ztl_core::dispatcher::UNKNOWN_END;

use super::{Description, RemoteId, RemoteTask, RequestError};
use crate::server::{ListedTask, Listing};
use crate::terminal::quoted;

/// The tasks of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerTasks {
    /// Differs from start to start of the server; `None` if its answer cannot be read.
    pub boot: Option<u32>,
    /// Those that run or may run first. A task appears once, by scope and id.
    pub tasks: Vec<ServerTask>,
    /// How many more the server remembers.
    pub more: usize,
    /// Reasons why other tasks may run than the named ones. Empty: every task that runs is named.
    pub gaps: Vec<String>,
}

/// A task that a server named.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerTask {
    /// Its id.
    pub id: RemoteId,
    /// The scope that it belongs to.
    pub scope: String,
    /// What the answer to `tasks` tells; `None` if only the answer to `probe` names the task.
    pub listed: Option<ListedTask>,
    /// Whether it runs or may run: one of the two answers says that it runs, or the server could not learn
    /// its end.
    pub may_run: bool,
}

impl ServerTask {
    /// `handler:component:goal`; empty if the server does not tell it.
    #[must_use]
    pub fn task(&self) -> &str {
        self.listed.as_ref().map_or("", |listed| &listed.task)
    }
}

impl ListedTask {
    /// Whether the task ended as FAILED because the server could not learn its end. It may still run.
    #[must_use]
    pub fn end_is_unknown(&self) -> bool {
        self.state == State::Failed.code() && self.text.starts_with(UNKNOWN_END)
    }

    /// Whether the list says that it runs, or does not say for certain that it has ended.
    fn may_run(&self) -> bool {
        let state = State::from_code(i64::from(self.state));
        let ended = self.ended_ms.is_some() && state.is_some_and(State::is_final);
        !ended || self.end_is_unknown()
    }
}

impl RemoteTask {
    /// Asks the server for its tasks, of every scope; `None` when it is not one of ours. The answers to `probe`
    /// and to `tasks` complete each other: `probe` names every task that runs, `tasks` describes up to 1,000.
    ///
    /// # Errors
    /// As [`RequestError`] says, when neither question brings a readable answer.
    pub fn tasks(&mut self) -> Result<Option<ServerTasks>, RequestError> {
        let told = match self.describe() {
            Err(error) if error.nothing_was_sent() => return Err(error),
            told => told,
        };
        let mut gaps = Vec::new();
        let listing = match self.ask_server("tasks") {
            Ok(None) => match &told {
                Ok(None) => return Ok(None),
                Ok(Some(_)) => None,
                Err(error) => return Err(error.clone()),
            },
            Ok(Some(json)) => match serde_json::from_str::<Listing>(&json) {
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
                if told.is_err() {
                    return Err(error);
                }
                gaps.push(format!(
                    "no list of tasks from the server: {error}; other tasks may run"
                ));
                None
            }
        };
        if let Err(error) = &told
            && listing.is_none()
        {
            gaps.push(error.to_string());
        }
        let told = told.ok().flatten();
        let boot = told.as_ref().map(|told| told.boot);
        let boot = boot.or(match self.client.server() {
            Server::Ours { boot } => Some(boot),
            _ => None,
        });
        let mut tasks = merge(told, listing, self.endpoint(), gaps);
        tasks.boot = boot;
        Ok(Some(tasks))
    }
}

fn merge(
    told: Option<Description>,
    listing: Option<Listing>,
    endpoint: &str,
    mut gaps: Vec<String>,
) -> ServerTasks {
    let (running, probe_unread) = match told {
        Some(told) => (told.running, told.unread),
        None => (None, 0),
    };
    if running.is_none() && listing.is_none() && gaps.is_empty() {
        gaps.push(format!(
            "the server at {endpoint} does not tell which tasks run"
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
    // The list begins with the running ones: if it reaches those that have ended, it names all that run.
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
