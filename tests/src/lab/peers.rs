//! Other ZeroMQ implementations, old and new (`tests/peers/README.md`), each with a client and a server.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::{OriginalClient, Process, SCOPE, Server, installed, python, reserve_port};

/// The name of the Python 2.7 that has the packages.
const PYTHON27: &str = "python2.7";

/// Another ZeroMQ than ours, with a ZTL client and a ZTL server on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// The original under Python 2.7, over libzmq 4.1.6. Left out where the machine has no such Python.
    Python27,
    /// The original under today's Python, over libzmq 4.1.6.
    OldLibzmq,
    /// JeroMQ 0.3.6, which speaks as libzmq 3.2.5: ZMTP 2.0.
    JeroMq,
    /// zeromq.js 6.
    JavaScript,
}

impl Peer {
    /// All of them.
    pub const ALL: [Self; 4] = [
        Self::Python27,
        Self::OldLibzmq,
        Self::JeroMq,
        Self::JavaScript,
    ];

    /// The peers available on this machine: all, but Python 2.7 only if it is installed.
    pub fn here() -> Vec<Self> {
        let lacking = |peer: &Self| *peer == Self::Python27 && python27().is_none();
        let (lacking, here): (Vec<_>, Vec<_>) = Self::ALL.into_iter().partition(lacking);
        for peer in lacking {
            eprintln!("left out: {peer:?}, which this machine has not");
        }
        here
    }

    /// Its client, of a scope at a port of this machine.
    #[track_caller]
    pub fn client(self, port: u16, scope: &str) -> OriginalClient {
        let mut command = self.command();
        match self {
            Self::Python27 | Self::OldLibzmq => command.arg(source("driver.py")),
            Self::JeroMq | Self::JavaScript => command.arg("client"),
        };
        command.args(["127.0.0.1", &port.to_string(), scope]);
        OriginalClient::of(&mut command)
    }

    /// Its server of the original's test tasks, `test:echo:…` and `test:sleep:SECONDS`.
    #[track_caller]
    pub fn server(self) -> Server {
        Server::start_at_reserved_port(|port| {
            let mut command = self.command();
            match self {
                Self::Python27 | Self::OldLibzmq => command.args(["-m", "ztl.example.task_server"]),
                Self::JeroMq | Self::JavaScript => command.arg("server"),
            };
            command.args(["-p", port, "-s", SCOPE]);
            command
        })
    }

    /// Those that publish and subscribe here.
    pub fn publishers_here() -> Vec<Self> {
        let mut here = Self::here();
        // It has only the sockets of tasks.
        here.retain(|peer| *peer != Self::OldLibzmq);
        here
    }

    /// Its publisher. It sends a message for each line of its input: the frames in hexadecimal.
    #[track_caller]
    pub fn publisher(self) -> (Process, u16) {
        loop {
            let port = reserve_port();
            let mut command = self.stream_command("publisher");
            let process = Process::start(command.arg(port.to_string()));
            if process.wait_for_unless_taken("ready").is_some() {
                return (process, port);
            }
        }
    }

    /// Its subscriber. It prints each message: the frames in hexadecimal.
    pub fn subscriber(self, port: u16, topic: &str) -> Process {
        let mut command = self.stream_command("subscriber");
        Process::start(command.args([&port.to_string(), topic]))
    }

    fn stream_command(self, role: &str) -> Command {
        let mut command = self.command();
        if self == Self::Python27 {
            command.arg(source("streams.py"));
        }
        command.arg(role);
        command
    }

    fn command(self) -> Command {
        let home = home();
        match self {
            Self::Python27 => {
                let packages = home.join("python27");
                let mut command = Command::new(packages.join(PYTHON27));
                command.env("PYTHONPATH", packages).arg("-u");
                command
            }
            Self::OldLibzmq => {
                let mut command = Command::new(python());
                command.env("PYTHONPATH", source("old_libzmq")).arg("-u");
                command.env("ZTL_OLD_LIBZMQ", there(home.join("libzmq-4.1.6.so")));
                command
            }
            Self::JeroMq => {
                let mut command = Command::new("java");
                let classes = there(home.join("java"));
                let path = format!("{}:/usr/share/java/jeromq.jar", classes.display());
                // It starts faster and uses fewer threads: its programs run for seconds.
                command.args(["-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1", "-cp", &path]);
                command.arg("Peer");
                command
            }
            Self::JavaScript => {
                let mut command = Command::new("node");
                command
                    .env("ZTL_CLIENTS", javascript_packages())
                    .arg(source("peer.mjs"));
                command
            }
        }
    }
}

/// Python 2.7, if the machine has it.
#[must_use]
pub fn python27() -> Option<PathBuf> {
    let python = home().join("python27").join(PYTHON27);
    python.exists().then_some(python)
}

fn source(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("peers")
        .join(name)
}

/// The directory with the dependencies of the peers.
#[track_caller]
fn home() -> PathBuf {
    installed("ZTL_PEERS", "peers")
}

/// The directory with zeromq.js in its `node_modules`.
///
/// # Panics
/// When it is missing.
#[track_caller]
pub fn javascript_packages() -> PathBuf {
    node_packages("zeromq")
}

/// The directory of the installed npm packages.
///
/// # Panics
/// When the package `needed` is not among them.
#[track_caller]
pub fn node_packages(needed: &str) -> PathBuf {
    let path = installed("ZTL_CLIENTS", "clients");
    there(path.join("node_modules").join(needed));
    path
}

#[track_caller]
fn there(path: PathBuf) -> PathBuf {
    assert!(
        path.exists(),
        "{} is missing: run `cargo xtask setup`",
        path.display()
    );
    path
}
