//! Options for the server of a command: host and port, a name in the configuration file, or the environment.

use std::path::PathBuf;

use ztl_std::keys::KeyFiles;
use ztl_std::remotes::{NoRemote, usual_path};
use ztl_std::{Remotes, RequestError, host, scope};

use crate::exit::Misuse;
use crate::option_values::{port_to_reach, whole};

/// Options for the address of a server.
#[derive(Debug, clap::Args)]
pub(crate) struct AddressOptions {
    /// Host of the server with --port, otherwise its name in the configuration file
    /// [default: $ZTL_HOST, else localhost]
    #[arg(short, long, value_name = "HOST|NAME")]
    remote: Option<String>,

    /// Port of the server [default: $ZTL_PORT]
    #[arg(short, long, value_parser = port_to_reach)]
    port: Option<i64>,

    /// The configuration file [default: zmq-remotes.yaml in $XDG_CONFIG_HOME or ~/.config]
    #[arg(
        short,
        long,
        value_name = "FILE",
        requires = "remote",
        conflicts_with = "port"
    )]
    config: Option<PathBuf>,
}

/// The address of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ServerAddress {
    pub(crate) host: String,
    pub(crate) port: i64,
    /// The scope in the configuration file.
    pub(crate) scope: Option<String>,
    /// The keys in the configuration file.
    pub(crate) keys: Option<KeyFiles>,
}

/// The result of looking up a name in the configuration file.
enum Lookup {
    Found(ServerAddress),
    /// There is no such server; an error unless a port is given.
    Unknown(Misuse),
}

/// How to name a server.
const HOW: &str =
    "give --port, or --remote NAME for a server in the configuration file, or set ZTL_PORT";

impl AddressOptions {
    /// The address of the server; an error if there is none.
    pub(crate) fn resolve(&self) -> Result<ServerAddress, Misuse> {
        self.resolve_if_any()?
            .ok_or_else(|| Misuse(format!("no port: {HOW}")))
    }

    /// The address of the server, if options or environment have one.
    pub(crate) fn resolve_if_any(&self) -> Result<Option<ServerAddress>, Misuse> {
        let unknown = match (&self.remote, self.port) {
            (Some(name), None) => match self.named(name)? {
                Lookup::Found(place) => return Ok(Some(place)),
                Lookup::Unknown(why) => Some(host::mistake(name).map_or(why, Misuse)),
            },
            _ => None,
        };
        let given = match self.port {
            None if self.config.is_none() => port_variable()?,
            given => given,
        };
        let host = match &self.remote {
            Some(host) => Some(host.clone()),
            None => variable("ZTL_HOST")?,
        };
        match (given, unknown) {
            (Some(port), _) => Ok(Some(ServerAddress {
                host: host.unwrap_or_else(|| "localhost".to_owned()),
                port,
                scope: None,
                keys: None,
            })),
            (None, Some(unknown)) => Err(unknown),
            (None, None) if host.is_some() => Err(Misuse(format!("no port: {HOW}"))),
            (None, None) => Ok(None),
        }
    }

    /// Looks up a name in the configuration file.
    fn named(&self, name: &str) -> Result<Lookup, Misuse> {
        let path = self.config.clone().unwrap_or_else(usual_path);
        if self.config.is_none() && !path.exists() {
            let path = path.display();
            let mistake =
                format!("no port for host '{name}', and no {path} to look it up as a name: {HOW}");
            return Ok(Lookup::Unknown(Misuse(mistake)));
        }
        let remotes = Remotes::load(&path).map_err(|mistakes| Misuse(mistakes.to_string()))?;
        match remotes.task(name) {
            Ok(remote) => Ok(Lookup::Found(ServerAddress {
                host: remote.host.clone(),
                port: i64::from(remote.port),
                scope: Some(remote.scope.clone()),
                keys: remote.keys.clone(),
            })),
            Err(unknown @ NoRemote::Unknown { .. }) => {
                let mistake = format!("{unknown} (a host needs --port)");
                Ok(Lookup::Unknown(Misuse(mistake)))
            }
            Err(wrong) => Err(Misuse(wrong.to_string())),
        }
    }
}

impl ServerAddress {
    /// The scope of the option, otherwise of the configuration file, otherwise of the environment.
    pub(crate) fn scope(&self, option: Option<&String>) -> Result<Option<String>, Misuse> {
        let scope = match option.or(self.scope.as_ref()) {
            Some(scope) => Some(scope.clone()),
            None => variable("ZTL_SCOPE")?,
        };
        match scope.as_deref().and_then(scope::cannot_be_asked) {
            Some(mistake) => Err(Misuse(mistake)),
            None => Ok(scope),
        }
    }

    /// The ZeroMQ endpoint.
    pub(crate) fn endpoint(&self) -> String {
        format!("tcp://{}:{}", self.host, self.port)
    }
}

/// Why a client cannot be created: a mistake of the options, the environment or the configuration, or the system's error.
pub(crate) fn no_client(error: RequestError) -> Box<dyn std::error::Error> {
    match error {
        RequestError::Endpoint { why, .. } => Misuse(why).into(),
        error @ (RequestError::Scope(_) | RequestError::NoCurve) => Misuse::of(error).into(),
        error => error.into(),
    }
}

/// An environment variable; `None` if it is empty.
fn variable(name: &str) -> Result<Option<String>, Misuse> {
    let Some(value) = std::env::var_os(name).filter(|value| !value.is_empty()) else {
        return Ok(None);
    };
    let text = value.into_string();
    text.map(Some)
        .map_err(|value| Misuse(format!("invalid {name} {value:?}: expected UTF-8")))
}

fn port_variable() -> Result<Option<i64>, Misuse> {
    let Some(text) = variable("ZTL_PORT")? else {
        return Ok(None);
    };
    let port = whole::<u16>(&text).map(i64::from);
    let wrong = || Misuse(format!("invalid ZTL_PORT '{text}': expected 0 to 65535"));
    port.map(Some).ok_or_else(wrong)
}
