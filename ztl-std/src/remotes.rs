//! Servers by name, from the original's configuration file `zmq-remotes.yaml` (`docs/scripts.md`, "Where the robots
//! are").
//!
//! ```
//! use ztl_std::Remotes;
//! use ztl_yaml::Document;
//!
//! let file = b"
//! remotes:
//!   robot: {host: cob4-1, port: 12345, scope: /robot}
//!   light: {host: lamp, prot: 12345, scope: /light}
//! ";
//! let remotes = Remotes::read(&Document::parse("zmq-remotes.yaml", file).unwrap()).unwrap();
//! assert_eq!(remotes.task("robot").unwrap().endpoint(), "tcp://cob4-1:12345");
//! assert_eq!(
//!     remotes.task("robto").unwrap_err().to_string(),
//!     "no remote 'robto' in zmq-remotes.yaml; did you mean 'robot'?"
//! );
//! // A mistake in one entry does not affect the others.
//! assert_eq!(remotes.task("light").unwrap_err().to_string(), "\
//! zmq-remotes.yaml:4:23: unknown key 'prot'; did you mean 'port'?
//!   4 |   light: {host: lamp, prot: 12345, scope: /light}
//!     |                       ^^^^
//! ");
//! ```

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};

use ztl_core::integer::Integer;

use crate::host;
use crate::keys::{KEYS, KeyFiles};
use crate::scope;
use ztl_yaml::python;
use ztl_yaml::{Diagnostic, Diagnostics, Document, Fields, Node, NodeValue, Reading, closest};

/// A server's or publisher's address and scope.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Remote {
    /// A host name or address, without brackets.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// The scope.
    pub scope: String,
    /// The keys for an encrypted connection: `key` and `server-key`, relative to the configuration file.
    pub keys: Option<KeyFiles>,
}

impl Remote {
    /// The ZeroMQ address: `tcp://HOST:PORT`.
    #[must_use]
    pub fn endpoint(&self) -> String {
        format!("tcp://{}:{}", self.host, self.port)
    }
}

/// An entry, or what is wrong with it.
type Entry = Result<Remote, Diagnostics>;

/// Task servers and publishers by name.
#[derive(Debug, Clone, Default)]
pub struct Remotes {
    /// The file's name.
    name: String,
    tasks: BTreeMap<String, Entry>,
    publishers: BTreeMap<String, Entry>,
    /// Why the file could not be read.
    unread: Option<Diagnostics>,
    /// What is wrong in entries that a later one of the same name has replaced.
    replaced: Vec<Diagnostics>,
}

