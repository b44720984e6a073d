//! `ztl ps`: the tasks of a server.

use std::process::ExitCode;

use ztl_std::{ListedTask, State};

use crate::Done;
use crate::ask::{Asking, spoken, table};
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
        let (json, listing) = self.server.server()?.tasks()?;
        if self.json {
            line(json);
            return Ok(ExitCode::SUCCESS);
        }
        let shown = |task: &&ListedTask| self.all || task.ended_ms.is_none();
        let rows: Vec<Vec<String>> = listing.tasks.iter().filter(shown).map(row).collect();
        if rows.is_empty() {
            line("No task is running.");
            return Ok(ExitCode::SUCCESS);
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
        Ok(ExitCode::SUCCESS)
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
