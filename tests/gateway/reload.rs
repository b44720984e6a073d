//! SIGHUP: the gateway reads its configuration again, and tasks continue.

use std::time::Duration;

use ztl_mcu::link::Loss;
use ztl_std::{RemoteId, RemoteTask, State};
use ztl_tests::lab::{PATIENCE, Process, Scratch, Terminal, connect_to, port_of, until, ztl};

use crate::firmware::{Endless, Firmware};
use crate::lines::complete;

/// A gateway with a file that can be changed.
struct ReloadRig {
    scratch: Scratch,
    gateway: Process,
    endpoint: String,
    /// How often it was reloaded.
    reloaded: usize,
}

impl ReloadRig {
    #[track_caller]
    fn new(text: &str) -> Self {
        Self::with(text, &[])
    }

    #[track_caller]
    fn with(text: &str, options: &[&str]) -> Self {
        let scratch = Scratch::new();
        let file = scratch.path("lab.yaml");
        std::fs::write(&file, file_of(text)).expect("to write");
        let gateway = Process::start(ztl().arg("gateway").arg(file).args(options));
        let line = gateway.wait_for("Serving ");
        let mut words = line.split([' ', ',']);
        let endpoint = words.find(|word| word.starts_with("tcp://"));
        Self {
            endpoint: endpoint.expect("an endpoint").to_owned(),
            scratch,
            gateway,
            reloaded: 0,
        }
    }

    /// Changes the file, and waits until the gateway has read it.
    #[track_caller]
    fn reload(&mut self, text: &str) {
        std::fs::write(self.scratch.path("lab.yaml"), file_of(text)).expect("to write");
        self.hang_up();
    }

    /// Waits until the gateway has tried to read its file again.
    #[track_caller]
    fn hang_up(&mut self) {
        self.gateway.signal("HUP");
        self.reloaded += 1;
        until("it is reloaded", PATIENCE, || {
            let said = self.gateway.stderr();
            let ends = [
                "The configuration was reloaded.",
                "everything stays as it is.",
            ];
            let times: usize = ends.iter().map(|end| said.matches(end).count()).sum();
            (times == self.reloaded).then_some(())
        });
    }

    #[track_caller]
    fn remote(&self) -> RemoteTask {
        connect_to(&self.endpoint, "/lab")
    }
}

/// A device with this component, whose tasks `go` last until they are aborted, and its URL.
fn endless(component: &'static str) -> (Firmware, String) {
    let firmware = Firmware::start((Endless::new(component, Loss::Abort),));
    let url = format!("tcp:{}", firmware.address);
    (firmware, url)
}

fn file_of(text: &str) -> String {
    format!("scope: /lab\nport: 0\n{text}")
}

#[track_caller]
fn started(remote: &mut RemoteTask, device: &str, component: &str, goal: &str) -> RemoteId {
    let taken = until("a task is taken", PATIENCE, || {
        remote.trigger(device, component, goal).ok()
    });
    taken.id
}

#[test]
fn a_reload_removes_a_shared_line_and_serves_it_again() {
    let mut line = Process::start(ztl().args(["device", "--bus", "sim:head", "--on", "tcp:0"]));
    let said = line.next_line(PATIENCE);
    let url = said.trim_start_matches("Simulated bus at ");
    let (url, _) = url.split_once(". ").expect("a URL");
    let served = format!("devices: {{arm: '{url}?wait=100', other: sim:gripper}}\n");
    let mut rig = ReloadRig::new(&served);
    let mut remote = rig.remote();
    // It takes 10 s then, so it still runs when its line is removed.
    let port = port_of(&rig.endpoint).to_string();
    let words = ["param", "set", "arm.head", "speed", "0.1", "-p", &port];
    until("it is slower", PATIENCE, || {
        (Process::run(ztl().args(words)).code == Some(0)).then_some(())
    });
    let head = started(&mut remote, "arm.head", "pan", "left");
    rig.reload("devices: {other: sim:gripper}\n");
    let end = remote.wait(&head, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Aborted);
    let refused = remote.trigger("arm.head", "pan", "left");
    let why = refused.expect_err("it is gone").to_string();
    assert!(
        why.contains("no device 'arm.head'; there are: other"),
        "{why}"
    );
    rig.reload(&served);
    let head = started(&mut remote, "arm.head", "pan", "straight");
    let end = remote.wait(&head, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Completed);
}

