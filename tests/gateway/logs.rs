//! A device's defmt log, sent over the link and decoded. `tests/log-device` is a program for this machine whose
//! log defmt's own macros have written.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use ztl_std::gateway::Gateway;
use ztl_tests::lab::{PATIENCE, Process, Scratch, built, connect, ztl};

use crate::lines::{complete, serve};

/// The program is built here, because no other part of the project may be built with its features.
#[track_caller]
fn elf() -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/log-device/Cargo.toml");
        let target = built("ztl").with_file_name("log-device");
        let host = "x86_64-unknown-linux-gnu";
        let mut cargo = Command::new(env!("CARGO"));
        // With a target, the flags do not apply to build scripts.
        cargo
            .args([
                "build",
                "--locked",
                "--manifest-path",
                manifest,
                "--target",
                host,
            ])
            .arg("--target-dir")
            .arg(&target)
            .env("RUSTFLAGS", "-C relocation-model=static");
        let ended = Process::start(&mut cargo).end(Duration::from_secs(300));
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
        target.join(host).join("debug/ztl-log-device")
    })
}

/// The device, and its address.
#[track_caller]
fn device() -> (Process, String) {
    let device = Process::start(Command::new(elf()).arg("127.0.0.1:0"));
    let line = device.wait_for("logging at ");
    (device, line.trim_start_matches("logging at ").to_owned())
}

/// A gateway that decodes the device's log with this file.
#[track_caller]
fn gateway(address: &str, elf: &Path, more: &[&str]) -> (Process, ztl_std::RemoteTask) {
    let mut command = ztl_tests::lab::gateway(&[&format!("arm={address}")]);
    command.args(["--elf", &format!("arm={}", elf.display())]);
    let gateway = Process::start(command.args(more));
    let line = gateway.wait_for("Serving arm at ");
    let endpoint = line
        .split([' ', ','])
        .find(|word| word.starts_with("tcp://"));
    let endpoint = endpoint.expect("it is said");
    let remote = connect(endpoint);
    (gateway, remote)
}

#[test]
fn every_kind_of_value_is_logged_with_its_level_and_position() {
    let (_device, address) = device();
    let (gateway, mut remote) = gateway(&address, elf(), &["--log", "debug"]);
    gateway.wait_for("INFO:firmware:arm: [1.500] started (src/main.rs:");
    complete(&mut remote, "arm", "motor", "all");
    for line in [
        "ERROR:firmware:arm: [1.500] Sample { way: Up { steps: 300 }, raw: [1, 2, 255], scale: 0.5, name: \"left\", next: Some(-3) } (src/main.rs:",
        "WARNING:firmware:arm: [1.500] 0xab 0042 fe true ä (src/main.rs:",
        "DEBUG:firmware:arm: [1.500] 5 1010 interned (src/main.rs:",
        "INFO:firmware:arm: [1.500] b\"a\\n\\\"\" [07, 08] [Some(1), None] (src/main.rs:",
        "INFO:firmware:arm: [1.500] HOT | LOCKED 1:01:01:01.000002 2000-02-29T00:00:00Z (src/main.rs:",
        "INFO:firmware:arm: [1.500] 1.25 {} (src/main.rs:",
    ] {
        gateway.wait_for(line);
    }
}

#[test]
fn json_log_events_name_their_device_and_source_position() {
    let (_device, address) = device();
    let (gateway, mut remote) = gateway(&address, elf(), &["--log-format", "json"]);
    complete(&mut remote, "arm", "motor", "left");
    let line = gateway.wait_for("goes to left");
    let event: serde_json::Value = serde_json::from_str(&line).expect("JSON");
    assert_eq!(event["target"], "firmware", "{line}");
    assert_eq!(event["device"], "arm", "{line}");
    let place = event["place"].as_str().expect("a text");
    assert!(place.starts_with("src/main.rs:"), "{line}");
}

#[test]
fn a_log_flood_is_truncated_and_lost_records_are_reported() {
    let (_device, address) = device();
    let (gateway, mut remote) = gateway(&address, elf(), &[]);
    complete(&mut remote, "arm", "motor", "flood");
    gateway.wait_for("WARNING:firmware:arm: ");
    gateway.wait_for("bytes of its log were lost, because its buffer was full");
    gateway.signal("TERM");
    let ended = gateway.end(PATIENCE);
    let numbers = ended.stderr.matches(": [1.500] number ").count();
    assert!((1..200).contains(&numbers), "{numbers}");
    // A message truncated in the middle is not decoded and does not make the file suspect.
    assert!(!ended.stderr.contains("does not match"), "{ended:?}");
}

