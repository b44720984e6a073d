//! The gateway as a service: notifications, signals and its log.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use ztl_mcu::link::Loss;
use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{
    PATIENCE, Process, Scratch, Server, ServiceManager, connect, gateway, until, verify_unit, ztl,
};

use crate::firmware::{Endless, Firmware};
use crate::lines::has_lost_link;
use crate::restart::device::Device;

#[test]
fn systemd_is_notified_of_readiness_status_liveness_and_stopping() {
    let scratch = Scratch::new();
    let path = scratch.path("notify");
    let name = format!("ztl-test-{}", std::process::id());
    let in_files = SocketAddr::from_pathname(&path).expect("an address");
    let in_no_file = SocketAddr::from_abstract_name(&name).expect("an address");
    for (address, written) in [
        (in_files, path.display().to_string()),
        (in_no_file, format!("@{name}")),
    ] {
        let mut manager = ServiceManager::at(&address);
        let device = scratch.path("arm");
        let arm = format!("arm=serial:{}", device.display());
        let mut command = gateway(&["head=sim:head", &arm]);
        command
            .env("NOTIFY_SOCKET", written)
            .env("WATCHDOG_USEC", "400000");
        let process = Process::start(&mut command);
        let ready = manager.wait_for("READY=1", 1);
        // The simulated device may be ready by then.
        assert!(ready.contains(" of 2 devices ready; arm: "), "{ready}");
        manager.wait_for("WATCHDOG=1", 2);
        process.wait_for("Device 'head' is ready");
        let problem = format!(
            "STATUS=1 of 2 devices ready; arm: serial:{}: there is no such port; is it plugged in?",
            device.display()
        );
        manager.wait_for(&problem, 1);
        process.signal("TERM");
        manager.wait_for("STOPPING=1", 1);
        assert_eq!(process.end(PATIENCE).code, Some(143));
    }
}

#[test]
fn a_watchdog_meant_for_another_process_is_not_fed() {
    let scratch = Scratch::new();
    let path = scratch.path("notify");
    let mut manager = ServiceManager::at(&SocketAddr::from_pathname(&path).expect("an address"));
    let mut command = gateway(&["head=sim:head"]);
    command
        .env("NOTIFY_SOCKET", &path)
        .env("WATCHDOG_USEC", "100000")
        .env("WATCHDOG_PID", "1");
    let process = Process::start(&mut command);
    manager.wait_for("STATUS=1 of 1 devices ready", 1);
    process.signal("INT");
    manager.wait_for("STOPPING=1", 1);
    let fed = manager
        .messages()
        .iter()
        .any(|message| message.contains("WATCHDOG"));
    assert!(!fed, "{:?}", manager.messages());
}

/// A task that the gateway has accepted.
#[track_caller]
fn started(remote: &mut RemoteTask, device: &str, component: &str, goal: &str) -> ztl_std::TaskId {
    until("a task is taken", PATIENCE, || {
        remote.trigger(device, component, goal).ok()
    })
    .id
    .number()
    .expect("a task id")
}

#[test]
fn a_signal_stops_every_task_and_reports_it() {
    let ended = until("the ends are told", PATIENCE, || {
        let gateway = Server::simulated();
        // They take 10 and 20 s then, so they still run when the gateway is stopped.
        gateway.set_speed("head", "speed", 0.1);
        gateway.set_speed("gripper", "speed", 0.1);
        let mut remote = connect(&gateway.endpoint());
        let head = started(&mut remote, "head", "pan", "left");
        let finger = started(&mut remote, "gripper", "finger", "100");
        gateway.process.signal("TERM");
        let mut remote = remote.with_timeout(Duration::from_secs(2));
        for id in [head, finger] {
            // The gateway waits 1 s for the devices and then 2 s for a client. A busy machine may be later.
            let end = remote.wait(id, Some(Duration::from_secs(5))).ok()?;
            if has_lost_link(&end) {
                return None;
            }
            assert_eq!(end.state, State::Aborted);
        }
        Some(gateway.process.end(PATIENCE))
    });
    assert_eq!(ended.code, Some(143));
    for task in ["'head:pan:left'", "'gripper:finger:100'"] {
        let line = format!("{task} has ended as ABORTED: ");
        assert_eq!(ended.stderr.matches(&line).count(), 1, "{ended:?}");
    }
    let last: Vec<&str> = ended.stdout.lines().rev().take(2).collect();
    let said = [
        "Stopped.",
        "Stopping; another Ctrl-C or SIGTERM exits at once.",
    ];
    assert_eq!(last, said);
}

