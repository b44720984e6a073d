//! Options for how a client connects: keys, and who speaks ZMTP.

use std::path::{Path, PathBuf};

use ztl_std::keys::{KeyError, KeyFiles, KeyPair, PublicKey, exposure};
use ztl_std::{RemoteTask, Transport};

use crate::exit::Misuse;
use crate::option_values::one_of;
use crate::server_address::no_client;
use crate::terminal::error_line;

/// Reads our own keys. Warns if others can read them.
pub(crate) fn own_keys(path: &Path) -> Result<KeyPair, KeyError> {
    let keys = KeyPair::read(path)?;
    warn_if_exposed(path);
    Ok(keys)
}

/// Warns if others can read the file of a secret.
pub(crate) fn warn_if_exposed(secret: &Path) {
    if let Some(exposure) = exposure(secret) {
        error_line(format_args!("ztl: warning: {exposure}"));
    }
}

/// The option for who speaks ZMTP.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub(crate) struct TransportOption {
    /// Who speaks ZeroMQ's protocol: native, or libzmq where it is built in [default: native, unless ZTL_TRANSPORT
    /// says otherwise]
    #[arg(long, value_name = "TRANSPORT", value_parser = transport)]
    transport: Option<Transport>,
}

fn transport(text: &str) -> Result<Transport, String> {
    one_of(text, Transport::ALL)
}

impl TransportOption {
    /// The transport of the option, or of the environment.
    pub(crate) fn get(self) -> Result<Transport, String> {
        let variable = std::env::var("ZTL_TRANSPORT").ok();
        match (self.transport, variable.filter(|value| !value.is_empty())) {
            (Some(transport), _) => Ok(transport),
            (None, None) => Ok(Transport::default()),
            (None, Some(text)) => {
                transport(&text).map_err(|known| format!("invalid ZTL_TRANSPORT '{text}': {known}"))
            }
        }
    }
}

/// Options for the keys of an encrypted connection.
#[derive(Debug, Clone, Default, clap::Args)]
pub(crate) struct KeyOptions {
    /// The client's secret key, for a server that encrypts (see `ztl keys`)
    #[arg(long, value_name = "NAME.key_secret", requires = "server_key")]
    key: Option<PathBuf>,

    /// The public key of the server
    #[arg(long, value_name = "NAME.key", requires = "key")]
    server_key: Option<PathBuf>,
}

impl KeyOptions {
    /// Our own keys and the server's. Those of the configuration file go before those of the options.
    pub(crate) fn read(
        &self,
        of_server: Option<&KeyFiles>,
    ) -> Result<Option<(KeyPair, PublicKey)>, KeyError> {
        let (own, server) = match (of_server, &self.key, &self.server_key) {
            (Some(KeyFiles { own, server }), ..) | (None, Some(own), Some(server)) => (own, server),
            _ => return Ok(None),
        };
        Ok(Some((own_keys(own)?, PublicKey::read(server)?)))
    }
}

/// Options for how a client connects.
#[derive(Debug, Clone, Default, clap::Args)]
pub(crate) struct ConnectOptions {
    #[command(flatten)]
    keys: KeyOptions,

    #[command(flatten)]
    transport: TransportOption,
}

impl ConnectOptions {
    /// The keys of the options.
    #[cfg(feature = "web")]
    pub(crate) const fn keys(&self) -> &KeyOptions {
        &self.keys
    }

    /// Applies the options to a client. Keys that the configuration file has for its server go before those of the
    /// options.
    pub(crate) fn apply(
        &self,
        remote: RemoteTask,
        of_server: Option<&KeyFiles>,
    ) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        let transport = self.transport.get().map_err(Misuse)?;
        let keys = self.keys.read(of_server).map_err(Misuse::of)?;
        let remote = remote.with_transport(transport).map_err(no_client)?;
        match keys {
            Some((own, server)) => remote.with_keys(own, server).map_err(no_client),
            None => Ok(remote),
        }
    }

    /// Finds mistakes in the options before anything is sent.
    pub(crate) fn check(&self) -> Result<(), Misuse> {
        self.transport.get().map_err(Misuse)?;
        self.keys.read(None).map_err(Misuse::of)?;
        Ok(())
    }
}