#[test]
fn an_unusable_elf_file_is_rejected_before_serving() {
    let scratch = Scratch::new();
    let text = scratch.path("text");
    std::fs::write(&text, "no ELF file").expect("to write");
    for (name, file, part) in [
        ("arm", text.display().to_string(), "not an ELF file"),
        (
            "arm",
            built("ztl").display().to_string(),
            "no defmt log in this program",
        ),
        (
            "arm",
            "/no/such.elf".to_owned(),
            "cannot read the file: No such file",
        ),
        (
            "leg",
            text.display().to_string(),
            "no device 'leg'; there are: arm",
        ),
    ] {
        let elf = format!("--elf={name}={file}");
        let mut command = ztl_tests::lab::gateway(&["arm=sim:head"]);
        let ended = Process::run(command.arg(&elf));
        assert_eq!(ended.code, Some(2), "{ended:?}");
        assert!(ended.stderr.contains(part), "{part}: {ended:?}");
    }
}

#[test]
fn an_elf_file_of_other_firmware_is_suspected() {
    let (_device, address) = device();
    let scratch = Scratch::new();
    // Simulates other firmware by renaming the messages, so that none of this device's messages is known.
    let mut other = std::fs::read(elf()).expect("the file");
    let (known, unknown) = (b"\"defmt_info\"", b"\"other_info\"");
    for place in 0..other.len().saturating_sub(known.len()) {
        if other[place..].starts_with(known) {
            other[place..place + unknown.len()].copy_from_slice(unknown);
        }
    }
    let file = scratch.path("other.elf");
    std::fs::write(&file, other).expect("to write");
    let (gateway, mut remote) = gateway(&address, &file, &[]);
    for _ in 0..3 {
        complete(&mut remote, "arm", "motor", "left");
    }
    let line = gateway.wait_for("sends a log that does not match");
    assert!(
        line.contains("it is probably not the ELF file of its firmware"),
        "{line}"
    );
}

#[test]
fn the_raw_log_is_saved_and_decoded_later() {
    let (_device, address) = device();
    let mut gateway = Gateway::new();
    gateway
        .add("arm", address.parse().expect("a URL"))
        .expect("a thread");
    let watch = gateway.devices();
    let (_server, mut remote) = serve(gateway);
    complete(&mut remote, "arm", "motor", "left");
    let mut decoder = ztl_std::defmt::Decoder::of_file(elf()).expect("a firmware");
    ztl_tests::lab::until("its log", PATIENCE, || {
        let mut texts = Vec::new();
        let raw = watch.raw_log("arm").expect("a device");
        decoder.skip();
        decoder.push(&raw.bytes, &mut |message| {
            texts.extend(message.map(|message| message.text));
        });
        (texts == ["started", "goes to left"]).then_some(())
    });
    assert_eq!(watch.raw_log("leg"), None);
}

#[test]
fn the_log_can_be_shown_from_a_remote_client() {
    let (_device, address) = device();
    let (gateway, mut remote) = gateway(&address, elf(), &["--log", "debug"]);
    complete(&mut remote, "arm", "motor", "all");
    gateway.wait_for("INFO:firmware:arm: [1.500] 1.25 {}");
    let port = gateway.wait_for_port("Serving arm at ").to_string();

    let elf = elf().display().to_string();
    let ask = |more: &[&str]| {
        let mut command = ztl();
        command.args(["devices", "-p", &port, "--log"]).args(more);
        Process::start(&mut command)
    };
    let once = ask(&["arm", "--elf", &elf, "--once"]).end(PATIENCE);
    assert_eq!(once.code, Some(0), "{once:?}");
    assert!(
        once.stdout.contains("1.500 INFO  started (src/main.rs:"),
        "{once:?}"
    );
    assert!(
        once.stdout
            .contains("1.500 ERROR Sample { way: Up { steps: 300 }"),
        "{once:?}"
    );

    // Later messages appear when they arrive.
    let follows = ask(&["arm", "--elf", &elf]);
    follows.wait_for("1.25 {}");
    complete(&mut remote, "arm", "motor", "all");
    ztl_tests::lab::until("the second round", PATIENCE, || {
        (follows.stdout().matches("1.25 {}").count() == 2).then_some(())
    });

    let ended = ask(&["leg", "--elf", &elf]).end(PATIENCE);
    assert_eq!(ended.code, Some(1));
    assert!(
        ended.stderr.contains("no device 'leg' with a log"),
        "{ended:?}"
    );
    let ended = ask(&["arm", "--elf", "/nowhere"]).end(PATIENCE);
    assert!(ended.stderr.contains("/nowhere: "), "{ended:?}");
}
