//! Bounds of a server's own connections, in figures: memory, processor time, files, and how long a good client waits beside
//! anonymous ones.

mod answers;
mod connections;
mod crowd;
mod curve;
mod endpoints;
mod slow_network;

use std::process::Command;

use ztl_std::{RemoteTask, RequestError, TaskId};
use ztl_tests::lab::{SCOPE, Scratch, Server, connect, start, ztl};

/// Peak memory of a server that one connection abuses.
const MEMORY: u64 = 64 << 10;

#[derive(Debug, Clone, Copy)]
enum Kind {
    Gateway,
    Serve,
    TaskServer,
}

/// A server, and a task of it that takes a second or two.
struct Subject {
    server: Server,
    task: [&'static str; 3],
}

impl Subject {
    /// A server with these options. `files` is how many files it may open.
    #[track_caller]
    fn start(kind: Kind, files: Option<u32>, options: &[&str]) -> Self {
        let scratch = Scratch::new();
        let mut command = ztl();
        let device = ["-p", "0", "-s", SCOPE, "--device", "gripper=sim:gripper"];
        match kind {
            Kind::Gateway => command.arg("gateway").args(device),
            Kind::Serve => {
                let file = scratch.path("naps.yaml");
                let text = format!("port: 0\nscopes: {{{SCOPE}: {{nap: {{for: sleep}}}}}}\n");
                std::fs::write(&file, text).expect("a file");
                command.arg("serve").arg(file)
            }
            Kind::TaskServer => command.arg("task-server").args(&device[..4]),
        };
        command.args(options);
        if let Some(files) = files {
            command = with_open_files(files, &command);
        }
        let server = match kind {
            Kind::TaskServer => Server::start_test_server(command),
            _ => Server::start(&mut command),
        };
        let task = match kind {
            Kind::Gateway => ["gripper", "finger", "100"],
            Kind::Serve => ["nap", "for", "2"],
            Kind::TaskServer => ["test", "sleep", "2"],
        };
        if let Kind::Gateway = kind {
            server.wait_ready("gripper");
        }
        Self { server, task }
    }

    /// A connected client.
    #[track_caller]
    fn client(&self) -> RemoteTask {
        let mut remote = connect(&self.server.endpoint());
        is_served(&mut remote);
        remote
    }

    #[track_caller]
    fn start_task(&self, remote: &mut RemoteTask) -> TaskId {
        let [handler, component, goal] = self.task;
        start(remote, handler, component, goal)
    }
}

/// The same program, which may open so many files.
fn with_open_files(files: u32, command: &Command) -> Command {
    let mut limited = Command::new("sh");
    let script = format!("ulimit -n {files}; exec \"$@\"");
    limited
        .args(["-c", &script, "sh"])
        .arg(command.get_program());
    limited.args(command.get_args());
    limited
}

/// A client is served.
#[track_caller]
fn is_served(remote: &mut RemoteTask) {
    match remote.status(99) {
        Err(RequestError::UnknownTask { .. }) => {}
        other => panic!("not served: {other:?}"),
    }
}
