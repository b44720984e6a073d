//! Options for the keys of a client.

use std::path::{Path, PathBuf};

use ztl_std::RemoteTask;
use ztl_std::keys::{KeyError, KeyPair, PublicKey, exposure};

use crate::terminal::error_line;

/// Reads our own keys. Warns if others can read them.
pub(crate) fn own_keys(path: &Path) -> Result<KeyPair, KeyError> {
    let keys = KeyPair::read(path)?;
    if let Some(exposure) = exposure(path) {
        error_line(format_args!("ztl: warning: {exposure}"));
    }
    Ok(keys)
}

/// The keys of a client and its server.
#[derive(Debug, clap::Args)]
pub(crate) struct Identity {
    /// The client's secret key, for a server that encrypts (see `ztl keys`)
    #[arg(long, value_name = "NAME.key_secret", requires = "server_key")]
    key: Option<PathBuf>,

    /// The public key of the server
    #[arg(long, value_name = "NAME.key", requires = "key")]
    server_key: Option<PathBuf>,
}

impl Identity {
    /// Sets the keys of a client, if there are any.
    pub(crate) fn apply(
        &self,
        remote: RemoteTask,
    ) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        let (Some(own), Some(server)) = (&self.key, &self.server_key) else {
            return Ok(remote);
        };
        Ok(remote.with_keys(own_keys(own)?, PublicKey::read(server)?)?)
    }
}
