//! The files of `ztl-fleet`: one for each agent, endpoint and router, with the same keys for what they share.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use tracing::warn;
use ztl_std::Access;
use ztl_std::files::load_yaml;
use ztl_std::keys::{KeyFiles, KeyPair, PublicKey, exposure};
use ztl_std::listen::{Listen, one_or_more};
use ztl_std::scope;
use ztl_yaml::{Diagnostics, Fields, Node, Reading};

use crate::wire::is_name;

/// Certificates for connections over TLS.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tls {
    /// Certificates of the authorities whose peers are accepted, in PEM.
    pub ca: PathBuf,
    /// The own certificate, in PEM.
    pub certificate: PathBuf,
    /// Its private key, in PEM.
    pub key: PathBuf,
}

/// How to reach the other parts of the fleet.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Links {
    /// Routers to connect to, as `tcp/10.0.0.1:7447`.
    pub routers: Vec<String>,
    /// Where a router listens.
    pub listen: Vec<String>,
    /// Certificates, if there is TLS.
    pub tls: Option<Tls>,
}

/// The file of an agent.
#[derive(Debug, Clone)]
pub struct AgentConfig {
    /// The robot's name.
    pub name: String,
    /// The ZeroMQ address of its server.
    pub server: String,
    /// The ZeroMQ address of its publisher, if it has one.
    pub publish: Option<String>,
    /// Keys for the server and the publisher, if they encrypt.
    pub keys: Option<KeyFiles>,
    /// Its scopes, if the server cannot tell them.
    pub scopes: Vec<String>,
    /// Groups that it belongs to.
    pub groups: Vec<String>,
    /// The robot's key in the fleet, and who may ask it.
    pub identity: Option<Identity>,
    /// Directory of what must survive a restart.
    pub state: PathBuf,
    /// How to reach the fleet.
    pub links: Links,
}

/// Who a robot is, and who may ask it what.
#[derive(Debug, Clone)]
pub struct Identity {
    /// The robot's keys.
    pub own: KeyPair,
    /// Keys of clients, each for one scope or for all.
    pub clients: Vec<(Option<String>, PublicKey)>,
}

impl Identity {
    /// Whether the owner of a key may use a scope.
    #[must_use]
    pub fn may_use(&self, client: &PublicKey, scope: &str) -> bool {
        let mut clients = self.clients.iter();
        clients.any(|(only, key)| key == client && only.as_deref().is_none_or(|only| only == scope))
    }

    /// Whether the owner of a key may use the whole robot.
    #[must_use]
    pub fn may_use_all(&self, client: &PublicKey) -> bool {
        self.clients.contains(&(None, *client))
    }
}

/// The file of an endpoint, and of the commands that look at a fleet.
#[derive(Debug, Clone)]
pub struct EndpointConfig {
    /// Where to listen, and who may use it.
    pub listen: Listen,
    /// The robots that belong to the fleet, with their keys if there is a [`fleet_key`](Self::fleet_key).
    pub robots: BTreeMap<String, Option<PublicKey>>,
    /// The own keys in the fleet. With them, nothing is sent to robots without a known key.
    pub fleet_key: Option<KeyPair>,
    /// How to reach the fleet.
    pub links: Links,
}

