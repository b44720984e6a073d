//! Fleets of real processes: agents, endpoints, and routers of ours and of PyPI's `eclipse-zenoh`, on one machine.

#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test says what is wrong by panicking"
)]

mod busy;
mod certificates;
mod commands;
mod connections;
mod faults;
mod identity;
#[expect(dead_code, reason = "the benchmark uses the rest")]
mod line;
mod pictures;
mod requests;
mod rules;
mod scene;
mod stream_rules;
mod streams;
#[path = "../../../tests/web/client.rs"]
#[expect(dead_code, reason = "the tests of the web console use the rest")]
mod web_client;

use std::path::{Path, PathBuf};
use std::process::Command;

use requests::{abort, start, status};
use ztl_std::{RemoteTask, RequestError, State, TriggerError};
use ztl_tests::lab::{
    COMPLETED, LIMIT, OriginalClient, PATIENCE, Process, Scratch, Server, connect_to, end,
    installed, reserve_port, until,
};

fn fleet(words: &[&str], file: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ztl-fleet"));
    command.args(words).arg(file);
    command
}

/// Python with `eclipse-zenoh`.
fn python(script: &str, args: &[&str]) -> Command {
    let mut command = Command::new(installed("ZTL_ZENOH", "zenoh/bin/python"));
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/processes");
    command.arg("-u").arg(directory.join(script)).args(args);
    command
}

/// A fleet with a router at a port of its own.
struct Fleet {
    scratch: Scratch,
    router: Process,
    address: String,
    port: u16,
    endpoint: Process,
}

impl Fleet {
    fn new() -> Self {
        Self::with(Scratch::new(), "robots: [arm, leg]\n")
    }

    /// `more` are lines of the endpoint's file.
    fn with(scratch: Scratch, more: &str) -> Self {
        let address = format!("tcp/127.0.0.1:{}", reserve_port());
        let router = Self::start_router(&scratch, &address);
        let endpoint = Self::start_endpoint(&scratch, &address, 0, more);
        let port = endpoint.wait_for_port("Serving ");
        Self {
            scratch,
            router,
            address,
            port,
            endpoint,
        }
    }

    fn start_router(scratch: &Scratch, address: &str) -> Process {
        let file = scratch.path("router.yaml");
        std::fs::write(&file, format!("listen: {address}\n")).unwrap();
        let router = Process::start(&mut fleet(&["router"], &file));
        router.wait_for("Routing at");
        router
    }

    fn start_endpoint(scratch: &Scratch, address: &str, port: u16, more: &str) -> Process {
        let file = scratch.path("endpoint.yaml");
        let text = format!("port: {port}\nrouters: {address}\n{more}");
        std::fs::write(&file, text).unwrap();
        Process::start(&mut fleet(&["endpoint"], &file))
    }

    /// Starts an agent beside a server, without waiting for it.
    fn start_agent(&self, state: &str, server: &Server, more: &str) -> Process {
        let file = self.agent_file(state, &server.endpoint(), more);
        Process::start(&mut fleet(&["join"], &file))
    }

    /// An agent's file.
    fn agent_file(&self, state: &str, server: &str, more: &str) -> PathBuf {
        let file = self.scratch.path(format!("{state}.yaml"));
        let address = &self.address;
        let text =
            format!("name: arm\nserver: {server}\nrouters: {address}\nstate: {state}\n{more}");
        std::fs::write(&file, text).unwrap();
        file
    }

    fn join(&self, server: &Server, more: &str) -> Process {
        let file = self.agent_file("arm", &server.endpoint(), more);
        self.join_by(&mut fleet(&["join"], &file))
    }

    fn join_by(&self, command: &mut Command) -> Process {
        let agent = Process::start(command);
        agent.wait_for("has joined");
        self.wait_there();
        agent
    }

    /// Waits until the endpoint knows the robot.
    fn wait_there(&self) {
        let mut remote = self.client();
        until("the robot is served", PATIENCE, || {
            let scopes = remote.describe().ok()??.scopes;
            scopes.contains_key("/arm/test").then_some(())
        });
    }

    fn client(&self) -> RemoteTask {
        requests::client(self.port, "/arm/test")
    }
}

/// Kills as `kill -9` does.
fn kill(process: Process) {
    drop(process);
}

/// How many tasks the robot's server has had.
fn tasks(server: &Server) -> usize {
    let known = connect_to(&server.endpoint(), "/test").tasks().unwrap();
    let known = known.expect("a list");
    known.tasks.len()
}

#[test]
fn a_python_program_without_our_code_lists_robots_and_starts_a_task_once() {
    // Servers of the original would start a repeated INIT again.
    let (fleet, server) = (Fleet::new(), Server::original());
    let _agent = fleet.join(&server, "scopes: /test\n");
    let args = [fleet.address.as_str(), "arm", "/test", "test:echo:hi"];
    let told = Process::run(&mut python("client.py", &args)).stdout;
    let lines: Vec<&str> = told.lines().collect();
    assert_eq!(lines[0], "robots arm");
    let rest = ["again True", "stale unknown:", "late stale:"];
    assert_eq!(lines[2..5], rest, "{told}");
    assert!(lines[5].starts_with("end 5 "), "{told}");
    let first = lines[1].strip_prefix("first /test;1;");
    let first = first.and_then(|rest| rest.split(';').next()?.parse::<i64>().ok());
    // Its ids are consecutive.
    let next = server.original_client().start("test", "echo", "hi");
    assert_eq!(first, Some(next - 1), "{told}");
}

