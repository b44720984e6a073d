//! Robots, their agents, routers and an endpoint, each a process.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use ztl_std::RemoteTask;
use ztl_std::keys::KeyPair;
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, reserve_port, until};

use crate::requests::client;

pub(crate) fn fleet(words: &[&str], file: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ztl-fleet"));
    command.args(words).arg(file);
    command
}

/// Starts a command with this file.
pub(crate) fn start(scratch: &Scratch, command: &str, file: &str, text: &str) -> Process {
    let file = scratch.path(file);
    std::fs::write(&file, text).expect("to write");
    Process::start(&mut fleet(&[command], &file))
}

/// Routers, each connected to all before it.
pub(crate) struct Routers {
    pub(crate) addresses: Vec<String>,
    pub(crate) processes: Vec<Process>,
}

impl Routers {
    pub(crate) fn start(scratch: &Scratch, count: usize) -> Self {
        let mut all = Self {
            addresses: Vec::new(),
            processes: Vec::new(),
        };
        for number in 0..count {
            all.addresses
                .push(format!("tcp/127.0.0.1:{}", reserve_port()));
            let router = all.process(scratch, number);
            all.processes.push(router);
        }
        all
    }

    fn process(&self, scratch: &Scratch, number: usize) -> Process {
        let text = format!(
            "listen: {}\nrouters: [{}]\n",
            self.addresses[number],
            self.addresses[..number].join(", ")
        );
        let router = start(scratch, "router", &format!("router-{number}.yaml"), &text);
        router.wait_for("Routing at");
        router
    }

    /// Ends one as `kill -9` does, and returns when.
    pub(crate) fn kill(&mut self, number: usize) -> Instant {
        let killed = Instant::now();
        self.processes[number].kill();
        killed
    }

    pub(crate) fn restart(&mut self, scratch: &Scratch, number: usize) {
        self.processes[number] = self.process(scratch, number);
    }

    /// All addresses, of which this one comes first.
    pub(crate) fn list(&self, first: usize) -> String {
        let count = self.addresses.len();
        let all = (0..count).map(|step| self.addresses[(first + step) % count].as_str());
        format!("[{}]", all.collect::<Vec<_>>().join(", "))
    }
}

/// A robot `arm` at the last of some routers, and an endpoint at the first one.
pub(crate) struct Pair {
    /// The endpoint's ports, for tasks and for subscribers.
    pub(crate) port: u16,
    pub(crate) publishes: Option<u16>,
    /// Killed when they are dropped.
    _processes: Vec<Process>,
}

impl Pair {
    /// A fleet of that name; with a publisher of the robot, and with keys.
    pub(crate) fn start(
        scratch: &Scratch,
        name: &str,
        server: &Server,
        publisher: Option<&str>,
        routers: usize,
        keys: bool,
    ) -> Self {
        let routers_of = Routers::start(scratch, routers);
        let (first, last) = (&routers_of.addresses[0], &routers_of.addresses[routers - 1]);
        let mut agent = format!(
            "name: arm\nserver: {}\nrouters: {last}\nstate: {name}\n",
            server.endpoint()
        );
        let mut endpoint = format!("port: 0\nrouters: {first}\n");
        if let Some(publisher) = publisher {
            agent += &format!("publish: {publisher}\n");
            endpoint += "publish: 0\n";
        }
        if keys {
            for key in ["arm", "desk"] {
                let pair = KeyPair::generate();
                pair.write(&scratch.path(key)).expect("to write");
            }
            agent += "fleet-key: arm.key_secret\nclient-keys: desk.key\n";
            endpoint += "fleet-key: desk.key_secret\nrobots: {arm: {key: arm.key}}\n";
        }
        let agent = start(scratch, "join", &format!("{name}-agent.yaml"), &agent);
        let endpoint = start(scratch, "endpoint", &format!("{name}.yaml"), &endpoint);
        let port = endpoint.wait_for_port("Serving ");
        let mut remote = client(port, "/arm/test");
        until("the robot is served", PATIENCE, || {
            let scopes = remote.describe().ok()??.scopes;
            scopes.contains_key("/arm/test").then_some(())
        });
        let publishes = publisher.map(|_| endpoint.wait_for_port("Publishing "));
        let mut processes = routers_of.processes;
        processes.extend([agent, endpoint]);
        Self {
            port,
            publishes,
            _processes: processes,
        }
    }

    /// A client of the robot.
    pub(crate) fn client(&self) -> RemoteTask {
        client(self.port, "/arm/test")
    }
}

/// A building full of robots.
pub(crate) struct Hall {
    pub(crate) scratch: Scratch,
    pub(crate) routers: Routers,
    /// The server of a robot is that at its number, modulo their count.
    pub(crate) servers: Vec<Server>,
    pub(crate) robots: usize,
    pub(crate) agents: Vec<Process>,
    pub(crate) endpoint: Process,
    pub(crate) port: u16,
}

impl Hall {
    /// So many robots at these servers; returns how long their agents took until the endpoint served all of them.
    pub(crate) fn open(robots: usize, servers: Vec<Server>) -> (Self, Duration) {
        let scratch = Scratch::new();
        let routers = Routers::start(&scratch, 3);
        let names: Vec<String> = (0..robots).map(name).collect();
        let text = format!(
            "port: 0\nrouters: {}\nrobots: [{}]\n",
            routers.list(0),
            names.join(", ")
        );
        let endpoint = start(&scratch, "endpoint", "endpoint.yaml", &text);
        let mut hall = Self {
            port: endpoint.wait_for_port("Serving "),
            agents: Vec::new(),
            endpoint,
            servers,
            robots,
            routers,
            scratch,
        };
        let begun = Instant::now();
        for robot in 0..robots {
            let agent = hall.start_agent(robot);
            hall.agents.push(agent);
        }
        hall.wait_complete();
        (hall, begun.elapsed())
    }

    fn start_agent(&self, robot: usize) -> Process {
        let name = name(robot);
        let text = format!(
            "name: {name}\nserver: {}\nrouters: {}\nstate: {name}\n",
            self.servers[robot % self.servers.len()].endpoint(),
            self.routers.list(robot)
        );
        start(&self.scratch, "join", &format!("{name}.yaml"), &text)
    }

    /// Which robots the endpoint serves.
    pub(crate) fn served(&self) -> BTreeSet<String> {
        let mut remote = client(self.port, "/none");
        let told = remote.describe().ok().flatten();
        let scopes = told.into_iter().flat_map(|told| told.scopes.into_keys());
        scopes.collect()
    }

    /// Waits until the endpoint serves all robots.
    pub(crate) fn wait_complete(&self) {
        until("all robots are served", 3 * PATIENCE, || {
            (self.served().len() == self.robots).then_some(())
        });
    }
}

pub(crate) fn name(robot: usize) -> String {
    format!("arm-{robot}")
}
