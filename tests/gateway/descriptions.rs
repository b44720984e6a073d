//! What components of devices say of themselves: in the firmware, on the line, and in the answers of the gateway.

use serde_json::{Value, json};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Scratch, Server, simulated_gripper, until, ztl};

/// What `ztl devices` prints, once it has this text.
#[track_caller]
fn wait_devices(server: &Server, text: &str) -> String {
    let port = server.port.to_string();
    until(text, PATIENCE, || {
        let told = Process::run(ztl().args(["devices", "-p", &port])).stdout;
        told.contains(text).then_some(told)
    })
}

#[test]
fn a_simulated_device_describes_its_finger() {
    let scratch = Scratch::new();
    let place = scratch.path("gripper");
    let mut device = simulated_gripper(&format!("pty:{}", place.display()));
    let gateway = Server::gateway(&[&format!("hand=serial:{}", place.display())]);
    let told = gateway.wait_described(&["opens the finger"]);
    let row = "hand:finger  a number from 0 to 100 percent  opens the finger; returns its opening in percent";
    assert!(told.contains(row), "{told}");
    let told = wait_devices(&gateway, "opens the finger");
    assert!(
        told.contains("finger: 0 to 100 percent; opens the finger; "),
        "{told}"
    );

    // While the device is away, its components still are what they are.
    std::fs::remove_file(&place).expect("the link");
    device.kill();
    wait_devices(&gateway, "not ready: ");
    gateway.wait_described(&[row]);
}

#[test]
fn descriptions_of_several_devices_are_for_programs_too() {
    let devices = ["left=sim:gripper", "top=sim:head", "room=sim:sensor"];
    let gateway = Server::gateway(&devices);
    gateway.wait_described(&["opens the finger", "turns the head", "publishes readings"]);
    let port = gateway.port.to_string();
    let told = Process::run(ztl().args(["describe", "--json", "-p", &port])).stdout;
    let told: Value = serde_json::from_str(&told).expect("JSON");
    let components = told["components"].as_array().expect("a list");
    let names = components
        .iter()
        .map(|it| [&it["handler"], &it["component"]]);
    let names: Vec<_> = names.collect();
    assert_eq!(
        names,
        [["left", "finger"], ["room", "probe"], ["top", "pan"]]
    );
    let numbers = json!({"type": "number", "minimum": 0, "maximum": 100, "description": "percent"});
    assert_eq!(components[0]["schema"], numbers);
    assert_eq!(
        components[1]["is"]["streams"],
        json!(["room/probe/reading"])
    );
    assert_eq!(
        components[2]["is"]["examples"],
        json!(["left", "straight", "right", "45"])
    );
    let told = Process::run(ztl().args(["devices", "--json", "-p", &port])).stdout;
    let told: Value = serde_json::from_str(&told).expect("JSON");
    let left = &told[SCOPE]["left"]["components"][0];
    assert_eq!(left["is"], components[0]["is"], "{told}");
}
