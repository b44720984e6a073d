//! A gateway ends while new firmware is on trial: the next one goes on with the update.

use crate::lines::complete;
use crate::updates::{Bench, update, wait_for_version};
use ztl_std::RemoteTask;
use ztl_tests::lab::{Ended, PATIENCE, Process, SCOPE, Server, reserve_port, until, ztl};

/// The options of a gateway that can be started again with its journal.
fn again(bench: &Bench, hand: &str, port: u16) -> Server {
    again_with(bench, hand, port, &[])
}

fn again_with(bench: &Bench, hand: &str, port: u16, options: &[&str]) -> Server {
    let mut command = ztl();
    let port = port.to_string();
    command.args(["gateway", "--device", hand, "-s", SCOPE, "-p", &port]);
    command.args(["--journal", &bench.path("journal")]);
    let gateway = Server::start(command.args(options));
    gateway.wait_ready("hand");
    gateway
}

#[test]
fn the_next_gateway_tests_and_confirms_what_runs_on_trial() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let port = reserve_port();
    let shown = || Process::run(ztl().args(["ps", "-p", &port.to_string()])).stdout;
    // The test takes 2 s. A trial that is shorter ends before the next gateway can confirm.
    for (version, trial, code, says) in [
        ("1.1.0", 60_000, 0, "runs 1.1.0, before 1.0.0"),
        ("1.2.0", 1500, 6, "went back from 1.2.0 to 1.1.0"),
    ] {
        let mut gateway = again(&bench, &hand, port);
        let image = bench.image(version, &format!("trial: {trial}\nself-test: 100\n"));
        let running = Process::start(&mut update(&gateway, &["hand", &image]));
        gateway.process.wait_for("tests the new firmware");
        // It is the gateway that has started the test.
        let shown = until("the test is shown", PATIENCE, || {
            Some(shown()).filter(|shown| shown.contains("hand:finger:100"))
        });
        assert!(!shown.contains("by the device"), "{shown}");
        gateway.process.kill();
        drop(gateway);
        let gateway = again(&bench, &hand, port);
        let ended = running.end(PATIENCE);
        assert_eq!(ended.code, Some(code), "{ended:?}");
        let said = format!("{}{}", ended.stdout, ended.stderr);
        assert!(said.contains(says), "{ended:?}");
        // Its finger is at 100 now, or in its first place again.
        let mut remote = RemoteTask::connect(&gateway.endpoint(), SCOPE).expect("an address");
        complete(&mut remote, "hand", "finger", "0");
    }
    let journal = std::fs::read_to_string(bench.path("journal")).expect("a journal");
    let tests =
        |line: &&str| line.contains(r#""event":"start""#) && line.contains(r#""goal":"100""#);
    assert_eq!(journal.lines().filter(tests).count(), 2, "{journal}");
}

/// Stops a gateway in order.
#[track_caller]
fn stop(gateway: Server) -> Ended {
    gateway.process.signal("TERM");
    let ended = gateway.process.end(PATIENCE);
    assert_eq!(ended.code, Some(143), "{ended:?}");
    ended
}

const GOES_ON: &str = "the gateway has stopped; the update goes on when it is started again";

#[test]
fn a_gateway_that_is_stopped_leaves_the_trial_to_the_next_one() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let port = reserve_port();
    let gateway = again(&bench, &hand, port);
    let image = bench.image("1.1.0", "self-test: 100\n");
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    gateway.process.wait_for("tests the new firmware");
    // No motor moves while there is no gateway: the stop aborts the test.
    stop(gateway);
    let journal = || std::fs::read_to_string(bench.path("journal")).expect("a journal");
    let tests = |state: &str| {
        let test = format!(r#""component":"finger","goal":"100","state":"{state}""#);
        let told = journal();
        told.lines().filter(|line| line.contains(&test)).count()
    };
    assert_eq!(tests("ABORTED"), 1, "{}", journal());
    running.wait_for(GOES_ON);
    let gateway = again(&bench, &hand, port);
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended.stdout.contains("runs 1.1.0, before 1.0.0"),
        "{ended:?}"
    );
    assert_eq!((tests("ABORTED"), tests("COMPLETED")), (1, 1));
    let mut remote = RemoteTask::connect(&gateway.endpoint(), SCOPE).expect("an address");
    complete(&mut remote, "hand", "finger", "0");
}

#[test]
fn a_self_test_that_a_gateway_leaves_running_counts_if_it_completes() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let port = reserve_port();
    let gateway = again_with(&bench, &hand, port, &["--leave-running"]);
    let image = bench.image("1.1.0", "self-test: 100\n");
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    gateway.process.wait_for("tests the new firmware");
    let ended = stop(gateway);
    let left = "'hand:finger:100' is left running";
    assert!(ended.stderr.contains(left), "{ended:?}");
    running.wait_for(GOES_ON);
    let _gateway = again(&bench, &hand, port);
    let ended = running.end(PATIENCE);
    // If the next gateway comes after the link timeout, the device has aborted the test, which then runs again.
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

#[test]
fn a_trial_that_ends_after_its_gateway_was_stopped_is_told_as_it_ended() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let port = reserve_port();
    // The test takes 2 s, so no gateway can confirm in time.
    let gateway = again(&bench, &hand, port);
    let image = bench.image("1.1.0", "trial: 1500\nself-test: 100\n");
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    gateway.process.wait_for("tests the new firmware");
    stop(gateway);
    running.wait_for(GOES_ON);
    let _gateway = again(&bench, &hand, port);
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(6), "{ended:?}");
    let says = "went back from 1.1.0 to 1.0.0";
    assert!(ended.stderr.contains(says), "{ended:?}");
}

#[test]
fn a_command_that_is_ended_while_there_is_no_gateway_does_not_know_the_outcome() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let port = reserve_port();
    let gateway = again(&bench, &hand, port);
    let image = bench.image("1.1.0", "self-test: 100\n");
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    gateway.process.wait_for("tests the new firmware");
    stop(gateway);
    running.wait_for(GOES_ON);
    running.signal("INT");
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(130), "{ended:?}");
    let says = "hand: the update may go on, ztl ps shows it: ";
    assert!(ended.stderr.contains(says), "{ended:?}");
    let gateway = again(&bench, &hand, port);
    gateway.process.wait_for("its update has ended: ");
    wait_for_version(&gateway, "hand", "1.1.0");
}

#[test]
fn without_a_journal_a_gateway_that_is_stopped_ends_the_update() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let gateway = Server::gateway_with(&[&hand], &["--no-journal"]);
    gateway.wait_ready("hand");
    let image = bench.image("1.1.0", "trial: 1500\nself-test: 100\n");
    let running = Process::start(&mut update(&gateway, &["hand", &image]));
    gateway.process.wait_for("tests the new firmware");
    stop(gateway);
    let ended = running.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stderr.contains("the gateway stops; "), "{ended:?}");
    let gateway = Server::gateway_with(&[&hand], &["--no-journal"]);
    wait_for_version(&gateway, "hand", "1.0.0");
}
