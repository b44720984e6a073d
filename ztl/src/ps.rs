//! `ztl ps`: the tasks of a server.

use std::process::ExitCode;

use serde_json::json;
use ztl_std::{ListedTask, RemoteId, State};

use crate::Done;
use crate::ask::{Asking, all_read, code, spoken, table};
use crate::terminal::{flat, line};

#[derive(Debug, clap::Args)]
pub(crate) struct Ps {
    #[command(flatten)]
    server: Asking,

    /// Show the ended ones too, as long as the server remembers them
    #[arg(short, long)]
    all: bool,

    /// What the server says, in JSON
    #[arg(long)]
    json: bool,
}

impl Ps {
    pub(crate) fn run(self) -> Done {
        let server = self.server.server()?;
        let Some((json, listing)) = server.tasks_if_told()? else {
            let told = server.describe()?;
            let unread = told.unread;
            show_running(&server.running(told)?, unread, self.json);
            return Ok(code(all_read(unread)));
        };
        if self.json {
            line(json);
            return Ok(ExitCode::SUCCESS);
        }
        let shown = |task: &&ListedTask| self.all || task.ended_ms.is_none();
        let rows: Vec<Vec<String>> = listing.tasks.iter().filter(shown).map(row).collect();
        let all_read = all_read(listing.unread);
        if rows.is_empty() {
            if all_read {
                line("No task is running.");
            }
            return Ok(code(all_read));
        }
        let shown_all = rows.len() == listing.tasks.len();
        let head = ["ID", "SCOPE", "TASK", "STATE", "SINCE", "TEXT"].map(str::to_owned);
        let mut all = vec![head.to_vec()];
        all.extend(rows);
        for text in table(&all) {
            line(text);
        }
        if listing.more > 0 && (self.all || shown_all) {
            line(format_args!("{} more are remembered.", listing.more));
        }
        Ok(code(all_read))
    }
}

/// All that a device tells that speaks ZeroMQ itself.
fn show_running(running: &[(RemoteId, String)], unread: usize, as_json: bool) {
    if as_json {
        let tasks = running
            .iter()
            .map(|(id, scope)| json!({ "id": id, "scope": scope }));
        line(json!({ "tasks": tasks.collect::<Vec<_>>(), "more": 0 }));
    } else if running.is_empty() && unread == 0 {
        line("No task is running.");
    } else if !running.is_empty() {
        let head = ["ID", "SCOPE"].map(str::to_owned).to_vec();
        let row = |(id, scope): &(RemoteId, String)| vec![id.to_string(), flat(scope).into_owned()];
        let rows: Vec<_> = std::iter::once(head)
            .chain(running.iter().map(row))
            .collect();
        table(&rows).iter().for_each(line);
    }
}

pub(crate) fn state(task: &ListedTask) -> String {
    let known = State::from_code(i64::from(task.state));
    known.map_or_else(|| task.state.to_string(), |state| state.name().to_owned())
}

fn row(task: &ListedTask) -> Vec<String> {
    vec![
        task.id.to_string(),
        flat(&task.scope).into_owned(),
        flat(&task.task).into_owned(),
        state(task),
        spoken(task.ended_ms.unwrap_or(task.age_ms)),
        flat(&task.text).into_owned(),
    ]
}
