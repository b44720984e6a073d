//! The gateway is stopped (SIGSTOP) at each point of a task, and clients are stopped or killed: no motor moves twice, and no
//! outcome is invented.

use super::device::Deed;
use super::rig::{GatewayRig, LONG, ONCE, USUAL};
use std::time::{Duration, Instant};
use ztl_std::{RunError, WaitError};
use ztl_std::{State, TriggerError};
use ztl_tests::lab::{LIMIT, PATIENCE, Process, our_client_at, status, until};

/// When the fault occurs, in microseconds after the client's start: from before its INIT arrives until
/// after the task has ended.
const POINTS: [u64; 8] = [0, 100, 300, 600, 1000, 2000, 4000, 10_000];

fn wait_until(moment: Instant) {
    // The test varies the moment itself, so there is no condition to wait for.
    std::thread::sleep(moment.saturating_duration_since(Instant::now()));
}

#[test]
fn a_suspended_gateway_moves_each_motor_once() {
    let rig = GatewayRig::new(LONG);
    // A running shell reacts faster than a program that has to start.
    let mut shell = Process::start(&mut std::process::Command::new("sh"));
    let mut outcomes = Vec::new();
    for point in POINTS {
        let goal = format!("{point} 2");
        let mut client = rig.client();
        // The client connects first, so the moment falls within the task.
        let before = client.run("motors", "belt", "1 1", LIMIT);
        before.expect("its end");
        let mut client = client.with_timeout(Duration::from_millis(500));
        let asked = goal.clone();
        let start = Instant::now();
        let asking = std::thread::spawn(move || {
            let outcome = client.run("motors", "arm", &asked, LIMIT);
            outcome.map(|status| status.state)
        });
        wait_until(start + Duration::from_micros(point));
        shell.write_line(&format!("kill -STOP {}", rig.gateway.process.id()));
        std::thread::sleep(Duration::from_millis(700));
        rig.gateway.process.signal("CONT");
        let outcome = asking.join().expect("no panic");
        println!(
            "stopped after {point} µs: {outcome:?}, {:?}",
            rig.device.deed(&goal)
        );
        outcomes.push((goal, outcome));
    }
    // Everything in flight is done by now, and the gateway serves.
    let last = until("a task is taken", PATIENCE, || {
        rig.client().run("motors", "arm", "7 1", LIMIT).ok()
    });
    assert_eq!(last, status(State::Completed, "7"));
    for (goal, outcome) in outcomes {
        let deed = rig.device.deed(&goal);
        let fits = match outcome {
            Ok(State::Completed) => deed == ONCE,
            // Unknown: either done or not done.
            Err(
                RunError::NotEnded(WaitError { last: Err(_) })
                | RunError::NotStarted(TriggerError::Request(_)),
            ) => deed == ONCE || deed == Deed::default(),
            // Its Start would have come too late.
            Err(RunError::NotStarted(TriggerError::NeverCame | TriggerError::Rejected { .. })) => {
                deed == Deed::default()
            }
            _ => false,
        };
        assert!(fits, "{goal}: told {outcome:?}, did {deed:?}");
    }
}

#[test]
fn a_gateway_suspended_beyond_the_link_timeout_reports_the_devices_outcomes() {
    let rig = GatewayRig::new(USUAL);
    let mut client = rig.client();
    let arm = client
        .trigger("motors", "arm", "7 60000")
        .expect("taken")
        .id;
    let belt = client
        .trigger("motors", "belt", "8 5000")
        .expect("taken")
        .id;
    rig.gateway.process.signal("STOP");
    // The belt carries on and arrives; the arm stopped long before.
    until("the belt has arrived", PATIENCE, || {
        (rig.device.deed("8 5000") == ONCE).then_some(())
    });
    rig.gateway.process.signal("CONT");
    let end = client.wait(arm, LIMIT).expect("its end");
    assert_eq!(end.state, State::Failed, "{end:?}");
    let stopped = Deed {
        begun: 1,
        finished: 0,
    };
    assert_eq!(rig.device.deed("7 60000"), stopped);
    assert_eq!(client.wait(belt, LIMIT), Ok(status(State::Completed, "8")));
}

#[test]
fn a_gateway_killed_or_stopped_anywhere_moves_a_motor_at_most_once() {
    let rig = GatewayRig::new(LONG);
    for point in POINTS {
        let client =
            |goal: &str| Process::start(our_client_at(rig.port).arg(format!("motors:arm:{goal}")));
        let goal = format!("{} 1", 100 + point);
        // Starting the program takes some milliseconds more.
        let mut killed = client(&goal);
        wait_until(Instant::now() + Duration::from_micros(point * 2));
        killed.kill();
        let told = killed.stdout().contains("'COMPLETED'");
        // A later task is done, so this one has started or never will.
        let after = rig.client().run("motors", "belt", "1 1", LIMIT);
        after.expect("its end");
        let deed = until("rest", PATIENCE, || {
            let deed = rig.device.deed(&goal);
            (deed.begun == deed.finished).then_some(deed)
        });
        assert!(
            deed == ONCE || (deed == Deed::default() && !told),
            "{goal}: {told}, {deed:?}"
        );

        let goal = format!("{} 1", 100_000 + point);
        let stopped = client(&goal);
        wait_until(Instant::now() + Duration::from_micros(point * 2));
        stopped.signal("STOP");
        stopped.signal("CONT");
        let ended = stopped.end(PATIENCE);
        assert!(ended.stdout.contains("'COMPLETED'"), "{goal}: {ended:?}");
        assert_eq!(rig.device.deed(&goal), ONCE, "{goal}");
    }
}
