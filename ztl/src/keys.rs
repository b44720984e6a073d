//! `ztl keys`: generates a key pair for encrypted connections.

use std::path::PathBuf;
use std::process::ExitCode;

use ztl_std::keys::KeyPair;

use crate::exit::Done;
use crate::terminal::line;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes NAME.key, the public key to share, and NAME.key_secret, to keep private, in the format of
pyzmq's and CZMQ's certificates. A server needs its own .key_secret and its clients' .key files; a
client needs its own .key_secret and the server's .key file."
)]
pub(crate) struct Keys {
    /// Name of the owner, or a path without extension
    #[arg(value_name = "NAME")]
    name: PathBuf,
}

impl Keys {
    pub(crate) fn run(self) -> Done {
        let keys = KeyPair::generate();
        let [public, secret] = keys.write(&self.name)?;
        line(format_args!(
            "{}: public key {}, to share",
            public.display(),
            keys.public()
        ));
        line(format_args!(
            "{}: secret key, to keep private",
            secret.display()
        ));
        Ok(ExitCode::SUCCESS)
    }
}
