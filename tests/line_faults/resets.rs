//! Devices that lose their power and lines that are pulled out, again and again, with a task under
//! way each time; and the gateway grows by nothing.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State, TaskId};
use ztl_tests::lab::{PATIENCE, until};

use crate::books::{Books, Told};
use crate::count;
use crate::rig::Rig;

/// A way that takes two seconds; the number makes each goal another one.
fn far(round: usize) -> String {
    format!("99.{round:06}")
}

/// Starts a task as soon as the gateway takes it; what was refused before goes into the books too.
#[track_caller]
fn start(remote: &mut RemoteTask, books: &mut Books, goal: &str) -> (TaskId, String) {
    let mut tries = 0;
    until("a task is taken", PATIENCE, || {
        let goal = format!("{goal}{tries:03}");
        tries += 1;
        match remote.trigger("gripper0", "finger", &goal) {
            Ok(task) => Some((task.id, goal)),
            Err(refused) => {
                books.note(goal, Told::Rejected(refused.to_string()));
                None
            }
        }
    })
}

#[track_caller]
fn end(remote: &mut RemoteTask, books: &mut Books, (id, goal): (TaskId, String)) -> State {
    let end = remote.wait(id, Some(PATIENCE)).expect("it ends");
    books.note(goal, Told::Ended(end.state, end.text));
    end.state
}

#[test]
fn resets_of_either_side_lose_no_task_and_the_gateway_grows_by_nothing() {
    let resets = count("ZTL_RESETS", 100);
    let mut rig = Rig::new(1, "--baud 921600");
    let mut remote = rig.client();
    let mut books = Books::default();
    let mut slowest = Duration::ZERO;
    let mut early = None;
    let begin = Instant::now();
    for round in 0..resets {
        // The device loses its power.
        let task = start(&mut remote, &mut books, &far(2 * round));
        let reset = Instant::now();
        rig.branches[0].device.signal("USR1");
        let state = end(&mut remote, &mut books, task);
        assert_eq!(state, State::Failed, "round {round}");
        slowest = slowest.max(reset.elapsed());

        // The line is pulled out for a moment, and its task goes on.
        let task = start(&mut remote, &mut books, &far(2 * round + 1));
        rig.branches[0].replug();
        until("it is stopped", PATIENCE, || {
            let state = remote.abort(task.0).expect("an answer").state;
            state.is_final().then_some(())
        });
        let state = end(&mut remote, &mut books, task);
        assert_ne!(state, State::Completed, "round {round}");

        // Warm after a fifth of the way.
        if round == resets / 5 {
            early = Some(rig.use_of_gateway());
        }
    }
    let took = begin.elapsed();
    let (early, late) = (early.expect("a round"), rig.use_of_gateway());
    books.check(&rig.branches[0].record(), true);
    println!(
        "{resets} resets of the device and {resets} of the line in {:.1} s, the slowest reset seen after {} ms\n\
         {}\nthe gateway, early: {early}\nthe gateway, at the end: {late}",
        took.as_secs_f64(),
        slowest.as_millis(),
        books.summary()
    );
    assert_eq!(
        (early.files, early.threads),
        (late.files, late.threads),
        "open files, threads"
    );
    let growth = late.resident_kib.saturating_sub(early.resident_kib);
    assert!(growth < 2048, "{growth} KiB more than early on");
}
