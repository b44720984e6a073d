//! The command-line clients, the original's and ours.

use std::process::Command;

use super::{Ended, Process, SCOPE, Scratch, Server, built, original_tool, ztl};

/// `ztl task-client`
#[track_caller]
pub fn our_client() -> Command {
    let mut command = ztl();
    command.arg("task-client");
    command
}

/// Our command under another name. Under a name of the original's, such as `ztl_task_client`, it is that tool.
#[track_caller]
pub fn ours_named(scratch: &Scratch, name: &str) -> Command {
    let link = scratch.path(name);
    if !link.exists() {
        std::os::unix::fs::symlink(built("ztl"), &link).expect("a link");
    }
    Command::new(link)
}

/// `ztl task-client` with the options for a server at this port of this machine.
#[track_caller]
pub fn our_client_at(port: u16) -> Command {
    let mut command = our_client();
    command.args(["-r", "localhost", "-p", &port.to_string(), "-s", SCOPE]);
    command
}

/// The original's `ztl_task_client`.
#[track_caller]
pub fn original_client() -> Command {
    original_tool("ztl_task_client")
}

/// A client's output and exit code, without the parts that differ between runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ClientOutput {
    /// Its stdout, without the task's id and the server's port.
    pub text: String,
    /// Its exit code.
    pub code: Option<i32>,
}

impl ClientOutput {
    /// The output of a client of the server at `port`.
    pub fn of(ended: &Ended, port: u16) -> Self {
        let text = ended.stdout.replace(&format!(":{port}'"), ":PORT'");
        let id = text
            .split_once("task with ID '")
            .and_then(|(_, rest)| rest.split('\'').next());
        let text = match id {
            Some(id) => text
                .replace(&format!("ID '{id}'"), "ID 'ID'")
                .replace(&format!("task '{id}'"), "task 'ID'"),
            None => text,
        };
        Self {
            text,
            code: ended.code,
        }
    }

    /// Checks how the last line ends, so that a test does not compare two failures.
    #[track_caller]
    pub fn assert_ends_with(&self, last: &str) {
        assert!(
            self.text.trim_end().ends_with(last),
            "not '{last}': {self:?}"
        );
    }
}

impl Server {
    /// Starts a client with the options for this server, and then `args`.
    #[track_caller]
    pub fn start_client(&self, mut client: Command, args: &[&str]) -> Process {
        let port = self.port.to_string();
        client.args(["-r", "localhost", "-p", &port, "-s", SCOPE]);
        Process::start(client.args(args))
    }
}
