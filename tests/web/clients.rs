//! Unmodified rosbridge clients start, watch, cancel and stop.

use std::process::Command;

use ztl_tests::lab::{Process, python};

use crate::console::{Console, node};

fn passes(command: &mut Command) {
    let ended = Process::run(command);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn roslib_runs_cancels_and_stops() {
    let console = Console::of_one();
    passes(node("roslib.mjs").arg(console.socket()));
}

#[test]
fn roslibpy_runs_cancels_and_stops() {
    let console = Console::of_one();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/web/roslibpy_client.py");
    passes(Command::new(python()).arg(script).arg(console.socket()));
}
