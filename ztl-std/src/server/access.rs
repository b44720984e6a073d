//! Who may use a server: from which networks, and with which keys at which scopes.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};

use ipnet::IpNet;

use crate::keys::{KeyPair, PublicKey};

/// Who may use a server. By default everyone who reaches it may use all of it, as with the original.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Access {
    networks: Vec<IpNet>,
    keys: Option<KeyPair>,
    clients: BTreeSet<PublicKey>,
    clients_of: BTreeMap<String, BTreeSet<PublicKey>>,
}

impl Access {
    /// Everyone may use everything.
    #[must_use]
    pub fn everybody() -> Self {
        Self::default()
    }

    /// Admits clients with an address in this network. Once a network is given, all others are excluded.
    #[must_use]
    pub fn from_network(mut self, network: IpNet) -> Self {
        self.networks.push(network);
        self
    }

    /// Encrypts with this key pair. From then on only clients with an allowed key may use anything.
    #[must_use]
    pub fn with_keys(mut self, keys: KeyPair) -> Self {
        self.keys = Some(keys);
        self
    }

    /// Allows a client every scope.
    #[must_use]
    pub fn allow(mut self, client: PublicKey) -> Self {
        self.clients.insert(client);
        self
    }

    /// Allows a client one scope.
    #[must_use]
    pub fn allow_scope(mut self, scope: &str, client: PublicKey) -> Self {
        let clients = self.clients_of.entry(scope.to_owned()).or_default();
        clients.insert(client);
        self
    }

    /// Whether both have the same server keys.
    #[must_use]
    pub fn has_keys_of(&self, other: &Self) -> bool {
        self.keys == other.keys
    }

    /// The server's keys, if it encrypts.
    pub(crate) const fn keys(&self) -> Option<&KeyPair> {
        self.keys.as_ref()
    }

    /// Whether the server encrypts, and no client's key is allowed.
    #[must_use]
    pub fn admits_nobody(&self) -> bool {
        self.keys.is_some() && self.clients.is_empty() && self.clients_of.is_empty()
    }

    /// The scopes to which clients are [restricted](Self::allow_scope).
    pub fn named_scopes(&self) -> impl Iterator<Item = &str> {
        self.clients_of.keys().map(String::as_str)
    }

    /// Who can reach a server that listens at this address; continues `Reachable for`.
    #[must_use]
    pub fn reachable_at(&self, bind: &str) -> String {
        let address = bind.trim_start_matches('[').trim_end_matches(']');
        let address = address
            .parse()
            .map(|address: IpAddr| address.to_canonical());
        let mut said = match (bind, address) {
            ("*", _) => "everybody in its networks",
            (_, Ok(address)) if address.is_unspecified() => "everybody in its networks",
            ("localhost", _) => "only this machine",
            (_, Ok(address)) if address.is_loopback() => "only this machine",
            _ => "everybody in that network",
        }
        .to_owned();
        if !self.networks.is_empty() {
            let networks: Vec<String> = self.networks.iter().map(IpNet::to_string).collect();
            said = format!("{said}, if its address is in {}", networks.join(" or "));
        }
        said.push_str(match (self.keys.is_some(), self.admits_nobody()) {
            (false, _) => "",
            (true, true) => ", encrypted; but no client's key is allowed, so no client can connect",
            (true, false) => ", encrypted, with an allowed key",
        });
        said
    }

    pub(crate) fn is_open(&self) -> bool {
        self.networks.is_empty() && self.keys.is_none()
    }

    #[cfg(feature = "libzmq")]
    pub(crate) const fn has_networks(&self) -> bool {
        !self.networks.is_empty()
    }

    pub(crate) fn admits_address(&self, address: IpAddr) -> bool {
        // An IPv4 address may arrive as an IPv6 one.
        let address = address.to_canonical();
        let contains = |network: &IpNet| network.contains(&address);
        self.networks.is_empty() || self.networks.iter().any(contains)
    }

