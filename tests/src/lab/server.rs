//! Task servers as processes: ours, the original's, and gateways.

use std::process::Command;

use super::{
    OriginalClient, PATIENCE, Process, Scratch, original_tool, python, reserve_port, until, ztl,
};

/// The scope of every server here.
pub const SCOPE: &str = "/test";

/// The first line of a server of test tasks.
const REGISTERED: &str = "Registering controller for scope '/test'";

/// The original's `ztl_task_server`, whose ids begin after 2^127.
const LARGE_IDS: &str = "\
import ztl.core.task
init = ztl.core.task.TaskController.__init__
def large(self):
    init(self)
    self._current = 2 ** 127
ztl.core.task.TaskController.__init__ = large
from ztl.example.task_server import main_cli
main_cli()
";

/// A server of the original with tasks that can be aborted: they last until then. The goal `mute` has no status.
const PATIENT_TASKS: &str = "\
import sys, threading
from ztl.core.server import TaskServer
from ztl.core.task import ExecutableTask, TaskController
class Nap(ExecutableTask):
    def __init__(self, goal):
        self.goal, self.over = goal, threading.Event()
    def execute(self):
        self.over.wait(60)
    def status(self):
        if self.goal == 'mute': raise Exception('no sensor')
    def abort(self):
        print('abort ' + self.goal)
        return True
class Naps(TaskController):
    def assign(self, handler, component, goal):
        return Nap, goal
server = TaskServer(int(sys.argv[1]))
server.register(sys.argv[2], Naps())
server.listen()
";

