//! `ztl describe`: lists what a server offers.

use std::process::ExitCode;

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
        if self.format.is_chosen() {
            self.format.print(&told)?;
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
