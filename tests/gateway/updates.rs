//! `ztl firmware update`: from a signed image over the gateway and the line to firmware that runs.

use crate::lines::complete;
use ztl_std::State;
use ztl_tests::lab::{
    Ended, Keys, PATIENCE, Process, SCOPE, Scratch, Server, connect, reserve_port, until, ztl,
};

/// Keys, images and devices.
pub(crate) struct Bench {
    scratch: Scratch,
}

impl Bench {
    pub(crate) fn new() -> Self {
        let scratch = Scratch::new();
        for name in ["lab", "other"] {
            let path = scratch.path(name);
            let made = Process::run(ztl().args(["firmware", "keygen"]).arg(path));
            assert_eq!(made.code, Some(0), "{made:?}");
        }
        Self { scratch }
    }

    pub(crate) fn path(&self, name: &str) -> String {
        self.scratch.path(name).display().to_string()
    }

    /// Signs an image of at least this many bytes that begins with this text. Returns the path of the file.
    fn signed(&self, [key, board, version]: [&str; 3], text: &str, length: usize) -> String {
        let mut image = text.as_bytes().to_vec();
        image.resize(length.max(image.len()), b'.');
        std::fs::write(self.scratch.path("image"), image).expect("a file");
        let secret = self.path(&format!("{key}.firmware_secret"));
        let image = self.path("image");
        let mut command = ztl();
        command.args(["firmware", "sign", &image, "-k", &secret]);
        command.args(["--board", board, "--version", version]);
        let signed = command.output().expect("ztl");
        assert!(signed.status.success(), "{signed:?}");
        let path = self.path(&format!("{key}-{board}-{version}.update"));
        std::fs::write(&path, signed.stdout).expect("a file");
        path
    }

    pub(crate) fn image(&self, version: &str, text: &str) -> String {
        self.signed(["lab", "simulated", version], text, 4000)
    }

    /// A simulated gripper that takes updates.
    fn device(&self, on: &str, options: &[&str]) -> Process {
        let key = self.path("lab.firmware_key");
        let mut command = ztl();
        command.args(["device", "sim:gripper", "--on", on, "--firmware-key", &key]);
        let device = Process::start(command.args(options));
        device.wait_for("Simulated gripper at");
        device
    }

    /// A line of simulated nodes that take updates, with buttons, and what the gateway calls it.
    fn shared_line(&self, nodes: [&str; 2]) -> (Process, String) {
        let (path, key) = (self.path("line"), self.path("lab.firmware_key"));
        let on = format!("pty:{path}");
        let mut command = ztl();
        command.args(["device", "--bus", "--buttons", "--on", &on]);
        let line = Process::start(command.args(["--firmware-key", &key]).args(nodes));
        line.wait_for("Serve it with");
        (line, format!("arm=rs485:{path}?wait=100"))
    }

    /// A device `name` with this rate, and what the gateway calls it.
    pub(crate) fn served(&self, name: &str, options: &[&str]) -> (Process, String) {
        let path = self.path(name);
        let device = self.device(&format!("pty:{path}"), options);
        (device, format!("{name}=serial:{path}"))
    }
}

/// A device that sends so slowly that an image of 40 kB takes some seconds.
const SLOW: [&str; 2] = ["--baud", "9600"];

/// `ztl firmware update` with these words.
pub(crate) fn update(server: &Server, words: &[&str]) -> std::process::Command {
    let port = server.port.to_string();
    let mut command = ztl();
    command
        .args(["firmware", "update"])
        .args(words)
        .args(["-p", &port]);
    command
}

#[track_caller]
fn updates(server: &Server, words: &[&str], code: i32, says: &str) -> Ended {
    let ended = Process::run(&mut update(server, words));
    assert_eq!(ended.code, Some(code), "{ended:?}");
    let said = format!("{}{}", ended.stdout, ended.stderr);
    assert!(said.contains(says), "{ended:?}");
    ended
}

/// Makes the finger of `hand` ten times slower: a self-test of the whole way takes 20 s. New firmware keeps the speed.
#[track_caller]
pub(crate) fn slow_down(server: &Server) {
    server.set_speed("hand", "speed", 0.1);
    let port = server.port.to_string();
    let saved = Process::run(ztl().args(["param", "save", "hand", "-p", &port]));
    assert_eq!(saved.code, Some(0), "{saved:?}");
}

