//! The gateway and its devices as processes, connected by a pty or TCP: tasks run, and a device that disappears is noticed in
//! time and served again when it returns.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, RequestError, State, Status, TaskId};
use ztl_tests::lab::{
    LIMIT, PATIENCE, Process, Scratch, Server, connect, in_time, reserve_port, simulated_gripper,
    status, until, ztl,
};

/// The address of a device, the same after a restart.
enum Place {
    Pty(Scratch),
    Tcp(u16),
}

impl Place {
    fn pty() -> Self {
        Self::Pty(Scratch::new())
    }

    fn tcp() -> Self {
        Self::Tcp(reserve_port())
    }

    /// For `ztl device --on`.
    fn on(&self) -> String {
        match self {
            Self::Pty(scratch) => format!("pty:{}", scratch.path("gripper").display()),
            Self::Tcp(port) => format!("tcp:{port}"),
        }
    }

    /// For `ztl gateway --device`.
    fn url(&self) -> String {
        match self {
            Self::Pty(scratch) => format!("serial:{}", scratch.path("gripper").display()),
            Self::Tcp(port) => format!("tcp:127.0.0.1:{port}"),
        }
    }

    /// A simulated gripper at this address.
    #[track_caller]
    fn power_on(&self) -> Process {
        simulated_gripper(&self.on())
    }

    /// Removes the device, like pulling a plug.
    #[track_caller]
    fn unplug(&self, device: &mut Process) {
        // For a USB port, the system also removes the name. If it stayed, it would lead to the next process
        // that gets a pty with the same number.
        if let Self::Pty(scratch) = self {
            std::fs::remove_file(scratch.path("gripper")).expect("the link");
        }
        device.kill();
    }

    #[track_caller]
    fn gateway(&self) -> (Server, RemoteTask) {
        let gateway = Server::gateway(&[&format!("gripper={}", self.url())]);
        let remote = connect(&gateway.endpoint());
        (gateway, remote)
    }

    /// The same when the device is ready, with a finger that needs 8 s for the whole way: a busy machine is not late for so long.
    #[track_caller]
    fn slow_gateway(&self) -> (Server, RemoteTask) {
        let (gateway, remote) = self.gateway();
        gateway.wait_ready("gripper");
        gateway.set_speed("gripper", "speed", 0.25);
        (gateway, remote)
    }
}

/// A lost device's task fails within 2.25 s. A busy machine may take longer.
const IN_TIME: Duration = Duration::from_secs(10);

/// Starts a task as soon as the gateway accepts it.
#[track_caller]
fn start_when_served(remote: &mut RemoteTask, goal: &str) -> TaskId {
    until("a task is taken", PATIENCE, || {
        remote.trigger("gripper", "finger", goal).ok()
    })
    .id
    .number()
    .expect("a task id")
}

/// Waits until the finger has passed a position.
#[track_caller]
fn wait_beyond(remote: &mut RemoteTask, id: TaskId, place: f32) -> f32 {
    until("the finger has come so far", PATIENCE, || {
        let status = remote.status(id).expect("an answer");
        assert_eq!(status.state, State::Accepted, "{status:?}");
        let position = status.text.parse().ok()?;
        (position > place).then_some(position)
    })
}

/// When and how a task ended, polled every few milliseconds.
#[track_caller]
fn watch_end(remote: &mut RemoteTask, id: TaskId) -> (Instant, Status) {
    until("its end", PATIENCE, || {
        let status = remote.status(id).expect("the gateway answers");
        status.state.is_final().then(|| (Instant::now(), status))
    })
}

fn does_what_is_asked(place: &Place) {
    let _device = place.power_on();
    let (gateway, mut remote) = place.gateway();
    gateway.wait_ready("gripper");
    let id = start_when_served(&mut remote, "40");
    wait_beyond(&mut remote, id, 0.0);
    let end = status(State::Completed, "40.0");
    assert_eq!(remote.wait(id, LIMIT), Ok(end));

    // The abort stops it on the way, which takes 12 s then.
    gateway.set_speed("gripper", "speed", 0.1);
    let id = start_when_served(&mut remote, "100");
    let seen = wait_beyond(&mut remote, id, 50.0);
    remote.abort(id).expect("an answer");
    let end = remote.wait(id, LIMIT).expect("its end");
    assert_eq!(end.state, State::Aborted);
    assert_eq!(remote.status(id), Ok(end.clone()));
    let stopped: f32 = end.text.parse().expect("a position");
    assert!((seen..100.0).contains(&stopped), "{seen}, then {stopped}");

    // A new gateway, which has no earlier knowledge, reads the position from the device.
    drop(gateway);
    let (gateway, mut remote) = place.gateway();
    gateway.wait_ready("gripper");
    let goal = stopped.to_string();
    let id = start_when_served(&mut remote, &goal);
    let asked = Instant::now();
    let (ended, end) = watch_end(&mut remote, id);
    assert_eq!(end, status(State::Completed, &format!("{stopped:.1}")));
    // The finger is already there; from 100 it would take longer.
    let longest = Duration::from_secs_f32((100.0 - stopped) / 5.0 * 0.9);
    assert!(ended - asked < longest, "{:?}", ended - asked);
}

