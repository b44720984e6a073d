//! A gateway that is killed and started again.

use std::path::PathBuf;
use std::time::Duration;

use super::device::{Deed, Device};
use ztl_std::{RemoteTask, State, TaskId};
use ztl_tests::lab::{
    LIMIT, PATIENCE, SCOPE, Scratch, Server, connect, reserve_port, start, status, until, ztl,
};

/// Long enough for a restart of the gateway on a busy machine.
pub(super) const LONG: Duration = Duration::from_secs(8);
/// Long enough for a client of a busy machine to see a task before it fails, which takes twice as long.
pub(super) const MEDIUM: Duration = Duration::from_secs(4);
/// A device's default link timeout.
pub(super) const USUAL: Duration = Duration::from_secs(1);

/// A gateway that can be killed and started again.
pub(super) struct GatewayRig {
    pub(super) device: Device,
    pub(super) scratch: Scratch,
    pub(super) port: u16,
    pub(super) gateway: Server,
}

impl GatewayRig {
    #[track_caller]
    pub(super) fn new(link_timeout: Duration) -> Self {
        let device = Device::power_on(link_timeout);
        let (scratch, port) = (Scratch::new(), reserve_port());
        let gateway = start_gateway(&device, &scratch, port);
        gateway.wait_ready("motors");
        Self {
            device,
            scratch,
            port,
            gateway,
        }
    }

    pub(super) fn journal(&self) -> PathBuf {
        self.scratch.path("journal")
    }

    #[track_caller]
    pub(super) fn client(&self) -> RemoteTask {
        connect(&self.gateway.endpoint())
    }

    /// A client for the time when the gateway is killed, created while no command is in flight that a `Start` would have to wait
    /// for.
    #[track_caller]
    pub(super) fn quiet_client(&self) -> RemoteTask {
        let mut client = self.client();
        let id = start(&mut client, "motors", "arm", "1 1");
        assert_eq!(client.wait(id, LIMIT), Ok(status(State::Completed, "1")));
        client.with_timeout(Duration::from_secs(5))
    }

    #[track_caller]
    pub(super) fn kill(&mut self) {
        self.gateway.process.kill();
    }

    #[track_caller]
    pub(super) fn start_again(&mut self) {
        self.gateway = start_gateway(&self.device, &self.scratch, self.port);
    }

    /// The complete lines of the journal.
    pub(super) fn lines(&self) -> Vec<serde_json::Value> {
        let written = std::fs::read(self.journal()).unwrap();
        let lines = written.split_inclusive(|byte| *byte == b'\n');
        let whole = lines.filter(|line| line.ends_with(b"\n"));
        whole.map(|l| serde_json::from_slice(l).unwrap()).collect()
    }

    /// Waits until the journal has this event for the last task, and returns the task.
    #[track_caller]
    pub(super) fn wait_for_line(&self, event: &str) -> TaskId {
        until("a line in the journal", PATIENCE, || {
            let lines = self.lines();
            let last = lines.last().filter(|line| line["event"] == event)?;
            TaskId::new(u32::try_from(last["task"].as_u64()?).ok()?)
        })
    }
}

pub(super) fn command(device: &Device, port: u16) -> std::process::Command {
    let mut command = ztl();
    let port = port.to_string();
    command.args(["gateway", "-p", &port, "-s", SCOPE, "-d", &device.url()]);
    command
}

#[track_caller]
pub(super) fn start_gateway(device: &Device, scratch: &Scratch, port: u16) -> Server {
    let mut command = command(device, port);
    command.arg("--journal").arg(scratch.path("journal"));
    Server::start(&mut command)
}

pub(super) const ONCE: Deed = Deed {
    begun: 1,
    finished: 1,
};