/// Whether an update has failed because a busy machine has lost the link during the self-test.
pub(crate) fn test_lost_link(said: &str) -> bool {
    let lost = [
        "link was lost",
        "device is not answering",
        "the command came too late",
    ];
    said.contains("the self-test failed: ") && lost.iter().any(|why| said.contains(why))
}

/// The numbers of bytes that were shown as sent.
fn sent(shown: &str) -> Vec<u32> {
    let texts = shown.split("sent ").skip(1);
    texts
        .filter_map(|text| text.split(' ').next()?.parse().ok())
        .collect()
}

/// Waits until the update has sent a part of the image.
#[track_caller]
fn wait_until_sending(command: &Process) {
    until("a part is sent", PATIENCE, || {
        sent(&command.stdout())
            .iter()
            .any(|sent| *sent > 4000)
            .then_some(())
    });
}

pub(crate) fn version(server: &Server, device: &str) -> Option<String> {
    let port = server.port.to_string();
    let shown = Process::run(ztl().args(["devices", "--json", "-p", &port]));
    let all: serde_json::Value = serde_json::from_str(&shown.stdout).ok()?;
    let firmware = &all.pointer("/scopes").unwrap_or(&all)[SCOPE][device]["firmware"];
    Some(firmware["version"].as_str()?.to_owned())
}

#[track_caller]
pub(crate) fn wait_for_version(server: &Server, device: &str, wanted: &str) {
    until(wanted, PATIENCE, || {
        (version(server, device)? == wanted).then_some(())
    });
}

#[test]
fn a_device_is_updated_tested_and_confirmed_and_the_journal_tells_it() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let journal = bench.path("journal");
    let gateway = Server::gateway_with(&[&hand], &["--journal", &journal]);
    gateway.wait_ready("hand");
    let image = bench.image("1.1.0", "self-test: 20\n");
    let ended = updates(
        &gateway,
        &["hand", &image],
        0,
        "hand: runs 1.1.0, before 1.0.0\n",
    );
    assert!(
        ended
            .stdout
            .starts_with("hand: runs 1.0.0; the image is 1.1.0\n"),
        "{ended:?}"
    );
    wait_for_version(&gateway, "hand", "1.1.0");
    let journal = std::fs::read_to_string(journal).expect("a journal");
    let entry = r#""state":"COMPLETED","text":"{\"before\":\"1.0.0\",\"after\":\"1.1.0\"}""#;
    assert!(journal.contains(entry), "{journal}");
    let test = r#""component":"finger","goal":"20","state":"COMPLETED""#;
    assert!(journal.contains(test), "{journal}");
}

#[test]
fn what_does_not_fit_is_refused_with_a_code_of_its_own() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &["--firmware-version", "2.0.0"]);
    let gateway = Server::gateway(&[&hand, "old=sim:gripper"]);
    gateway.wait_ready("hand");
    gateway.wait_ready("old");
    let of = |key, board, version| bench.signed([key, board, version], "", 100);
    let forged = of("other", "simulated", "2.1.0");
    updates(
        &gateway,
        &["hand", &forged],
        3,
        "the signature does not fit",
    );
    let other = of("lab", "microbit", "2.1.0");
    updates(
        &gateway,
        &["hand", &other],
        4,
        "the image is for another board",
    );
    let older = of("lab", "simulated", "1.9.9");
    updates(
        &gateway,
        &["hand", &older],
        5,
        "older than the firmware that runs",
    );
    let key = bench.path("lab.firmware_key");
    updates(&gateway, &["hand", &key], 2, "too short for a manifest");
    let whole = std::fs::read(&older).expect("a file");
    for (length, says) in [
        (
            whole.len() - 1,
            "bytes of image, but 127 follow it; is the file complete?",
        ),
        (103, "too short for a manifest"),
        (0, "too short for a manifest"),
    ] {
        let cut = bench.path("cut.update");
        std::fs::write(&cut, &whole[..length]).expect("a file");
        updates(&gateway, &["hand", &cut], 2, says);
    }
    let none = bench.path("none.update");
    updates(&gateway, &["hand", &none], 2, "none.update: ");
    updates(
        &gateway,
        &["old", &older],
        1,
        "its firmware takes no updates",
    );
    updates(&gateway, &["hnd", &older], 1, "no device 'hnd'");
    assert_eq!(version(&gateway, "hand").as_deref(), Some("2.0.0"));
    updates(&gateway, &["hand", &older, "--downgrade"], 0, "runs 1.9.9");
}

