//! `ztl ps`: lists the tasks of a server.

use serde_json::json;
use ztl_std::{ListedTask, ServerTask};

use crate::columns::{spoken, table};
use crate::data_format::DataFormat;
use crate::exit::Done;
use crate::server_query::{QueryOptions, all_named, code, state};
use crate::terminal::{flat, line};

#[derive(Debug, clap::Args)]
pub(crate) struct Ps {
    #[command(flatten)]
    server: QueryOptions,

    /// Also show ended tasks that the server still keeps
    #[arg(short, long)]
    all: bool,

    #[command(flatten)]
    format: DataFormat,
}

impl Ps {
    pub(crate) fn run(self) -> Done {
        let known = self.server.server()?.tasks()?;
        let all_named = all_named(&known);
        if known.tasks.is_empty() && !all_named {
            return Ok(code(false));
        }
        if self.format.is_chosen() {
            let tasks: Result<Vec<_>, _> = known.tasks.iter().map(as_json).collect();
            let list = json!({ "tasks": tasks?, "more": known.more });
            self.format.print(&list)?;
            return Ok(code(all_named));
        }
        let shown = |task: &&ServerTask| self.all || task.may_run;
        let shown: Vec<&ServerTask> = known.tasks.iter().filter(shown).collect();
        if shown.is_empty() {
            if all_named {
                line("No task is running.");
            }
            return Ok(code(all_named));
        }
        // A device lists only ids and scopes.
        let is_listed = shown.iter().any(|task| task.listed.is_some());
        let columns = if is_listed { 6 } else { 2 };
        let head = ["ID", "SCOPE", "TASK", "STATE", "SINCE", "TEXT"].map(str::to_owned);
        let mut all = vec![head.into_iter().take(columns).collect()];
        all.extend(shown.iter().map(|task| row(task)));
        for text in table(&all) {
            line(text);
        }
        if known.more > 0 && (self.all || shown.len() == known.tasks.len()) {
            line(format_args!("{} more are remembered.", known.more));
        }
        Ok(code(all_named))
    }
}

fn as_json(task: &ServerTask) -> serde_json::Result<serde_json::Value> {
    match &task.listed {
        Some(listed) => serde_json::to_value(listed),
        None => Ok(json!({ "id": task.id, "scope": task.scope })),
    }
}

/// The task, and who started it if that was no client.
fn shown(task: &ListedTask) -> String {
    let by = if task.by_device {
        " (by the device)"
    } else {
        ""
    };
    format!("{}{by}", flat(&task.task))
}

fn row(task: &ServerTask) -> Vec<String> {
    let mut cells = vec![task.id.to_string(), flat(&task.scope).into_owned()];
    if let Some(listed) = &task.listed {
        cells.extend([
            shown(listed),
            state(listed),
            spoken(listed.ended_ms.unwrap_or(listed.age_ms)),
            flat(&listed.text).into_owned(),
        ]);
    }
    cells
}
