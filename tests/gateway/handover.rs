//! A gateway ends while new firmware is on trial: the next one goes on with the update.

use std::time::{Duration, Instant};

use crate::lines::complete;
use crate::updates::{Bench, slow_down, test_lost_link, update, wait_for_version};
use ztl_tests::lab::{Ended, PATIENCE, Process, SCOPE, Server, connect, reserve_port, until, ztl};

/// The options of a gateway that can be started again with its journal.
fn again(bench: &Bench, hand: &str, port: u16) -> Server {
    again_with(bench, hand, port, &[])
}

fn again_with(bench: &Bench, hand: &str, port: u16, options: &[&str]) -> Server {
    let mut command = ztl();
    let port = port.to_string();
    command.args(["gateway", "--device", hand, "-s", SCOPE, "-p", &port]);
    if !options.contains(&"--no-journal") {
        command.args(["--journal", &bench.path("journal")]);
    }
    let gateway = Server::start(command.args(options));
    gateway.wait_ready("hand");
    gateway
}

#[test]
fn the_next_gateway_tests_and_confirms_what_runs_on_trial() {
    let bench = Bench::new();
    let (_device, hand) = bench.served("hand", &[]);
    let port = reserve_port();
    slow_down(&again(&bench, &hand, port));
    let shown = || Process::run(ztl().args(["ps", "-p", &port.to_string()])).stdout;
    let mut rounds = 0;
    // The test takes 20 s. A trial that is shorter ends before the next gateway can confirm.
    for (version, trial, code, says) in [
        ("1.1.0", 60_000, 0, "runs 1.1.0, before 1.0.0"),
        ("1.2.0", 10_000, 6, "went back from 1.2.0 to 1.1.0"),
    ] {
        let mut round = || {
            rounds += 1;
            let mut gateway = again(&bench, &hand, port);
            let image = bench.image(version, &format!("trial: {trial}\nself-test: 100\n"));
            let running = Process::start(&mut update(&gateway, &["hand", &image]));
            gateway.process.wait_for("tests the new firmware");
            // It is the gateway that has started the test.
            let shown = until("the test is shown, or has failed", PATIENCE, || {
                let is_over = !running.stderr().is_empty();
                Some(shown()).filter(|shown| is_over || shown.contains("hand:finger:100"))
            });
            assert!(!shown.contains("by the device"), "{shown}");
            gateway.process.kill();
            drop(gateway);
            let gateway = again(&bench, &hand, port);
            let ended = running.end(PATIENCE);
            // Its finger is at 100 now, or in its first place again.
            gateway.set_speed("hand", "speed", 4.0);
            complete(&mut connect(&gateway.endpoint()), "hand", "finger", "0");
            ended
        };
        // The device ends the test if the next gateway is not there within its link timeout of 1 s.
        let ended = until("the next gateway is in time", PATIENCE, || {
            Some(round()).filter(|ended| !test_lost_link(&ended.stderr))
        });
        assert_eq!(ended.code, Some(code), "{ended:?}");
        let said = format!("{}{}", ended.stdout, ended.stderr);
        assert!(said.contains(says), "{ended:?}");
    }
    let journal = std::fs::read_to_string(bench.path("journal")).expect("a journal");
    let tests =
        |line: &&str| line.contains(r#""event":"start""#) && line.contains(r#""goal":"100""#);
    let tests = journal.lines().filter(tests).count();
    assert!((2..=rounds).contains(&tests), "{rounds}: {journal}");
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

/// An update whose gateway was stopped while it tested the new firmware.
struct Stopped {
    bench: Bench,
    _device: Process,
    hand: String,
    port: u16,
    /// `ztl firmware update`.
    update: Process,
}

impl Stopped {
    /// Updates to this image with a gateway with these options. When the gateway is stopped, its log says `fate` of the test,
    /// and the command says `says`.
    ///
    /// A busy machine may lose the link before, or ask for the progress when the gateway is gone. Then this begins again.
    #[track_caller]
    fn with(image: &str, options: &[&str], fate: &str, says: &str) -> Self {
        until("the gateway is stopped during the test", PATIENCE, || {
            let bench = Bench::new();
            let (device, hand) = bench.served("hand", &[]);
            let port = reserve_port();
            let gateway = again_with(&bench, &hand, port, options);
            slow_down(&gateway);
            let image = bench.image("1.1.0", image);
            let update = Process::start(&mut update(&gateway, &["hand", &image]));
            gateway.process.wait_for("tests the new firmware");
            let log = stop(gateway).stderr;
            let has_said = || format!("{}{}", update.stdout(), update.stderr()).contains(says);
            let stopped = Instant::now();
            while !has_said() && stopped.elapsed() < Duration::from_secs(5) {
                std::thread::sleep(Duration::from_millis(10));
            }
            (log.contains(fate) && has_said()).then_some(Self {
                bench,
                _device: device,
                hand,
                port,
                update,
            })
        })
    }

    /// Starts the next gateway.
    #[track_caller]
    fn again(&self) -> Server {
        again(&self.bench, &self.hand, self.port)
    }
}

#[test]
fn a_gateway_that_is_stopped_leaves_the_trial_to_the_next_one() {
    until("the link holds", PATIENCE, || {
        // No motor moves while there is no gateway: the stop aborts the test.
        let fate = "'hand:finger:50' has ended as ABORTED";
        let stopped = Stopped::with("self-test: 50\n", &[], fate, GOES_ON);
        let path = stopped.bench.path("journal");
        let journal = || std::fs::read_to_string(&path).expect("a journal");
        let tests = |state: &str| {
            let test = format!(r#""component":"finger","goal":"50","state":"{state}""#);
            let told = journal();
            told.lines().filter(|line| line.contains(&test)).count()
        };
        assert_eq!(tests("ABORTED"), 1, "{}", journal());
        let gateway = stopped.again();
        let ended = stopped.update.end(PATIENCE);
        if test_lost_link(&ended.stderr) {
            return None;
        }
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(
            ended.stdout.contains("runs 1.1.0, before 1.0.0"),
            "{ended:?}"
        );
        assert_eq!((tests("ABORTED"), tests("COMPLETED")), (1, 1));
        complete(&mut connect(&gateway.endpoint()), "hand", "finger", "50");
        Some(())
    });
}

#[test]
fn a_self_test_that_a_gateway_leaves_running_counts_if_it_completes() {
    let ended = until("the next gateway is in time", PATIENCE, || {
        let fate = "'hand:finger:50' is left running";
        let stopped = Stopped::with("self-test: 50\n", &["--leave-running"], fate, GOES_ON);
        let _gateway = stopped.again();
        let ended = stopped.update.end(PATIENCE);
        // If the next gateway comes after the link timeout, the device has ended the test as FAILED.
        Some(ended).filter(|ended| !test_lost_link(&ended.stderr))
    });
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

#[test]
fn a_trial_that_ends_after_its_gateway_was_stopped_is_told_as_it_ended() {
    // The test takes 20 s, so no gateway can confirm in time.
    let image = "trial: 10000\nself-test: 100\n";
    let fate = "'hand:finger:100' has ended as ABORTED";
    let stopped = Stopped::with(image, &[], fate, GOES_ON);
    let _gateway = stopped.again();
    let ended = stopped.update.end(PATIENCE);
    assert_eq!(ended.code, Some(6), "{ended:?}");
    let says = "went back from 1.1.0 to 1.0.0";
    assert!(ended.stderr.contains(says), "{ended:?}");
}

#[test]
fn a_command_that_is_ended_while_there_is_no_gateway_does_not_know_the_outcome() {
    until("the link holds", PATIENCE, || {
        let fate = "'hand:finger:50' has ended as ABORTED";
        let stopped = Stopped::with("self-test: 50\n", &[], fate, GOES_ON);
        stopped.update.signal("INT");
        let ended = stopped.update.end(PATIENCE);
        assert_eq!(ended.code, Some(130), "{ended:?}");
        let says = "hand: the update may go on, ztl ps shows it: ";
        assert!(ended.stderr.contains(says), "{ended:?}");
        let gateway = again(&stopped.bench, &stopped.hand, stopped.port);
        let end = gateway.process.wait_for("its update has ");
        if test_lost_link(&end) {
            return None;
        }
        assert!(end.contains("its update has ended: "), "{end}");
        wait_for_version(&gateway, "hand", "1.1.0");
        Some(())
    });
}

#[test]
fn without_a_journal_a_gateway_that_is_stopped_ends_the_update() {
    let image = "trial: 10000\nself-test: 100\n";
    let fate = "'hand:finger:100' has ended as ABORTED";
    let stopped = Stopped::with(image, &["--no-journal"], fate, "the gateway stops; ");
    let ended = stopped.update.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stderr.contains("the gateway stops; "), "{ended:?}");
    let gateway = Server::gateway_with(&[&stopped.hand], &["--no-journal"]);
    wait_for_version(&gateway, "hand", "1.0.0");
}
