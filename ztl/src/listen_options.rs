//! Options of servers: where they listen, who may use them, and what they log.

use std::fmt;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use ipnet::IpNet;
use tracing::Level;
use ztl_std::keys::{KeyError, PublicKey};
use ztl_std::listen::{LEVELS, LOG_FORMATS, Listen, LogFormat, bind_mistake};
use ztl_std::{
    Access, BindError, Limits, Obstacle, RemoteTask, RequestError, ServerBuilder, TaskServer,
    Transport,
};
use ztl_yaml::{Diagnostics, closest};

use crate::connect_options::{TransportOption, own_keys};
use crate::exit::{Done, Misuse};
use crate::option_values::{one_of, port};
use crate::terminal::{error_line, line};

/// The exit code for a wrong configuration, after which a restart does not help.
pub(crate) const MISCONFIGURED: u8 = 2;

/// How long a check waits for who uses the port.
const PROBE: Duration = Duration::from_secs(1);

/// A mistake in the configuration.
#[derive(Debug)]
pub(crate) enum ConfigError {
    File(Diagnostics),
    Whole(String),
}

impl ConfigError {
    /// A value is missing in the options and the file.
    pub(crate) fn missing(file: Option<&str>, what: &str, option: &str, key: &str) -> Self {
        let key = match file {
            Some(file) => format!("`{key}` in {file}"),
            None => format!("a configuration file (docs/gateway.md) with `{key}`"),
        };
        Self::Whole(format!("no {what}: give {option}, or {key}"))
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            // Editors expect the place first in the line.
            Self::File(mistakes) => f.write_str(mistakes.to_string().trim_end()),
            Self::Whole(mistake) => write!(f, "ztl: {mistake}"),
        }
    }
}

/// Where a server listens, who may use it, and what it logs.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct ListenOptions {
    /// Port to serve at
    #[arg(short, long, value_parser = port)]
    port: Option<u16>,

    /// Address to serve at; '*' is every interface of this machine [default: 127.0.0.1]
    #[arg(long, value_name = "ADDR", value_parser = bind)]
    bind: Option<String>,

    /// Publish what happens to tasks, readings and streams at this port for ZeroMQ subscribers (docs/streams.md)
    #[arg(long, value_name = "PORT", value_parser = port)]
    publish: Option<u16>,

    #[command(flatten)]
    access: AccessOptions,

    #[command(flatten)]
    limits: LimitOptions,

    #[command(flatten)]
    transport: TransportOption,

    /// Log level: error, warn, info or debug [default: info]
    #[arg(long, value_name = "LEVEL", value_parser = level)]
    log: Option<Level>,

    /// Log format: text, or json (an object a line) [default: text]
    #[arg(long, value_name = "FORMAT", value_parser = log_format)]
    log_format: Option<LogFormat>,
}

pub(crate) fn bind(text: &str) -> Result<String, String> {
    bind_mistake(text).map_or_else(|| Ok(text.to_owned()), Err)
}

fn level(text: &str) -> Result<Level, String> {
    one_of(text, &LEVELS)
}

pub(crate) fn log_format(text: &str) -> Result<LogFormat, String> {
    one_of(text, &LOG_FORMATS)
}

impl ListenOptions {
    /// The files in the options.
    pub(crate) fn files(&self) -> impl Iterator<Item = &Path> {
        let clients = self.access.client_key.iter().map(|client| {
            let path = client
                .split_once('=')
                .map_or(client.as_str(), |(_, path)| path);
            Path::new(path)
        });
        self.access.key.iter().map(PathBuf::as_path).chain(clients)
    }

    /// Combines the options with the file. Options override the file, except that networks and clients are added.
    /// `None` if neither has a port.
    pub(crate) fn with(self, file: Listen) -> Result<Option<ListenPlace>, ConfigError> {
        let mut access = self.access;
        access.allow.extend(file.allow);
        access.client_key.extend(file.client_keys);
        access.key = access.key.or(file.key);
        if access.key.is_none()
            && let Some(mistake) = file.keyless
        {
            return Err(ConfigError::File(mistake.into()));
        }
        let Some(port) = self.port.or(file.port) else {
            return Ok(None);
        };
        let publish = self.publish.or(file.publish);
        if publish == Some(port) && port != 0 {
            let mistake = format!("port {port} is for tasks; publish at another port");
            return Err(ConfigError::Whole(mistake));
        }
        let (access, warnings) = access.access().map_err(ConfigError::Whole)?;
        Ok(Some(ListenPlace {
            limits: self.limits.over(file.limits),
            transport: self.transport.get().map_err(ConfigError::Whole)?,
            port,
            publish,
            bind: self.bind.or(file.bind).unwrap_or("127.0.0.1".to_owned()),
            access,
            warnings,
            log: self.log.or(file.log).unwrap_or(Level::INFO),
            log_format: self.log_format.or(file.log_format).unwrap_or_default(),
        }))
    }
}

