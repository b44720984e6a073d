//! What `ztl devices`, `ztl describe`, `ztl ps` and `ztl abort` share: which server is asked, and how
//! answers look.

use std::process::ExitCode;

use serde::de::DeserializeOwned;
use ztl_std::terminal::quoted;
use ztl_std::{Description, RemoteTask, ServerTasks};

use crate::address::{Address, Place};
use crate::conversation::no_client;
use crate::exit::Misuse;
use crate::reach::Identity;
use crate::terminal::error_line;

/// Options that say which server is asked, and by whom.
#[derive(Debug, clap::Args)]
pub(crate) struct Asking {
    #[command(flatten)]
    address: Address,

    #[command(flatten)]
    identity: Identity,
}

impl Asking {
    /// The server that is asked.
    ///
    /// # Errors
    /// When nothing says which it is.
    pub(crate) fn server(self) -> Result<Server, Misuse> {
        Ok(Server {
            place: self.address.place()?,
            identity: self.identity,
        })
    }
}

/// A server that is asked.
pub(crate) struct Server {
    pub(crate) place: Place,
    identity: Identity,
}

impl Server {
    pub(crate) fn endpoint(&self) -> String {
        self.place.endpoint()
    }

    /// A client of `scope` there.
    pub(crate) fn connect(&self, scope: &str) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        let remote = RemoteTask::connect(&self.endpoint(), scope)
            .map_err(|error| no_client(&self.place.host, error))?;
        self.identity.apply(remote)
    }

    /// What the server says of itself.
    pub(crate) fn describe(&self) -> Result<Description, Box<dyn std::error::Error>> {
        let told = self.connect("$ztl")?.describe()?;
        Ok(told.ok_or_else(|| self.original())?)
    }

    /// # Errors
    /// The server says which scopes it has, and this one is not among them.
    pub(crate) fn demand_scope(&self, scope: &str) -> Result<(), Box<dyn std::error::Error>> {
        let scopes = self.describe()?.scopes;
        if scopes.is_empty() || scopes.contains_key(scope) {
            return Ok(());
        }
        let names: Vec<&str> = scopes.keys().map(String::as_str).collect();
        let endpoint = self.endpoint();
        let names = names.join(", ");
        Err(format!("the server at {endpoint} has no scope '{scope}'; it has: {names}").into())
    }

    /// Why a server tells nothing.
    pub(crate) fn original(&self) -> String {
        let endpoint = self.endpoint();
        format!("the server at {endpoint} is an original ztl; it does not say what it offers")
    }

    /// What the server answers to a question, as JSON; `None` where it does not know it.
    pub(crate) fn ask(&self, question: &str) -> Result<Option<String>, Box<dyn std::error::Error>> {
        Ok(self.connect("$ztl")?.ask_server(question)?)
    }

    /// The tasks that the server names; `None`: it is an original server.
    pub(crate) fn tasks_if_any(&self) -> Result<Option<ServerTasks>, Box<dyn std::error::Error>> {
        Ok(self.connect("$ztl")?.tasks()?)
    }

    /// The same; an original server is an error.
    pub(crate) fn tasks(&self) -> Result<ServerTasks, Box<dyn std::error::Error>> {
        Ok(self.tasks_if_any()?.ok_or_else(|| self.original())?)
    }
}

/// Reads an answer.
pub(crate) fn read<T: DeserializeOwned>(json: &str) -> Result<T, String> {
    serde_json::from_str(json).map_err(|error| {
        format!(
            "cannot read the server's answer: {}",
            quoted(&error.to_string())
        )
    })
}

/// Says why tasks may run that the server does not name, if so; whether it names all that run.
pub(crate) fn all_named(tasks: &ServerTasks) -> bool {
    for gap in &tasks.gaps {
        error_line(format_args!("ztl: {gap}"));
    }
    tasks.gaps.is_empty()
}

/// The exit code of a command that did all that it was asked to, or did not.
pub(crate) fn code(all: bool) -> ExitCode {
    if all {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

/// A time as people say it: the two greatest units.
pub(crate) fn spoken(millis: u64) -> String {
    let seconds = millis / 1000;
    let (days, hours) = (seconds / 86_400, seconds / 3600 % 24);
    let (minutes, rest) = (seconds / 60 % 60, seconds % 60);
    match (days, hours, minutes) {
        (0, 0, 0) if seconds < 10 => format!("{}.{} s", seconds, millis / 100 % 10),
        (0, 0, 0) => format!("{seconds} s"),
        (0, 0, _) => format!("{minutes} min {rest} s"),
        (0, ..) => format!("{hours} h {minutes} min"),
        _ => format!("{days} d {hours} h"),
    }
}

/// Rows with their columns below each other; the last is as long as it is.
pub(crate) fn table(rows: &[Vec<String>]) -> Vec<String> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths);
        let cells: Vec<String> = cells
            .map(|(cell, width)| format!("{cell:<width$}"))
            .collect();
        cells.join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_told_in_their_two_greatest_units() {
        for (millis, words) in [
            (0, "0.0 s"),
            (1250, "1.2 s"),
            (59_999, "59 s"),
            (61_000, "1 min 1 s"),
            (3_660_000, "1 h 1 min"),
            (90_000_000, "1 d 1 h"),
        ] {
            assert_eq!(spoken(millis), words);
        }
    }
}
