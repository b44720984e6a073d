//! The part of a configuration file that every server has: where it listens, who may use it, its limits and its log.

use std::net::IpAddr;
use std::path::{Path, PathBuf};

use ipnet::IpNet;

use crate::files::is_stream;
use crate::server::{LIMITS, Limits};
use ztl_yaml::{Diagnostic, Fields, Node, NodeValue, Reading};

/// These settings. Each can be left out of the file and be given elsewhere.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Listen {
    /// Port; 0 means any free one.
    pub port: Option<u16>,
    /// Address; `*` means every interface of this machine.
    pub bind: Option<String>,
    /// Port at which events of tasks and readings are published, if they are.
    pub publish: Option<u16>,
    /// Networks of clients; if empty, every network.
    pub allow: Vec<IpNet>,
    /// File of the server's secret key, if it encrypts.
    pub key: Option<PathBuf>,
    /// Allowed clients, like `--client-key`: `[SCOPE=]FILE` or a directory.
    pub client_keys: Vec<String>,
    /// The mistake that `client_keys` stand without a `key`, unless a key is given elsewhere.
    pub keyless: Option<Diagnostic>,
    /// The server's limits.
    pub limits: Limits,
    /// The log level.
    pub log: Option<tracing::Level>,
    /// The log format.
    pub log_format: Option<LogFormat>,
}

/// The format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LogFormat {
    /// `LEVEL:logger:text`, like the original.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

/// Log levels by their names in files and options.
pub const LEVELS: [(&str, tracing::Level); 4] = [
    ("error", tracing::Level::ERROR),
    ("warn", tracing::Level::WARN),
    ("info", tracing::Level::INFO),
    ("debug", tracing::Level::DEBUG),
];

/// Log formats by their names in files and options.
pub const LOG_FORMATS: [(&str, LogFormat); 2] =
    [("text", LogFormat::Text), ("json", LogFormat::Json)];

/// What a port is, for messages.
const PORT: &str = "a port, a whole number from 0 to 65535";

impl Listen {
    /// Reads these settings from a file; paths are relative to `base`.
    pub fn read<'d>(reading: &mut Reading<'d>, fields: &mut Fields<'d>, base: &Path) -> Self {
        let mut listen = Self::default();
        if let Some(node) = fields.optional("port") {
            listen.port = reading.whole(node, PORT);
        }
        if let Some(node) = fields.optional("publish") {
            listen.publish = reading.whole(node, PORT);
        }
        if let Some(node) = fields.optional("bind") {
            let what = "an address of this machine, as 127.0.0.1, or '*' for every interface";
            listen.bind = reading.parsed(node, what, |text| {
                bind_mistake(text).map_or_else(|| Ok(text.to_owned()), Err)
            });
        }
        if let Some(node) = fields.present("allow") {
            let what = "a network, as 192.168.1.0/24, or one address";
            if one_or_more(node).is_empty() {
                let message = "the list is empty, which would allow every address";
                let help = format!("write {what}, or leave out 'allow'");
                reading.wrong_with(node, message.to_owned(), Some(help));
            }
            for node in one_or_more(node) {
                let network = reading.parsed(node, what, |text| {
                    let one = || text.parse::<IpAddr>().map(IpNet::from);
                    let network = text.parse().or_else(|_| one());
                    network.map_err(|_| format!("'{text}' is not {what}"))
                });
                listen.allow.extend(network);
            }
        }
        let key = fields.present("key");
        if let Some(node) = key {
            let what = "the file of the server's secret key";
            listen.key = reading.parsed(node, what, |text| file(base, text));
        }
        if let Some(node) = fields.present("client-keys") {
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
            if key.is_none() {
                let message = "clients can have keys only if the server has one; write key: robot.key_secret, or give --key";
                listen.keyless = Some(reading.mistake(node, message));
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

/// A file named in a configuration. A stream is rejected, since a reload cannot read it again.
fn file(base: &Path, text: &str) -> Result<PathBuf, String> {
    let path = base.join(text);
    match is_stream(&path) {
        true => Err(format!("'{text}' is not a regular file")),
        false => Ok(path),
    }
}

/// The limits in a file.
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

/// The items of a list; any other value counts as a list of one.
#[must_use]
pub fn one_or_more(node: &Node) -> &[Node] {
    match &node.value {
        NodeValue::List(nodes) => nodes,
        _ => std::slice::from_ref(node),
    }
}

/// Why an address is invalid, judging by its form.
#[must_use]
pub fn bind_mistake(bind: &str) -> Option<String> {
    let odd = |c: char| !(c.is_ascii_alphanumeric() || "*.-_:[]%".contains(c));
    (bind.is_empty() || bind.contains(odd) || bind.contains("//")).then(|| {
        format!(
            "'{bind}' is not an address; use 127.0.0.1 for this machine only, or '*' for every interface"
        )
    })
}