/// A task server in its own process, at its own port.
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
        Self::ours_at(0)
    }

    /// The same, with this transport.
    #[track_caller]
    pub fn ours_over(transport: &str) -> Self {
        let mut command = ztl();
        command.args(["task-server", "-p", "0", "-s", SCOPE]);
        command.args(["--transport", transport]);
        Self::start_test_server(command)
    }

    /// The same at a port of the test's own, so that another can follow it there.
    #[track_caller]
    pub fn ours_at(port: u16) -> Self {
        let mut command = ztl();
        command.args(["task-server", "-p", &port.to_string(), "-s", SCOPE]);
        Self::start_test_server(command)
    }

    /// The original's `ztl_task_server`, at a port of the test's own.
    #[track_caller]
    pub fn original() -> Self {
        Self::start_at_reserved_port(original_at)
    }

    /// The same, unchanged, but its ids are as long as those of `uuid.uuid4().int`.
    #[track_caller]
    pub fn original_with_large_ids() -> Self {
        Self::start_at_reserved_port(|port| {
            let mut command = Command::new(python());
            command.args(["-u", "-c", LARGE_IDS, "-p", port, "-s", SCOPE]);
            command
        })
    }

    /// The original's server, unchanged, with tasks that last until they are aborted, and print their goal then.
    #[track_caller]
    pub fn original_with_patient_tasks() -> Self {
        Self::start_at_reserved_port(|port| {
            let mut command = Command::new(python());
            command.args(["-u", "-c", PATIENT_TASKS, port, SCOPE]);
            command
        })
    }

    /// `ztl simple-server`.
    #[track_caller]
    pub fn simple_ours() -> Self {
        let mut command = ztl();
        command.args(["simple-server", "0", SCOPE]);
        Self::start_test_server(command)
    }

    /// The original's `ztl_simple_server`.
    #[track_caller]
    pub fn simple_original() -> Self {
        Self::start_at_reserved_port(|port| {
            let mut command = original_tool("ztl_simple_server");
            command.args([port, SCOPE]);
            command
        })
    }

    /// Any of our commands that serves the original's test tasks with the original's options.
    #[track_caller]
    pub fn test_server(mut command: Command) -> Self {
        // It chooses its port itself and prints it.
        command.args(["-p", "0", "-s", SCOPE]);
        Self::start_test_server(command)
    }

    /// Starts one of our test servers, which print the scope and then the port.
    #[track_caller]
    pub fn start_test_server(mut command: Command) -> Self {
        let process = Process::start(&mut command);
        // The port is bound before this line.
        process.wait_for(REGISTERED);
        let port = process.wait_for_port("Task Server listening at");
        Self { process, port }
    }

    /// Starts a server at a reserved port; at another one if a program takes that first.
    #[track_caller]
    pub(super) fn start_at_reserved_port(command: impl Fn(&str) -> Command) -> Self {
        loop {
            let port = reserve_port();
            let process = Process::start(&mut command(&port.to_string()));
            if process.wait_for_unless_taken(REGISTERED).is_some() {
                return Self { process, port };
            }
        }
    }

    /// A server that prints `Serving …` with its address.
    #[track_caller]
    pub fn start(command: &mut Command) -> Self {
        let process = Process::start(command);
        let port = process.wait_for_port("Serving ");
        Self { process, port }
    }

    /// `ztl serve` with tasks that last: `nap:for:60` sleeps a minute, and can be aborted.
    #[track_caller]
    pub fn naps() -> Self {
        let scratch = Scratch::new();
        let file = scratch.path("naps.yaml");
        let text = format!("port: 0\nscopes: {{{SCOPE}: {{nap: {{for: sleep}}}}}}\n");
        std::fs::write(&file, text).expect("a file");
        Self::start(ztl().arg("serve").arg(file))
    }

    /// `ztl gateway` with these devices, as `gripper=sim:gripper`; which need not be there yet.
    #[track_caller]
    pub fn gateway(devices: &[&str]) -> Self {
        Self::gateway_with(devices, &[])
    }

    /// The same with more options.
    #[track_caller]
    pub fn gateway_with(devices: &[&str], options: &[&str]) -> Self {
        Self::start(gateway(devices).args(options))
    }

    /// A gateway with a simulated gripper and a simulated head, both ready.
    #[track_caller]
    pub fn simulated() -> Self {
        let gateway = Self::gateway(&["gripper=sim:gripper", "head=sim:head"]);
        gateway.wait_ready("gripper");
        gateway.wait_ready("head");
        gateway
    }

    /// Waits until a gateway's device first accepts tasks.
    #[track_caller]
    pub fn wait_ready(&self, device: &str) {
        self.process
            .wait_for(&format!("Device '{device}' is ready"));
    }

    /// Sets how fast an axis of a simulated device moves, as `head`, `pan.speed`, 0.1: ten times slower than usual.
    #[track_caller]
    pub fn set_speed(&self, device: &str, parameter: &str, factor: f32) {
        let (factor, port) = (factor.to_string(), self.port.to_string());
        let words = ["param", "set", device, parameter, &factor, "-p", &port];
        let ended = Process::run(ztl().args(words));
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }

    /// What `ztl describe` prints, once it has each of these texts: devices describe themselves after they are ready.
    #[track_caller]
    pub fn wait_described(&self, texts: &[&str]) -> String {
        let port = self.port.to_string();
        until(&texts.join(", "), PATIENCE, || {
            let told = Process::run(ztl().args(["describe", "-p", &port])).stdout;
            let is_told = texts.iter().all(|text| told.contains(text));
            is_told.then_some(told)
        })
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

/// `ztl gateway` at any port, with these devices.
#[track_caller]
pub fn gateway(devices: &[&str]) -> Command {
    let mut command = ztl();
    command.args(["gateway", "-p", "0", "-s", SCOPE]);
    for device in devices {
        command.args(["--device", device]);
    }
    command
}

/// `ztl device sim:gripper` at an address such as `pty:LINK`, once it is there.
#[track_caller]
pub fn simulated_gripper(on: &str) -> Process {
    let device = Process::start(ztl().args(["device", "sim:gripper", "--on", on]));
    device.wait_for("Simulated gripper at");
    device
}

/// The original's `ztl_task_server` at a port.
#[track_caller]
fn original_at(port: &str) -> Command {
    let mut command = original_tool("ztl_task_server");
    command.args(["-p", port, "-s", SCOPE]);
    command
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn a_server_with_a_taken_port_is_started_at_another() {
        let taken = TcpListener::bind(("0.0.0.0", 0)).expect("a port");
        let taken = taken.local_addr().expect("its address").port().to_string();
        let starts = Cell::new(0);
        let server = Server::start_at_reserved_port(|port| {
            starts.set(starts.get() + 1);
            original_at(if starts.get() == 1 { &taken } else { port })
        });
        assert_eq!(starts.get(), 2);
        let id = server.original_client().start("test", "echo", "hi");
        assert!(id > 0, "{id}");
    }
}