#[test]
fn reloads_add_and_remove_devices_without_disturbing_other_tasks() {
    let (_bench, bench) = endless("arm");
    let (_head, head) = endless("pan");
    let (_lift, lift) = endless("lift");
    let bench = format!("devices:\n  bench: {bench}\n");
    let mut rig = ReloadRig::new(&format!("{bench}  head: {head}\n"));
    let mut remote = rig.remote();
    let arm = started(&mut remote, "bench", "arm", "go");
    let head = started(&mut remote, "head", "pan", "go");
    let bench = format!("{bench}  gripper: sim:gripper\n");
    rig.reload(&format!("{bench}  lift: {lift}\n"));
    // The task of a device that is no longer served is aborted.
    let end = remote.wait(&head, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Aborted);
    let refused = remote.trigger("head", "pan", "go").expect_err("it is gone");
    let refused = refused.to_string();
    assert!(
        refused.contains("no device 'head'; there are: bench, gripper, lift"),
        "{refused}"
    );
    assert_eq!(complete(&mut remote, "gripper", "finger", "3"), "3.0");

    // Its URL changed: the running task is aborted first.
    let moving = started(&mut remote, "lift", "lift", "go");
    rig.reload(&format!("{bench}  lift: sim:head\n"));
    let end = remote.wait(&moving, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Aborted);
    let pan = started(&mut remote, "lift", "pan", "left");
    remote.abort(&pan).expect("an answer");
    assert_eq!(remote.status(&arm).expect("known").state, State::Accepted);
    remote.abort(&arm).expect("an answer");
    let end = remote.wait(&arm, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Aborted);
    let log = rig.gateway.stderr();
    assert!(
        !log.contains("'head': device is not answering"),
        "a device that is not served was missed: {log}"
    );
}

#[test]
fn reloading_an_invalid_file_changes_nothing_and_reports_each_mistake() {
    let (_bench, bench) = endless("arm");
    let mut rig = ReloadRig::new(&format!("devices: {{bench: '{bench}'}}\n"));
    let mut remote = rig.remote();
    let arm = started(&mut remote, "bench", "arm", "go");
    rig.reload("devices: {gripper: sim:gripper}\nprot: 1\nlog: loud\nkey: no.key_secret\n");
    for mistake in [
        "lab.yaml:4:1: unknown key 'prot'",
        "lab.yaml:5:6: 'loud' is not known here",
        "lab.yaml:6:6: ",
    ] {
        rig.gateway.wait_for(mistake);
    }
    assert_eq!(remote.status(&arm).expect("known").state, State::Accepted);
    let refused = remote
        .trigger("gripper", "finger", "3")
        .expect_err("not served");
    let refused = refused.to_string();
    assert!(refused.contains("there are: bench"), "{refused}");
    rig.gateway
        .wait_for("'gripper:finger:3' was refused: no such device");
}

#[test]
fn a_reload_changes_rules_limits_and_logging_and_nothing_else() {
    let (_bench, bench) = endless("arm");
    let devices = format!("devices: {{bench: '{bench}'}}\n");
    let mut rig = ReloadRig::new(&format!("allow: 127.0.0.0/8\nlog: warn\n{devices}"));
    let mut remote = rig.remote();
    let arm = started(&mut remote, "bench", "arm", "go");
    rig.reload(&format!(
        "allow: 127.0.0.0/8\nlog: info\nbind: 127.0.0.2\nlog-format: json\n\
         limits: {{running: 1, queue: 7}}\n{devices}",
    ));
    for key in ["bind", "log-format", "queue"] {
        let said = format!("'{key}' has changed; restart to apply it.");
        rig.gateway.wait_for(&said);
    }
    assert!(!rig.gateway.stderr().contains("'limits'"));
    let refused = remote.trigger("bench", "arm", "go").expect_err("one runs");
    assert!(
        refused.to_string().contains("too many tasks are running"),
        "{refused}"
    );
    rig.gateway
        .wait_for("was refused: too many tasks are running");
    remote.abort(&arm).expect("an answer");
    rig.gateway.wait_for("'bench:arm:go' has ended as ABORTED");

    // No client is allowed any more, not even connected ones.
    rig.reload(&format!("allow: 192.0.2.0/24\n{devices}"));
    let mut remote = remote.with_timeout(Duration::from_secs(2));
    remote.status(&arm).expect_err("no answer");
    rig.reload(&format!("allow: 127.0.0.1\n{devices}"));
    let mut remote = remote.with_timeout(PATIENCE);
    assert_eq!(remote.status(&arm).expect("known").state, State::Aborted);
}

#[test]
fn a_flood_of_refused_tasks_does_not_fill_the_log() {
    let (_bench, bench) = endless("arm");
    let text = format!("limits: {{running: 1}}\ndevices: {{bench: '{bench}'}}\n");
    let rig = ReloadRig::new(&text);
    let mut remote = rig.remote();
    for _ in 0..200 {
        remote.trigger("nobody", "x", "y").expect_err("not served");
    }
    let arm = started(&mut remote, "bench", "arm", "go");
    for _ in 0..200 {
        remote.trigger("bench", "arm", "go").expect_err("one runs");
    }
    remote.abort(&arm).expect("an answer");
    rig.gateway.wait_for("'bench:arm:go' has ended as ABORTED");
    let log = rig.gateway.stderr();
    for line in [
        "was refused: no such device",
        "was refused: too many tasks are running",
    ] {
        let count = log.matches(line).count();
        assert!((100..150).contains(&count), "{line}: {count}");
    }
}

#[test]
fn an_open_server_is_restricted_at_once() {
    let mut rig = ReloadRig::with("devices: {head: sim:head}\n", &["--transport", "native"]);
    let mut remote = rig.remote();
    let head = started(&mut remote, "head", "pan", "left");
    rig.reload("allow: 192.0.2.0/24\ndevices: {head: sim:head}\n");
    let mut remote = remote.with_timeout(Duration::from_secs(2));
    remote.status(&head).expect_err("no answer");
}

