//! Queries of a server, as `ztl devices`, `ztl describe`, `ztl ps` and `ztl abort` make them.

use std::process::ExitCode;

use serde::de::DeserializeOwned;
use ztl_std::terminal::{flat, quoted};
use ztl_std::{DescribedComponent, Description, ListedTask, RemoteTask, ServerTasks, State};

use crate::connect_options::ConnectOptions;
use crate::exit::Misuse;
use crate::server_address::{AddressOptions, ServerAddress, no_client};
use crate::terminal::error_line;

/// Options for a server to query.
#[derive(Debug, clap::Args)]
pub(crate) struct QueryOptions {
    #[command(flatten)]
    address: AddressOptions,

    #[command(flatten)]
    connecting: ConnectOptions,
}

impl QueryOptions {
    /// The server of the options and the environment.
    pub(crate) fn server(self) -> Result<QueriedServer, Misuse> {
        Ok(QueriedServer {
            address: self.address.resolve()?,
            connecting: self.connecting,
        })
    }
}

/// A server to query.
pub(crate) struct QueriedServer {
    pub(crate) address: ServerAddress,
    connecting: ConnectOptions,
}

impl QueriedServer {
    pub(crate) fn endpoint(&self) -> String {
        self.address.endpoint()
    }

    /// Connects to a scope of the server.
    pub(crate) fn connect(&self, scope: &str) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        let remote = RemoteTask::connect(&self.endpoint(), scope).map_err(no_client)?;
        self.connecting.apply(remote, self.address.keys.as_ref())
    }

    /// The server's description of itself.
    pub(crate) fn describe(&self) -> Result<Description, Box<dyn std::error::Error>> {
        let told = self.connect("$ztl")?.describe()?;
        Ok(told.ok_or_else(|| self.original())?)
    }

    /// What its components say of themselves.
    pub(crate) fn components(&self) -> Result<Vec<DescribedComponent>, Box<dyn std::error::Error>> {
        Ok(self.connect("$ztl")?.describe_components()?)
    }

    /// Fails if the server lists its scopes without this one.
    pub(crate) fn demand_scope(&self, scope: &str) -> Result<(), Box<dyn std::error::Error>> {
        let scopes = self.describe()?.scopes;
        if scopes.is_empty() || scopes.contains_key(scope) {
            return Ok(());
        }
        let names: Vec<&str> = scopes.keys().map(String::as_str).collect();
        let endpoint = self.endpoint();
        let names = names.join(", ");
        let names = flat(&names);
        Err(format!("the server at {endpoint} has no scope '{scope}'; it has: {names}").into())
    }

    /// The error for a server that does not describe itself.
    pub(crate) fn original(&self) -> String {
        let endpoint = self.endpoint();
        format!("the server at {endpoint} is an original ztl; it does not say what it offers")
    }

    /// The answer to a question in JSON; `None` if the server does not know the question.
    pub(crate) fn ask(&self, question: &str) -> Result<Option<String>, Box<dyn std::error::Error>> {
        Ok(self.connect("$ztl")?.ask_server(question)?)
    }

    /// The tasks that the server lists; `None` for an original server.
    pub(crate) fn tasks_if_any(&self) -> Result<Option<ServerTasks>, Box<dyn std::error::Error>> {
        Ok(self.connect("$ztl")?.tasks()?)
    }

    /// The tasks that the server lists; an error for an original server.
    pub(crate) fn tasks(&self) -> Result<ServerTasks, Box<dyn std::error::Error>> {
        Ok(self.tasks_if_any()?.ok_or_else(|| self.original())?)
    }
}

/// Parses an answer.
pub(crate) fn read<T: DeserializeOwned>(json: &str) -> Result<T, String> {
    serde_json::from_str(json).map_err(|error| {
        format!(
            "cannot read the server's answer: {}",
            quoted(&error.to_string())
        )
    })
}

/// Returns whether the server lists all running tasks. Prints why not.
pub(crate) fn all_named(tasks: &ServerTasks) -> bool {
    for gap in &tasks.gaps {
        error_line(format_args!("ztl: {gap}"));
    }
    tasks.gaps.is_empty()
}

/// The exit code for complete success or not.
pub(crate) fn code(all: bool) -> ExitCode {
    if all {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

/// The state of a task for people.
pub(crate) fn state(task: &ListedTask) -> String {
    if task.end_is_unknown() {
        return "may still run".to_owned();
    }
    let known = State::from_code(i64::from(task.state));
    known.map_or_else(|| task.state.to_string(), |state| state.name().to_owned())
}
