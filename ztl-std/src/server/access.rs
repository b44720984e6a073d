//! Who may use a server: from which networks, and with which keys at which scopes.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

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
    pub(super) const fn keys(&self) -> Option<&KeyPair> {
        self.keys.as_ref()
    }

    /// A description for people, which continues `Reachable for`; `where_from` says who can reach the
    /// server at all.
    #[must_use]
    pub fn describe(&self, where_from: &str) -> String {
        let mut said = where_from.to_owned();
        if !self.networks.is_empty() {
            let networks: Vec<String> = self.networks.iter().map(IpNet::to_string).collect();
            said = format!("{said}, if its address is in {}", networks.join(" or "));
        }
        said.push_str(
            match (&self.keys, self.clients.len() + self.clients_of.len()) {
                (None, _) => "",
                (Some(_), 0) => {
                    ", encrypted; but no client's key is allowed, so no client can connect"
                }
                (Some(_), _) => ", encrypted, with an allowed key",
            },
        );
        said
    }

    pub(super) fn is_open(&self) -> bool {
        self.networks.is_empty() && self.keys.is_none()
    }

    pub(super) const fn has_networks(&self) -> bool {
        !self.networks.is_empty()
    }

    pub(super) fn admits_address(&self, address: &str) -> bool {
        let address = address.parse::<IpAddr>();
        // An IPv4 address may arrive as an IPv6 one.
        let address = address.map(|address| address.to_canonical());
        let contains = |network: &IpNet| address.as_ref().is_ok_and(|a| network.contains(a));
        self.networks.is_empty() || self.networks.iter().any(contains)
    }

    pub(super) fn may_connect(&self, address: &str, client: Option<&PublicKey>) -> bool {
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

    pub(super) fn may_use(&self, client: &PublicKey, scope: &str) -> bool {
        let of_scope = self.clients_of.get(scope);
        self.clients.contains(client) || of_scope.is_some_and(|clients| clients.contains(client))
    }
}
