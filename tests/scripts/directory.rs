//! A directory with a script and its configuration.

use std::fs;
use std::process::Command;
use ztl_tests::lab::{Ended, Process, Scratch, ztl};

pub(crate) const PLAY: &str = "run-script -s show.yaml -c remotes.yaml --yes --plain";

/// A directory with the script `show.yaml` and, if there are servers, `remotes.yaml`.
pub(crate) struct ScriptDirectory {
    pub(crate) files: Scratch,
}

impl ScriptDirectory {
    pub(crate) fn new(script: &str) -> Self {
        let files = Scratch::new();
        fs::write(files.path("show.yaml"), script).unwrap();
        Self { files }
    }

    /// With these servers, by name, port and scope.
    pub(crate) fn with(script: &str, remotes: &[(&str, u16, &str)]) -> Self {
        let directory = Self::new(script);
        let mut text = "remotes:\n".to_owned();
        for (name, port, scope) in remotes {
            text += &format!("  {name}: {{host: 127.0.0.1, port: {port}, scope: {scope}}}\n");
        }
        fs::write(directory.files.path("remotes.yaml"), text).unwrap();
        directory
    }

    pub(crate) fn command(&self, words: &str) -> Command {
        let mut command = ztl();
        command.args(words.split(' ').filter(|word| !word.is_empty()));
        command
            .current_dir(self.files.path(""))
            .env("XDG_CONFIG_HOME", self.files.path("nothing"));
        command
    }

    pub(crate) fn run(&self, words: &str) -> Ended {
        Process::run(&mut self.command(words))
    }
}
