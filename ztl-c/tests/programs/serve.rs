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

/// Starts a task, and returns it once the client receives its progress. On a busy machine, the task may complete before
/// that, or its INIT may have no answer: then this starts another one, each goal in turn.
#[track_caller]
fn on_its_way(client: &mut OriginalClient, component: &str, goals: &[&str], part: &str) -> i64 {
    let mut goals = goals.iter().cycle();
    until("a task on its way", PATIENCE, || {
        let id = client.trigger("robot", component, goals.next()?).number;
        if id <= 0 {
            return None;
        }
        let is_seen = until("its progress", PATIENCE, || {
            let answer = client.status(id);
            match answer.number {
                COMPLETED => Some(false),
                ACCEPTED => answer.text.contains(part).then_some(true),
                _ => None,
            }
        });
        is_seen.then_some(id)
    })
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

    let answer = until("a busy head, whose task is aborted", PATIENCE, || {
        let id = on_its_way(&mut client, "head", &["-90", "90"], "degrees");
        let other = client.trigger("robot", "head", "0");
        if other.number > 0 {
            // On a busy machine, the first one has arrived.
            client.stop(other.number);
            return None;
        }
        client.stop(id);
        let answer = client.status(id);
        let is_so = other.text == "busy with another task" && answer.number == ABORTED;
        is_so.then_some(answer)
    });
    assert!(answer.text.starts_with("stopped at "), "{answer:?}");

    // One runs when it is ended.
    on_its_way(&mut client, "head", &["90", "-90"], "degrees");
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
    let answer = until("a drive that is aborted", PATIENCE, || {
        let id = on_its_way(&mut client, "base", &["back"], "percent");
        client.stop(id);
        let answer = client.status(id);
        (answer.number == ABORTED).then_some(answer)
    });
    assert!(answer.text.ends_with(" percent"), "{answer:?}");
    assert_eq!(client.wait(forward, 20.0), (COMPLETED, "arrived"));

    // One runs when it is ended.
    client.start("robot", "base", "forward");
    process.write_line("");
    ended_well(process);
}
