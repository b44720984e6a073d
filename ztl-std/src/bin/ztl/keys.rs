//! `ztl keys`: a pair of keys for encrypted connections.

use std::path::PathBuf;
use std::process::ExitCode;

use ztl_std::keys::KeyPair;

use crate::Done;
use crate::terminal::line;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes NAME.key, the public key, to be given to others, and NAME.key_secret, for its owner alone;
both as pyzmq's and CZMQ's certificates. A server needs its own NAME.key_secret and its clients' .key
files; a client its own .key_secret and the server's .key."
)]
pub(crate) struct Keys {
    /// Who they are for: a name, or a path without an ending
    #[arg(value_name = "NAME")]
    name: PathBuf,
}

impl Keys {
    pub(crate) fn run(self) -> Done {
        let keys = KeyPair::generate()?;
        let [public, secret] = keys.write(&self.name)?;
        line(format_args!(
            "{}: the public key {}, to be given to others",
            public.display(),
            keys.public()
        ));
        line(format_args!(
            "{}: the secret key, for its owner alone",
            secret.display()
        ));
        Ok(ExitCode::SUCCESS)
    }
}