#[test]
fn a_device_on_a_pty_completes_tasks() {
    does_what_is_asked(&Place::pty());
}

#[test]
fn a_device_on_tcp_completes_tasks() {
    does_what_is_asked(&Place::tcp());
}

fn fails_in_time_and_is_served_again(place: &Place) {
    let mut device = place.power_on();
    let (_gateway, mut remote) = place.slow_gateway();
    let done = start_when_served(&mut remote, "10");
    let kept = status(State::Completed, "10.0");
    assert_eq!(remote.wait(done, LIMIT), Ok(kept.clone()));
    let lost = start_when_served(&mut remote, "100");
    wait_beyond(&mut remote, lost, 20.0);

    let killed = Instant::now();
    place.unplug(&mut device);
    let (ended, end) = watch_end(&mut remote, lost);
    assert_eq!(end, status(State::Failed, "device is not answering"));
    // Not before a live device must have acted, one link timeout (1 s) after the last command;
    // at most 1 s later. Commands are sent every quarter of a second.
    let took = ended - killed;
    assert!(took > Duration::from_millis(500), "{took:?}");
    assert!(took < IN_TIME, "{took:?}");

    // Meanwhile the gateway rejects a new task with the reason.
    let refused = remote.trigger("gripper", "finger", "50");
    let reason = refused.expect_err("nobody is there").to_string();
    assert!(reason.contains("device is not answering"), "{reason}");
    assert_eq!(remote.status(lost), Ok(end.clone()));
    assert_eq!(remote.abort(lost).unwrap().state, State::Failed);

    let _device = place.power_on();
    let id = start_when_served(&mut remote, "30");
    assert!(id > lost, "an id came twice");
    let again = status(State::Completed, "30.0");
    assert_eq!(remote.wait(id, LIMIT), Ok(again));
    assert_eq!(remote.status(lost), Ok(end));
    assert_eq!(remote.status(done), Ok(kept));
}

#[test]
fn an_unplugged_pty_device_fails_its_task_and_is_served_on_return() {
    fails_in_time_and_is_served_again(&Place::pty());
}

#[test]
fn a_disconnected_tcp_device_fails_its_task_and_is_served_on_return() {
    fails_in_time_and_is_served_again(&Place::tcp());
}

fn a_quick_reset_is_noticed(place: &Place) {
    let mut device = place.power_on();
    let (gateway, mut remote) = place.gateway();
    gateway.wait_ready("gripper");
    for round in 0..3 {
        // A device that was reset has its usual speed.
        gateway.set_speed("gripper", "speed", 0.25);
        let id = start_when_served(&mut remote, "100");
        wait_beyond(&mut remote, id, 10.0);
        let killed = Instant::now();
        place.unplug(&mut device);
        device = place.power_on();
        let (ended, end) = watch_end(&mut remote, id);
        assert_eq!(end.state, State::Failed, "round {round}: {end:?}");
        let reasons = ["device was reset", "device is not answering"];
        assert!(reasons.contains(&end.text.as_str()), "{end:?}");
        assert!(ended - killed < IN_TIME);

        // The final state never changes, even after the new device ran tasks.
        let next = start_when_served(&mut remote, "20");
        assert_eq!(remote.abort(id).unwrap().state, State::Failed);
        let done = status(State::Completed, "20.0");
        assert_eq!(remote.wait(next, LIMIT), Ok(done));
        assert_eq!(remote.status(id), Ok(end));
    }
}

#[test]
fn a_quick_reset_on_a_pty_fails_only_the_devices_task() {
    a_quick_reset_is_noticed(&Place::pty());
}

#[test]
fn a_quick_reset_on_tcp_fails_only_the_devices_task() {
    a_quick_reset_is_noticed(&Place::tcp());
}

#[test]
fn a_stalled_device_stops_and_its_task_has_one_final_state() {
    let place = Place::tcp();
    let device = place.power_on();
    let (_gateway, mut remote) = place.slow_gateway();
    let id = start_when_served(&mut remote, "100");
    wait_beyond(&mut remote, id, 5.0);

    // The process is suspended; the line stays open.
    let stalled = Instant::now();
    device.signal("STOP");
    let (ended, end) = watch_end(&mut remote, id);
    assert_eq!(end, status(State::Failed, "device is not answering"));
    let took = ended - stalled;
    assert!(took > Duration::from_millis(500), "{took:?}");
    assert!(took < IN_TIME, "{took:?}");

    device.signal("CONT");
    // The device has the task's true outcome, which arrives too late; its finger stopped on the way.
    let next = start_when_served(&mut remote, "0");
    let (_, zero) = watch_end(&mut remote, next);
    assert_eq!(zero, status(State::Completed, "0.0"));
    assert_eq!(remote.status(id), Ok(end));
}