impl Remotes {
    /// An empty list; messages use `name` in place of a file's name.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            ..Self::default()
        }
    }

    /// An empty list in place of a file that could not be read.
    #[must_use]
    pub fn not_read(name: &str, why: Diagnostics) -> Self {
        Self {
            unread: Some(why),
            ..Self::named(name)
        }
    }

    /// Reads a file.
    ///
    /// # Errors
    /// Why it cannot be read as a mapping of `remotes` and `publishers`. Mistakes in entries are reported by
    /// [`task`](Self::task) and [`mistakes`](Self::mistakes).
    pub fn load(path: &Path) -> Result<Self, Diagnostics> {
        Self::read(&crate::files::load_yaml(path)?)
    }

    /// Reads a file for a check: as far as possible, and why [`load`](Self::load) rejects it. `None` if it cannot be
    /// read or is invalid YAML.
    #[must_use]
    pub fn check(path: &Path) -> (Option<Self>, Vec<Diagnostic>) {
        match crate::files::load_yaml(path) {
            Ok(document) => Self::reading(&document),
            Err(mistakes) => (None, mistakes.into_iter().collect()),
        }
    }

    /// Reads a document.
    ///
    /// # Errors
    /// Those of [`load`](Self::load).
    pub fn read(document: &Document) -> Result<Self, Diagnostics> {
        match Self::reading(document) {
            (Some(remotes), mistakes) if mistakes.is_empty() => Ok(remotes),
            (_, mistakes) => Err(Diagnostics::new(mistakes)),
        }
    }

    fn reading(document: &Document) -> (Option<Self>, Vec<Diagnostic>) {
        let mut reading = document.reading();
        let pairs = reading.pairs(document.root(), "remotes and publishers");
        let mut remotes = Self::named(document.name());
        // Ignores other keys, like the original.
        for (key, value) in pairs.into_iter().flatten() {
            let place = match word(key) {
                Some("remotes") => &mut remotes.tasks,
                Some("publishers") => &mut remotes.publishers,
                _ => continue,
            };
            // A key without a value has no entries.
            if value.is_null() {
                continue;
            }
            let entries = reading.pairs(value, "NAME: {host: lamp, port: 12345, scope: /lab}");
            for (name, entry) in entries.into_iter().flatten() {
                match python::text(name) {
                    Some(Ok(name)) => {
                        let before = place.insert(name, endpoint(document, entry));
                        remotes.replaced.extend(before.and_then(Result::err));
                    }
                    Some(Err(wrong)) => reading.wrong(name, wrong),
                    None => reading.wrong(name, "a name is a single word"),
                }
            }
        }
        reading.into_parts(Some(remotes))
    }

    /// The name of the file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Why the file could not be read, if this stands in its place.
    #[must_use]
    pub const fn unread(&self) -> Option<&Diagnostics> {
        self.unread.as_ref()
    }

    /// Adds or replaces a task server.
    pub fn set_task(&mut self, name: &str, remote: Remote) {
        self.tasks.insert(name.to_owned(), Ok(remote));
    }

    /// Adds or replaces a publisher.
    pub fn set_publisher(&mut self, name: &str, publisher: Remote) {
        self.publishers.insert(name.to_owned(), Ok(publisher));
    }

    /// The task server with this name.
    ///
    /// # Errors
    /// [`NoRemote`] if there is none or its entry is invalid.
    pub fn task(&self, name: &str) -> Result<&Remote, NoRemote> {
        self.find("remote", &self.tasks, name)
    }

    /// The publisher with this name.
    ///
    /// # Errors
    /// [`NoRemote`] if there is none or its entry is invalid.
    pub fn publisher(&self, name: &str) -> Result<&Remote, NoRemote> {
        self.find("publisher", &self.publishers, name)
    }

    /// The names of the task servers.
    pub fn task_names(&self) -> impl Iterator<Item = &str> {
        self.tasks.keys().map(String::as_str)
    }

    /// The names of the publishers.
    pub fn publisher_names(&self) -> impl Iterator<Item = &str> {
        self.publishers.keys().map(String::as_str)
    }

    /// The mistakes in all entries.
    pub fn mistakes(&self) -> impl Iterator<Item = &Diagnostics> {
        let entries = self.tasks.values().chain(self.publishers.values());
        let wrong = entries.filter_map(|entry| entry.as_ref().err());
        wrong.chain(&self.replaced)
    }

    fn find<'r>(
        &'r self,
        kind: &'static str,
        known: &'r BTreeMap<String, Entry>,
        name: &str,
    ) -> Result<&'r Remote, NoRemote> {
        match known.get(name) {
            Some(Ok(remote)) => Ok(remote),
            Some(Err(mistakes)) => Err(NoRemote::Wrong(mistakes.clone())),
            None => Err(NoRemote::Unknown {
                kind,
                name: name.to_owned(),
                file: self.name.clone(),
                known: known.keys().cloned().collect(),
            }),
        }
    }
}

/// Why there is no server or publisher with a name.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum NoRemote {
    /// There is no such name.
    Unknown {
        /// `remote` or `publisher`.
        kind: &'static str,
        /// The name.
        name: String,
        /// The file's name.
        file: String,
        /// The known names.
        known: Vec<String>,
    },
    /// The entry is invalid.
    Wrong(Diagnostics),
}

