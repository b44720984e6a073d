//! The devices of a gateway on the page.

use serde_json::{Map, Value, json};
use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, Server, busy, reserve_port, simulated_gripper, ztl,
};

use crate::client::Client;
use crate::console::{Console, drive, port, web};
use crate::robot::{Scripted, listed, probed};

/// The answer of a gateway with 53 devices whose texts are hostile.
fn hostile() -> String {
    let evil = "<img src=x onerror=alert(1)><script>alert(2)</script>\u{202e}";
    let device = |number: usize| {
        let report = json!({
            "url": evil, "ready": number.is_multiple_of(2), "problem": format!("{evil}{}", "W".repeat(400)),
            "firmware": { "name": evil, "version": "v".repeat(400), "boot": 1, "uptime_ms": 0, "link_timeout_ms": 1 },
            "components": [],
            "link": {
                "frames": 0, "damaged": u64::MAX, "truncated": u64::MAX, "too_long": 0, "not_understood": 0,
                "repeats": u64::MAX, "duplicates": 0, "sessions": 1, "resets": u64::MAX, "lost": u64::MAX,
                "round_trip_p50_us": u64::MAX, "round_trip_p99_us": u64::MAX, "queue": 0,
            },
        });
        (format!("{evil}{number}{}", "W".repeat(100)), report)
    };
    let devices: Map<String, Value> = (0..53).map(device).collect();
    json!({ SCOPE: devices }).to_string()
}

/// A device whose port does not exist.
const WRIST: &str = "wrist=serial:/no/such/port";

/// Kills it, as if its plug was pulled.
#[track_caller]
fn unplug(device: &mut Process, link: &str) {
    // If it stayed, it would lead to the next process that gets a pty with the same number.
    std::fs::remove_file(link).expect("the link");
    device.kill();
}

/// A gateway with a device at `link`, one inside of it, and more.
fn gateway(port: u16, link: &str, more: &[&str]) -> Server {
    let mut command = ztl();
    command.args(["gateway", "-p", &port.to_string(), "-s", SCOPE]);
    let arm = format!("arm=serial:{link}");
    for device in [&arm, "gripper=sim:gripper"].iter().chain(more) {
        command.args(["--device", device]);
    }
    let process = Process::start(&mut command);
    process.wait_for("Device 'arm' is ready");
    Server { process, port }
}

