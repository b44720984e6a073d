//! Options for named servers and publishers.

use std::path::PathBuf;

use tracing::warn;
use ztl_std::remotes::{Remote, usual_path};
use ztl_std::{Remotes, scope};

use crate::exit::Misuse;
use crate::option_values::port;
use crate::terminal::error_part;

/// The original's logger.
const LOG: &str = "remote-config";

/// Options for the servers and publishers that have names.
#[derive(Debug, clap::Args)]
pub(crate) struct RemotesOptions {
    /// The configuration file [default: zmq-remotes.yaml in $XDG_CONFIG_HOME or ~/.config]
    #[arg(short, long)]
    config: Option<PathBuf>,

    /// Add or replace a server (repeatable)
    #[arg(long, num_args = 4, allow_negative_numbers = true, value_names = ["NAME", "HOST", "PORT", "SCOPE"])]
    task: Vec<String>,

    /// Add or replace a publisher (repeatable)
    #[arg(long, num_args = 4, allow_negative_numbers = true, value_names = ["NAME", "HOST", "PORT", "SCOPE"])]
    publisher: Vec<String>,
}

impl RemotesOptions {
    /// The given configuration file, or the default.
    pub(crate) fn path(&self) -> PathBuf {
        self.config.clone().unwrap_or_else(usual_path)
    }

    /// Whether the options name servers, or there is a configuration file.
    pub(crate) fn is_given(&self) -> bool {
        !self.task.is_empty() || self.has_file()
    }

    /// Whether a configuration file is given, or the default exists.
    pub(crate) fn has_file(&self) -> bool {
        self.config.is_some() || self.path().exists()
    }

    /// Reads the file and adds the options. If the file cannot be read, warns and continues, like the original.
    pub(crate) fn read(&self) -> Result<Remotes, Misuse> {
        let path = self.path();
        let remotes = Remotes::load(&path).unwrap_or_else(|mistakes| {
            let path = path.display();
            warn!(target: LOG, "WARNING: Configuration file '{path}' not found/accessible, remote services will not be accessible.");
            error_part(&mistakes);
            Remotes::not_read(&path.to_string(), mistakes)
        });
        self.added_to(remotes)
    }

    /// Adds the servers and publishers of the options.
    pub(crate) fn added_to(&self, mut remotes: Remotes) -> Result<Remotes, Misuse> {
        for words in self.task.chunks(4) {
            let (name, remote) = endpoint(words)?;
            remotes.set_task(name, remote);
        }
        for words in self.publisher.chunks(4) {
            let (name, publisher) = endpoint(words)?;
            remotes.set_publisher(name, publisher);
        }
        Ok(remotes)
    }
}

/// Parses NAME HOST PORT SCOPE.
fn endpoint(words: &[String]) -> Result<(&str, Remote), Misuse> {
    let [name, host, given, scope] = words else {
        return Err(Misuse::of("an endpoint is NAME HOST PORT SCOPE"));
    };
    if let Some(mistake) = scope::cannot_be_asked(scope) {
        return Err(Misuse(mistake));
    }
    let remote = Remote {
        host: host.clone(),
        port: port(given).map_err(|wrong| Misuse(format!("'{given}': {wrong}")))?,
        scope: scope.clone(),
        keys: None,
    };
    Ok((name, remote))
}