    pub(crate) fn may_connect(&self, address: IpAddr, client: Option<&PublicKey>) -> bool {
        if !self.admits_address(address) {
            return false;
        }
        match (&self.keys, client) {
            (None, _) => true,
            (Some(_), None) => false,
            (Some(_), Some(client)) => {
                self.clients.contains(client)
                    || self
                        .clients_of
                        .values()
                        .any(|clients| clients.contains(client))
            }
        }
    }

    /// Whether a subscriber may hear what is published under a scope: if it may use that scope.
    #[cfg(feature = "publish")]
    pub(crate) fn may_hear(&self, subscriber: Option<&PublicKey>, scope: &[u8]) -> bool {
        match (&self.keys, subscriber) {
            (None, _) => true,
            (Some(_), None) => false,
            (Some(_), Some(subscriber)) => {
                let scope = str::from_utf8(scope);
                scope.is_ok_and(|scope| self.may_use(subscriber, scope))
            }
        }
    }

    /// Whether a client with an allowed key may use a scope.
    #[must_use]
    pub fn may_use(&self, client: &PublicKey, scope: &str) -> bool {
        let of_scope = self.clients_of.get(scope);
        self.clients.contains(client) || of_scope.is_some_and(|clients| clients.contains(client))
    }
}

/// Who sent a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sender {
    /// Anyone; the server does not encrypt.
    Anyone,
    /// The owner of a key.
    Client(PublicKey),
}

impl Sender {
    /// The sender's key, if the server encrypts.
    pub(crate) const fn key(self) -> Option<PublicKey> {
        match self {
            Self::Anyone => None,
            Self::Client(key) => Some(key),
        }
    }
}

/// The access of a running server, which can be changed.
#[derive(Clone)]
pub(crate) struct CurrentAccess {
    access: Arc<RwLock<Access>>,
    /// Whether each connection is asked for. libzmq fixes that when the server is bound.
    asks: bool,
}

impl CurrentAccess {
    /// The access of a server that asks by itself.
    pub(crate) fn new(access: Access) -> Self {
        Self::with(access, true)
    }

    /// The access of a server that may not `ask` for each connection.
    pub(crate) fn with(access: Access, asks: bool) -> Self {
        Self {
            access: Arc::new(RwLock::new(access)),
            asks,
        }
    }

    /// Whether a client may connect.
    pub(crate) fn admits(&self, address: IpAddr, key: Option<PublicKey>) -> bool {
        self.read().may_connect(address, key.as_ref())
    }

    /// Who a client is; `None` if it may not use the server any more.
    pub(super) fn sender(&self, address: IpAddr, key: Option<PublicKey>) -> Option<Sender> {
        let access = self.read();
        if access.is_open() {
            return Some(Sender::Anyone);
        }
        let admitted = access.may_connect(address, key.as_ref());
        admitted.then(|| key.map_or(Sender::Anyone, Sender::Client))
    }

    /// Whether a sender may use a scope.
    pub(super) fn may_use(&self, sender: Sender, scope: &str) -> bool {
        match sender {
            Sender::Anyone => true,
            Sender::Client(client) => self.read().may_use(&client, scope),
        }
    }

    pub(crate) fn read(&self) -> RwLockReadGuard<'_, Access> {
        self.access.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the access; returns whether that is possible without binding again.
    pub(super) fn change(&self, access: Access) -> bool {
        let mut current = self.access.write().unwrap_or_else(PoisonError::into_inner);
        let possible = current.has_keys_of(&access) && (self.asks || access.is_open());
        if possible {
            *current = access;
        }
        possible
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_can_reach_a_server_follows_from_its_address() {
        for (who, binds) in [
            (
                "only this machine",
                &[
                    "127.0.0.1",
                    "127.8.0.1",
                    "localhost",
                    "::1",
                    "[::1]",
                    "::ffff:127.0.0.1",
                ][..],
            ),
            (
                "everybody in its networks",
                &["*", "0.0.0.0", "::", "[::]", "0:0:0:0:0:0:0:0"],
            ),
            (
                "everybody in that network",
                &["192.168.1.7", "[fe80::1]", "127.example.org", "eth0"],
            ),
        ] {
            for bind in binds {
                assert_eq!(Access::everybody().reachable_at(bind), who, "{bind}");
            }
        }
    }
}
