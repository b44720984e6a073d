//! Options of servers: where they listen, who may use them, and what they log.

use std::fmt;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use ipnet::IpNet;
use tracing::Level;
use ztl_std::keys::PublicKey;
use ztl_std::listen::{LEVELS, LOG_FORMATS, Listen, LogFormat, bind_mistake, one_or_more};
use ztl_std::{
    Access, BindError, Limits, Obstacle, RemoteTask, RequestError, ServerBuilder, TaskServer,
    Transport,
};
use ztl_yaml::{Span, closest};

use crate::config_file::ConfigFile;
use crate::connect_options::{TransportOption, own_keys};
use crate::exit::{Done, Misuse};
use crate::option_values::{one_of, port};
use crate::terminal::{error_line, line};

/// The exit code for a wrong configuration, after which a restart does not help.
pub(crate) const MISCONFIGURED: u8 = 2;

/// How long a check waits for who uses the port.
const PROBE: Duration = Duration::from_secs(1);

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
    /// What is wrong is added to `file`; what is returned is only for a check then.
    pub(crate) fn with(self, listen: Listen, file: &mut ConfigFile) -> ListenPlace {
        // The place of a value, if it is the file's.
        let at = |given: bool, key| file.place(&[key]).filter(|_| !given);
        let places = Places {
            port: at(self.port.is_some(), "port"),
            publish: at(self.publish.is_some(), "publish"),
            bind: at(self.bind.is_some(), "bind"),
        };
        let port = self.port.or(listen.port);
        if port.is_none() {
            file.missing("port", "--port <PORT>", "port: 12345");
        }
        let port = port.unwrap_or_default();
        let publish = self.publish.or(listen.publish);
        if publish == Some(port) && port != 0 {
            let mistake = format!("port {port} is for tasks; publish at another port");
            file.wrong(places.publish, mistake);
        }
        let (access, warnings) = self.access.with(&listen, file);
        let transport = self.transport.get().unwrap_or_else(|mistake| {
            file.wrong(None, mistake);
            Transport::default()
        });
        ListenPlace {
            limits: self.limits.over(listen.limits),
            transport,
            port,
            publish,
            bind: self.bind.or(listen.bind).unwrap_or("127.0.0.1".to_owned()),
            places,
            access,
            warnings,
            log: self.log.or(listen.log).unwrap_or(Level::INFO),
            log_format: self.log_format.or(listen.log_format).unwrap_or_default(),
        }
    }
}

/// The places of values in the configuration file, if they are from there.
struct Places {
    port: Option<Span>,
    publish: Option<Span>,
    bind: Option<Span>,
}