#[test]
fn devices_are_shown_with_their_links_and_since_when_one_is_silent() {
    let _busy = busy();
    let console = Console::of_one();
    let link = console.files.path("arm").display().to_string();
    let on = format!("pty:{link}");
    let mut device = simulated_gripper(&on);
    let mut gateway = gateway(reserve_port(), &link, &[WRIST]);
    let evil = Scripted::with_devices(&hostile(), |request| match request {
        "$ztl;2;-1;probe" => Some(probed(&[])),
        _ => Some(listed()),
    });
    let robots = [
        ("plain", console.robot.port),
        ("lab", gateway.port),
        ("evil", evil.port),
    ];
    let (_process, url) = web(0, &robots, &[]);
    let mut driver = drive("devices", &url, &console);
    driver.wait_for("do: kill the device");
    unplug(&mut device, &link);
    driver.write_line("done");
    driver.wait_for("do: start the device");
    let _device = simulated_gripper(&on);
    driver.write_line("done");
    driver.wait_for("do: kill the gateway");
    gateway.process.kill();
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn a_client_hears_of_devices_and_a_server_without_them_has_none() {
    let console = Console::of_one();
    let gateway = Server::simulated();
    let robots = [("plain", console.robot.port), ("lab", gateway.port)];
    let (_process, url) = web(0, &robots, &[]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/robots");
    // By name.
    let told = client.topic("/ztl/robots", |told| {
        let [lab, plain] = [0, 1].map(|at| &told["robots"][at]);
        lab["devices"][1]["state"] == "up" && plain["health"] == "there"
    });
    let [lab, plain] = [0, 1].map(|at| &told["robots"][at]);
    assert_eq!(
        (&lab["name"], &plain["devices"]),
        (&json!("lab"), &json!([]))
    );
    let gripper = &lab["devices"][0];
    assert_eq!(
        (&gripper["name"], &gripper["scope"]),
        (&json!("gripper"), &json!(SCOPE))
    );
    assert!(
        gripper["reset_ms"].is_u64() && gripper["lost"].is_u64(),
        "{gripper}"
    );
    assert_eq!(lab["devices_text"], "");
}

/// What the only robot has told a Stop.
#[track_caller]
fn stopped(client: &mut Client) -> (bool, String) {
    let told = client.call("/ztl/stop", &json!({}));
    let robot = &told["robots"][0];
    let confirmed = robot["confirmed"].as_bool().expect("decided");
    (
        confirmed,
        robot["text"].as_str().expect("a text").to_owned(),
    )
}

#[test]
fn a_device_that_does_not_answer_is_not_called_stopped() {
    let _busy = busy();
    let files = Scratch::new();
    let link = files.path("arm").display().to_string();
    let on = format!("pty:{link}");
    let mut device = simulated_gripper(&on);
    let gateway = gateway(reserve_port(), &link, &[]);
    // It takes 20 s to open then, and is unplugged on its way.
    gateway.set_speed("arm", "speed", 0.1);
    let (_process, url) = web(0, &[("lab", gateway.port)], &[]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/robots");
    client.topic("/ztl/robots", |told| {
        told["robots"][0]["devices"][0]["state"] == "up"
    });
    assert_eq!(stopped(&mut client), (true, "nothing ran".to_owned()));
    // The device vanishes while it moves: the gateway reports the task as FAILED, but the device may still move.
    for goal in ["0", "100"] {
        client.goal(goal, "/test/arm/finger", &json!({ "goal": goal }));
        if goal == "0" {
            client.result(goal);
        }
    }
    client.subscribe("/ztl/tasks");
    // Once the device has begun: before, it is still waiting in the gateway, and can be aborted for certain.
    client.task(|task| task["task"] == "arm:finger:100" && task["state"] == "ACCEPTED");
    unplug(&mut device, &link);
    for _ in 0..2 {
        let (confirmed, why) = stopped(&mut client);
        assert!(
            !confirmed && why.contains("device arm is SILENT"),
            "{confirmed}: {why}"
        );
    }
    assert_eq!(client.result("100")["values"]["state"], "FAILED");
    let _device = simulated_gripper(&on);
    client.topic("/ztl/robots", |told| {
        told["robots"][0]["devices"][0]["state"] == "up"
    });
    assert_eq!(stopped(&mut client), (true, "nothing ran".to_owned()));
}

#[test]
fn a_device_that_its_gateway_has_not_reached_is_not_called_stopped() {
    let reports = ["up", "away"].map(|name| {
        let ready = name == "up";
        let link = json!({
            "frames": 0, "damaged": 0, "truncated": 0, "too_long": 0, "not_understood": 0, "repeats": 0,
            "duplicates": 0, "sessions": u8::from(ready), "resets": 0, "lost": 0, "queue": 0,
        });
        let report = json!({
            "url": "x", "ready": ready, "problem": null, "firmware": null, "components": [], "link": link,
        });
        (name, report)
    });
    let devices: Map<String, Value> = reports
        .map(|(name, report)| (name.to_owned(), report))
        .into_iter()
        .collect();
    let lab = Scripted::with_devices(
        &json!({ SCOPE: devices }).to_string(),
        |request| match request {
            "$ztl;2;-1;probe" => Some(probed(&[])),
            _ => Some(listed()),
        },
    );
    let (_process, url) = web(0, &[("lab", lab.port)], &[]);
    let (confirmed, why) = stopped(&mut Client::open(port(&url)));
    assert!(!confirmed, "{why}");
    assert!(
        why.starts_with("device away is NOT THERE") && !why.contains("device up"),
        "{why}"
    );
}
