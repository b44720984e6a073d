//! `ztl man`: writes the man pages.

use std::fs;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Command;

use crate::exit::Done;

#[derive(Debug, clap::Args)]
#[command(after_help = "To read one: man ./DIR/ztl-gateway.1. The Debian package installs them.")]
pub(crate) struct Man {
    /// Directory for ztl.1 and a page for each subcommand; created if missing
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

impl Man {
    pub(crate) fn run(self, command: Command) -> Done {
        let directory = &self.directory;
        fs::create_dir_all(directory)
            .and_then(|()| clap_mangen::generate_to(command, directory))
            .map_err(|error| format!("cannot write to {}: {error}", directory.display()))?;
        Ok(ExitCode::SUCCESS)
    }
}
