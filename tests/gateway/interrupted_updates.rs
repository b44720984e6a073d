//! Signals to `ztl firmware update`: what the command says is what the device does.

use crate::lines::complete;
use crate::updates::{Bench, update, version};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Server, connect, reserve_port, ztl};

#[test]
fn a_command_that_is_ended_while_the_device_verifies_says_what_is_true() {
    let bench = Bench::new();
    let (device, hand) = bench.served("hand", &[]);
    let gateway = Server::gateway(&[&hand]);
    gateway.wait_ready("hand");
    let image = bench.image("1.1.0", "verify: 600000\n");
    let begin = || {
        let running = Process::start(&mut update(&gateway, &["hand", &image]));
        running.wait_for("the device verifies the image");
        running
    };
    // The device does not answer: it may have verified the image.
    let running = begin();
    device.signal("STOP");
    running.signal("TERM");
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(143), "{ended:?}");
    let said = "hand: it is not known which firmware the device will run";
    assert!(ended.stderr.contains(said), "{ended:?}");
    assert!(!ended.stderr.contains("keeps"), "{ended:?}");
    device.signal("CONT");
    gateway.process.wait_for("aborted; the device keeps 1.0.0");
    // It says that it has dropped the image, at once or when it answers again.
    for hangs in [false, true] {
        let running = begin();
        if hangs {
            device.signal("STOP");
            running.wait_for("device is not answering");
        }
        running.signal("INT");
        device.signal("CONT");
        let ended = running.end(PATIENCE);
        assert_eq!(ended.code, Some(130), "{ended:?}");
        let said = "ztl: hand: aborted; the device keeps 1.0.0";
        assert!(ended.stderr.contains(said), "{ended:?}");
    }
    complete(&mut connect(&gateway.endpoint()), "hand", "finger", "3");
    assert_eq!(version(&gateway, "hand").as_deref(), Some("1.0.0"));
}

#[test]
fn a_gateway_that_is_killed_while_the_device_verifies_leaves_open_what_will_run() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let (port, journal) = (reserve_port().to_string(), bench.path("journal"));
    let start = || {
        let mut command = ztl();
        command.args(["gateway", "--device", &hand, "-s", SCOPE, "-p", &port]);
        Server::start(command.args(["--journal", &journal]))
    };
    let mut gateway = start();
    gateway.wait_ready("hand");
    let image = bench.image("1.1.0", "verify: 600000\n");
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    running.wait_for("the device verifies the image");
    gateway.process.kill();
    drop(gateway);
    let gateway = start();
    gateway.wait_ready("hand");
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    let said = "it is not known which firmware the device will run, ztl devices shows it";
    assert!(ended.stderr.contains(said), "{ended:?}");
    assert!(!ended.stderr.contains("keeps"), "{ended:?}");
}
