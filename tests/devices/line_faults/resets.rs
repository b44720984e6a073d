//! Devices lose power and lines are unplugged, again and again, each time during a task. The gateway does not grow.

use std::time::{Duration, Instant};

use ztl_std::{RemoteId, RemoteTask, State};
use ztl_tests::lab::{PATIENCE, Process, until, ztl};

use super::ledger::{Ledger, Told};
use super::rig::{Rig, count};
use super::tasks::drive;

/// A motion of 20 s at the lowest speed; the number makes each goal unique.
fn far(round: usize) -> String {
    format!("99.{round:06}")
}

/// Starts a task as soon as the gateway accepts it; rejected attempts are recorded, too.
#[track_caller]
fn start(remote: &mut RemoteTask, ledger: &mut Ledger, goal: &str) -> (RemoteId, String) {
    let mut tries = 0;
    until("a task is taken", PATIENCE, || {
        let goal = format!("{goal}{tries:03}");
        tries += 1;
        match remote.trigger("gripper0", "finger", &goal) {
            Ok(task) => Some((task.id, goal)),
            Err(refused) => {
                ledger.note(goal, Told::Rejected(refused.to_string()));
                None
            }
        }
    })
}

#[track_caller]
fn end(remote: &mut RemoteTask, ledger: &mut Ledger, (id, goal): (RemoteId, String)) -> State {
    let end = remote.wait(id, Some(PATIENCE)).expect("it ends");
    ledger.note(goal, Told::Ended(end.state, end.text));
    end.state
}

#[test]
fn resets_of_either_side_lose_no_task_and_leak_no_memory() {
    let resets = count("ZTL_RESETS", 100);
    let mut rig = Rig::new(1, "--baud 921600");
    let mut remote = rig.client();
    // A gateway keeps the results of its last 10,000 tasks; after that, it stops growing.
    let mut ledger = drive(rig.client(), "gripper0", 0, count("ZTL_FILL", 100));
    // Saved, since the resets would lose it: the device still moves when a busy machine resets it or replugs its line.
    rig.gateway.set_speed("gripper0", "speed", 0.1);
    let port = rig.gateway.port.to_string();
    let saved = Process::run(ztl().args(["param", "save", "gripper0", "-p", &port]));
    assert_eq!(saved.code, Some(0), "{saved:?}");
    let mut slowest = Duration::ZERO;
    // After each fifth of the run; after the first it is warm.
    let mut uses = Vec::new();
    let begin = Instant::now();
    for round in 0..resets {
        // The device loses its power.
        let task = start(&mut remote, &mut ledger, &far(2 * round));
        let reset = Instant::now();
        rig.branches[0].device.signal("USR1");
        let state = end(&mut remote, &mut ledger, task);
        assert_eq!(state, State::Failed, "round {round}");
        slowest = slowest.max(reset.elapsed());

        // The line is unplugged for a moment, and its task continues.
        let task = start(&mut remote, &mut ledger, &far(2 * round + 1));
        rig.branches[0].replug();
        until("it is stopped", PATIENCE, || {
            let state = remote.abort(&task.0).expect("an answer").state;
            state.is_final().then_some(())
        });
        let state = end(&mut remote, &mut ledger, task);
        assert_ne!(state, State::Completed, "round {round}");

        if (round + 1) % (resets / 5) == 0 {
            uses.push(rig.use_of_gateway());
        }
    }
    let took = begin.elapsed();
    let (early, late) = (uses[0], uses[uses.len() - 1]);
    // At some moments the line is closed, or a thread of the previous line is still exiting.
    let first = &uses[..3];
    let files = first.iter().map(|used| used.files).max();
    let threads = first.iter().map(|used| used.threads).max();
    ledger.check(&rig.branches[0].record(), true);
    println!(
        "{resets} resets of the device and {resets} of the line in {:.1} s, the slowest reset seen after {} ms\n\
         {}\nthe gateway after each fifth of them:",
        took.as_secs_f64(),
        slowest.as_millis(),
        ledger.summary()
    );
    for used in &uses {
        println!("    {used}");
    }
    until(
        "as many open files and threads as early on",
        PATIENCE,
        || {
            let used = rig.use_of_gateway();
            (Some(used.files) <= files && Some(used.threads) <= threads).then_some(())
        },
    );
    let growth = late.resident_kib.saturating_sub(early.resident_kib);
    assert!(growth < 2048, "{growth} KiB more than early on");
}
