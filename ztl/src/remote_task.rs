//! `ztl remote-task`: a task on a server that the configuration names, with the original's options
//! and output (wire specification 7.3).

use std::path::PathBuf;

use tracing::{Level, info, warn};
use ztl_std::Remotes;
use ztl_std::remotes::{Remote, usual_path};
use ztl_std::scope;

use crate::conversation::{AFTER_HELP, Conversation, Target, Telling, Words};
use crate::exit::Done;
use crate::reach::Identity;
use crate::terminal::error_part;
use crate::tool::{Called, port, seconds, specification};
use crate::{log, signals};

/// Name under which the original logs.
const LOG: &str = "remote-config";

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct RemoteTask {
    /// Seconds to wait for the task to end before it is aborted; 0 or less waits for ever
    #[arg(short, long, default_value_t = -1, allow_negative_numbers = true, value_parser = seconds)]
    timeout: i64,

    #[command(flatten)]
    endpoints: Endpoints,

    #[command(flatten)]
    telling: Telling,

    #[command(flatten)]
    identity: Identity,

    /// The server, by its name in the configuration
    remote: String,

    /// The task: handler, component and goal separated by ':', e.g. 'handler:component:goal'
    payload: String,
}

/// Where the servers and publishers are that have names.
#[derive(Debug, clap::Args)]
pub(crate) struct Endpoints {
    /// The configuration file [default: zmq-remotes.yaml in $XDG_CONFIG_HOME or ~/.config]
    #[arg(short, long)]
    config: Option<PathBuf>,

    /// Add or replace a server (repeatable)
    #[arg(long, num_args = 4, value_names = ["NAME", "HOST", "PORT", "SCOPE"])]
    task: Vec<String>,

    /// Add or replace a publisher (repeatable)
    #[arg(long, num_args = 4, value_names = ["NAME", "HOST", "PORT", "SCOPE"])]
    publisher: Vec<String>,
}

impl Endpoints {
    /// The configuration file, named or the usual one.
    pub(crate) fn path(&self) -> PathBuf {
        self.config.clone().unwrap_or_else(usual_path)
    }

    /// Whether the options say where servers are, or the usual file is there.
    pub(crate) fn is_given(&self) -> bool {
        !self.task.is_empty() || self.has_file()
    }

    /// Whether a file is named, or the usual one is there.
    pub(crate) fn has_file(&self) -> bool {
        self.config.is_some() || self.path().exists()
    }

    /// Reads the file, and adds what the options say. Without the file there is only that, with a
    /// warning, as the original does.
    pub(crate) fn read(&self) -> Result<Remotes, Box<dyn std::error::Error>> {
        let path = self.path();
        let remotes = Remotes::load(&path).unwrap_or_else(|mistakes| {
            let path = path.display();
            warn!(target: LOG, "WARNING: Configuration file '{path}' not found/accessible, remote services will not be accessible.");
            error_part(mistakes);
            Remotes::named(&path.to_string())
        });
        self.added_to(remotes)
    }

    /// Adds what the options say.
    pub(crate) fn added_to(
        &self,
        mut remotes: Remotes,
    ) -> Result<Remotes, Box<dyn std::error::Error>> {
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

/// NAME HOST PORT SCOPE.
fn endpoint(words: &[String]) -> Result<(&str, Remote), Box<dyn std::error::Error>> {
    let [name, host, given, scope] = words else {
        return Err("an endpoint is NAME HOST PORT SCOPE".into());
    };
    if let Some(mistake) = scope::cannot_be_asked(scope) {
        return Err(mistake.into());
    }
    let remote = Remote {
        host: host.clone(),
        port: port(given).map_err(|wrong| format!("'{given}': {wrong}"))?,
        scope: scope.clone(),
    };
    Ok((name, remote))
}

impl RemoteTask {
    pub(crate) fn run(self, called: &Called) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        let remotes = self.endpoints.read()?;
        let request = match specification(&self.payload, called, "remote-task") {
            Ok(request) => request,
            Err(code) => return Ok(code),
        };
        let name = &self.remote;
        let Remote { host, port, scope } = remotes.task(name)?;
        info!(target: LOG, "Initialising remote task interface '{name}'...");
        let conversation = Conversation {
            target: Target {
                host,
                port: i64::from(*port),
                scope,
            },
            request: &request,
            words: Words::RemoteTask(self.timeout),
            as_original: called.is_original(),
            telling: &self.telling,
        };
        conversation.run(|remote| self.identity.apply(remote))
    }
}
