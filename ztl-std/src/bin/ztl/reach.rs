//! Who reaches a server, and how a client says who it is: options that commands share.

use std::net::IpAddr;
use std::path::{Path, PathBuf};

use ipnet::IpNet;
use ztl_std::gateway::config::Config;
use ztl_std::keys::{KeyPair, PublicKey};
use ztl_std::{Access, RemoteTask, RequestError};

/// Who may use a server.
#[derive(Debug, clap::Args)]
pub(crate) struct Reach {
    /// Only clients with an address in this network, as 192.168.1.0/24 (repeatable)
    #[arg(long, value_name = "NETWORK", value_parser = network)]
    allow: Vec<IpNet>,

    /// The server's secret key: encrypts, and only allowed clients get in (see `ztl keys`)
    #[arg(long, value_name = "NAME.key_secret")]
    key: Option<PathBuf>,

    /// A client that is allowed, by its key or a directory of keys; with SCOPE= at that scope only (repeatable)
    #[arg(long, value_name = "[SCOPE=]NAME.key", requires = "key")]
    client_key: Vec<String>,
}

fn network(text: &str) -> Result<IpNet, &'static str> {
    let one = text.parse::<IpAddr>().map(IpNet::from);
    text.parse()
        .or(one)
        .map_err(|_| "write a network as 192.168.1.0/24, one address as 192.168.1.7")
}

impl Reach {
    /// With what the configuration file says: its networks and clients too, and its key, if no option
    /// names one.
    pub(crate) fn with(mut self, config: &Config) -> Self {
        self.allow.extend(&config.allow);
        self.client_key.extend(config.client_keys.iter().cloned());
        self.key = self.key.or_else(|| config.key.clone());
        self
    }

    pub(crate) fn access(&self) -> Result<Access, Box<dyn std::error::Error>> {
        let mut access = Access::everybody();
        for network in &self.allow {
            access = access.from_network(*network);
        }
        if let Some(path) = &self.key {
            access = access.with_keys(KeyPair::read(path)?);
        }
        for client in &self.client_key {
            match client.split_once('=') {
                Some((scope, path)) => {
                    for key in PublicKey::read_all(Path::new(path))? {
                        access = access.allow_scope(scope, key);
                    }
                }
                None => {
                    for key in PublicKey::read_all(Path::new(client))? {
                        access = access.allow(key);
                    }
                }
            }
        }
        Ok(access)
    }
}

/// Who reaches a server that listens at this address, for people: what follows `Reachable for`.
pub(crate) fn reachable(bind: &str, access: &Access) -> String {
    access.describe(match bind {
        "*" | "0.0.0.0" | "[::]" => "everybody in its networks",
        bind if bind.starts_with("127.") || bind == "localhost" || bind == "[::1]" => {
            "only this machine"
        }
        _ => "everybody in that network",
    })
}

/// Who a client is, and which server it means.
#[derive(Debug, clap::Args)]
pub(crate) struct Identity {
    /// One's own secret key, for a server that encrypts (see `ztl keys`)
    #[arg(long, value_name = "NAME.key_secret", requires = "server_key")]
    key: Option<PathBuf>,

    /// The public key of the server that is meant
    #[arg(long, value_name = "NAME.key", requires = "key")]
    server_key: Option<PathBuf>,
}

impl Identity {
    /// Makes a client say who it is, where keys were given.
    pub(crate) fn apply(
        &self,
        remote: RemoteTask,
    ) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        let (Some(own), Some(server)) = (&self.key, &self.server_key) else {
            return Ok(remote);
        };
        let with_keys: Result<RemoteTask, RequestError> =
            remote.with_keys(KeyPair::read(own)?, PublicKey::read(server)?);
        Ok(with_keys?)
    }
}
