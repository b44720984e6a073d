//! `ztl completions`: prints a script that completes the command in a shell.

use std::process::ExitCode;

use clap::Command;
use clap_complete::generate;
use clap_complete::shells::{Bash, Fish, Zsh};

use crate::exit::Done;
use crate::terminal::part;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "To try it in bash: source <(ztl completions bash). The Debian package installs all three scripts."
)]
pub(crate) struct Completions {
    /// The shell that reads the script
    shell: Shell,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Shell {
    Bash,
    Zsh,
    Fish,
}

impl Completions {
    pub(crate) fn run(self, command: &mut Command) -> Done {
        let name = command.get_name().to_owned();
        let mut script = Vec::new();
        match self.shell {
            Shell::Bash => generate(Bash, command, name, &mut script),
            Shell::Zsh => generate(Zsh, command, name, &mut script),
            Shell::Fish => generate(Fish, command, name, &mut script),
        }
        part(String::from_utf8(script)?);
        Ok(ExitCode::SUCCESS)
    }
}
