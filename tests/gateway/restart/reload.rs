//! A reload restores a device that still has tasks: they settle, and the device serves again.

use super::device::Device;
use super::rig::{MEDIUM, ONCE};
use ztl_std::{RemoteTask, State, TaskId};
use ztl_tests::lab::{LIMIT, PATIENCE, SCOPE, Scratch, Server, connect, status, until, ztl};

/// A gateway whose configuration can be changed while it serves.
struct Reloaded {
    device: Device,
    scratch: Scratch,
    gateway: Option<Server>,
    /// How often this gateway has reloaded its configuration.
    reloads: usize,
}

impl Reloaded {
    /// The device is connected, and two tasks run until aborted: on its arm and its belt.
    #[track_caller]
    fn with_tasks() -> (Self, TaskId, TaskId) {
        let mut rig = Self {
            device: Device::power_on(MEDIUM),
            scratch: Scratch::new(),
            gateway: None,
            reloads: 0,
        };
        rig.configure(true);
        rig.start();
        rig.gateway().wait_ready("motors");
        let mut client = rig.client();
        let mut begin = |component, goal: &str| {
            let id = client.trigger("motors", component, goal).unwrap().id;
            until("the task begins", PATIENCE, || {
                (rig.device.deed(goal).begun == 1).then_some(())
            });
            id.number().unwrap()
        };
        let (arm, belt) = (begin("arm", "7 1000000"), begin("belt", "8 1000000"));
        (rig, arm, belt)
    }

    fn configure(&self, has_motors: bool) {
        let port = self.device.port;
        let motors = match has_motors {
            true => format!("  motors: tcp:127.0.0.1:{port}\n"),
            false => String::new(),
        };
        let text = format!(
            "scope: {SCOPE}\nport: 0\njournal: journal\ndevices:\n  other: sim:head\n{motors}"
        );
        std::fs::write(self.scratch.path("lab.yaml"), text).unwrap();
    }

    #[track_caller]
    fn start(&mut self) {
        let file = self.scratch.path("lab.yaml");
        self.gateway = Some(Server::start(ztl().arg("gateway").arg(file)));
        self.reloads = 0;
    }

    fn gateway(&self) -> &Server {
        self.gateway.as_ref().unwrap()
    }

    #[track_caller]
    fn client(&self) -> RemoteTask {
        connect(&self.gateway().endpoint())
    }

    /// Starts the gateway again, without the device in its configuration.
    #[track_caller]
    fn restart_without_motors(&mut self) {
        self.gateway.take().unwrap().process.kill();
        self.configure(false);
        self.start();
    }

    #[track_caller]
    fn reload(&mut self, has_motors: bool) {
        self.configure(has_motors);
        self.gateway().process.signal("HUP");
        self.reloads += 1;
        until("it is reloaded", PATIENCE, || {
            let said = self.gateway().process.stderr();
            let times = said.matches("The configuration was reloaded.").count();
            (times == self.reloads).then_some(())
        });
    }

    #[track_caller]
    fn assert_serves_again(&self) {
        let mut client = self.client();
        let id = until("the device takes a task", PATIENCE, || {
            client.trigger("motors", "arm", "9 1").ok()
        });
        let end = client.wait(&id.id, LIMIT);
        assert_eq!(end, Ok(status(State::Completed, "9")));
        assert_eq!(self.device.deed("9 1"), ONCE);
    }
}

#[test]
fn a_device_restored_by_a_reload_continues_its_journaled_tasks() {
    let (mut rig, arm, belt) = Reloaded::with_tasks();
    rig.restart_without_motors();
    let mut client = rig.client();
    let end = client.wait(arm, LIMIT);
    assert_eq!(end, Ok(status(State::Failed, "device is not answering")));
    let waits = status(State::Accepted, "device 'motors' is not served any more");
    assert_eq!(client.status(belt), Ok(waits));

    rig.reload(true);
    rig.gateway().wait_ready("motors");
    assert_eq!(client.status(belt).unwrap().state, State::Accepted);
    client.abort(belt).unwrap();
    assert_eq!(client.wait(belt, LIMIT).unwrap().state, State::Aborted);
    assert_eq!(rig.device.deed("8 1000000").begun, 1);
    rig.assert_serves_again();
}

#[test]
fn a_device_reset_before_a_reload_restores_it_has_failed_tasks() {
    let (mut rig, _, belt) = Reloaded::with_tasks();
    rig.restart_without_motors();
    rig.device.world().reset = true;
    rig.reload(true);
    let end = rig.client().wait(belt, LIMIT);
    assert_eq!(end, Ok(status(State::Failed, "device was reset")));
    rig.assert_serves_again();
}

#[test]
fn a_device_restored_early_serves_once_its_old_tasks_stopped() {
    let (mut rig, arm, belt) = Reloaded::with_tasks();
    rig.device.world().unplugged = true;
    let mut client = rig.client();
    let end = client.wait(arm, LIMIT);
    assert_eq!(end, Ok(status(State::Failed, "device is not answering")));
    // Its belt carries on, so only the device can say that it stopped.
    rig.reload(false);
    rig.reload(true);
    let refused = client.trigger("motors", "arm", "9 1").unwrap_err();
    let refused = refused.to_string();
    assert!(refused.contains("from before"), "{refused}");
    assert_eq!(client.status(belt).unwrap().state, State::Accepted);

    rig.device.world().unplugged = false;
    assert_eq!(client.wait(belt, LIMIT).unwrap().state, State::Aborted);
    rig.assert_serves_again();
}
