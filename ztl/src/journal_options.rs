//! Options for the journal of `ztl gateway`.

use std::env;
use std::error::Error;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use ztl_std::gateway::config::JournalPlace;
use ztl_std::gateway::{Gateway, Journal, JournalError};
use ztl_yaml::Span;

use crate::listen_options::CheckFindings;
use crate::terminal::line;

#[derive(Debug, Clone, PartialEq, Eq, clap::Args)]
pub(crate) struct JournalOptions {
    /// File of the journal, or the directory for it (docs/journal.md) [default: in $STATE_DIRECTORY, else in $XDG_STATE_HOME/ztl, else in ~/.local/state/ztl]
    #[arg(long, value_name = "FILE|DIR", value_parser = file)]
    journal: Option<PathBuf>,

    /// Keep no journal: the outcomes of tasks are lost at a restart
    #[arg(long, conflicts_with_all = ["journal", "journal_sync"])]
    no_journal: bool,

    /// Sync each entry to the disk before acting on it, for machines that may lose power
    #[arg(long)]
    journal_sync: bool,
}

/// In the configuration file, these words mean that there is no journal.
fn file(text: &str) -> Result<PathBuf, String> {
    match text {
        "off" | "no" | "false" => Err(format!(
            "to keep no journal, give --no-journal; a file with this name is ./{text}"
        )),
        path => Ok(path.into()),
    }
}

/// Whether a gateway has a journal.
enum JournalChoice {
    At(PathBuf),
    /// `--no-journal`.
    NotWanted,
    /// The system chooses the port, so that the next start would not find the journal.
    AnyPort,
}

impl JournalOptions {
    /// Uses the configuration file where no option is given.
    pub(crate) fn or(mut self, place: Option<JournalPlace>) -> Self {
        if !self.is_given() {
            match place {
                Some(JournalPlace::At(path)) => self.journal = Some(path),
                Some(JournalPlace::Off) => self.no_journal = true,
                None => {}
            }
        }
        self
    }

    /// What these options mean for a gateway with this port and scope.
    fn choice(&self, port: u16, scope: &str) -> Result<JournalChoice, String> {
        if self.no_journal {
            return Ok(JournalChoice::NotWanted);
        }
        let path = match &self.journal {
            Some(path) if path.is_dir() || ends_as_directory(path) => path.join(name(port, scope)),
            Some(path) => path.clone(),
            // Another port after a restart has another journal.
            None if port == 0 => return Ok(JournalChoice::AnyPort),
            None => directory()
                .ok_or("no directory for the journal: neither STATE_DIRECTORY nor XDG_STATE_HOME nor HOME is set; give --journal FILE, or --no-journal")?
                .join(name(port, scope)),
        };
        Ok(JournalChoice::At(path))
    }

    /// Creates a gateway with this journal, and prints its path.
    pub(crate) fn gateway(&self, port: u16, scope: &str) -> Result<Gateway, Box<dyn Error>> {
        let why = match self.choice(port, scope)? {
            JournalChoice::At(path) => return self.open(&path),
            JournalChoice::NotWanted => "",
            JournalChoice::AnyPort => {
                ", as the port is another at each start (--journal FILE keeps one)"
            }
        };
        line(format_args!(
            "Without a journal{why}: after a restart, task ids and results are unknown, and running tasks are aborted."
        ));
        Ok(Gateway::new())
    }

    fn open(&self, path: &Path) -> Result<Gateway, Box<dyn Error>> {
        let journal = Journal::open(path, self.journal_sync).map_err(elsewhere)?;
        line(format_args!("Journal: {}", path.display()));
        Ok(Gateway::with_journal(journal))
    }

    /// Whether an option, and not the configuration file, says where the journal is.
    pub(crate) const fn is_given(&self) -> bool {
        self.journal.is_some() || self.no_journal
    }