/// Where a server listens, for whom, and what it logs.
pub(crate) struct ListenPlace {
    pub(crate) port: u16,
    /// Where events of tasks and readings are published, if they are.
    pub(crate) publish: Option<u16>,
    pub(crate) bind: String,
    pub(crate) access: Access,
    /// What may not be intended in the options for `access`.
    warnings: Vec<String>,
    pub(crate) limits: Limits,
    pub(crate) transport: Transport,
    pub(crate) log: Level,
    pub(crate) log_format: LogFormat,
}

impl ListenPlace {
    /// Who can reach the server, for people.
    pub(crate) fn reachable(&self) -> String {
        self.access.reachable_at(&self.bind)
    }

    /// What keeps clients with keys out of a server with these scopes, and may not be intended.
    pub(crate) fn warnings(&self, scopes: &[&str]) -> Vec<String> {
        let mut warnings = self.warnings.clone();
        if self.access.admits_nobody() {
            warnings.push(
                "no client's key is allowed, so no client can connect; give --client-key (in a file, client-keys)"
                    .to_owned(),
            );
        }
        // A client may be allowed only to ask what the server is.
        let scopes_of_keys = self.access.named_scopes().filter(|scope| *scope != "$ztl");
        for scope in scopes_of_keys.filter(|scope| !scopes.contains(scope)) {
            let help = match closest(scope, scopes.iter().copied()) {
                Some(meant) => format!("did you mean '{meant}'?"),
                None => format!("there are: {}", scopes.join(", ")),
            };
            warnings.push(format!(
                "client keys are allowed at scope '{scope}', which is not served; {help}"
            ));
        }
        warnings
    }

    /// Checks whether a server could listen and publish here. Ports that a ZTL server uses are only noted, since it may be the
    /// one of this configuration.
    pub(crate) fn check(&self) -> CheckFindings {
        let mut findings = CheckFindings::default();
        let ports = [Some(self.port), self.publish].into_iter().flatten();
        let mut is_served = None;
        for port in ports {
            let tried = self.builder().check(&self.bind, port);
            match tried {
                Ok(()) => {}
                Err(error @ BindError::InUse { .. })
                    if *is_served.get_or_insert_with(|| self.is_served()) =>
                {
                    findings.notes.push(error.to_string());
                }
                Err(error) => {
                    findings.wrong.push(error.to_string());
                    break;
                }
            }
        }
        findings
    }

    /// Whether a ZTL server has the port for tasks, also one that does not let us connect.
    fn is_served(&self) -> bool {
        let host = match self.bind.as_str() {
            "*" | "0.0.0.0" | "::" | "[::]" => "localhost",
            host => host,
        };
        let remote = RemoteTask::connect(&format!("tcp://{host}:{}", self.port), "$ztl");
        let Ok(remote) = remote else {
            return false;
        };
        match remote.with_timeout(PROBE).server_info(true) {
            Ok(server) => server.is_some(),
            Err(RequestError::NotConnected { obstacle, .. }) => matches!(
                obstacle,
                Some(Obstacle::PeerEncrypts | Obstacle::NotAdmitted | Obstacle::KeyNotAdmitted)
            ),
            Err(_) => false,
        }
    }

    /// Starts to listen.
    pub(crate) fn listen(&self) -> Result<TaskServer, BindError> {
        let endpoint = format!("tcp://{}:{}", self.bind, self.port);
        self.builder().bind(&endpoint)
    }

    /// The endpoint to publish at.
    pub(crate) fn publish_endpoint(&self) -> Option<String> {
        let port = self.publish?;
        Some(format!("tcp://{}:{port}", self.bind))
    }

    fn builder(&self) -> ServerBuilder {
        TaskServer::builder()
            .access(self.access.clone())
            .limits(self.limits)
            .transport(self.transport)
    }
}

