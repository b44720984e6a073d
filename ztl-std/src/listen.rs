//! Where a server listens, who may use it, and what it logs: the keys that every configuration file
//! has, whatever else it says.

use std::net::IpAddr;
use std::path::{Path, PathBuf};

use ipnet::IpNet;

use crate::files::is_stream;
use crate::server::{LIMITS, Limits};
use ztl_yaml::{Fields, Node, NodeValue, Reading};

/// What a configuration file says of it. All of it can be left out there, and said elsewhere.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Listen {
    /// Port to serve at; 0 is any free one.
    pub port: Option<u16>,
    /// Address to serve at; `*` is every one that this machine has.
    pub bind: Option<String>,
    /// Networks that clients must be in; none is every network.
    pub allow: Vec<IpNet>,
    /// The server's secret key, with which it encrypts.
    pub key: Option<PathBuf>,
    /// Clients that are allowed, as `--client-key` takes them: `[SCOPE=]FILE` or a directory.
    pub client_keys: Vec<String>,
    /// What the server allows at most.
    pub limits: Limits,
    /// What is logged.
    pub log: Option<tracing::Level>,
    /// How it is logged.
    pub log_format: Option<LogFormat>,
}

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LogFormat {
    /// `LEVEL:logger:text`, as the original's.
    #[default]
    Text,
    /// A JSON object a line.
    Json,
}

/// What a level is called in files and on the command line.
pub const LEVELS: [(&str, tracing::Level); 4] = [
    ("error", tracing::Level::ERROR),
    ("warn", tracing::Level::WARN),
    ("info", tracing::Level::INFO),
    ("debug", tracing::Level::DEBUG),
];

/// What a format is called there.
pub const LOG_FORMATS: [(&str, LogFormat); 2] =
    [("text", LogFormat::Text), ("json", LogFormat::Json)];

/// What a port is, for messages.
pub const PORT: &str = "a port, a whole number from 0 to 65535";

impl Listen {
    /// Takes its keys out of a file's; paths are relative to `base`.
    pub fn read<'d>(reading: &mut Reading<'d>, fields: &mut Fields<'d>, base: &Path) -> Self {
        let mut listen = Self::default();
        if let Some(node) = fields.optional("port") {
            listen.port = reading.whole(node, PORT);
        }
        if let Some(node) = fields.optional("bind") {
            let what = "an address of this machine, as 127.0.0.1, or '*' for every interface";
            listen.bind = reading.parsed(node, what, |text| {
                bind_mistake(text).map_or_else(|| Ok(text.to_owned()), Err)
            });
        }
        if let Some(node) = fields.optional("allow") {
            let what = "a network, as 192.168.1.0/24, or one address";
            for node in one_or_more(node) {
                let network = reading.parsed(node, what, |text| {
                    let one = || text.parse::<IpAddr>().map(IpNet::from);
                    let network = text.parse().or_else(|_| one());
                    network.map_err(|_| format!("'{text}' is not {what}"))
                });
                listen.allow.extend(network);
            }
        }
        if let Some(node) = fields.optional("key") {
            let what = "the file of the server's secret key";
            listen.key = reading.parsed(node, what, |text| file(base, text));
        }
        if let Some(node) = fields.optional("client-keys") {
            for node in one_or_more(node) {
                let what = "a client's key, as anna.key or /lab=anna.key";
                listen
                    .client_keys
                    .extend(reading.parsed(node, what, |text| {
                        let (scope, path) = match text.split_once('=') {
                            Some((scope, path)) => (format!("{scope}="), path),
                            None => (String::new(), text),
                        };
                        file(base, path).map(|path| format!("{scope}{}", path.display()))
                    }));
            }
            if listen.key.is_none() {
                reading.wrong(
                    node,
                    "clients have keys only where the server has one; write key: robot.key_secret",
                );
            }
        }
        if let Some(node) = fields.optional("limits") {
            listen.limits = limits(reading, node);
        }
        if let Some(node) = fields.optional("log") {
            listen.log = reading.one_of(node, &LEVELS);
        }
        if let Some(node) = fields.optional("log-format") {
            listen.log_format = reading.one_of(node, &LOG_FORMATS);
        }
        listen
    }
}

/// A file that a configuration names; a stream could not be read again at a reload.
fn file(base: &Path, text: &str) -> Result<PathBuf, String> {
    let path = base.join(text);
    match is_stream(&path) {
        true => Err(format!("'{text}' is not a regular file")),
        false => Ok(path),
    }
}

/// The limits that a file sets.
fn limits<'d>(reading: &mut Reading<'d>, node: &'d Node) -> Limits {
    let mut limits = Limits::default();
    let Some(mut fields) = reading.fields(node, "each limit and its value, as running: 100") else {
        return limits;
    };
    for (name, example) in LIMITS {
        if let Some(node) = fields.optional(name) {
            let what = format!("the limit, as {example}");
            reading.parsed(node, &what, |text| limits.choose(name, text));
        }
    }
    fields.finish(reading);
    limits
}

/// The items of a list, or a value that stands for a list of one.
#[must_use]
pub fn one_or_more(node: &Node) -> &[Node] {
    match &node.value {
        NodeValue::List(nodes) => nodes,
        _ => std::slice::from_ref(node),
    }
}

/// Why nothing can be served there, as far as it can be seen without trying.
#[must_use]
pub fn bind_mistake(bind: &str) -> Option<String> {
    let odd = |c: char| !(c.is_ascii_alphanumeric() || "*.-_:[]%".contains(c));
    (bind.is_empty() || bind.contains(odd) || bind.contains("//")).then(|| {
        format!(
            "'{bind}' is no address; use 127.0.0.1 for this machine only, or '*' for every interface"
        )
    })
}