impl fmt::Display for NoRemote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Wrong(mistakes) => mistakes.fmt(f),
            Self::Unknown {
                kind,
                name,
                file,
                known,
            } => {
                write!(f, "no {kind} '{name}' in {file}; ")?;
                match closest(name, known.iter().map(String::as_str)) {
                    Some(meant) => write!(f, "did you mean '{meant}'?"),
                    None if known.is_empty() => f.write_str("there are none"),
                    None => write!(f, "there are: {}", known.join(", ")),
                }
            }
        }
    }
}

impl std::error::Error for NoRemote {}

/// The default file: `zmq-remotes.yaml` in `$XDG_CONFIG_HOME`, else in `$HOME/.config`, else in
/// `/home/demo/.config`.
#[must_use]
pub fn usual_path() -> PathBuf {
    usual_path_by(|name| std::env::var_os(name))
}

fn usual_path_by(variable: impl Fn(&str) -> Option<OsString>) -> PathBuf {
    let mut path = variable("XDG_CONFIG_HOME").unwrap_or_else(|| {
        let mut home = variable("HOME").unwrap_or_else(|| "/home/demo".into());
        home.push("/.config");
        home
    });
    // Like the original, an empty variable means the root.
    path.push("/zmq-remotes.yaml");
    path.into()
}

/// Reads one entry. Other keys are ignored, unless one of the three is missing or a key seems to be meant for encryption.
fn endpoint(document: &Document, node: &Node) -> Entry {
    let mut reading = document.part_reading();
    let what = "{host: lamp, port: 12345, scope: /lab}";
    let remote = (|| {
        let mut fields = reading.fields(node, what)?;
        let host = fields.required("host", "host: lamp");
        let number = fields.required("port", "port: 12345");
        let scope = fields.required("scope", "scope: /lab");
        let base = Path::new(document.name()).parent();
        let key = fields.optional("key");
        // Of an incomplete entry, every unknown key is reported below.
        let complete = host.is_some() && number.is_some() && scope.is_some();
        let keys = match complete && misspelt_keys(&mut reading, &fields) {
            true => None,
            false => KeyFiles::take(&mut reading, &mut fields, base.unwrap_or(Path::new(""))),
        };
        if let (Some(key), Some(Err(wrong))) = (key, keys.as_ref().map(KeyFiles::read)) {
            reading.wrong(key, wrong.to_string());
        }
        let (Some(host), Some(number), Some(scope)) = (host, number, scope) else {
            fields.finish(&mut reading);
            return None;
        };
        let place = host;
        let host = text(&mut reading, host, "a host, as lamp or 192.168.1.7");
        if let Some(wrong) = host.as_deref().and_then(host::mistake) {
            reading.wrong(place, wrong);
        }
        let port = text(&mut reading, number, "a port, as 12345");
        let port = port.and_then(|text| match port_of(&text) {
            Ok(port) => Some(port),
            Err(wrong) => {
                reading.wrong(number, wrong);
                None
            }
        });
        let given = text(&mut reading, scope, "a scope, as /lab");
        if let Some(wrong) = given.as_deref().and_then(scope::cannot_be_asked) {
            reading.wrong(scope, wrong);
        }
        Some(Remote {
            host: host?,
            port: port?,
            scope: given?,
            keys,
        })
    })();
    reading.finish(remote)
}

/// Reports keys that seem to be meant for encryption: without them, the client would speak in plain text.
fn misspelt_keys<'d>(reading: &mut Reading<'d>, fields: &Fields<'d>) -> bool {
    let mut found = false;
    for (name, text) in fields.unknown().filter(|(_, text)| !KEYS.contains(text)) {
        let lower = text.to_lowercase();
        let has_key = lower.contains("key");
        let own = ["client", "own", "private", "secret"];
        let meant = match closest(text, KEYS) {
            _ if has_key && own.iter().any(|word| lower.contains(word)) => Some("key"),
            Some(meant) => Some(meant),
            None if has_key => None,
            None => continue,
        };
        let help = match meant {
            Some(meant) => format!("did you mean '{meant}'?"),
            None => format!("for encryption, there are: {}", KEYS.join(", ")),
        };
        reading.wrong_with(name, format!("unknown key '{text}'"), Some(help));
        found = true;
    }
    found
}

