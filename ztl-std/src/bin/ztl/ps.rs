//! `ztl ps`: the tasks of a server.

use std::process::ExitCode;

use ztl_std::{ListedTask, State};

use crate::Done;
use crate::ask::{Server, spoken, table};
use crate::terminal::line;

#[derive(Debug, clap::Args)]
pub(crate) struct Ps {
    #[command(flatten)]
    server: Server,

    /// Show the ended ones too, as long as the server remembers them
    #[arg(short, long)]
    all: bool,

    /// What the server says, in JSON
    #[arg(long)]
    json: bool,
}

impl Ps {
    pub(crate) fn run(self) -> Done {
        let (json, listing) = self.server.tasks()?;
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
        let head = ["ID", "SCOPE", "TASK", "STATE", "SINCE", "TEXT"].map(str::to_owned);
        let mut all = vec![head.to_vec()];
        all.extend(rows);
        for text in table(&all) {
            line(text);
        }
        if self.all && listing.more > 0 {
            line(format_args!("{} more are remembered.", listing.more));
        }
        Ok(ExitCode::SUCCESS)
    }
}

pub(crate) fn state(task: &ListedTask) -> String {
    let known = State::from_code(i64::from(task.state));
    known.map_or_else(|| task.state.to_string(), |state| state.name().to_owned())
}

/// One line, whatever a handler says.
pub(crate) fn flat(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect()
}

fn row(task: &ListedTask) -> Vec<String> {
    vec![
        task.id.to_string(),
        flat(&task.scope),
        flat(&task.task),
        state(task),
        spoken(task.ended_ms.unwrap_or(task.age_ms)),
        flat(&task.text),
    ]
}
