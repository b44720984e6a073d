//! `ztl abort`: stops tasks of a server, whoever started them.

use std::process::ExitCode;

use ztl_std::{ListedTask, RequestError, State, Status, TaskId};

use crate::Done;
use crate::ask::Server;
use crate::ps::flat;
use crate::terminal::line;

#[derive(Debug, clap::Args)]
#[command(after_help = "Exit codes: 0 every task has ended, 1 at least one may still run.")]
pub(crate) struct Abort {
    #[command(flatten)]
    server: Server,

    /// The tasks to stop, by their ids
    #[arg(value_name = "ID", required_unless_present = "all", value_parser = id)]
    ids: Vec<TaskId>,

    /// Stop every task that runs
    #[arg(long, conflicts_with = "ids")]
    all: bool,

    /// The tasks' scope; needed only for a server that does not tell it, as the original
    #[arg(short, long)]
    scope: Option<String>,
}

/// A task to be stopped.
struct Wanted {
    scope: String,
    id: TaskId,
    /// What it is, as far as it is known.
    task: String,
}

fn wanted_task(task: &ListedTask) -> Option<Wanted> {
    Some(Wanted {
        scope: task.scope.clone(),
        id: TaskId::new(task.id)?,
        task: task.task.clone(),
    })
}

fn id(text: &str) -> Result<TaskId, &'static str> {
    let number = text.parse().ok().and_then(TaskId::new);
    number.ok_or("an id is a whole number above 0, as `ztl ps` shows it")
}

impl Abort {
    pub(crate) fn run(self) -> Done {
        let mut all_ended = true;
        for Wanted { scope, id, task } in self.wanted()? {
            let mut remote = self.server.connect(&scope)?;
            let answer = remote.abort(id).and_then(|status| match status.state {
                // The answer to an ABORT does not tell the result.
                State::Aborted => remote.status(id),
                _ => Ok(status),
            });
            let (ended, said) = told(&answer);
            all_ended &= ended;
            let name = format!("{id} {task}");
            line(format_args!("{}: {said}", flat(name.trim_end())));
        }
        Ok(if all_ended {
            ExitCode::SUCCESS
        } else {
            ExitCode::FAILURE
        })
    }

    fn wanted(&self) -> Result<Vec<Wanted>, Box<dyn std::error::Error>> {
        if let Some(scope) = &self.scope
            && !self.all
        {
            let named = |id: &TaskId| Wanted {
                scope: scope.clone(),
                id: *id,
                task: String::new(),
            };
            return Ok(self.ids.iter().map(named).collect());
        }
        let (_, listing) = self.server.tasks()?;
        let mut wanted = Vec::new();
        if self.all {
            let runs = |task: &&ListedTask| {
                let here = self.scope.as_ref().is_none_or(|scope| *scope == task.scope);
                task.ended_ms.is_none() && here
            };
            for task in listing.tasks.iter().filter(runs) {
                wanted.extend(wanted_task(task));
            }
            if wanted.is_empty() {
                line("No task is running.");
            }
            return Ok(wanted);
        }
        for id in &self.ids {
            let known = listing.tasks.iter().find(|task| task.id == id.get());
            let known = known.ok_or_else(|| {
                format!(
                    "no task {id} is known at {}; `ztl ps --all` lists them",
                    self.server.endpoint()
                )
            })?;
            wanted.extend(wanted_task(known));
        }
        Ok(wanted)
    }
}

/// Whether the task has certainly ended, and what is said about it.
fn told(answer: &Result<Status, RequestError>) -> (bool, String) {
    match answer {
        Ok(Status { state, text }) if *state == State::Accepted => {
            (false, format!("not stopped yet: {}", flat(text)))
        }
        Ok(Status { state, text }) => {
            let said = format!("{}, {}", state.name(), flat(text));
            (state.is_final(), said)
        }
        Err(error) => (false, error.to_string()),
    }
}
