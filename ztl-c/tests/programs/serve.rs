//! Handlers in C, and the original's client.

use ztl_tests::lab::{ABORTED, ACCEPTED, COMPLETED, OriginalClient, PATIENCE, Process, until, ztl};

use crate::build::{Build, ended_well};

/// Starts a program that serves, at any free port.
#[track_caller]
pub(crate) fn started(build: Build, example: &str) -> (Process, u16) {
    let process = Process::start(build.example(example).arg("tcp://127.0.0.1:*"));
    let port = port_of(&process);
    (process, port)
}

/// Where a program serves.
#[track_caller]
pub(crate) fn port_of(process: &Process) -> u16 {
    process.wait_for_port("serving /robot at ")
}

/// Repeats a task that is rejected until the reply is in time: the original's client waits for 2 s, and valgrind must
/// translate the program first.
#[track_caller]
pub(crate) fn warm_up(client: &mut OriginalClient, reason: &str) {
    until("a refusal", PATIENCE, || {
        let answer = client.trigger("robot", "arm", "1");
        assert!(answer.number <= 0, "{answer:?}");
        (answer.text == reason).then_some(())
    });
}

/// Waits until the client receives progress.
#[track_caller]
fn wait_progress(client: &mut OriginalClient, id: i64, part: &str) {
    until("its progress", PATIENCE, || {
        let answer = client.status(id);
        (answer.number == ACCEPTED && answer.text.contains(part)).then_some(())
    });
}

#[track_caller]
pub(crate) fn from_its_main_loop(build: Build) {
    let (process, port) = started(build, "handler.c");
    let mut client = OriginalClient::connect(port, "/robot");
    warm_up(&mut client, "no such component; there is: head");
    let id = client.start("robot", "head", "20");
    assert_eq!(client.wait(id, 20.0), (COMPLETED, "20 degrees"));

    let port_text = port.to_string();
    let told = Process::run(ztl().args(["describe", "-r", "localhost", "-p", &port_text]));
    let head =
        "robot:head  a whole number from -90 to 90 degrees  turns the head; for example 45\n";
    assert!(told.stdout.contains(head), "{told:?}");

    for (component, goal, reason) in [
        ("head", "91", "head takes degrees from -90 to 90"),
        ("head", "up", "head takes degrees from -90 to 90"),
    ] {
        let answer = client.trigger("robot", component, goal);
        assert!(answer.number <= 0 && answer.text == reason, "{answer:?}");
    }

    let id = client.start("robot", "head", "-90");
    wait_progress(&mut client, id, "degrees");
    let answer = client.trigger("robot", "head", "0");
    assert!(
        answer.number <= 0 && answer.text == "busy with another task",
        "{answer:?}"
    );
    assert_eq!(client.abort(id).number, ABORTED);
    let answer = client.status(id);
    assert!(
        answer.number == ABORTED && answer.text.starts_with("stopped at "),
        "{answer:?}"
    );

    // One runs when it is ended.
    let id = client.start("robot", "head", "90");
    wait_progress(&mut client, id, "degrees");
    process.signal("TERM");
    let printed = ended_well(process);
    assert!(printed.ends_with("\nended\n"), "{printed}");
}

#[track_caller]
pub(crate) fn on_threads(build: Build) {
    let (mut process, port) = started(build, "worker.c");
    let mut client = OriginalClient::connect(port, "/robot");
    warm_up(&mut client, "no such component; there is: base");

    let forward = client.start("robot", "base", "forward");
    let back = client.start("robot", "base", "back");
    wait_progress(&mut client, back, "percent");
    assert_eq!(client.abort(back).number, ABORTED);
    let answer = client.status(back);
    assert!(
        answer.number == ABORTED && answer.text.ends_with(" percent"),
        "{answer:?}"
    );
    assert_eq!(client.wait(forward, 20.0), (COMPLETED, "arrived"));

    // One runs when it is ended.
    client.start("robot", "base", "forward");
    process.write_line("");
    ended_well(process);
}
