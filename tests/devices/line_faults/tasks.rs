//! Thousands of short tasks on a line that damages about every fiftieth frame.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, RunError, TriggerError};

use super::ledger::{Ledger, Told};
use super::rig::{Rig, count};

/// Devices, each with its own client and a competing one.
const BRANCHES: usize = 2;
/// Maximum attempts for each accepted task.
const TRIES: usize = 10;
/// Longest time until a task of a few milliseconds ends.
const LIMIT: Duration = Duration::from_secs(30);

/// Runs tasks in sequence until this many were accepted; each goal is
/// unique.
#[track_caller]
pub fn drive(mut remote: RemoteTask, device: &str, client: usize, tasks: usize) -> Ledger {
    let mut ledger = Ledger::default();
    let mut taken = 0;
    for number in 0..tasks * TRIES {
        if taken == tasks {
            break;
        }
        // Near the finger's position, so that it arrives at once.
        let goal = format!("0.{client}{number:06}");
        let told = match remote.run(device, "finger", &goal, Some(LIMIT)) {
            Ok(end) => Told::Ended(end.state, end.text),
            Err(RunError::NotStarted(TriggerError::Rejected { reason, .. })) => {
                Told::Rejected(reason)
            }
            other => panic!("{device}, {goal}: no end within {LIMIT:?}: {other:?}"),
        };
        taken += usize::from(matches!(told, Told::Ended(..)));
        ledger.note(goal, told);
    }
    ledger
}

#[test]
fn on_a_bad_line_accepted_tasks_run_once_and_rejected_ones_never() {
    let tasks = count("ZTL_TASKS", 2000);
    let mut rig = Rig::new(
        BRANCHES,
        "--baud 921600 --flip 1e-4 --drop 1e-5 --double 1e-5 --stall 1e-5 --stall-for 300ms",
    );
    let start = Instant::now();
    let each = tasks.div_ceil(BRANCHES * 2);
    let mut all = 0;
    let mut report = Vec::new();
    let ledger: Vec<Ledger> = std::thread::scope(|scope| {
        let drivers: Vec<_> = rig
            .branches
            .iter()
            .map(|branch| {
                // The second client uses the same finger, so its tasks are sometimes rejected.
                [0, 1].map(|client| {
                    let remote = rig.client();
                    scope.spawn(move || drive(remote, &branch.name, client, each))
                })
            })
            .collect();
        drivers
            .into_iter()
            .map(|pair| {
                let mut ledger = Ledger::default();
                for driver in pair {
                    ledger.add(driver.join().expect("a client that came to its end"));
                }
                ledger
            })
            .collect()
    });
    let took = start.elapsed();
    let used = rig.use_of_gateway();
    for (branch, ledger) in rig.branches.iter_mut().zip(&ledger) {
        ledger.check(&branch.record(), false);
        // After the comparison, whose message says more.
        assert_eq!(ledger.taken(), 2 * each, "{:?}", ledger.reasons());
        all += ledger.len();
        report.push(format!("{}: {}", branch.name, ledger.summary()));
        for (reason, times) in ledger.reasons() {
            report.push(format!("    {times} x {reason}"));
        }
        report.push(branch.unplug());
    }
    println!(
        "{all} tasks in {:.1} s; the gateway: {used}\n{}",
        took.as_secs_f64(),
        report.join("\n")
    );
}