#[test]
fn an_empty_image_is_named() {
    let bench = Bench::new();
    let (image, key) = (bench.path("image"), bench.path("lab.firmware_secret"));
    std::fs::write(&image, "").expect("a file");
    let mut command = ztl();
    command.args(["firmware", "sign", &image, "-k", &key]);
    let ended = Process::run(command.args(["--board", "desk", "--version", "1.0.0"]));
    assert_eq!(ended.code, Some(1), "{ended:?}");
    let says = format!("ztl: {image}: empty image\n");
    assert_eq!(ended.stderr, says);
}

#[test]
fn a_task_delays_the_update_unless_it_is_to_end_now() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &SLOW);
    let gateway = Server::gateway(&[&hand]);
    gateway.wait_ready("hand");
    let mut remote = connect(&gateway.endpoint());
    gateway.set_speed("hand", "speed", 0.1);
    let image = bench.signed(["lab", "simulated", "1.1.0"], "", 40_000);
    let task = remote.trigger("hand", "finger", "100").expect("a task");
    updates(
        &gateway,
        &["hand", &image],
        1,
        "a task runs, and the update would end it",
    );
    let running = Process::start(&mut update(&gateway, &["hand", &image, "--now"]));
    wait_until_sending(&running);
    let end = remote.wait(task.id, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Aborted, "{end:?}");
    let refused = remote
        .trigger("hand", "finger", "1")
        .expect_err("it is being updated");
    let said = refused.to_string();
    assert!(said.contains("a firmware update is in progress"), "{said}");
    // A second update of the same device, by another client.
    updates(
        &gateway,
        &["hand", &image],
        1,
        "another update of this device",
    );
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

#[test]
fn an_update_goes_on_after_the_line_was_broken() {
    let bench = Bench::new();
    let port = reserve_port();
    let device = bench.device(&format!("tcp:{port}"), &SLOW);
    let between = reserve_port();
    let mut command = ztl();
    command.args([
        "line",
        &format!("tcp-listen:{between}"),
        &format!("tcp:127.0.0.1:{port}"),
    ]);
    let mut line = Process::start(&mut command);
    let gateway = Server::gateway(&[&format!("hand=tcp:127.0.0.1:{between}")]);
    gateway.wait_ready("hand");
    let image = bench.signed(["lab", "simulated", "1.1.0"], "", 40_000);
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    wait_until_sending(&running);
    line.kill();
    gateway.process.wait_for("'hand': tcp:");
    line = Process::start(&mut command);
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let sent = sent(&ended.stdout);
    assert!(sent.is_sorted(), "it began again: {sent:?}");
    assert!(sent.len() > 3, "{sent:?}");
    drop((line, device));
}

#[test]
fn an_aborted_update_leaves_the_firmware_and_the_device_serves_again() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &SLOW);
    let gateway = Server::gateway(&[&hand]);
    gateway.wait_ready("hand");
    let image = bench.signed(["lab", "simulated", "1.1.0"], "", 40_000);
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    wait_until_sending(&running);
    running.signal("INT");
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(130), "{ended:?}");
    assert!(
        ended.stderr.contains("aborted; the device keeps 1.0.0"),
        "{ended:?}"
    );
    let mut remote = connect(&gateway.endpoint());
    // The device hears of it within a moment, over a slow line.
    complete(&mut remote, "hand", "finger", "3");
    assert_eq!(version(&gateway, "hand").as_deref(), Some("1.0.0"));
}

#[test]
fn a_signal_ends_the_command_also_when_the_gateway_is_gone_or_hangs() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &SLOW);
    let image = bench.signed(["lab", "simulated", "1.1.0"], "", 40_000);
    for how in ["STOP", "KILL"] {
        let gateway = Server::gateway(&[&hand]);
        gateway.wait_ready("hand");
        let running = Process::start(&mut update(&gateway, &["hand", &image]));
        wait_until_sending(&running);
        gateway.process.signal(how);
        running.signal("TERM");
        let ended = running.end(PATIENCE);
        assert_eq!(ended.code, Some(143), "{ended:?}");
        let said = "hand: the update may go on, ztl ps shows it: ";
        assert!(ended.stderr.contains(said), "{ended:?}");
        if how == "STOP" {
            gateway.process.signal("CONT");
        }
    }
}

