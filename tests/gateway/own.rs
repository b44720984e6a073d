//! Tasks that devices start themselves, their events, and long results.

use ztl_mcu::link::Offer;
use ztl_mcu::{Component, Instant, Refused, Report, Run};
use ztl_sim::{Buttons, Device, Kind, Running};
use ztl_std::gateway::Gateway;
use ztl_std::{RemoteTask, State, TaskId};
use ztl_tests::lab::{
    LIMIT, PATIENCE, Process, SCOPE, Scratch, Server, connect, reserve_port, until, ztl,
};

use crate::firmware::Firmware;
use crate::lines::{complete, serve};

/// A simulated gripper with its buttons, and its URL.
fn gripper() -> (Running, Buttons, String) {
    let device = Device::new(Kind::Gripper).on_tcp("127.0.0.1:0");
    let (running, address) = device.expect("a port");
    let buttons = running.buttons();
    (running, buttons, format!("gripper=tcp:{address}"))
}

fn start_gateway(url: &str, scratch: &Scratch, port: u16) -> Server {
    let mut command = ztl();
    let port = port.to_string();
    command.args(["gateway", "-p", &port, "-s", SCOPE, "-d", url]);
    command.arg("--journal").arg(scratch.path("journal"));
    let gateway = Server::start(&mut command);
    gateway.wait_ready("gripper");
    gateway
}

/// What `ztl ps` says of a server.
fn ps(gateway: &Server, options: &[&str]) -> String {
    let port = gateway.port.to_string();
    let ended = Process::run(ztl().args(["ps", "-p", &port]).args(options));
    ended.stdout
}

/// The tasks that it lists, without those of `ztl param`.
fn listed(gateway: &Server) -> Vec<serde_json::Value> {
    let list: serde_json::Value = serde_json::from_str(&ps(gateway, &["--json"])).expect("JSON");
    let mut tasks = list["tasks"].as_array().cloned().unwrap_or_default();
    tasks.retain(|task| !task["task"].to_string().contains("$param"));
    tasks
}

/// The id of the only task that the device has started.
#[track_caller]
fn only_id(gateway: &Server) -> TaskId {
    let all = until("the task of the device", PATIENCE, || {
        let all = listed(gateway);
        (!all.is_empty()).then_some(all)
    });
    assert_eq!(all.len(), 1, "{all:?}");
    assert_eq!(all[0]["by_device"], true, "{all:?}");
    let id = all[0]["id"].as_u64().and_then(|id| u32::try_from(id).ok());
    id.and_then(TaskId::new).expect("an id")
}

/// Presses as soon as the link is up.
#[track_caller]
fn press(buttons: &Buttons, goal: &str) {
    until("the button works", PATIENCE, || buttons.press(goal).ok());
}

fn state(remote: &mut RemoteTask, id: TaskId) -> State {
    remote.status(id).expect("an answer").state
}

#[test]
fn clients_see_a_task_of_the_device_abort_it_and_learn_its_end() {
    let (_running, buttons, url) = gripper();
    assert_eq!(buttons.press("100"), Err("no link".to_owned()));
    let scratch = Scratch::new();
    let gateway = start_gateway(&url, &scratch, reserve_port());
    let mut remote = connect(&gateway.endpoint());
    // It takes 20 s then, so it still runs when it is aborted.
    gateway.set_speed("gripper", "speed", 0.1);
    press(&buttons, "100");
    let id = only_id(&gateway);
    assert_eq!(listed(&gateway)[0]["task"], "gripper:finger:100");
    assert_eq!(state(&mut remote, id), State::Accepted);
    let table = ps(&gateway, &[]);
    assert!(
        table.contains("gripper:finger:100 (by the device)"),
        "{table}"
    );
    remote.abort(id).expect("an answer");
    let end = remote.wait(id, LIMIT).expect("its end");
    assert_eq!(end.state, State::Aborted);
    // The device forgets the task when the gateway has acknowledged its end.
    until("the task is forgotten", PATIENCE, || {
        buttons.release().err()
    });
    gateway.process.wait_for("was started by the device");

    gateway.set_speed("gripper", "speed", 4.0);
    press(&buttons, "0");
    until("the second end", PATIENCE, || {
        let all = listed(&gateway);
        let done = all
            .iter()
            .filter(|task| task["state"] == State::Completed.code());
        (done.count() == 1).then_some(())
    });
}

#[test]
fn a_button_that_is_stuck_fills_no_journal() {
    let (_running, buttons, url) = gripper();
    let scratch = Scratch::new();
    let _gateway = start_gateway(&url, &scratch, reserve_port());
    let begin = std::time::Instant::now();
    // 20 at once and then five a second; four more wait in the device.
    for _ in 0..36 {
        press(&buttons, "0");
    }
    let took = begin.elapsed();
    assert!(took > std::time::Duration::from_secs(2), "{took:?}");
}

