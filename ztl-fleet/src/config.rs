//! The files of `ztl-fleet`: one for each agent, endpoint and router, with the same keys for what they share.

mod keys;
mod links;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ztl_std::Access;
use ztl_std::files::load_yaml;
use ztl_std::keys::{KeyFiles, KeyPair, PublicKey};
use ztl_std::listen::{Listen, one_or_more};
use ztl_yaml::{Diagnostics, Document, Fields, Node, Reading};

pub use crate::tls::Tls;
use crate::wire::is_name;
pub use keys::Identity;
pub use links::Links;

/// Each kind of file: keys that only it has, what it is, and the command for it.
const KINDS: [(&[&str], &str, &str); 3] = [
    (&["name", "server"], "a robot", "join"),
    (&["listen"], "a router", "router"),
    (&["port", "robots"], "an endpoint", "endpoint"),
];

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

/// The file of an endpoint, and of the commands that look at a fleet.
#[derive(Debug, Clone)]
pub struct EndpointConfig {
    /// Where to listen, and who may use it.
    pub listen: Listen,
    /// The robots that belong to the fleet, with their keys if there is a [`fleet_key`](Self::fleet_key).
    pub robots: BTreeMap<String, Option<PublicKey>>,
    /// The own keys in the fleet. With them, nothing is sent to robots without a known key.
    pub fleet_key: Option<KeyPair>,
    /// Who may use it, or what is wrong with that: whoever only looks at the fleet does not need it.
    pub access: Result<Access, Diagnostics>,
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
        let read = fields(&document, &mut reading, "join", example).and_then(|mut fields| {
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
                    keys::unusable(text).map_or_else(|| Ok(text.to_owned()), Err)
                }));
            }
            let mut groups = Vec::new();
            for node in fields.optional("groups").map_or(&[][..], one_or_more) {
                groups.extend(named(&mut reading, node, "a group, as floor-2"));
            }
            let state = fields.optional("state");
            let state = state.and_then(|node| reading.text(node, "a directory"));
            let keys = KeyFiles::take(&mut reading, &mut fields, base);
            if keys.is_some()
                && let Some(mut again) = reading.fields(document.root(), example)
            {
                let own = again.present("key");
                own.and_then(|node| keys::own_key(&mut reading, node, base));
                let of_server = again.present("server-key");
                of_server.and_then(|node| keys::public_key(&mut reading, node, base));
            }
            let identity = Identity::read(&mut reading, &mut fields, base);
            let links = Links::read(&mut reading, &mut fields, base, false);
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
        // What only concerns its clients is collected apart.
        let mut serving = document.reading();
        let again = serving.fields(document.root(), example);
        let read = fields(&document, &mut reading, "endpoint", example).zip(again);
        let read = read.map(|(mut fields, mut again)| {
            let listen = Listen::read(&mut reading, &mut fields, base);
            for key in ["log", "log-format"] {
                if let Some(node) = again.present(key) {
                    let message = format!("'{key}' does nothing here; leave it out, and set the environment variable RUST_LOG, as RUST_LOG=debug");
                    reading.wrong(node, message);
                }
            }
            let access = access(&mut serving, &mut again, base, &listen);
            let key_at = fields.present("fleet-key");
            let fleet_key = key_at.and_then(|node| keys::own_key(&mut reading, node, base));
            let robots_at = fields.optional("robots");
            let robots = keys::robots(&mut reading, robots_at, base, key_at);
            let links = Links::read(&mut reading, &mut fields, base, false);
            fields.finish(&mut reading);
            Self {
                access: serving.finish(Some(access)),
                listen,
                robots,
                fleet_key,
                links,
            }
        });
        reading.finish(read)
    }
}

/// Who may use an endpoint.
fn access<'d>(
    reading: &mut Reading<'d>,
    fields: &mut Fields<'d>,
    base: &Path,
    listen: &Listen,
) -> Access {
    let (key_at, clients_at) = (fields.present("key"), fields.present("client-keys"));
    let mut access = Access::everybody();
    for network in &listen.allow {
        access = access.from_network(*network);
    }
    match (key_at, clients_at) {
        (Some(key), clients) if clients.is_none_or(|node| one_or_more(node).is_empty()) => {
            let message = "with a key, only keys of 'client-keys' may use the endpoint, so nobody may; write client-keys: [anna.key]";
            reading.wrong(clients.unwrap_or(key), message);
        }
        (None, Some(clients)) => {
            let message =
                "clients can have keys only if the endpoint has one; write key: desk.key_secret";
            reading.wrong(clients, message);
        }
        _ => {}
    }
    if let Some(own) = key_at.and_then(|node| keys::own_key(reading, node, base)) {
        access = access.with_keys(own);
    }
    let clients = clients_at.map(|node| keys::clients(reading, node, base, keys::of_no_robot));
    for (scope, key) in clients.unwrap_or_default() {
        access = match scope {
            Some(scope) => access.allow_scope(&scope, key),
            None => access.allow(key),
        };
    }
    access
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
        let read = fields(&document, &mut reading, "router", example).map(|mut fields| {
            let links = Self::read(&mut reading, &mut fields, base, true);
            fields.finish(&mut reading);
            links
        });
        reading.finish(read)
    }
}

/// The keys of a file for this command. A file for another command is one mistake, instead of many odd ones.
fn fields<'d>(
    document: &'d Document,
    reading: &mut Reading<'d>,
    command: &str,
    example: &str,
) -> Option<Fields<'d>> {
    let fields = reading.fields(document.root(), example)?;
    let is_own = |(keys, _, of): &(&[&str], _, &str)| *of == command && fields.has_one_of(keys);
    if KINDS.iter().any(is_own) {
        return Some(fields);
    }
    let mut others = KINDS.iter();
    if let Some((_, what, of)) = others.find(|(keys, _, _)| fields.has_one_of(keys)) {
        let message =
            format!("this is the file of {what}, for `ztl-fleet {of}`; expected {example}");
        reading.wrong(document.root(), message);
        return None;
    }
    Some(fields)
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
mod tests;