#[test]
fn a_killed_gateway_leaves_the_firmware_and_the_next_one_goes_on() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &SLOW);
    let (port, journal) = (reserve_port().to_string(), bench.path("journal"));
    let start = || {
        let mut command = ztl();
        command.args(["gateway", "--device", &hand, "-s", SCOPE, "-p", &port]);
        Server::start(command.args(["--journal", &journal]))
    };
    let mut gateway = start();
    gateway.wait_ready("hand");
    let image = bench.signed(["lab", "simulated", "1.1.0"], "", 40_000);
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    wait_until_sending(&running);
    gateway.process.kill();
    drop(gateway);
    let gateway = start();
    gateway.wait_ready("hand");
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended.stderr.contains("the gateway ended during the update"),
        "{ended:?}"
    );
    assert_eq!(version(&gateway, "hand").as_deref(), Some("1.0.0"));
    let ended = updates(&gateway, &["hand", &image], 0, "runs 1.1.0, before 1.0.0");
    let sent = sent(&ended.stdout);
    assert!(sent.first().is_some_and(|first| *first > 4000), "{sent:?}");
}

#[test]
fn firmware_that_is_not_confirmed_goes_back() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let gateway = Server::gateway(&[&hand]);
    gateway.wait_ready("hand");
    // The component refuses the goal.
    let unfit = bench.image("1.1.0", "self-test: 500\n");
    let ended = updates(
        &gateway,
        &["hand", &unfit],
        6,
        "went back from 1.1.0 to 1.0.0",
    );
    assert!(ended.stderr.contains("the self-test failed"), "{ended:?}");
    // The test takes 20 s, which is longer than the trial: the device goes back by itself.
    slow_down(&gateway);
    let late = bench.image("1.2.0", "trial: 10000\nself-test: 100\n");
    let says = "went back from 1.2.0 to 1.0.0";
    let ended = until("the link holds", PATIENCE, || {
        let ended = updates(&gateway, &["hand", &late], 6, says);
        Some(ended).filter(|ended| !test_lost_link(&ended.stderr))
    });
    assert!(ended.stderr.contains("the device restarts"), "{ended:?}");
    assert_eq!(version(&gateway, "hand").as_deref(), Some("1.0.0"));
    let good = bench.image("1.3.0", "self-test: 10\n");
    updates(&gateway, &["hand", &good], 0, "runs 1.3.0, before 1.0.0");
}

#[test]
fn without_its_gateway_new_firmware_goes_back() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let mut gateway = Server::gateway(&[&hand]);
    gateway.wait_ready("hand");
    slow_down(&gateway);
    let image = bench.image("1.1.0", "trial: 10000\nself-test: 100\n");
    let _running = Process::start(&mut update(&gateway, &["hand", &image]));
    gateway.process.wait_for("tests the new firmware");
    gateway.process.kill();
    drop(gateway);
    let gateway = Server::gateway(&[&hand]);
    wait_for_version(&gateway, "hand", "1.0.0");
}

#[test]
fn a_node_of_a_shared_line_is_updated_while_another_one_moves() {
    let bench = Bench::new();
    let (_line, arm) = bench.shared_line(["left=sim:gripper@1", "right=sim:gripper@2"]);
    let gateway = Server::gateway(&[&arm]);
    gateway.wait_ready("arm.left");
    gateway.wait_ready("arm.right");
    gateway.set_speed("arm.right", "speed", 0.1);
    let mut remote = connect(&gateway.endpoint());
    let task = remote.trigger("arm.right", "finger", "90").expect("a task");
    let image = bench.image("1.1.0", "self-test: 20\n");
    let words = ["arm.left", &image];
    updates(&gateway, &words, 0, "arm.left: runs 1.1.0, before 1.0.0");
    assert_eq!(version(&gateway, "arm.right").as_deref(), Some("1.0.0"));
    // Its link was never lost: then it would have failed.
    let end = remote.wait(task.id, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Completed, "{end:?}");
}

#[test]
fn a_board_with_another_name_at_the_address_ends_the_update_and_is_named() {
    let bench = Bench::new();
    let (mut line, arm) = bench.shared_line(["left=sim:gripper@3", "right=sim:head@3"]);
    line.write_line("right off");
    let gateway = Server::gateway(&[&arm]);
    gateway.wait_ready("arm.left");
    let image = bench.image("1.1.0", "self-test: 100\n");
    let running = Process::start(&mut update(&gateway, &["arm.left", &image]));
    running.wait_for("the device restarts");
    line.write_line("left off");
    line.write_line("right on");
    let ended = running.end(PATIENCE);
    // One that does not answer at all ends it after 90 s, with another text.
    assert_eq!(ended.code, Some(1), "{ended:?}");
    for says in [
        "'right' ",
        " address 3 ",
        "what that one runs is not certain",
    ] {
        assert!(ended.stderr.contains(says), "{ended:?}");
    }
}