#[test]
fn a_gateway_waits_for_an_absent_device() {
    let place = Place::pty();
    let (gateway, mut remote) = place.gateway();
    // Before a client times out.
    let refused = in_time(Duration::from_secs(2), || {
        remote.trigger("gripper", "finger", "40")
    });
    let reason = refused.expect_err("nobody is there").to_string();
    // With the system's error for the line.
    assert!(reason.contains("device is not answering"), "{reason}");
    assert!(reason.contains(&place.url()), "{reason}");

    let _device = place.power_on();
    gateway.wait_ready("gripper");
    let id = start_when_served(&mut remote, "10");
    let end = status(State::Completed, "10.0");
    assert_eq!(remote.wait(id, LIMIT), Ok(end));
}

#[test]
fn a_dead_device_affects_no_other() {
    let place = Place::tcp();
    let mut device = place.power_on();
    let gripper = format!("gripper={}", place.url());
    let gateway = Server::gateway(&[&gripper, "head=sim:head"]);
    gateway.wait_ready("gripper");
    gateway.wait_ready("head");
    gateway.set_speed("gripper", "speed", 0.25);
    let mut client = gateway.original_client();
    let lost = client.start("gripper", "finger", "100");
    device.kill();
    let left = client.start("head", "pan", "left");
    assert_eq!(client.wait(left, 20.0), (5, "90.0"));
    assert_eq!(client.wait(lost, 20.0), (3, "device is not answering"));
}

#[test]
fn after_a_gateway_restart_ids_are_unknown_and_the_device_is_free() {
    let place = Place::pty();
    let _device = place.power_on();
    let (gateway, mut remote) = place.slow_gateway();
    let id = start_when_served(&mut remote, "100");
    wait_beyond(&mut remote, id, 10.0);
    drop(gateway);

    let (_gateway, mut remote) = place.gateway();
    let unknown = RequestError::UnknownTask {
        id: id.into(),
        text: format!("Invalid ID '{id}'"),
    };
    assert_eq!(remote.status(id), Err(unknown.clone()));
    // The device stops the orphaned task and accepts the next one.
    let next = start_when_served(&mut remote, "0");
    assert_ne!(next, id);
    let end = status(State::Completed, "0.0");
    assert_eq!(remote.wait(next, LIMIT), Ok(end));
    assert_eq!(remote.status(id), Err(unknown));
}

#[test]
fn a_device_stops_when_its_gateway_is_lost() {
    let place = Place::pty();
    let _device = place.power_on();
    let (gateway, mut remote) = place.slow_gateway();
    let id = start_when_served(&mut remote, "100");
    let seen = wait_beyond(&mut remote, id, 5.0);
    drop(gateway);
    // A task that continued would arrive after 8 s.
    let gone = Instant::now();
    until("8.5 s", PATIENCE, || {
        (gone.elapsed() > Duration::from_millis(8500)).then_some(())
    });
    let (_gateway, mut remote) = place.gateway();
    let id = start_when_served(&mut remote, "100");
    let stopped = wait_beyond(&mut remote, id, -1.0);
    // Its link timeout is 1 s, which is an eighth of the way.
    assert!((seen..90.0).contains(&stopped), "{seen}, then {stopped}");
}

fn a_second_gateway_gets_nothing(place: &Place) {
    let _device = place.power_on();
    let (_gateway, mut remote) = place.slow_gateway();
    let id = start_when_served(&mut remote, "100");
    wait_beyond(&mut remote, id, 5.0);
    let (_second, mut intruder) = place.gateway();
    let refused = intruder.trigger("gripper", "finger", "0");
    assert!(refused.is_err(), "{refused:?}");
    let end = status(State::Completed, "100.0");
    assert_eq!(remote.wait(id, LIMIT), Ok(end));
}

#[test]
fn a_second_gateway_cannot_take_over_a_device_on_a_pty() {
    a_second_gateway_gets_nothing(&Place::pty());
}

#[test]
fn a_second_gateway_cannot_take_over_a_device_on_tcp() {
    a_second_gateway_gets_nothing(&Place::tcp());
}

#[test]
fn a_device_with_a_blocked_output_still_receives() {
    let scratch = Scratch::new();
    let link = scratch.path("sensor");
    let mut device = ztl();
    device.args(["device", "sim:sensor", "--baud", "921600"]);
    let device = device.args(["--on", &format!("pty:{}", link.display())]);
    let device = Process::start(device);
    device.wait_for("Serve it with");
    let gateway = Server::gateway(&[&format!("sensor=serial:{}", link.display())]);
    gateway.wait_ready("sensor");
    // The gateway is suspended with the line open, which buffers a few KiB and then blocks.
    gateway.process.signal("STOP");
    let still = Instant::now();
    until("half a second", PATIENCE, || {
        (still.elapsed() > Duration::from_millis(500)).then_some(())
    });
    device.signal("TERM");
    let ended = device.end(PATIENCE);
    assert_eq!(ended.code, Some(143), "{ended:?}");
}