#[test]
fn leave_running_reports_what_each_task_will_do_and_no_outcome() {
    let firmware = Firmware::start((
        Endless::new("arm", Loss::Abort),
        Endless::new("lift", Loss::Hold),
        Endless::new("pump", Loss::CarryOn),
    ));
    let mut command = gateway(&[&format!("bench=tcp:{}", firmware.address)]);
    let process = Process::start(command.arg("--leave-running"));
    let line = process.wait_for("Serving bench at ");
    let endpoint = line
        .split([' ', ','])
        .find(|word| word.starts_with("tcp://"));
    let mut remote = connect(endpoint.expect("it is said"));
    let tasks = ["arm", "lift", "pump"].map(|name| started(&mut remote, "bench", name, "go"));
    process.signal("TERM");
    // A STATUS during this time gets the same reply as before.
    let mut remote = remote.with_timeout(Duration::from_secs(2));
    for id in tasks {
        if let Ok(status) = remote.status(id) {
            assert_eq!(status.state, State::Accepted);
        }
    }
    let ended = process.end(PATIENCE);
    assert_eq!(ended.code, Some(143));
    let stops = "stops by itself after hearing nothing for its link timeout";
    for (task, becomes) in [
        ("arm", format!("{stops} (abort).")),
        ("lift", format!("{stops}, and keeps its position (hold).")),
        ("pump", "carries on.".to_owned()),
    ] {
        let line = format!("'bench:{task}:go' is left running; it {becomes}");
        assert!(ended.stderr.contains(&line), "{line} in {ended:?}");
    }
    assert!(!ended.stderr.contains("has ended"), "{ended:?}");

    // The next gateway stops tasks that it does not know.
    let gateway = Server::gateway(&[&format!("bench=tcp:{}", firmware.address)]);
    gateway.wait_ready("bench");
    let mut remote = connect(&gateway.endpoint());
    started(&mut remote, "bench", "pump", "go");
}

/// Longer than any of these tests.
const LONGEST_LINK_TIMEOUT: Duration = Duration::from_secs(60);

/// A gateway with a device that runs a task and does not hear any more that it is to stop.
#[track_caller]
fn with_deaf_device() -> (Device, Server, RemoteTask, ztl_std::TaskId) {
    let device = Device::power_on(LONGEST_LINK_TIMEOUT);
    let gateway = Server::gateway(&[&device.url()]);
    gateway.wait_ready("motors");
    let mut remote = connect(&gateway.endpoint());
    let id = started(&mut remote, "motors", "arm", "7 600000");
    device.world().deaf = true;
    (device, gateway, remote, id)
}

#[test]
fn a_second_signal_exits_at_once() {
    let ended = until("it does not wait for the device", PATIENCE, || {
        let (_device, gateway, _, _) = with_deaf_device();
        gateway.process.signal("INT");
        gateway.process.wait_for("Stopping;");
        let ended = gateway.process.signal_until_end("INT", PATIENCE);
        // It gives up after 1 s, when a busy machine may not have sent the second signal.
        (!ended.stdout.contains("Stopped.")).then_some(ended)
    });
    assert_eq!(ended.code, Some(130), "{ended:?}");
}

