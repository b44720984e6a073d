//! `ztl completions`: prints a script that completes the command in a shell. To clap's scripts it adds the tasks of
//! servers, which `ztl complete-goal` knows.

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

const BASH: &str = include_str!("completions/goals.bash");
const ZSH: &str = include_str!("completions/goals.zsh");
const FISH: &str = include_str!("completions/goals.fish");

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
        let script = String::from_utf8(script)?;
        part(match self.shell {
            Shell::Bash => {
                script.replace("    complete -F _ztl ", "    complete -F _ztl_goals ") + BASH
            }
            Shell::Zsh => {
                let begin = "_ztl() {\n";
                script.replacen(
                    begin,
                    &format!("{ZSH}{begin}    _ztl_goals && return 0\n"),
                    1,
                )
            }
            Shell::Fish => script + FISH,
        });
        Ok(ExitCode::SUCCESS)
    }
}
