//! Keys of robots, endpoints and their clients.

use std::collections::BTreeMap;
use std::path::Path;

use tracing::warn;
use ztl_std::keys::{KeyError, KeyPair, PublicKey, exposure};
use ztl_std::listen::one_or_more;
use ztl_std::scope;
use ztl_yaml::{Fields, Node, Reading};

use super::robot;
use crate::wire::is_name;

/// How keys are made.
const MAKE: &str = "`ztl keys NAME` makes NAME.key_secret and NAME.key";

/// Keys of clients, each for one scope or for all.
pub(super) type Clients = Vec<(Option<String>, PublicKey)>;

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

    /// A robot's own key, and who may ask it.
    pub(super) fn read<'d>(
        reading: &mut Reading<'d>,
        fields: &mut Fields<'d>,
        base: &Path,
    ) -> Option<Self> {
        let (own_at, clients_at) = (fields.present("fleet-key"), fields.present("client-keys"));
        let Some(own_at) = own_at else {
            if let Some(clients) = clients_at {
                let message = "clients can have keys only if the robot has one; write fleet-key: arm-1.key_secret";
                reading.wrong(clients, message);
            }
            return None;
        };
        if clients_at.is_none_or(|node| one_or_more(node).is_empty()) {
            let message = "with a fleet-key, only keys of 'client-keys' may use the robot, so nobody may; write client-keys: [desk.key]";
            reading.wrong(clients_at.unwrap_or(own_at), message);
        }
        let own = own_key(reading, own_at, base);
        let clients = clients_at.map(|node| clients(reading, node, base, |_| None));
        Some(Self {
            own: own?,
            clients: clients.unwrap_or_default(),
        })
    }
}

/// Warns if others can read the file of a secret.
pub(super) fn warn_if_exposed(secret: &Path) {
    if let Some(exposure) = exposure(secret) {
        warn!(target: "fleet", "{exposure}");
    }
}

/// The own secret key.
pub(super) fn own_key<'d>(
    reading: &mut Reading<'d>,
    node: &'d Node,
    base: &Path,
) -> Option<KeyPair> {
    reading.parsed(node, "a file of `ztl keys`, as arm-1.key_secret", |text| {
        let path = base.join(text);
        let pair = KeyPair::read(&path);
        if pair.is_ok() {
            warn_if_exposed(&path);
        }
        pair.map_err(|error| match error {
            KeyError::Missing { .. } if PublicKey::read(&path).is_ok() => format!(
                "'{}' is a public key; expected the secret one of the same name, as NAME.key_secret; {MAKE}",
                path.display()
            ),
            error => advised(&error),
        })
    })
}

/// The public key of another part.
pub(super) fn public_key<'d>(
    reading: &mut Reading<'d>,
    node: &'d Node,
    base: &Path,
) -> Option<PublicKey> {
    let what = "a public key of `ztl keys`, as arm-1.key";
    reading.parsed(node, what, |text| public(&base.join(text)))
}

fn public(path: &Path) -> Result<PublicKey, String> {
    if KeyPair::read(path).is_ok() {
        return Err(format!(
            "'{}' is a secret key, which belongs to its owner only; expected the public one of the same name, as NAME.key",
            path.display()
        ));
    }
    PublicKey::read(path).map_err(|error| advised(&error))
}

fn advised(error: &KeyError) -> String {
    match error {
        KeyError::File { .. } => format!("{error}; {MAKE}"),
        error => error.to_string(),
    }
}

/// Keys of clients, as `desk.key` or `/lab=desk.key`. `wrong` tells what is wrong with a scope.
pub(super) fn clients<'d>(
    reading: &mut Reading<'d>,
    node: &'d Node,
    base: &Path,
    wrong: impl Fn(&str) -> Option<String>,
) -> Clients {
    let mut clients = Vec::new();
    for node in one_or_more(node) {
        let what = "a client's key, as desk.key or /lab=desk.key";
        let read = reading.parsed(node, what, |text| {
            let (scope, path) = match text.split_once('=') {
                Some((scope, path)) => (Some(scope.to_owned()), path),
                None => (None, text),
            };
            if let Some(scope) = &scope
                && let Some(mistake) = unusable(scope).or_else(|| wrong(scope))
            {
                return Err(mistake);
            }
            let path = base.join(path);
            let keys = match path.is_dir() {
                true => PublicKey::read_all(&path).map_err(|error| advised(&error)),
                false => public(&path).map(|key| vec![key]),
            };
            keys.map(|keys| (scope, keys))
        });
        if let Some((scope, keys)) = read {
            clients.extend(keys.into_iter().map(|key| (scope.clone(), key)));
        }
    }
    clients
}

/// Why no client of a fleet reaches a scope.
pub(super) fn unusable(text: &str) -> Option<String> {
    match scope::cannot_be_asked(text) {
        None if text.starts_with('/') => None,
        None => Some(format!(
            "scope '{text}' does not begin with '/', so no client of a fleet reaches it"
        )),
        mistake => mistake,
    }
}

/// Why a scope is none of an endpoint: these begin with a robot.
pub(super) fn of_no_robot(scope: &str) -> Option<String> {
    let robot = scope
        .strip_prefix('/')
        .and_then(|rest| rest.split('/').next());
    (!robot.is_some_and(is_name)).then(|| {
        format!("'{scope}' does not begin with a robot's name; write it as /arm-1 or /arm-1/lab")
    })
}

/// The robots of an endpoint: names, or with a `fleet-key`, a mapping from names to keys.
pub(super) fn robots<'d>(
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
        if let ztl_yaml::NodeValue::Map(_) = node.value {
            let message = format!(
                "robots have keys only if the endpoint has one; write fleet-key: desk.key_secret, or names alone, as [arm-1]; {MAKE}"
            );
            reading.wrong(node, message);
            return all;
        }
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
                public_key(reading, node?, base)
            });
        let (Some(name), Some(key)) = (name, key) else {
            continue;
        };
        if let Some((other, _)) = all.iter().find(|(_, known)| **known == Some(key)) {
            let message = format!("'{other}' has this key, too; each robot has its own; {MAKE}");
            reading.wrong(value, message);
        } else if all.insert(name, Some(key)).is_some() {
            reading.wrong(name_at, "this robot has a key already");
        }
    }
    all
}