#[test]
fn a_foreign_router_serves_as_well_and_so_does_the_originals_client_and_server() {
    let scratch = Scratch::new();
    let address = format!("tcp/127.0.0.1:{}", reserve_port());
    let router = Process::start(&mut python("router.py", &[&address]));
    router.wait_for("Routing");
    let endpoint = Fleet::start_endpoint(&scratch, &address, 0, "");
    let port = endpoint.wait_for_port("Serving ");
    let fleet = Fleet {
        scratch,
        router,
        address,
        port,
        endpoint,
    };
    let server = Server::original();
    let _agent = fleet.join(&server, "scopes: /test\n");
    let mut client = OriginalClient::connect(fleet.port, "/arm/test");
    let id = client.start("test", "echo", "hi");
    assert_eq!(client.wait(id, 20.0).number, COMPLETED);
    // The id is the robot's own.
    let mut direct = server.original_client();
    assert_eq!(direct.status(id).number, COMPLETED);
}

#[test]
fn no_task_is_doubled_or_told_falsely_when_router_agent_and_endpoint_are_killed() {
    let (mut fleet, server) = (Fleet::new(), Server::naps());
    let agent = fleet.join(&server, "");
    let mut remote = fleet.client();
    let id = start(&mut remote, "nap", "for", "60");

    kill(fleet.router);
    // Nobody knows, and nobody says that it has failed.
    assert!(matches!(
        remote.status(id),
        Err(RequestError::NoAnswer { .. })
    ));
    fleet.router = Fleet::start_router(&fleet.scratch, &fleet.address);
    fleet.wait_there();
    assert_eq!(status(&mut remote, id).state, State::Accepted);

    kill(agent);
    until("the robot is gone", PATIENCE, || {
        let refused = remote.trigger("nap", "for", "0");
        matches!(refused, Err(TriggerError::Rejected { reason, .. }) if reason == "robot 'arm' is not connected")
            .then_some(())
    });
    let _agent = fleet.join(&server, "");
    assert_eq!(status(&mut remote, id).state, State::Accepted);

    kill(fleet.endpoint);
    fleet.endpoint = Fleet::start_endpoint(&fleet.scratch, &fleet.address, fleet.port, "");
    fleet.wait_there();
    assert_eq!(status(&mut remote, id).state, State::Accepted);
    abort(&mut remote, id);
    assert_eq!(end(&mut remote, id).0, State::Aborted);
    let mut direct = connect_to(&server.endpoint(), "/test");
    assert_eq!(direct.status(id).unwrap().state, State::Aborted);
}

#[test]
fn a_robot_that_was_cut_off_has_the_same_ids_and_final_states() {
    let (mut fleet, server) = (Fleet::new(), Server::naps());
    let _agent = fleet.join(&server, "");
    let mut remote = fleet.client();
    let done = start(&mut remote, "nap", "for", "0");
    let ended = end(&mut remote, done);
    let running = start(&mut remote, "nap", "for", "1");
    kill(fleet.router);
    // It goes on alone.
    let mut direct = connect_to(&server.endpoint(), "/test");
    assert_eq!(direct.wait(running, LIMIT).unwrap().state, State::Completed);
    fleet.router = Fleet::start_router(&fleet.scratch, &fleet.address);
    fleet.wait_there();
    assert_eq!(end(&mut remote, done), ended);
    assert_eq!(end(&mut remote, running).0, State::Completed);
    assert_eq!(tasks(&server), 2);
}

#[test]
fn stop_all_names_who_confirmed_and_who_was_not_there() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let _agent = fleet.join(&server, "");
    let mut remote = fleet.client();
    let [one, two] = ["60", "61"].map(|time| start(&mut remote, "nap", "for", time));
    let file = fleet.scratch.path("endpoint.yaml");
    let stopped = Process::run(&mut self::fleet(&["stop-all"], &file));
    // What is known first is printed first.
    let mut lines: Vec<&str> = stopped.stdout.lines().collect();
    lines.sort_unstable();
    assert_eq!(lines, ["arm  stopped: 2 tasks", "leg  was not there"]);
    assert_eq!(stopped.code, Some(1));
    for id in [one, two] {
        assert_eq!(status(&mut remote, id).state, State::Aborted);
    }
    let listed = Process::run(&mut self::fleet(&["ls"], &file)).stdout;
    assert!(listed.starts_with("arm  ready  /test  since 2"), "{listed}");
    assert!(listed.ends_with("Z\nleg  not there  \n"), "{listed}");
}

#[test]
fn a_second_robot_of_the_same_name_is_refused_and_both_are_told() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let first = fleet.join(&server, "");
    let second = fleet.start_agent("other", &server, "");
    second.wait_for("the name 'arm' is taken by agent");
    first.wait_for("claims the name 'arm', too, and was refused");
    let mut remote = fleet.client();
    let id = start(&mut remote, "nap", "for", "0");
    assert_eq!(end(&mut remote, id).0, State::Completed);
}
