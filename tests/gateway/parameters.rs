//! `ztl param`: parameters of devices, from the firmware over the line and the gateway to people and programs.

use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::Value;
use ztl_mcu::parameters::{self, Declaration, Parameter, Tunable, Tuned};
use ztl_tests::inert;
use ztl_tests::lab::{
    Ended, Keys, PATIENCE, Process, SCOPE, Scratch, Server, simulated_gripper, until, ztl,
};

use crate::firmware::Firmware;

/// Does nothing but note which parameters are read.
struct Shelf(u32, [&'static AtomicBool; 4]);

inert!(Shelf, "shelf");

impl Tunable for Shelf {
    const PARAMETERS: &'static [Declaration] = &[
        Parameter::<u32>::new(0).declare("a"),
        Parameter::<u32>::new(0).declare("b"),
        Parameter::<u32>::new(0).declare("c"),
        Parameter::<u32>::new(0).declare("d"),
    ];

    fn value(&self, index: usize) -> Option<parameters::Value<'_>> {
        self.1.get(index)?.store(true, Ordering::SeqCst);
        Some(parameters::Value::U32(self.0))
    }

    fn set(&mut self, _: usize, value: parameters::Value<'_>) {
        if let parameters::Value::U32(number) = value {
            self.0 = number;
        }
    }
}

/// Runs `ztl param` with these words and options.
#[track_caller]
fn param(server: &Server, words: &[&str], options: &[String]) -> Ended {
    let port = server.port.to_string();
    let mut command = ztl();
    command.arg("param").args(words).args(["-p", &port]);
    Process::run(command.args(options))
}

/// What it prints.
#[track_caller]
fn told(server: &Server, words: &[&str]) -> String {
    let ended = param(server, words, &[]);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    ended.stdout
}

/// Why it fails.
#[track_caller]
fn refused(server: &Server, words: &[&str]) -> String {
    let ended = param(server, words, &[]);
    assert_eq!(
        (ended.code, ended.stdout.as_str()),
        (Some(1), ""),
        "{ended:?}"
    );
    ended.stderr
}

#[test]
fn a_parameter_is_set_at_once_and_survives_a_restart_when_it_is_saved() {
    let scratch = Scratch::new();
    let (place, journal) = (scratch.path("gripper"), scratch.path("journal"));
    let device = simulated_gripper(&format!("pty:{}", place.display()));
    let hand = format!("hand=serial:{}", place.display());
    let gateway = Server::gateway_with(&[&hand], &["--journal", &journal.display().to_string()]);
    gateway.wait_ready("hand");
    let list = told(&gateway, &["list", "hand"]);
    let speed = "finger.speed  1   0.1 to 4          default  saved  times its usual speed\n";
    let label = "finger.label  ''  at most 16 bytes  default  saved  what people call it\n";
    assert_eq!(list, format!("{speed}{label}"));
    let until_saved = "until the device is restarted, unless you run `ztl param save hand`";
    let set = told(&gateway, &["set", "hand", "speed", "2.5"]);
    assert_eq!(set, format!("finger.speed = 2.5; {until_saved}\n"));
    assert_eq!(told(&gateway, &["get", "hand", "finger.speed"]), "2.5\n");
    assert_eq!(told(&gateway, &["save", "hand"]), "hand: saved\n");
    told(&gateway, &["set", "hand", "label", "it's mine"]);
    let json = told(&gateway, &["list", "hand", "--json"]);
    let all: Value = serde_json::from_str(&json).expect("JSON");
    let kept = |index: usize| (&all[index]["value"], &all[index]["kept"]);
    assert_eq!(kept(0), (&2.5.into(), &"saved".into()));
    assert_eq!(kept(1), (&"it's mine".into(), &"changed".into()));

    // A power cut: what was not saved is lost.
    device.signal("USR1");
    let list = until("the label is lost", PATIENCE, || {
        let ended = param(&gateway, &["list", "hand"], &[]);
        ended.stdout.contains("label  ''").then_some(ended.stdout)
    });
    assert!(
        list.contains("finger.speed  2.5  0.1 to 4          default 1  saved"),
        "{list}"
    );
    let journal = std::fs::read_to_string(journal).expect("a journal");
    for entry in [
        r#""component":"$param","goal":"{'set': ['speed', '2.5']}","state":"COMPLETED","text":"finger.speed is 2.5, was 1""#,
        r#""component":"$param","goal":"save","state":"COMPLETED","text":"saved""#,
    ] {
        assert!(journal.contains(entry), "{journal}");
    }
    gateway.process.wait_for("finger.speed is 2.5, was 1");
}

#[test]
fn nothing_is_set_under_a_task_and_reading_does_not_disturb_it() {
    let gateway = Server::gateway(&["hand=sim:gripper"]);
    gateway.wait_ready("hand");
    told(&gateway, &["set", "hand", "speed", "0.1"]);
    let port = gateway.port.to_string();
    // 20 s long.
    let task = ["-p", &port, "-s", SCOPE, "-t", "600", "hand:finger:100"];
    let client = Process::start(ztl().arg("task-client").args(task));
    gateway.process.wait_for("has started");
    let busy = "the device refuses: a task runs that it would change";
    let why = refused(&gateway, &["set", "hand", "speed", "4"]);
    assert_eq!(why, format!("ztl: hand: {busy}\n"));
    let why = refused(&gateway, &["save", "hand"]);
    assert!(
        why.contains("not while a component moves or is not safe"),
        "{why}"
    );
    assert_eq!(told(&gateway, &["get", "hand", "speed"]), "0.1\n");
    let abort = Process::run(ztl().args(["abort", "--all", "-p", &port]));
    assert!(abort.stdout.contains("ABORTED"), "{abort:?}");
    client.end(PATIENCE);
    told(&gateway, &["set", "hand", "speed", "4"]);
}