#[test]
fn a_restarted_gateway_keeps_the_id_and_a_reset_device_fails_the_task() {
    let (running, buttons, url) = gripper();
    let (scratch, port) = (Scratch::new(), reserve_port());
    let mut gateway = start_gateway(&url, &scratch, port);
    // It takes 20 s then, so it still runs when it is released or the device is reset.
    gateway.set_speed("gripper", "speed", 0.1);
    press(&buttons, "100");
    buttons.release().expect("it runs");
    let id = only_id(&gateway);
    // Whether or not the device loses the link meanwhile.
    gateway.process.kill();
    drop(gateway);
    let gateway = start_gateway(&url, &scratch, port);
    assert_eq!(only_id(&gateway), id);
    let mut remote = connect(&gateway.endpoint());
    let end = until("its end", PATIENCE, || {
        Some(remote.status(id).expect("an answer")).filter(|status| status.state.is_final())
    });
    assert_eq!(end.state, State::Aborted, "{end:?}");

    press(&buttons, "100");
    let second = until("the next task", PATIENCE, || {
        let all = listed(&gateway);
        let next = all.iter().find(|task| task["id"] != u64::from(id.get()))?;
        TaskId::new(u32::try_from(next["id"].as_u64()?).ok()?)
    });
    running.reset()();
    let end = remote.wait(second, LIMIT).expect("its end");
    assert_eq!((end.state, &*end.text), (State::Failed, "device was reset"));
}

#[test]
fn events_of_a_device_are_logged_and_go_where_readings_go() {
    let (_running, buttons, url) = gripper();
    let mut gateway = Gateway::new();
    let readings = gateway.observe(100);
    let (name, url) = url.split_once('=').expect("a name");
    gateway
        .add(name, url.parse().expect("a URL"))
        .expect("a thread");
    let (_server, _remote) = serve(gateway);
    for number in 0..6 {
        let event = format!("event {number}");
        until("there is room", PATIENCE, || buttons.report(&event).ok());
    }
    for number in 0..6 {
        let event = readings.next_within(PATIENCE).expect("an event");
        assert_eq!(event.topic, "gripper/events");
        assert_eq!(event.bytes, format!("event {number}").into_bytes());
    }
}

#[test]
fn lines_push_the_buttons_of_a_simulated_device() {
    let mut device =
        Process::start(ztl().args(["device", "sim:head", "--on", "tcp:0", "--buttons"]));
    let at = device.wait_for("Simulated head at ");
    let url = at.trim_start_matches("Simulated head at ");
    let (url, _) = url.split_once(". ").expect("a URL");
    for push in ["press left", "release", "hello"] {
        device.write_line(push);
    }
    device.wait_for("press left: no link");
    device.wait_for("release: no task was started here");
    device.wait_for("hello: expected press GOAL, release or report TEXT");
    let gateway = Server::gateway(&[&format!("head={url}")]);
    gateway.wait_ready("head");
    device.write_line("report hello there");
    gateway
        .process
        .wait_for("Device 'head' reports: hello there");
    // Until the link is up.
    until("a task", PATIENCE, || {
        device.write_line("press left");
        (!listed(&gateway).is_empty()).then_some(())
    });
    assert_eq!(listed(&gateway)[0]["task"], "head:pan:left");
}

/// Returns as many letters as its goal says.
struct Speller {
    spelled: String,
    wanted: usize,
}

impl Component for Speller {
    fn offer(&self) -> Offer<'_> {
        Offer::new("speller")
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        goal.parse::<usize>().map(drop).map_err(|_| {
            why.text("speller takes a number of letters");
            Refused
        })
    }

    fn start(&mut self, _: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.spelled.clear();
        self.wanted = goal.parse().map_err(|_| Refused)?;
        Ok(())
    }

    fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run {
        report.text("spelled");
        self.spelled = "abcde".chars().cycle().take(self.wanted).collect();
        Run::Completed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}

    fn result(&self) -> &str {
        &self.spelled
    }
}

#[test]
fn a_client_gets_a_result_of_500_bytes() {
    let firmware = Firmware::start((Speller {
        spelled: String::new(),
        wanted: 0,
    },));
    let mut gateway = Gateway::new();
    let url = format!("tcp:{}", firmware.address);
    gateway
        .add("bench", url.parse().expect("a URL"))
        .expect("a thread");
    let (_server, mut remote) = serve(gateway);
    for _ in 0..3 {
        assert_eq!(
            complete(&mut remote, "bench", "speller", "500"),
            "abcde".repeat(100)
        );
    }
    assert_eq!(complete(&mut remote, "bench", "speller", "0"), "spelled");
    let longer = complete(&mut remote, "bench", "speller", "2000");
    assert!(longer.ends_with('…') && longer.len() > 600, "{longer}");
}
