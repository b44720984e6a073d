//! Signals to a client whose server does not answer.

use std::time::{Duration, Instant};

use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, Server, our_client, ours_named, until, ztl,
};

/// SIGTERM waits 2 s for the answer to the ABORT, and not for a STATUS before it.
const LIMIT: Duration = Duration::from_secs(3);

#[test]
fn sigterm_sends_the_abort_at_once_to_a_server_that_does_not_answer() {
    let scratch = Scratch::new();
    let server = Server::naps();
    let port = server.port.to_string();
    let tasks = || Process::run(ztl().args(["ps", "-p", &port])).stdout;
    let mut remote = ztl();
    remote.args(["remote-task", "--task", "robot", "localhost", &port, SCOPE]);
    let at = ["-r", "localhost", "-p", &port, "-s", SCOPE];
    let (mut ours, mut originals) = (our_client(), ours_named(&scratch, "ztl_task_client"));
    ours.args(at);
    originals.args(at);
    for command in [&mut ours, &mut originals, remote.arg("robot")] {
        command.arg("nap:for:600");
        // A busy machine delays some attempts, a defect delays all.
        until("SIGTERM ends the client in time", PATIENCE, || {
            let client = Process::start(command);
            client.wait_for("Initialised task with ID");
            server.process.signal("STOP");
            let start = Instant::now();
            client.signal("TERM");
            let ended = client.end(PATIENCE);
            let took = start.elapsed();
            server.process.signal("CONT");
            assert_eq!(ended.code, Some(143), "{ended:?}");
            assert!(ended.stdout.contains("may still run"), "{ended:?}");
            // The server finds the ABORT when it goes on, although the client is gone.
            until("the end of the task", PATIENCE, || {
                (tasks() == "No task is running.\n").then_some(())
            });
            (took < LIMIT).then_some(())
        });
    }
}