impl AgentConfig {
    /// Reads a file.
    ///
    /// # Errors
    /// All that is wrong in it.
    pub fn load(path: &Path) -> Result<Self, Diagnostics> {
        let base = path.parent().unwrap_or(Path::new("."));
        let document = load_yaml(path)?;
        let mut reading = document.reading();
        let example =
            "an agent, as name: arm-1, server: tcp://127.0.0.1:12345, routers: [tcp/10.0.0.1:7447]";
        let read = reading.fields(document.root(), example);
        let read = read.and_then(|mut fields| {
            let name = fields.required("name", "name: arm-1");
            let name = name.and_then(|node| robot(&mut reading, node));
            let server = fields.required("server", "server: tcp://127.0.0.1:12345");
            let server = server.and_then(|node| {
                let what = "the address of the robot's server, as tcp://127.0.0.1:12345";
                reading.parsed(node, what, |text| {
                    let endpoint = ztl_std::relay::RelayClient::new(text, None);
                    endpoint.map(|_| text.to_owned())
                })
            });
            let publish = fields.optional("publish").and_then(|node| {
                let what = "the address of the robot's publisher, as tcp://127.0.0.1:12346";
                reading.parsed(node, what, |text| {
                    let endpoint = ztl_std::relay::RelayClient::new(text, None);
                    endpoint.map(|_| text.to_owned())
                })
            });
            let mut scopes = Vec::new();
            for node in fields.optional("scopes").map_or(&[][..], one_or_more) {
                scopes.extend(reading.parsed(node, "a scope, as /lab", |text| {
                    match scope::cannot_be_asked(text) {
                        None if text.starts_with('/') => Ok(text.to_owned()),
                        None => Err(format!(
                            "scope '{text}' does not begin with '/', so no client of a fleet reaches it"
                        )),
                        Some(mistake) => Err(mistake),
                    }
                }));
            }
            let mut groups = Vec::new();
            for node in fields.optional("groups").map_or(&[][..], one_or_more) {
                groups.extend(named(&mut reading, node, "a group, as floor-2"));
            }
            let state = fields.optional("state");
            let state = state.and_then(|node| reading.text(node, "a directory"));
            let keys = KeyFiles::take(&mut reading, &mut fields, base);
            let identity = identity(&mut reading, &mut fields, base);
            let links = links(&mut reading, &mut fields, base, false);
            fields.finish(&mut reading);
            let name: String = name?;
            let state = state.map_or_else(|| format!("{name}.fleet"), str::to_owned);
            Some(Self {
                server: server?,
                publish,
                keys,
                scopes,
                groups,
                identity,
                state: base.join(state),
                links,
                name,
            })
        });
        reading.finish(read)
    }
}

impl EndpointConfig {
    /// Reads a file.
    ///
    /// # Errors
    /// All that is wrong in it.
    pub fn load(path: &Path) -> Result<Self, Diagnostics> {
        let base = path.parent().unwrap_or(Path::new("."));
        let document = load_yaml(path)?;
        let mut reading = document.reading();
        let example = "an endpoint, as port: 12345, routers: [tcp/10.0.0.1:7447]";
        let read = reading.fields(document.root(), example);
        let read = read.map(|mut fields| {
            let listen = Listen::read(&mut reading, &mut fields, base);
            let key_at = fields.present("fleet-key");
            let fleet_key = key_at.and_then(|node| own_key(&mut reading, node, base));
            let robots_at = fields.optional("robots");
            let robots = robots(&mut reading, robots_at, base, key_at);
            let links = links(&mut reading, &mut fields, base, false);
            fields.finish(&mut reading);
            Self {
                listen,
                robots,
                fleet_key,
                links,
            }
        });
        reading.finish(read)
    }

    /// Who may use the endpoint.
    ///
    /// # Errors
    /// Which key cannot be read.
    pub fn access(&self) -> Result<Access, String> {
        if let Some(keyless) = &self.listen.keyless {
            return Err(keyless.to_string());
        }
        let mut access = Access::everybody();
        for network in &self.listen.allow {
            access = access.from_network(*network);
        }
        if let Some(path) = &self.listen.key {
            let keys = KeyPair::read(path).map_err(|error| error.to_string())?;
            access = access.with_keys(keys);
        }
        for client in &self.listen.client_keys {
            let (scope, path) = match client.split_once('=') {
                Some((scope, path)) => (Some(scope), path),
                None => (None, client.as_str()),
            };
            let keys = PublicKey::read_all(Path::new(path)).map_err(|error| error.to_string())?;
            for key in keys {
                access = match scope {
                    Some(scope) => access.allow_scope(scope, key),
                    None => access.allow(key),
                };
            }
        }
        Ok(access)
    }
}

