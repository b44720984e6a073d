//! `ztl devices`, `ztl ps` and `ztl abort`: a person looks at a server and stops what runs there,
//! whoever started it.

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{Ended, PATIENCE, Process, SCOPE, Server, reserve_port, until, ztl};

/// `ztl` with these words and the server's port.
#[track_caller]
fn ask(server: &Server, line: &str) -> Ended {
    let port = server.port.to_string();
    Process::run(ztl().args(line.split(' ')).args(["-p", &port]))
}

/// The same, which has to go well; what it prints.
#[track_caller]
fn tell(server: &Server, line: &str) -> String {
    let ended = ask(server, line);
    assert_eq!(
        (ended.code, ended.stderr.as_str()),
        (Some(0), ""),
        "{line}: {ended:?}"
    );
    ended.stdout
}

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

fn client(server: &Server) -> RemoteTask {
    RemoteTask::connect(&server.endpoint(), SCOPE).expect("an address")
}

#[test]
fn devices_tells_what_is_connected_and_what_is_not() {
    let nobody = format!("ghost=tcp:127.0.0.1:{}", reserve_port());
    let gateway = Server::gateway(&["gripper=sim:gripper", "head=sim:head", &nobody]);
    gateway.wait_ready("gripper");
    gateway.wait_ready("head");
    gateway.process.wait_for("Device 'ghost'");

    let text = tell(&gateway, "devices");
    for part in [
        "/test gripper at sim:gripper: ready\n",
        "finger: 0 to 100 percent; a second task is refused; without link it goes to its safe state, also when idle\n",
        "pan: -90 to 90 degrees, left, straight, right;",
        "ghost at tcp:127.0.0.1:",
        "not ready: ",
        "refused",
    ] {
        assert!(text.contains(part), "'{part}' in {text}");
    }

    let told = json(&tell(&gateway, "devices --json"));
    let gripper = &told["/test"]["gripper"];
    assert_eq!(gripper["ready"], true);
    assert_eq!(gripper["firmware"]["name"], "gripper");
    assert_eq!(gripper["components"][0]["range"], json("[0.0, 100.0]"));
    assert_eq!(gripper["link"]["sessions"], 1);
    assert!(
        gripper["link"]["round_trip_p50_us"].as_u64() > Some(0),
        "{told}"
    );
    assert_eq!(told["/test"]["ghost"]["ready"], false);
    assert_eq!(told["/test"]["ghost"]["firmware"], serde_json::Value::Null);

    let one = tell(&gateway, "devices head");
    assert!(one.contains("pan") && !one.contains("finger"), "{one}");
    let ended = ask(&gateway, "devices tail");
    assert_eq!(ended.code, Some(1));
    assert_eq!(
        ended.stderr,
        "ztl: no device 'tail'; there are: ghost, gripper, head\n"
    );
}

#[test]
fn a_task_of_another_client_is_seen_and_stopped() {
    let gateway = Server::simulated();
    assert_eq!(tell(&gateway, "ps"), "No task is running.\n");
    assert_eq!(tell(&gateway, "abort --all"), "No task is running.\n");

    let mut other = client(&gateway);
    let task = other.trigger("gripper", "finger", "100").expect("accepted");
    let listed = tell(&gateway, "ps");
    let row = format!("{}  /test  gripper:finger:100  ACCEPTED  ", task.id);
    assert!(
        listed.lines().any(|line| line.starts_with(&row)),
        "{listed}"
    );
    let device = tell(&gateway, "devices gripper");
    let line = format!("  task {} gripper:finger:100: ACCEPTED since ", task.id);
    assert!(device.contains(&line), "{device}");

    let said = tell(&gateway, &format!("abort {}", task.id));
    let start = format!("{} gripper:finger:100: ABORTED, ", task.id);
    assert!(said.starts_with(&start), "{said}");
    let end = other.status(task.id).expect("an answer");
    assert_eq!(end.state, State::Aborted);
    // It is told as the device told it, which is where the finger stopped.
    assert_eq!(said, format!("{start}{}\n", end.text));

    assert_eq!(tell(&gateway, "ps"), "No task is running.\n");
    let told = json(&tell(&gateway, "ps --all --json"));
    assert_eq!(told["tasks"][0]["id"], task.id.get());
    assert_eq!(told["tasks"][0]["state"], 4);
    // Its times pass.
    until("it has grown older since its end", PATIENCE, || {
        let told = json(&tell(&gateway, "ps --all --json"));
        let [age, ended] = ["age_ms", "ended_ms"].map(|name| told["tasks"][0][name].as_u64());
        (age > ended && ended > Some(0)).then_some(())
    });
}

#[test]
fn everything_is_stopped_at_once() {
    let gateway = Server::simulated();
    let mut other = client(&gateway);
    let finger = other.trigger("gripper", "finger", "100").expect("accepted");
    let pan = other.trigger("head", "pan", "left").expect("accepted");
    let said = tell(&gateway, "abort --all");
    assert_eq!(said.matches(": ABORTED, ").count(), 2, "{said}");
    for id in [finger.id, pan.id] {
        assert_eq!(other.status(id).expect("an answer").state, State::Aborted);
    }
}

#[test]
fn a_task_that_nobody_knows_is_no_task_to_stop() {
    let gateway = Server::simulated();
    let ended = ask(&gateway, "abort 7");
    assert_eq!(ended.code, Some(1));
    assert!(
        ended.stderr.starts_with("ztl: no task 7 is known at "),
        "{ended:?}"
    );
    let ended = ask(&gateway, "abort 0");
    assert_eq!(ended.code, Some(2));
    assert!(
        ended.stderr.contains("an id is a whole number above 0"),
        "{ended:?}"
    );
}

#[test]
fn the_exit_code_tells_whether_the_task_has_stopped() {
    let server = Server::ours();
    let mut other = client(&server);
    let task = other.trigger("test", "sleep", "20").expect("accepted");
    let listed = tell(&server, "ps");
    assert!(listed.contains("test:sleep:20"), "{listed}");
    let ended = ask(&server, &format!("abort {}", task.id));
    let stopped = other.status(task.id).expect("an answer").state == State::Aborted;
    assert_eq!(ended.code, Some(i32::from(!stopped)), "{ended:?}");
}

#[test]
fn the_original_server_is_said_to_tell_nothing() {
    let server = Server::original();
    for line in ["ps", "abort --all"] {
        let ended = ask(&server, line);
        assert_eq!(ended.code, Some(1), "{line}");
        assert!(
            ended.stderr.contains("does not tell its tasks"),
            "{line}: {ended:?}"
        );
    }
    let ended = ask(&server, "devices");
    assert!(ended.stderr.contains("it is no gateway"), "{ended:?}");
    // With the scope said by hand, its tasks can be stopped.
    let mut other = client(&server);
    let task = other.trigger("test", "sleep", "1").expect("accepted");
    until("the original's task to run", PATIENCE, || {
        let state = other.status(task.id).ok()?.state;
        (state == State::Accepted || state.is_final()).then_some(())
    });
    let ended = ask(&server, &format!("abort -s {SCOPE} {}", task.id));
    assert!(
        ended.stdout.starts_with(&format!("{}: ", task.id)),
        "{ended:?}"
    );
}