#[test]
fn mistakes_are_told_with_what_would_be_right() {
    let gateway = Server::gateway(&["hand=sim:gripper", "room=sim:sensor"]);
    gateway.wait_ready("hand");
    gateway.wait_ready("room");
    for (words, why) in [
        (
            &["get", "hand", "sped"][..],
            "hand: no parameter 'sped'; did you mean 'speed'?",
        ),
        (
            &["get", "hand", "x"],
            "hand: no parameter 'x'; there are: finger.speed, finger.label",
        ),
        (
            &["set", "hand", "speed", "-1"],
            "hand: finger.speed takes a number from 0.1 to 4, not '-1'",
        ),
        (
            &["set", "hand", "label", "more than 16 bytes"],
            "hand: finger.label takes a text of at most 16 bytes, not 'more than 16 bytes'",
        ),
        (
            &["list", "room"],
            "room: the firmware of 'room' has no parameters, or is older than parameters",
        ),
        (&["list", "desk"], "no device 'desk'; there are: hand, room"),
    ] {
        assert_eq!(refused(&gateway, words), format!("ztl: {why}\n"));
    }
    assert_eq!(told(&gateway, &["get", "hand", "speed"]), "1\n");
    let ended = Process::run(ztl().args(["param", "set", "hand", "speed"]));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    // A long text is not repeated.
    let long = "x".repeat(5000);
    let why = refused(&gateway, &["set", "hand", "label", &long]);
    let x300 = "x".repeat(300);
    let takes = "hand: finger.label takes a text of at most 16 bytes";
    assert_eq!(why, format!("ztl: {takes}, not '{x300}… (5000 bytes)'\n"));
    let why = refused(&gateway, &["get", "hand", &long]);
    assert!(why.len() < 500, "{why}");
    gateway.process.wait_for("… (5000 bytes)'");
    let log = gateway.process.stderr();
    assert!(!log.contains(&"x".repeat(400)), "{log}");
}

#[test]
fn only_the_parameters_that_a_request_needs_are_read() {
    static READ: [AtomicBool; 4] = [const { AtomicBool::new(false) }; 4];
    let shelf = Shelf(0, READ.each_ref());
    let firmware = Firmware::start(Tuned::new((shelf,)));
    let gateway = Server::gateway(&[&format!("hand=tcp:{}", firmware.address)]);
    gateway.wait_ready("hand");
    for (words, read) in [
        // In each boot of the device, names are read until this one.
        (&["get", "hand", "shelf.b"][..], [true, true, false, false]),
        (&["get", "hand", "shelf.b"], [false, true, false, false]),
        // Another component may have this name, too.
        (&["get", "hand", "c"], [false, false, true, true]),
        (&["get", "hand", "c"], [false, false, true, false]),
        (&["set", "hand", "a", "5"], [true, false, false, false]),
        (&["list", "hand"], [true; 4]),
    ] {
        READ.iter()
            .for_each(|read| read.store(false, Ordering::SeqCst));
        let told = told(&gateway, words);
        let were = READ.each_ref().map(|read| read.load(Ordering::SeqCst));
        assert_eq!(were, read, "{words:?}: {told}");
    }
    assert_eq!(told(&gateway, &["get", "hand", "d"]), "5\n");
    let why = refused(&gateway, &["get", "hand", "f"]);
    assert_eq!(
        why,
        "ztl: hand: no parameter 'f'; there are: shelf.a, shelf.b, shelf.c, shelf.d\n"
    );
}

#[test]
fn only_clients_that_may_use_the_scope_see_and_set_parameters() {
    let keys = Keys::make(&["robot", "anna", "bob"]);
    let client = |scope: &str, name: &str| format!("{scope}={}", keys.path(&format!("{name}.key")));
    let gateway = Server::gateway_with(
        &["hand=sim:gripper"],
        &[
            "--key",
            &keys.path("robot.key_secret"),
            "--client-key",
            &client(SCOPE, "anna"),
            "--client-key",
            &client("/elsewhere", "bob"),
        ],
    );
    gateway.wait_ready("hand");
    let set = ["set", "hand", "speed", "2"];
    let bob = keys.options("bob", "robot");
    let ended = param(&gateway, &set, &bob);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    // Nor if he knows where it is.
    let ended = param(&gateway, &[&set[..], &["--scope", SCOPE]].concat(), &bob);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    let anna = keys.options("anna", "robot");
    let ended = param(&gateway, &["get", "hand", "speed"], &anna);
    assert_eq!(ended.stdout, "1\n", "{ended:?}");
    let ended = param(&gateway, &set, &anna);
    assert!(ended.stdout.starts_with("finger.speed = 2;"), "{ended:?}");
}