impl Links {
    /// Reads the file of a router.
    ///
    /// # Errors
    /// All that is wrong in it.
    pub fn load_router(path: &Path) -> Result<Self, Diagnostics> {
        let base = path.parent().unwrap_or(Path::new("."));
        let document = load_yaml(path)?;
        let mut reading = document.reading();
        let example = "a router, as listen: [tcp/0.0.0.0:7447]";
        let read = reading.fields(document.root(), example);
        let read = read.map(|mut fields| {
            let links = links(&mut reading, &mut fields, base, true);
            fields.finish(&mut reading);
            links
        });
        reading.finish(read)
    }
}

fn links<'d>(
    reading: &mut Reading<'d>,
    fields: &mut Fields<'d>,
    base: &Path,
    is_router: bool,
) -> Links {
    let mut links = Links::default();
    let what = "a router's address, as tcp/10.0.0.1:7447 or tls/router.example.org:7447";
    let routers = match is_router {
        true => fields.optional("routers"),
        false => fields.required("routers", "routers: [tcp/10.0.0.1:7447]"),
    };
    for node in routers.map_or(&[][..], one_or_more) {
        links.routers.extend(address(reading, node, what));
    }
    let listen = match is_router {
        true => fields.required("listen", "listen: [tcp/0.0.0.0:7447]"),
        false => None,
    };
    if is_router {
        let what = "where to listen, as tcp/0.0.0.0:7447";
        for node in listen.map_or(&[][..], one_or_more) {
            links.listen.extend(address(reading, node, what));
        }
    }
    let tls = fields.optional("tls");
    let mut addresses = links.routers.iter().chain(&links.listen);
    if tls.is_none()
        && let Some(address) = addresses.find(|address| address.starts_with("tls/"))
        && let Some(node) = routers.or(listen)
    {
        let message = format!(
            "{address} needs certificates; write tls: {{ca: ca.pem, certificate: arm.pem, key: arm.key}}"
        );
        reading.wrong(node, message);
    }
    if let Some(node) = tls {
        let what = "certificates: ca: ca.pem, certificate: arm.pem, key: arm.key";
        let read = reading.fields(node, what);
        links.tls = read.and_then(|mut fields| {
            let mut file = |key, example| {
                let node = fields.required(key, example)?;
                reading.parsed(node, "a file", |text| {
                    let path = base.join(text);
                    match std::fs::File::open(&path) {
                        // Zenoh does not know what paths are relative to.
                        Ok(_) => path.canonicalize().map_err(|error| error.to_string()),
                        Err(error) => Err(format!("cannot read '{}': {error}", path.display())),
                    }
                })
            };
            let ca = file("ca", "ca: ca.pem");
            let certificate = file("certificate", "certificate: arm.pem");
            let key = file("key", "key: arm.key");
            fields.finish(reading);
            Some(Tls {
                ca: ca?,
                certificate: certificate?,
                key: key?,
            })
        });
    }
    links
}

/// The robots of an endpoint: names, or with a `fleet-key`, a mapping from names to keys.
fn robots<'d>(
    reading: &mut Reading<'d>,
    node: Option<&'d Node>,
    base: &Path,
    fleet_key: Option<&'d Node>,
) -> BTreeMap<String, Option<PublicKey>> {
    let mut all = BTreeMap::new();
    let example = "each robot and its key, as arm-1: {key: arm-1.key}";
    let Some(node) = node else {
        if let Some(fleet_key) = fleet_key {
            let message = format!("with a fleet-key, 'robots' must name {example}");
            reading.wrong(fleet_key, message);
        }
        return all;
    };
    if fleet_key.is_none() {
        for node in one_or_more(node) {
            all.extend(robot(reading, node).map(|name| (name, None)));
        }
        return all;
    }
    for (name_at, value) in reading.pairs(node, example).unwrap_or_default() {
        let name = robot(reading, name_at);
        let key = reading
            .fields(value, "key: arm-1.key")
            .and_then(|mut fields| {
                let node = fields.required("key", "key: arm-1.key");
                fields.finish(reading);
                let read = |text: &str| PublicKey::read(&base.join(text));
                reading.parsed(node?, "the file of the robot's public key", read)
            });
        if let (Some(name), Some(key)) = (name, key)
            && all.insert(name, Some(key)).is_some()
        {
            reading.wrong(name_at, "this robot has a key already");
        }
    }
    all
}