/// Where a server listens, for whom, and what it logs.
pub(crate) struct ListenPlace {
    pub(crate) port: u16,
    /// Where events of tasks and readings are published, if they are.
    pub(crate) publish: Option<u16>,
    pub(crate) bind: String,
    places: Places,
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
        let ports = [
            (Some(self.port), self.places.port),
            (self.publish, self.places.publish),
        ];
        let mut is_served = None;
        for (port, place) in ports {
            let Some(port) = port else { continue };
            let tried = self.builder().check(&self.bind, port);
            match tried {
                Ok(()) => {}
                Err(error @ BindError::InUse { .. })
                    if *is_served.get_or_insert_with(|| self.is_served()) =>
                {
                    findings.notes.push(error.to_string());
                }
                Err(error @ BindError::InUse { .. }) => {
                    findings.wrong.push((place, error.to_string()));
                }
                Err(error) => {
                    findings.wrong.push((self.places.bind, error.to_string()));
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
    /// Errors at the start, and their places in the file.
    pub(crate) wrong: Vec<(Option<Span>, String)>,
    /// Errors that are expected while the same server runs.
    pub(crate) notes: Vec<String>,
}

impl CheckFindings {
    /// Prints the findings together with what is wrong in the configuration; `right` if there are no errors.
    pub(crate) fn tell(self, mut file: ConfigFile, right: impl fmt::Display) -> Done {
        let code = match file.is_wrong() {
            true => ExitCode::from(MISCONFIGURED),
            false => ExitCode::FAILURE,
        };
        for (place, wrong) in self.wrong {
            file.wrong(place, wrong);
        }
        let wrong = file.finish();
        if let Err(wrong) = &wrong {
            error_line(wrong);
        }
        for note in &self.notes {
            error_line(format_args!("ztl: note: {note}"));
        }
        if wrong.is_err() {
            return Ok(code);
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
        let mut mistakes = Vec::new();
        let own = self.key.as_deref().map(|path| (path, None));
        let clients = self.client_key.iter().map(|client| (client.as_str(), None));
        let wrong = &mut |_, mistake| mistakes.push(mistake);
        let (access, warnings) = access(&self.allow, own, clients, wrong);
        mistakes.extend(self.keyless(own.is_some()));
        if let Some(mistake) = mistakes.into_iter().next() {
            return Err(Misuse(mistake));
        }
        for warning in warnings {
            error_line(format_args!("ztl: warning: {warning}"));
        }
        Ok(access)
    }

    /// Combines the options with the file. Adds to `file` what is wrong. Also returns what may not be intended.
    fn with(&self, listen: &Listen, file: &mut ConfigFile) -> (Access, Vec<String>) {
        let allow: Vec<IpNet> = self.allow.iter().chain(&listen.allow).copied().collect();
        let key = self.key.as_deref().map(|path| (path, None));
        let of_file = listen.key.as_deref();
        let own = key.or(of_file.map(|path| (path, file.place(&["key"]))));
        if own.is_none() {
            file.add(listen.keyless.clone());
        }
        if let Some(mistake) = self.keyless(own.is_some()) {
            file.wrong(None, mistake);
        }
        let list = file.value(&["client-keys"]);
        let nodes = list.map(one_or_more).unwrap_or_default();
        let places: Vec<Option<Span>> = match nodes.len() == listen.client_keys.len() {
            true => nodes.iter().map(|node| Some(node.span)).collect(),
            // One of them was not read.
            false => vec![list.map(|node| node.span); listen.client_keys.len()],
        };
        let options = self.client_key.iter().map(|client| (client.as_str(), None));
        let of_file = listen.client_keys.iter().map(String::as_str).zip(places);
        access(
            &allow,
            own,
            options.chain(of_file),
            &mut |place, mistake| {
                file.wrong(place, mistake);
            },
        )
    }

    /// The mistake that there are keys of clients, and the server has none.
    fn keyless(&self, has_key: bool) -> Option<String> {
        let client = self.client_key.first().filter(|_| !has_key)?;
        Some(format!(
            "--client-key {client}: clients can have keys only if the server has one; give --key, or `key` in a configuration file"
        ))
    }
}

/// Reads the keys, each of which may have a place in the configuration file. Also returns what may not be intended.
fn access<'k>(
    allow: &[IpNet],
    own: Option<(&Path, Option<Span>)>,
    clients: impl Iterator<Item = (&'k str, Option<Span>)>,
    wrong: &mut dyn FnMut(Option<Span>, String),
) -> (Access, Vec<String>) {
    let mut access = Access::everybody();
    let mut warnings = Vec::new();
    for network in allow {
        access = access.from_network(*network);
    }
    if let Some((path, place)) = own {
        match own_keys(path) {
            Ok(keys) => access = access.with_keys(keys),
            Err(mistake) => wrong(place, mistake.to_string()),
        }
    }
    for (client, place) in clients {
        let (scope, path) = match client.split_once('=') {
            Some((scope, path)) => (Some(scope), path),
            None => (None, client),
        };
        let keys = match PublicKey::read_all(Path::new(path)) {
            Ok(keys) => keys,
            Err(mistake) => {
                wrong(place, mistake.to_string());
                continue;
            }
        };
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
    (access, warnings)
}
