//! `ztl check`: what is wrong with a script, before the show.

use std::path::PathBuf;
use std::process::ExitCode;

use tracing::Level;
use ztl_std::script::{Defaults, Script, ask_all};

use crate::remote_task::Endpoints;
use crate::terminal::{line, part};
use crate::{Done, log};

#[derive(Debug, clap::Args)]
#[command(after_help = "Exit code: 0 if nothing was found, 1 otherwise.")]
pub(crate) struct Check {
    /// The script
    #[arg(value_name = "FILE")]
    script: PathBuf,

    #[command(flatten)]
    endpoints: Endpoints,

    /// Ask each server too whether it is there, and ours whether they would take the tasks
    #[arg(long)]
    live: bool,

    /// The defaults file that it will be played with
    #[arg(long, value_name = "FILE")]
    defaults: Option<PathBuf>,
}

impl Check {
    pub(crate) fn run(self) -> Done {
        log::init(Level::ERROR);
        // Without a configuration there are no names to check.
        let remotes = self
            .endpoints
            .is_given()
            .then(|| self.endpoints.read())
            .transpose()?;
        let mut defaults = Defaults::default();
        let mut mistakes = 0;
        if let Some(path) = &self.defaults {
            match Defaults::load(path) {
                Ok(read) => defaults = read,
                Err(found) => {
                    mistakes += found.iter().count();
                    part(found);
                }
            }
        }
        let (script, mut findings) = Script::check(&self.script, defaults);
        match (&script, &remotes) {
            (Some(script), Some(remotes)) => findings.extend(script.unknown_remotes(remotes)),
            (_, Some(_)) => {}
            (_, None) => line(format_args!(
                "No configuration at {}: the names of servers are not checked (-c FILE).",
                self.endpoints.path().display()
            )),
        }
        match (self.live, &script, &remotes) {
            (true, Some(script), Some(remotes)) => {
                let said = script.ask_servers(remotes);
                said.servers.iter().for_each(line);
                findings.extend(said.findings);
            }
            // Which of them the script uses cannot be told.
            (true, None, Some(remotes)) => ask_all(remotes).iter().for_each(line),
            _ => {}
        }
        findings.sort_by_key(|finding| finding.diagnostic().span.map(|span| span.start));
        for finding in &findings {
            let word = if finding.is_doubt() {
                "doubtful"
            } else {
                "mistake"
            };
            part(format_args!("{word}: {finding}"));
        }
        let doubts = findings.iter().filter(|finding| finding.is_doubt()).count();
        mistakes += findings.len() - doubts;
        line(summary(mistakes, doubts));
        Ok(ExitCode::from(u8::from(mistakes + doubts > 0)))
    }
}

fn summary(mistakes: usize, doubts: usize) -> String {
    let count = |count: usize, what: &str| match count {
        1 => format!("1 {what}"),
        count => format!("{count} {what}s"),
    };
    match (mistakes, doubts) {
        (0, 0) => "Nothing is wrong.".to_owned(),
        (0, doubts) => format!(
            "{}: it is played so, and was probably not meant so.",
            count(doubts, "doubtful place")
        ),
        (mistakes, 0) => format!("{}.", count(mistakes, "mistake")),
        (mistakes, doubts) => format!(
            "{}, {}.",
            count(mistakes, "mistake"),
            count(doubts, "doubtful place")
        ),
    }
}