/// The result of a check without mistakes.
pub(crate) fn verdict(warnings: usize) -> String {
    match warnings {
        0 => "Nothing is wrong".to_owned(),
        1 => "Nothing is wrong except a warning".to_owned(),
        many => format!("Nothing is wrong except {many} warnings"),
    }
}

/// What a check has found.
#[derive(Default)]
pub(crate) struct CheckFindings {
    /// Errors at the start.
    pub(crate) wrong: Vec<String>,
    /// Errors that are expected while the same server runs.
    pub(crate) notes: Vec<String>,
}

impl CheckFindings {
    /// Prints the findings; `right` if there are no errors.
    pub(crate) fn tell(self, right: impl fmt::Display) -> Done {
        for wrong in &self.wrong {
            error_line(format_args!("ztl: {wrong}"));
        }
        for note in &self.notes {
            error_line(format_args!("ztl: note: {note}"));
        }
        if !self.wrong.is_empty() {
            return Ok(ExitCode::FAILURE);
        }
        line(right);
        Ok(ExitCode::SUCCESS)
    }
}

/// Options for the limits of a server.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct LimitOptions {
    /// A limit of the server, such as running=100 (repeatable; docs/limits.md)
    #[arg(long, value_name = "NAME=VALUE", value_parser = bound)]
    limit: Vec<(String, String)>,
}

fn bound(text: &str) -> Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("write a limit as running=100")?;
    Limits::default().choose(name, value)?;
    Ok((name.to_owned(), value.to_owned()))
}

impl LimitOptions {
    /// Overrides these limits.
    pub(crate) fn over(&self, mut limits: Limits) -> Limits {
        for (name, value) in &self.limit {
            // Checked when the option was parsed.
            let _ = limits.choose(name, value);
        }
        limits
    }
}

/// Options for who may use a server.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct AccessOptions {
    /// Allow only clients in this network, such as 192.168.1.0/24 (repeatable)
    #[arg(long, value_name = "NETWORK", value_parser = network)]
    allow: Vec<IpNet>,

    /// The server's secret key: encrypts, and only allowed clients can connect (see `ztl keys`)
    #[arg(long, value_name = "NAME.key_secret")]
    key: Option<PathBuf>,

    /// Allow a client by its key, or a directory of keys; with SCOPE=, only at that scope (repeatable)
    #[arg(long, value_name = "[SCOPE=]NAME.key")]
    client_key: Vec<String>,
}

fn network(text: &str) -> Result<IpNet, &'static str> {
    let one = text.parse::<IpAddr>().map(IpNet::from);
    text.parse()
        .or(one)
        .map_err(|_| "write a network as 192.168.1.0/24, one address as 192.168.1.7")
}

impl AccessOptions {
    /// Who may subscribe to a publisher. Warns of what may not be intended.
    pub(crate) fn of_publisher(&self) -> Result<Access, Misuse> {
        let (access, warnings) = self.access().map_err(Misuse)?;
        for warning in warnings {
            error_line(format_args!("ztl: warning: {warning}"));
        }
        Ok(access)
    }

    /// Reads the keys. Also returns what may not be intended.
    fn access(&self) -> Result<(Access, Vec<String>), String> {
        if self.key.is_none()
            && let Some(client) = self.client_key.first()
        {
            return Err(format!(
                "--client-key {client}: clients can have keys only if the server has one; give --key, or `key` in a configuration file"
            ));
        }
        let wrong = |mistake: KeyError| mistake.to_string();
        let mut access = Access::everybody();
        let mut warnings = Vec::new();
        for network in &self.allow {
            access = access.from_network(*network);
        }
        if let Some(path) = &self.key {
            access = access.with_keys(own_keys(path).map_err(wrong)?);
        }
        for client in &self.client_key {
            let (scope, path) = match client.split_once('=') {
                Some((scope, path)) => (Some(scope), path),
                None => (None, client.as_str()),
            };
            let keys = PublicKey::read_all(Path::new(path)).map_err(wrong)?;
            if keys.is_empty() {
                warnings.push(format!("{path}: there is no *.key in this directory"));
            }
            for key in keys {
                access = match scope {
                    Some(scope) => access.allow_scope(scope, key),
                    None => access.allow(key),
                };
            }
        }
        Ok((access, warnings))
    }
}