fn own_key<'d>(reading: &mut Reading<'d>, node: &'d Node, base: &Path) -> Option<KeyPair> {
    reading.parsed(node, "a file of `ztl keys`, as arm-1.key_secret", |text| {
        let path = base.join(text);
        if let Some(exposure) = exposure(&path) {
            warn!(target: "fleet", "{exposure}");
        }
        KeyPair::read(&path)
    })
}

/// A robot's own key, and who may ask it.
fn identity<'d>(
    reading: &mut Reading<'d>,
    fields: &mut Fields<'d>,
    base: &Path,
) -> Option<Identity> {
    let (own, clients_at) = (fields.present("fleet-key"), fields.present("client-keys"));
    let Some(own) = own else {
        if let Some(clients) = clients_at {
            let message = "clients can have keys only if the robot has one; write fleet-key: arm-1.key_secret";
            reading.wrong(clients, message);
        }
        return None;
    };
    let own = own_key(reading, own, base);
    let mut clients = Vec::new();
    for node in clients_at.map_or(&[][..], one_or_more) {
        let what = "a client's key, as desk.key or /lab=desk.key";
        let read = reading.parsed(node, what, |text| {
            let (scope, path) = match text.split_once('=') {
                Some((scope, path)) => (Some(scope.to_owned()), path),
                None => (None, text),
            };
            PublicKey::read_all(&base.join(path)).map(|keys| (scope, keys))
        });
        if let Some((scope, keys)) = read {
            clients.extend(keys.into_iter().map(|key| (scope.clone(), key)));
        }
    }
    Some(Identity { own: own?, clients })
}

fn address<'d>(reading: &mut Reading<'d>, node: &'d Node, what: &str) -> Option<String> {
    reading.parsed(node, what, |text| {
        let rest = text
            .strip_prefix("tcp/")
            .or_else(|| text.strip_prefix("tls/"));
        let port = rest.and_then(|rest| rest.rsplit_once(':'));
        let port = port.filter(|(host, _)| !host.is_empty() && !host.contains(['?', '#', '/']));
        match port.map(|(_, port)| port.parse::<u16>()) {
            Some(Ok(_)) => Ok(text.to_owned()),
            _ => Err(format!("'{text}' is not {what}")),
        }
    })
}

fn robot<'d>(reading: &mut Reading<'d>, node: &'d Node) -> Option<String> {
    named(reading, node, "a robot's name, as arm-1")
}