    /// Checks the path of the journal, which may have a place in the configuration file. A journal in use by another
    /// gateway is only a note.
    pub(crate) fn check(
        &self,
        port: u16,
        scope: &str,
        place: Option<Span>,
        findings: &mut CheckFindings,
    ) {
        match self.choice(port, scope) {
            Ok(JournalChoice::At(path)) => match Journal::check(&path) {
                Ok(()) => {}
                Err(error @ JournalError::InUse { .. }) => findings.notes.push(error.to_string()),
                Err(error) => findings.wrong.push((place, elsewhere(error))),
            },
            Ok(JournalChoice::NotWanted | JournalChoice::AnyPort) => {}
            Err(error) => findings.wrong.push((place, error)),
        }
    }
}

fn elsewhere(error: JournalError) -> String {
    format!("{error} (--journal FILE, or --no-journal)")
}

/// Whether a path ends as that of a directory, which may not exist yet.
fn ends_as_directory(path: &Path) -> bool {
    let text = path.as_os_str().as_encoded_bytes();
    text.last()
        .is_some_and(|last| std::path::is_separator(char::from(*last)))
}

/// The default directory for journals.
pub(crate) fn directory() -> Option<PathBuf> {
    place(|variable| env::var_os(variable))
}

/// The service manager's directory, otherwise the user's.
fn place(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    if let Some(directories) = variable("STATE_DIRECTORY") {
        // There may be several, separated by ':'.
        let first = env::split_paths(&directories).next();
        if let Some(first) = first.filter(|first| first.is_absolute()) {
            return Some(first);
        }
    }
    let absolute = |name| {
        variable(name)
            .map(PathBuf::from)
            .filter(|path| path.is_absolute())
    };
    let state = absolute("XDG_STATE_HOME").or_else(|| Some(absolute("HOME")?.join(".local/state")));
    Some(state?.join("ztl"))
}

/// A file name that is unique on this machine: `gateway-12345-lab.jsonl` for port 12345 and scope /lab.
fn name(port: u16, scope: &str) -> String {
    let mut name = format!("gateway-{port}-");
    for byte in scope.strip_prefix('/').unwrap_or(scope).bytes() {
        if byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b'.') {
            name.push(char::from(byte));
        } else {
            // Writing to a string cannot fail.
            let _ = write!(name, "%{byte:02X}");
        }
    }
    // File systems allow 255 bytes, including suffixes.
    name.truncate(200);
    name.push_str(".jsonl");
    name
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(variables: &[(&str, &str)]) -> Option<PathBuf> {
        let value = |name: &str| variables.iter().find(|(known, _)| *known == name);
        place(|name| value(name).map(|(_, value)| OsString::from(value)))
    }

    #[test]
    fn the_service_managers_directory_comes_before_the_users() {
        let home = ("HOME", "/home/lab");
        let path = |path: &str| Some(PathBuf::from(path));
        assert_eq!(with(&[]), None);
        assert_eq!(with(&[("HOME", "")]), None);
        assert_eq!(with(&[home]), path("/home/lab/.local/state/ztl"));
        assert_eq!(
            with(&[home, ("XDG_STATE_HOME", "/state")]),
            path("/state/ztl")
        );
        assert_eq!(
            with(&[home, ("XDG_STATE_HOME", "not/absolute")]),
            path("/home/lab/.local/state/ztl")
        );
        assert_eq!(
            with(&[home, ("STATE_DIRECTORY", "/var/lib/ztl:/var/lib/other")]),
            path("/var/lib/ztl")
        );
    }

    #[test]
    fn each_port_and_scope_has_its_own_file() {
        assert_eq!(name(12345, "/lab"), "gateway-12345-lab.jsonl");
        assert_eq!(name(1, "/lab/arm"), "gateway-1-lab%2Farm.jsonl");
        assert_ne!(name(1, "/lab/arm"), name(1, "/lab-arm"));
        assert_eq!(name(1, "//"), "gateway-1-%2F.jsonl");
        assert!(name(1, &"ä".repeat(1000)).len() < 255);
    }
}