#[test]
fn an_unconfirmed_stop_names_the_device_and_is_not_reported_as_failed() {
    let (_device, gateway, remote, id) = with_deaf_device();
    let mut remote = remote.with_timeout(Duration::from_millis(300));
    gateway.process.signal("TERM");
    while let Ok(status) = remote.status(id) {
        assert_eq!(status.state, State::Accepted, "{status:?}");
    }
    let ended = gateway.process.end(PATIENCE);
    let line = "Device 'motors' has not confirmed that 'motors:arm:7 600000' stopped";
    assert!(ended.stderr.contains(line), "{ended:?}");
    assert_eq!(ended.code, Some(143));
}

#[test]
fn each_tasks_start_and_end_is_logged_with_the_time() {
    let gateway = Server::simulated();
    let mut remote = connect(&gateway.endpoint());
    let id = until("a task completes", PATIENCE, || {
        let id = started(&mut remote, "gripper", "finger", "3");
        let end = remote.wait(id, Some(PATIENCE)).expect("its end");
        (!has_lost_link(&end)).then_some(id)
    });
    let refused = remote
        .trigger("gripper", "thumb", "3")
        .expect_err("no thumb");
    assert!(refused.to_string().contains("no component"), "{refused}");
    let task = format!("INFO:gateway:Device 'gripper': task {id} 'gripper:finger:3' ");
    for what in [
        "has started",
        "has ended as COMPLETED: 3.0",
        "was refused: no component",
    ] {
        let line = match what.strip_prefix("was ") {
            Some(_) => gateway.process.wait_for(what),
            None => gateway.process.wait_for(&format!("{task}{what}")),
        };
        let (time, _) = line.split_once(" INFO:").expect("a time");
        let form: String = time
            .chars()
            .map(|c| if c.is_ascii_digit() { '0' } else { c })
            .collect();
        assert_eq!(form, "0000-00-00T00:00:00.000Z", "{line}");
    }
}

#[test]
fn log_lines_for_systemds_journal_carry_no_time() {
    let gateway = gateway(&["head=sim:head"]);
    for (of, has_time) in [("2", false), ("1", true)] {
        let mut command = Command::new("sh");
        let script = format!("JOURNAL_STREAM=$(stat -L -c %d:%i /proc/self/fd/{of}) exec \"$@\"");
        // Within the substitution stdout is a pipe.
        let script = script.replace("fd/1", "fd/0");
        command.args(["-c", &script, "sh"]);
        command.arg(gateway.get_program()).args(gateway.get_args());
        let process = Process::start(&mut command);
        let line = process.wait_for("INFO:gateway:Device 'head' is ready");
        assert_eq!(!line.starts_with("INFO:"), has_time, "{line}");
    }
}

/// The unit file that people copy.
fn unit() -> (std::path::PathBuf, String) {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/systemd/ztl-gateway.service");
    let text = std::fs::read_to_string(&path).expect("the unit file");
    (path, text)
}

#[test]
fn the_unit_starts_an_existing_command() {
    let (_, text) = unit();
    let start = text
        .lines()
        .find_map(|line| line.strip_prefix("ExecStart="));
    let words: Vec<&str> = start.expect("ExecStart").split(' ').collect();
    assert_eq!(words[..2], ["/usr/local/bin/ztl", "gateway"]);
    let help = Process::run(ztl().args(["gateway", "--help"])).stdout;
    for option in words.iter().filter(|word| word.starts_with("--")) {
        assert!(help.contains(option), "{option} in {help}");
    }
    assert!(text.contains("Type=notify"));
    assert!(text.contains("ExecReload=/bin/kill -HUP $MAINPID"));
    assert!(text.contains("WatchdogSec="));
    // The exit code for a wrong configuration, which a retry cannot fix.
    assert!(text.contains("RestartPreventExitStatus=2"));
}

#[test]
fn systemd_accepts_the_unit() {
    verify_unit(&unit().0);
}