#[test]
fn over_libzmq_enabling_authentication_needs_a_restart() {
    let mut rig = ReloadRig::with("devices: {head: sim:head}\n", &["--transport", "libzmq"]);
    rig.reload("allow: 192.0.2.0/24\ndevices: {head: sim:head}\n");
    rig.gateway
        .wait_for("'allow' has changed; restart to apply it.");
    started(&mut rig.remote(), "head", "pan", "left");
}

#[test]
fn a_gateway_without_a_file_has_nothing_to_reload() {
    let words = ["gateway", "-p", "0", "-s", "/lab", "-d", "head=sim:head"];
    let gateway = Process::start(ztl().args(words));
    gateway.wait_for("Device 'head' is ready");
    gateway.signal("HUP");
    gateway.wait_for("There is no configuration file to be reloaded.");
    gateway.signal("TERM");
    assert_eq!(gateway.end(PATIENCE).code, Some(143));
}

/// A named pipe in place of a file, without a writer.
#[track_caller]
fn replace_by_pipe(path: &std::path::Path) {
    std::fs::remove_file(path).ok();
    let mut mkfifo = std::process::Command::new("mkfifo");
    assert!(mkfifo.arg(path).status().expect("mkfifo").success());
}

#[test]
fn a_named_pipe_is_rejected_and_the_next_reload_works() {
    let mut rig = ReloadRig::new("devices: {head: sim:head}\n");
    let file = rig.scratch.path("lab.yaml");
    replace_by_pipe(&file);
    rig.hang_up();
    rig.gateway
        .wait_for("lab.yaml: cannot read it: it is not a regular file");
    std::fs::remove_file(&file).expect("to remove it");
    replace_by_pipe(&rig.scratch.path("robot.key_secret"));
    rig.reload("key: robot.key_secret\ndevices: {head: sim:head}\n");
    rig.gateway
        .wait_for("robot.key_secret: it is not a regular file");
    // The process at the other end decides when the stream ends.
    rig.reload("key: /dev/stdin\ndevices: {head: sim:head}\n");
    rig.gateway
        .wait_for("lab.yaml:3:6: '/dev/stdin' is not a regular file");
    rig.reload("devices: {gripper: sim:gripper}\n");
    started(&mut rig.remote(), "gripper", "finger", "3");
}

#[test]
fn a_configuration_read_from_a_stream_is_not_reread() {
    let mut gateway = Process::start(ztl().args(["gateway", "/dev/stdin"]));
    gateway.write_line(&file_of("devices: {head: sim:head}"));
    gateway.close_stdin();
    gateway.wait_for("Device 'head' is ready");
    gateway.signal("HUP");
    gateway.wait_for("/dev/stdin cannot be read again, so nothing was reloaded.");
    gateway.signal("TERM");
    assert_eq!(gateway.end(PATIENCE).code, Some(143));
}

#[test]
fn mistakes_of_a_reload_name_their_file_in_each_entry_of_a_json_log() {
    let mut rig = ReloadRig::new("log-format: json\ndevices: {head: sim:head}\n");
    rig.reload("log-format: json\nprot: 1\nlog: loud\ndevices: {head: sim:head}\n");
    let said = rig.gateway.stderr();
    let entries = said.lines().filter_map(|line| {
        let entry: serde_json::Value = serde_json::from_str(line).ok()?;
        (entry["level"] == "ERROR").then(|| entry["message"].as_str().unwrap().to_owned())
    });
    let entries: Vec<String> = entries.collect();
    let file = rig.scratch.path("lab.yaml").display().to_string();
    assert_eq!(entries.len(), 3, "{entries:?}");
    assert!(entries[0].starts_with(&format!("{file}:4:1: unknown key 'prot'; ")));
    assert!(!entries[0].contains('\n'), "{entries:?}");
    assert!(entries[1].starts_with(&format!("{file}:5:6: 'loud' is not known here")));
    assert!(entries[2].starts_with(&format!("{file}: ")), "{entries:?}");
}

#[test]
fn a_hangup_of_its_terminal_stops_the_gateway() {
    let scratch = Scratch::new();
    let (file, log) = (scratch.path("lab.yaml"), scratch.path("log"));
    std::fs::write(&file, file_of("devices: {head: sim:head}\n")).expect("to write");
    let gateway = ztl();
    let mut shell = std::process::Command::new("sh");
    let script = "\"$0\" gateway \"$1\" > \"$2\" 2>&1 < /dev/null; true";
    shell.args(["-c", script]).arg(gateway.get_program());
    let terminal = Terminal::start(shell.arg(file).arg(&log), (80, 24));
    let says = |part: &str| {
        until(part, PATIENCE, || {
            let said = std::fs::read_to_string(&log).unwrap_or_default();
            said.contains(part).then_some(())
        });
    };
    says("Device 'head' is ready");
    drop(terminal);
    says("Stopped.");
}
