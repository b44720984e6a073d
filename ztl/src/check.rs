//! `ztl check`: finds mistakes in a script.

use std::path::PathBuf;
use std::process::ExitCode;

use tracing::Level;
use ztl_script::{Defaults, Finding, Script, check_servers};
use ztl_std::{Remotes, SavedDescription};
use ztl_yaml::Diagnostics;

use crate::connect_options::ConnectOptions;
use crate::exit::{Done, Misuse};
use crate::log;
use crate::remotes_options::RemotesOptions;
use crate::server_connection::connect_once;
use crate::terminal::{line, part};

#[derive(Debug, clap::Args)]
#[command(after_help = "Exit code: 0 if nothing was found, 1 otherwise.")]
pub(crate) struct Check {
    /// The script
    #[arg(value_name = "FILE")]
    script: PathBuf,

    #[command(flatten)]
    endpoints: RemotesOptions,

    #[command(flatten)]
    connecting: ConnectOptions,

    /// Ask each server whether it is reachable, and servers of this project whether they accept the tasks
    #[arg(long)]
    live: bool,

    /// Check the tasks against what servers said of themselves: files that `ztl describe --json` wrote (repeatable)
    #[arg(long, value_name = "FILE", conflicts_with = "live")]
    descriptions: Vec<PathBuf>,

    /// The defaults file of `ztl run-script`
    #[arg(long, value_name = "FILE")]
    defaults: Option<PathBuf>,
}

impl Check {
    pub(crate) fn run(self) -> Done {
        log::init(Level::ERROR);
        let mut findings = Vec::new();
        let remotes = match self.remotes(&mut findings) {
            Some(remotes) => Some(self.endpoints.added_to(remotes)?),
            None => None,
        };
        if remotes.is_none() && !self.descriptions.is_empty() {
            let needed = "--descriptions needs the configuration, which names the scope of each server (-c FILE)";
            return Err(Misuse::of(needed).into());
        }
        let defaults = self.defaults.as_deref().map(Defaults::load);
        let defaults = defaults.and_then(|read| taken(read, &mut findings));
        let (script, found) = Script::check(&self.script, defaults.unwrap_or_default());
        findings.extend(found);
        if let Some(remotes) = &remotes {
            let connect = |name: &str| connect_once(remotes, &self.connecting, name);
            if let Some(script) = &script {
                for unknown in script.unknown_remotes(remotes) {
                    add_unknown(unknown, &mut findings);
                }
            }
            // Also entries that the script does not use: their owner may believe that they are encrypted.
            for wrong in remotes.mistakes().flatten().cloned() {
                let wrong = Finding::mistake(wrong);
                if !findings.contains(&wrong) {
                    findings.push(wrong);
                }
            }
            match (self.live, &script) {
                (true, Some(script)) => {
                    let live = script.check_live(remotes, &connect);
                    live.servers.iter().for_each(line);
                    findings.extend(live.findings);
                }
                // The script is unreadable, so all servers are asked.
                (true, None) => check_servers(remotes, &connect).iter().for_each(line),
                (false, Some(script)) if !self.descriptions.is_empty() => {
                    let mut saved = Vec::new();
                    for path in &self.descriptions {
                        if let Some(told) = taken(SavedDescription::load(path), &mut findings) {
                            saved.push((path.clone(), told));
                        }
                    }
                    let described = script.check_described(remotes, &saved);
                    described.servers.iter().for_each(line);
                    findings.extend(described.findings);
                }
                (false, _) => {}
            }
        }
        findings.sort_by_cached_key(|finding| {
            let found = finding.diagnostic();
            (found.file.clone(), found.span.map(|span| span.start))
        });
        for finding in &findings {
            let word = if finding.is_doubt() {
                "doubtful"
            } else {
                "mistake"
            };
            part(format_args!("{word}: {finding}"));
        }
        let doubts = findings.iter().filter(|finding| finding.is_doubt()).count();
        let mistakes = findings.len() - doubts;
        line(summary(mistakes, doubts));
        Ok(ExitCode::from(u8::from(mistakes + doubts > 0)))
    }

    /// The configuration, to check names of servers, as far as it can be read.
    fn remotes(&self, findings: &mut Vec<Finding>) -> Option<Remotes> {
        let path = self.endpoints.path();
        if self.endpoints.has_file() {
            let (remotes, mistakes) = Remotes::check(&path);
            findings.extend(mistakes.into_iter().map(Finding::mistake));
            return remotes;
        }
        if self.endpoints.is_given() {
            return Some(Remotes::named("the options"));
        }
        line(format_args!(
            "No configuration at {}: the names of servers are not checked (-c FILE).",
            path.display()
        ));
        None
    }
}

/// Adds the finding for a name without a server. If the parentheses in its key are doubtful, they are the
/// cause, and become a mistake instead.
fn add_unknown(unknown: Finding, findings: &mut Vec<Finding>) {
    let key = unknown.diagnostic().span;
    let is_cause = |found: &&mut Finding| {
        let span = found.diagnostic().span;
        let inside = key
            .zip(span)
            .is_some_and(|(key, part)| key.start < part.start && part.start < key.end);
        inside && found.diagnostic().file == unknown.diagnostic().file
    };
    match findings.iter_mut().find(is_cause) {
        Some(cause) => *cause = Finding::mistake(cause.diagnostic().clone()),
        None => findings.push(unknown),
    }
}

/// The value, or `None` after adding the mistakes.
fn taken<T>(read: Result<T, Diagnostics>, findings: &mut Vec<Finding>) -> Option<T> {
    match read {
        Ok(read) => Some(read),
        Err(mistakes) => {
            findings.extend(mistakes.into_iter().map(Finding::mistake));
            None
        }
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
            "{}: it will be played as written, which is probably not intended.",
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
