//! `ztl describe`: shows what a server offers, and what its components say of themselves.

use std::process::ExitCode;

use serde::Serialize;
use serde_json::Value;
use ztl_std::describe::GoalRule;
use ztl_std::{DescribedComponent, Description};

use crate::columns::table;
use crate::data_format::DataFormat;
use crate::exit::Done;
use crate::server_query::QueryOptions;
use crate::terminal::{flat, line};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit code 1: the server was not reached, or does not describe itself, as an original ztl."
)]
pub(crate) struct Describe {
    #[command(flatten)]
    server: QueryOptions,

    #[command(flatten)]
    format: DataFormat,
}

impl Describe {
    pub(crate) fn run(self) -> Done {
        let server = self.server.server()?;
        let told = server.describe()?;
        let components = server.components()?;
        if self.format.is_chosen() {
            let components = components.iter().map(Written::of);
            self.format.print(&Told {
                endpoint: server.endpoint(),
                server: &told,
                components: components.collect::<Result<_, _>>()?,
            })?;
            return Ok(ExitCode::SUCCESS);
        }
        let version = flat(&told.version).into_owned();
        line(format_args!("ztl {version} at {}", server.endpoint()));
        for (scope, handlers) in &told.scopes {
            line(flat(scope));
            if handlers.is_empty() {
                line("  its handlers are not told");
            }
            let row = |(handler, components): (&String, &Vec<String>)| {
                let all: Vec<_> = components.iter().map(|name| flat(name)).collect();
                let all = if all.is_empty() {
                    "its components are not told".to_owned()
                } else {
                    all.join(", ")
                };
                vec![format!("  {}", flat(handler)), all]
            };
            let rows: Vec<Vec<String>> = handlers.iter().map(row).collect();
            table(&rows).iter().for_each(line);
            let own = components.iter().filter(|it| it.scope == *scope);
            let rows: Vec<Vec<String>> = own.filter_map(explained).collect();
            table(&rows).iter().for_each(line);
        }
        let running = told.running.map(|running| running.len() + told.unread);
        line(match running {
            None => "It does not tell which tasks run.".to_owned(),
            Some(0) => "No task is running.".to_owned(),
            Some(1) => "1 task is running; `ztl ps` shows it.".to_owned(),
            Some(many) => format!("{many} tasks are running; `ztl ps` shows them."),
        });
        Ok(ExitCode::SUCCESS)
    }
}

/// What programs read.
#[derive(Serialize)]
struct Told<'a> {
    /// Where the server is, for `ztl check --descriptions`.
    endpoint: String,
    #[serde(flatten)]
    server: &'a Description,
    components: Vec<Written<'a>>,
}

#[derive(Serialize)]
struct Written<'a> {
    scope: &'a str,
    handler: &'a str,
    component: &'a str,
    is: Value,
    /// The goal as JSON Schema.
    schema: Value,
}

impl<'a> Written<'a> {
    fn of(it: &'a DescribedComponent) -> serde_json::Result<Self> {
        Ok(Self {
            scope: &it.scope,
            handler: &it.handler,
            component: &it.component,
            is: serde_json::from_str(&it.is.json().to_string())?,
            schema: serde_json::from_str(&it.is.goal.schema().to_string())?,
        })
    }
}

/// A row for people about a component; `None` if it says nothing of itself.
fn explained(it: &DescribedComponent) -> Option<Vec<String>> {
    let is = &it.is;
    let mut parts: Vec<String> = is.about.iter().map(|about| about.to_string()).collect();
    if !is.examples.is_empty() {
        parts.push(format!("for example {}", is.examples.join(" or ")));
    }
    parts.extend(is.result.iter().map(|result| format!("returns {result}")));
    if !is.streams.is_empty() {
        parts.push(format!("publishes {}", is.streams.join(", ")));
    }
    if let Some(ms) = is.usually_ms {
        let time = std::time::Duration::from_millis(ms.into());
        parts.push(format!("usually {}", humantime::format_duration(time)));
    }
    if !is.can_abort {
        parts.push("cannot be aborted".to_owned());
    }
    if parts.is_empty() && matches!(is.goal, GoalRule::Any) {
        return None;
    }
    let name = format!("    {}:{}", flat(&it.handler), flat(&it.component));
    let goal = is.goal.to_string();
    Some(vec![
        name,
        flat(&goal).into_owned(),
        flat(&parts.join("; ")).into_owned(),
    ])
}