fn named<'d>(reading: &mut Reading<'d>, node: &'d Node, what: &str) -> Option<String> {
    reading.parsed(node, what, |text| match is_name(text) {
        true => Ok(text.to_owned()),
        false => Err(format!(
            "'{text}' is not {what}: at most 64 letters, digits, '-', '_' and '.'"
        )),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    fn mistakes(text: &str) -> String {
        mistakes_of("agent", text, |path| AgentConfig::load(path).map(drop))
    }

    fn mistakes_of(
        what: &str,
        text: &str,
        load: impl Fn(&Path) -> Result<(), Diagnostics>,
    ) -> String {
        let directory = std::env::temp_dir();
        // Tests run at the same time.
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("ztl-fleet-{what}-{}-{number}.yaml", std::process::id());
        let path = directory.join(name);
        std::fs::write(&path, text).unwrap();
        let loaded = load(&path);
        std::fs::remove_file(&path).unwrap();
        let text = loaded.map_or_else(|error| error.to_string(), |_| String::new());
        text.replace(&format!("{}:", path.display()), &format!("{what}.yaml:"))
    }

    #[test]
    fn mistakes_have_their_place() {
        let good = "name: arm-1\nserver: tcp://127.0.0.1:7\nrouters: tcp/10.0.0.1:7447\n";
        assert_eq!(mistakes(good), "");
        for (wrong, message) in [
            (
                "name: arm/1\nserver: tcp://h:7\nrouters: []\n",
                "agent.yaml:1:7: 'arm/1' is not a robot's name",
            ),
            (
                "name: a\nserver: 7\nrouters: []\n",
                "agent.yaml:2:9: '7' is not an endpoint",
            ),
            (
                "name: a\nserver: tcp://h:7\npublish: 12346\nrouters: []\n",
                "agent.yaml:3:10: '12346' is not an endpoint",
            ),
            (
                "name: a\nserver: tcp://h:7\n",
                "routers: [tcp/10.0.0.1:7447]",
            ),
            (
                "name: a\nserver: tcp://h:7\nrouters: [udp/h:7]\n",
                "agent.yaml:3:11: 'udp/h:7' is not a router's address",
            ),
            (
                "name: a\nserver: tcp://h:7\nrouters: []\nscopes: lab\n",
                "agent.yaml:4:9: scope 'lab' does not begin with '/'",
            ),
            (
                "name: a\nserver: tcp://h:7\nrouters: []\ntls: {ca: no.pem}\n",
                "agent.yaml:4:11: cannot read",
            ),
            (
                "name: a\nserver: tcp://h:7\nrouters: tls/h:7\n",
                "agent.yaml:3:10: tls/h:7 needs certificates; write tls: {ca: ca.pem,",
            ),
            (
                "name: a\nserver: tcp://h:7\nrouters: []\ngruops: x\n",
                "agent.yaml:4:1: unknown key 'gruops'; did you mean 'groups'?",
            ),
        ] {
            let told = mistakes(wrong);
            assert!(told.contains(message), "{message}: {told}");
        }
    }

    #[test]
    fn keys_are_needed_on_both_sides_and_for_each_robot() {
        let endpoint = |more: &str| {
            let text = format!("routers: []\n{more}");
            mistakes_of("endpoint", &text, |path| {
                EndpointConfig::load(path).map(drop)
            })
        };
        let name = std::env::temp_dir().join(format!("ztl-fleet-desk-{}", std::process::id()));
        let files = KeyPair::generate().write(&name).unwrap();
        let name = name.display();
        let own = format!("fleet-key: {name}.key_secret\n");
        let arm = format!("arm: {{key: {name}.key}}");
        assert_eq!(endpoint(&format!("{own}robots: {{{arm}}}\n")), "");
        for (wrong, message) in [
            (
                own.clone(),
                "endpoint.yaml:2:12: with a fleet-key, 'robots' must name each robot",
            ),
            (
                format!("{own}robots: [arm]\n"),
                "endpoint.yaml:3:9: found a list; expected a mapping",
            ),
            (format!("{own}robots: {{arm: {{}}}}\n"), "key: arm-1.key"),
            (
                format!("{own}robots: {{arm: {{key: no.key}}}}\n"),
                "endpoint.yaml:3:21: ",
            ),
            (format!("robots: {{{arm}}}\n"), "endpoint.yaml:2:9: "),
            (
                "fleet-key: no.key_secret\nrobots: {}\n".to_owned(),
                "endpoint.yaml:2:12: ",
            ),
        ] {
            let told = endpoint(&wrong);
            assert!(told.contains(message), "{message}: {told}");
        }
        let robot = "name: a\nserver: tcp://h:7\nrouters: []\n";
        let clients = format!("client-keys: [{name}.key, /lab={name}.key]\n");
        assert_eq!(mistakes(&format!("{robot}{own}{clients}")), "");
        let keyless = mistakes(&format!("{robot}{clients}"));
        assert!(
            keyless.contains("agent.yaml:4:14: clients can have keys only if"),
            "{keyless}"
        );
        let unread = mistakes(&format!("{robot}{own}client-keys: no.key\n"));
        assert!(unread.contains("agent.yaml:5:14: "), "{unread}");
        for file in files {
            std::fs::remove_file(file).unwrap();
        }
    }
}
