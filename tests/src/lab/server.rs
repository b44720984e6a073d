//! Task servers as processes: ours, the original's, and gateways.

use std::process::Command;

use super::{OriginalClient, Process, free_port, original_tool, ztl};

/// The scope of every server here.
pub const SCOPE: &str = "/test";

/// A task server in a process of its own, at a port of its own.
#[derive(Debug)]
pub struct Server {
    /// The process.
    pub process: Process,
    /// Where it listens.
    pub port: u16,
}

impl Server {
    /// `ztl task-server`.
    #[track_caller]
    pub fn ours() -> Self {
        let mut command = ztl();
        command.arg("task-server");
        Self::test_server(command)
    }

    /// The original's `ztl_task_server`.
    #[track_caller]
    pub fn original() -> Self {
        Self::test_server(original_tool("ztl_task_server"))
    }

    /// `ztl simple-server`.
    #[track_caller]
    pub fn simple_ours() -> Self {
        let mut command = ztl();
        command.arg("simple-server");
        Self::simple(command)
    }

    /// The original's `ztl_simple_server`.
    #[track_caller]
    pub fn simple_original() -> Self {
        Self::simple(original_tool("ztl_simple_server"))
    }

    #[track_caller]
    fn simple(mut command: Command) -> Self {
        let port = free_port();
        command.args([&port.to_string(), SCOPE]);
        let process = Process::start(&mut command);
        process.wait_for("Registering controller for scope '/test'");
        Self { process, port }
    }

    /// Any command that serves the original's test tasks with the original's options.
    #[track_caller]
    pub fn test_server(mut command: Command) -> Self {
        let port = free_port();
        command.args(["-p", &port.to_string(), "-s", SCOPE]);
        let process = Process::start(&mut command);
        // Bound before this is said.
        process.wait_for("Registering controller for scope '/test'");
        Self { process, port }
    }

    /// `ztl gateway` with these devices, as `gripper=sim:gripper`; which need not be there yet.
    #[track_caller]
    pub fn gateway(devices: &[&str]) -> Self {
        Self::gateway_with(devices, &[])
    }

    /// The same with more options.
    #[track_caller]
    pub fn gateway_with(devices: &[&str], options: &[&str]) -> Self {
        let mut command = ztl();
        // It chooses its port itself, and says it.
        command.args(["gateway", "-p", "0", "-s", SCOPE]);
        for device in devices {
            command.args(["--device", device]);
        }
        command.args(options);
        let process = Process::start(&mut command);
        let line = process.wait_for("Serving ");
        let port = line
            .split_once("tcp://127.0.0.1:")
            .and_then(|(_, rest)| rest.split(',').next())
            .and_then(|port| port.parse().ok());
        let port = port.unwrap_or_else(|| panic!("no port in '{line}'"));
        Self { process, port }
    }

    /// A gateway with a simulated gripper and a simulated head, both ready.
    #[track_caller]
    pub fn simulated() -> Self {
        let gateway = Self::gateway(&["gripper=sim:gripper", "head=sim:head"]);
        gateway.wait_ready("gripper");
        gateway.wait_ready("head");
        gateway
    }

    /// Waits until a gateway's device takes tasks for the first time.
    #[track_caller]
    pub fn wait_ready(&self, device: &str) {
        self.process
            .wait_for(&format!("Device '{device}' is ready"));
    }

    /// Its ZeroMQ address.
    pub fn endpoint(&self) -> String {
        format!("tcp://127.0.0.1:{}", self.port)
    }

    /// One of the original's clients of it.
    #[track_caller]
    pub fn original_client(&self) -> OriginalClient {
        OriginalClient::connect(self.port, SCOPE)
    }
}