#[test]
fn firmware_that_says_another_version_than_it_was_signed_for_is_recognised() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let gateway = Server::gateway(&[&hand]);
    gateway.wait_ready("hand");
    let other = bench.image("1.1.0", "version: 1.0.0\n");
    let ended = updates(&gateway, &["hand", &other], 0, "runs 1.0.0, before 1.0.0");
    let says = "the image was signed as 1.1.0, but says that it is 1.0.0";
    assert!(ended.stderr.contains(says), "{ended:?}");
}

#[test]
fn two_devices_are_updated_at_once() {
    let bench = Bench::new();
    let (_left, left) = bench.served("left", &SLOW);
    let (_right, right) = bench.served("right", &SLOW);
    let gateway = Server::gateway(&[&left, &right]);
    gateway.wait_ready("left");
    gateway.wait_ready("right");
    let image = bench.signed(["lab", "simulated", "1.1.0"], "", 20_000);
    let both = ["left", "right"].map(|name| Process::start(&mut update(&gateway, &[name, &image])));
    both.iter().for_each(wait_until_sending);
    for running in both {
        let ended = running.end(PATIENCE);
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }
}

#[test]
fn only_clients_that_may_use_the_scope_update_its_devices() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let keys = Keys::make(&["robot", "anna", "bob"]);
    let client = |scope: &str, name: &str| format!("{scope}={}", keys.path(&format!("{name}.key")));
    let gateway = Server::gateway_with(
        &[&hand],
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
    let image = bench.image("1.1.0", "");
    let with = |name: &str| {
        let mut command = update(&gateway, &["hand", &image, "--scope", SCOPE]);
        Process::run(command.args(keys.options(name, "robot")))
    };
    let bob = with("bob");
    assert_eq!(bob.code, Some(1), "{bob:?}");
    let anna = with("anna");
    assert!(anna.stdout.contains("runs 1.1.0, before 1.0.0"), "{anna:?}");
}

/// The walk of `docs/update.md`.
const WALK: &str = include_str!("../../docs/update.md");

#[test]
fn the_walk_of_the_documentation_works() {
    let bench = Bench::new();
    let key = |name: &str| bench.path(&format!("lab.firmware_{name}"));
    std::fs::write(bench.path("new.bin"), "self-test: 20\n").expect("a file");
    let run = |begin: &str, port: &str| {
        let lines = WALK.lines().filter_map(|line| line.strip_prefix("ztl "));
        let mut lines = lines.filter(|line| line.starts_with(begin));
        let (line, others) = (lines.next().expect("a line"), lines.count());
        assert_eq!(others, 0, "{begin}");
        let (line, to) = match line.split_once(" > ") {
            Some((line, to)) => (line, Some(bench.path(to))),
            None => (line, None),
        };
        let own = |word: &str| match word {
            "/tmp/hand" | "new.bin" | "new.update" => bench.path(word.trim_start_matches("/tmp/")),
            "lab.firmware_key" => key("key"),
            "lab.firmware_secret" => key("secret"),
            _ => word
                .replace("/tmp/hand", &bench.path("hand"))
                .replace("12345", port),
        };
        let mut command = ztl();
        command.args(line.split(' ').map(own));
        (command, to)
    };
    let _device = Process::start(&mut run("device ", "0").0);
    until("the device", PATIENCE, || {
        bench.scratch.path("hand").exists().then_some(())
    });
    let gateway = Server::start(run("gateway ", "0").0.arg("--no-journal"));
    gateway.wait_ready("hand");
    let (mut sign, to) = run("firmware sign ", "0");
    let signed = sign.output().expect("ztl");
    assert!(signed.status.success(), "{signed:?}");
    std::fs::write(to.expect("a file"), signed.stdout).expect("a file");
    let port = gateway.port.to_string();
    let ended = Process::run(&mut run("firmware update ", &port).0);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let last = ended.stdout.lines().last().expect("a line");
    assert!(WALK.contains(last), "{last}");
}