fn port_of(text: &str) -> Result<u16, String> {
    let number = Integer::parse(text).ok().and_then(Integer::value);
    let port = number.and_then(|number| u16::try_from(number).ok());
    port.ok_or_else(|| format!("invalid port '{text}': expected 0 to 65535"))
}

/// A text as the original reads it.
fn text<'d>(reading: &mut Reading<'d>, node: &'d Node, what: &str) -> Option<String> {
    reading.text(node, what)?;
    match python::text(node)? {
        Ok(text) => Some(text),
        Err(wrong) => {
            reading.wrong(node, wrong);
            None
        }
    }
}

fn word(node: &Node) -> Option<&str> {
    match &node.value {
        NodeValue::Scalar { text, .. } => Some(text),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Remotes, String> {
        let document = Document::parse("remotes.yaml", text.as_bytes());
        let read = document.and_then(|document| Remotes::read(&document));
        read.map_err(|mistakes| mistakes.to_string())
    }

    #[test]
    fn a_file_of_the_original_is_read() {
        let text = "
other: [1, 2]
remotes:
  robot: {host: cob4-1, port: '12345', scope: /robot, colour: red}
  7: {host: 127.0.0.1, port: 1_000, scope: ''}
publishers:
";
        let remotes = read(text).unwrap();
        assert_eq!(remotes.task_names().collect::<Vec<_>>(), ["7", "robot"]);
        let seven = remotes.task("7").unwrap();
        assert_eq!((seven.port, seven.scope.as_str()), (1000, ""));
        assert!(remotes.publishers.is_empty());
        assert_eq!(remotes.mistakes().count(), 0);
        assert_eq!(read("").unwrap().task_names().count(), 0);
    }

    #[test]
    fn a_mistake_is_shown_with_its_place() {
        for (text, message) in [
            ("remotes: {a: {host: h", "remotes.yaml:1:"),
            ("- a", "remotes.yaml:1:1: found a list; expected a mapping"),
            ("remotes: 7", "remotes.yaml:1:10: found a single value"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.starts_with(message), "{text}: {error}");
        }
        for (entry, message) in [
            ("", "remotes.yaml:2:5: found nothing; expected a mapping"),
            (
                "{host: h, scope: s}",
                "remotes.yaml:2:6: 'port' is missing; write port: 12345",
            ),
            (
                "{host: h, port: 65536, scope: s}",
                "remotes.yaml:2:22: invalid port '65536'",
            ),
            (
                "{host: h, port: 1, scope: a;b}",
                "remotes.yaml:2:32: the scope 'a;b' contains ';', which would end it; write it as /lab",
            ),
            (
                "{host: [], port: 1, scope: s}",
                "remotes.yaml:2:13: found a list",
            ),
            (
                "{host: 'tcp://lamp:7', port: 1, scope: s}",
                "remotes.yaml:2:13: 'tcp://lamp:7' is not a host; write lamp as the host, and 7 as the port",
            ),
        ] {
            let remotes = read(&format!(
                "remotes:\n  a: {entry}\n  b: {{host: h, port: 1, scope: /s}}"
            ));
            let remotes = remotes.unwrap();
            let error = remotes.task("a").unwrap_err().to_string();
            assert!(error.starts_with(message), "{entry}: {error}");
            assert_eq!(remotes.mistakes().count(), 1);
            assert!(remotes.task("b").is_ok(), "{entry}");
        }
    }

    #[test]
    fn a_misspelt_or_incomplete_key_makes_no_plain_text_entry() {
        let both = "an encrypted connection needs both: key: robot.key_secret, server-key: far.key";
        let nothing = "found nothing; expected a file of `ztl keys`";
        for (keys, messages) in [
            (
                "key: a.key_secret, server_key: r.key",
                &["59: unknown key 'server_key'; did you mean 'server-key'?"][..],
            ),
            (
                "sever-key: r.key",
                &["40: unknown key 'sever-key'; did you mean 'server-key'?"],
            ),
            (
                "serverkey: r.key",
                &["40: unknown key 'serverkey'; did you mean 'server-key'?"],
            ),
            ("Key: a", &["40: unknown key 'Key'; did you mean 'key'?"]),
            ("keys: a", &["40: unknown key 'keys'; did you mean 'key'?"]),
            ("kye: a", &["40: unknown key 'kye'; did you mean 'key'?"]),
            (
                "secret-key: a",
                &["40: unknown key 'secret-key'; did you mean 'key'?"],
            ),
            (
                "ClientKey: a",
                &["40: unknown key 'ClientKey'; did you mean 'key'?"],
            ),
            (
                "public_key: a",
                &["40: unknown key 'public_key'; for encryption, there are: key, server-key"],
            ),
            (
                "sever-key: r, keys: a",
                &[
                    "40: unknown key 'sever-key'; did you mean 'server-key'?",
                    "54: unknown key 'keys'; did you mean 'key'?",
                ],
            ),
            ("key: a", &[&format!("45: {both}")]),
            ("server-key: r", &[&format!("52: {both}")]),
            ("server-key: r, key: ~", &[&format!("60: {nothing}")]),
            (
                "key: ~, server-key: ~",
                &[&format!("45: {nothing}"), &format!("60: {nothing}")],
            ),
        ] {
            let text = format!("remotes:\n  robot: {{host: h, port: 1, scope: /s, {keys}}}\n");
            let remotes = read(&text).unwrap();
            let error = remotes.task("robot").unwrap_err().to_string();
            let found: Vec<&str> = error
                .lines()
                .filter_map(|line| line.strip_prefix("remotes.yaml:2:"))
                .collect();
            assert_eq!(found, messages, "{keys}: {error}");
            assert_eq!(remotes.mistakes().count(), 1);
        }
        // As with the original, other keys say nothing.
        let text = "remotes: {robot: {host: h, port: 1, scope: /s, colour: red, server: big, note: hello}}";
        assert_eq!(read(text).unwrap().task("robot").unwrap().keys, None);
    }

    #[test]
    fn merged_entries_and_values_are_read_like_pyyaml() {
        let text = "
base: &base {host: lab-1, port: 010}
remotes:
  <<: &more {spare: {host: h, port: 0x10, scope: /s}, robot: {}}
  robot: {<<: *base, scope: /robot}
  on: {<<: [{port: 1:40}, *base], scope: 'on'}
  ~: {<<: *base, scope: no, port: !!str 0777}
";
        let remotes = read(text).unwrap();
        let found: Vec<String> = ["robot", "True", "None", "spare"]
            .iter()
            .map(|name| {
                let Remote {
                    host, port, scope, ..
                } = remotes.task(name).unwrap();
                format!("{host} {port} {scope}")
            })
            .collect();
        let expected = [
            "lab-1 8 /robot",
            "lab-1 100 on",
            "lab-1 777 False",
            "h 16 /s",
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn the_default_file_is_the_originals() {
        let usual = |known: &[(&str, &str)]| {
            let variable = |name: &str| {
                let mut found = known.iter().filter(|(known, _)| *known == name);
                found.next().map(|(_, value)| OsString::from(value))
            };
            usual_path_by(variable).display().to_string()
        };
        let both = [("XDG_CONFIG_HOME", "/x"), ("HOME", "/h")];
        assert_eq!(usual(&both), "/x/zmq-remotes.yaml");
        assert_eq!(usual(&both[1..]), "/h/.config/zmq-remotes.yaml");
        assert_eq!(usual(&[]), "/home/demo/.config/zmq-remotes.yaml");
        assert_eq!(usual(&[("XDG_CONFIG_HOME", "")]), "/zmq-remotes.yaml");
    }
}
