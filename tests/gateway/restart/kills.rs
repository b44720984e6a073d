//! The gateway is killed at chosen moments of a task.

use super::device::Deed;
use super::rig::{GatewayRig, LONG, MEDIUM, ONCE, USUAL, command};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use ztl_std::{RemoteTask, RequestError, State, TriggerError};
use ztl_tests::lab::{
    COMPLETED, LIMIT, PATIENCE, Process, SCOPE, in_time, reserve_port, start, status, until, ztl,
};

#[test]
fn a_client_that_waits_through_a_restart_gets_the_true_outcome() {
    let mut rig = GatewayRig::new(LONG);
    let mut client = rig.client();
    let id = start(&mut client, "motors", "arm", "7 1500");
    // What the killed gateway was asked is never answered.
    let mut client = client.with_timeout(Duration::from_secs(2));
    // Waits from before the kill until after the end.
    let waiting = std::thread::spawn(move || client.wait(id, LIMIT));
    until("it moves", PATIENCE, || {
        (rig.device.deed("7 1500").begun == 1).then_some(())
    });
    rig.kill();
    rig.start_again();
    let end = waiting.join().unwrap();
    assert_eq!(end, Ok(status(State::Completed, "7")));
    assert_eq!(rig.device.deed("7 1500"), ONCE);

    // It stays so after another restart.
    rig.kill();
    rig.start_again();
    let mut client = rig.client();
    assert_eq!(client.status(id), Ok(status(State::Completed, "7")));
    let aborted = client.abort(id).unwrap();
    assert_eq!(aborted.state, State::Completed);
    // A new task has an unused id.
    let next = start(&mut client, "motors", "arm", "8 1");
    assert!(next > id, "{next} after {id}");
}

#[test]
fn the_originals_client_polling_status_gets_the_true_outcome() {
    let mut rig = GatewayRig::new(LONG);
    let mut client = rig.gateway.original_client();
    let id = client.start("motors", "belt", "7 1000");
    rig.kill();
    rig.start_again();
    let mut client = rig.gateway.original_client();
    assert_eq!(client.end(id), (COMPLETED, "7"));
    assert_eq!(client.status(id), (COMPLETED, "7"));
    assert_eq!(rig.device.deed("7 1000"), ONCE);
}

#[test]
fn a_start_unanswered_at_the_kill_continues() {
    until("the kill is in time", PATIENCE, || {
        let mut rig = GatewayRig::new(LONG);
        let mut client = rig.quiet_client();
        rig.device.world().mute = true;
        let asking = std::thread::spawn(move || client.trigger("motors", "arm", "7 6000"));
        until("it moves", PATIENCE, || {
            (rig.device.deed("7 6000").begun == 1).then_some(())
        });
        let id = rig.wait_for_line("start");
        rig.kill();
        rig.device.world().mute = false;
        rig.start_again();
        let mut client = rig.client();
        assert_eq!(client.status(id).unwrap().state, State::Accepted);
        // Its client cannot know the id; a STATUS with that id returns the truth. If a busy machine kills the gateway only after
        // 1.5 s, it has answered.
        match asking.join().unwrap() {
            Ok(_) => return None,
            Err(TriggerError::Request(RequestError::NoAnswer { .. })) => {}
            told => panic!("{told:?}"),
        }
        assert_eq!(client.wait(id, LIMIT), Ok(status(State::Completed, "7")));
        assert_eq!(rig.device.deed("7 6000"), ONCE);
        Some(())
    });
}

#[test]
fn a_start_unsent_at_the_kill_never_runs() {
    until("the kill is in time", PATIENCE, || {
        let mut rig = GatewayRig::new(LONG);
        let mut client = rig.quiet_client();
        rig.device.world().deaf = true;
        let asking = std::thread::spawn(move || client.trigger("motors", "arm", "7 1"));
        let id = rig.wait_for_line("start");
        rig.kill();
        // What the gateway has sent may not have been read yet.
        until("the device has lost the gateway", PATIENCE, || {
            (!rig.device.world().connected).then_some(())
        });
        rig.device.world().deaf = false;
        rig.start_again();
        let end = rig.client().wait(id, LIMIT).unwrap();
        assert_eq!(end.state, State::Failed);
        assert!(end.text.starts_with("never started: "), "{end:?}");
        assert_eq!(rig.device.deed("7 1"), Deed::default());
        // It is asked again if the gateway has answered before the kill.
        asking.join().unwrap().err().map(drop)
    });
}

#[test]
fn an_outcome_is_known_after_a_kill_before_anyone_asked() {
    let mut rig = GatewayRig::new(LONG);
    let mut client = rig.client();
    let id = start(&mut client, "motors", "arm", "7 50");
    assert_eq!(rig.wait_for_line("ended"), id);
    rig.kill();
    // This does not need the device.
    rig.device.world().unplugged = true;
    rig.start_again();
    let end = Ok(status(State::Completed, "7"));
    assert_eq!(rig.client().status(id), end);
}

#[test]
fn a_device_reset_during_the_restart_fails_its_task() {
    let mut rig = GatewayRig::new(LONG);
    let mut client = rig.client();
    let arm = start(&mut client, "motors", "arm", "7 60000");
    let belt = start(&mut client, "motors", "belt", "8 60000");
    rig.kill();
    rig.device.world().reset = true;
    rig.start_again();
    let end = status(State::Failed, "device was reset");
    assert_eq!(rig.client().wait(arm, LIMIT), Ok(end.clone()));
    assert_eq!(rig.client().wait(belt, LIMIT), Ok(end));
    let next = until("a task is taken", PATIENCE, || {
        rig.client().trigger("motors", "arm", "9 1").ok()
    });
    assert_eq!(
        rig.client().wait(next.id, LIMIT),
        Ok(status(State::Completed, "9"))
    );
}

#[test]
fn an_absent_devices_tasks_fail_after_its_timeout_unless_they_carry_on() {
    let mut rig = GatewayRig::new(MEDIUM);
    let mut client = rig.client();
    let arm = start(&mut client, "motors", "arm", "7 60000");
    let belt = start(&mut client, "motors", "belt", "8 2500");
    rig.kill();
    rig.device.world().unplugged = true;
    let started = Instant::now();
    rig.start_again();
    let mut client = rig.client();
    let not_yet = status(State::Accepted, "device is not answering yet");
    assert_eq!(client.status(arm), Ok(not_yet));
    let belt_now = client.status(belt).unwrap();
    assert_eq!(belt_now.state, State::Accepted);
    assert!(
        belt_now.text.starts_with("device is not answering"),
        "{belt_now:?}"
    );
    // An ABORT is still answered in time.
    let aborted = in_time(Duration::from_secs(2), || client.abort(belt).unwrap());
    assert_eq!(aborted, status(State::Accepted, "aborting"));
    let end = client.wait(arm, LIMIT).unwrap();
    assert_eq!(end, status(State::Failed, "device is not answering"));
    let took = started.elapsed();
    // The device may have received commands from the killed gateway until then: two link timeouts.
    assert!(took >= 2 * MEDIUM, "{took:?}");
    until("the belt has arrived", PATIENCE, || {
        (rig.device.deed("8 2500") == ONCE).then_some(())
    });
    assert_eq!(client.status(belt).unwrap().state, State::Accepted);
    rig.device.world().unplugged = false;
    assert_eq!(client.wait(belt, LIMIT), Ok(status(State::Completed, "8")));
    assert_eq!(client.status(arm), Ok(end));
}

#[test]
fn an_abort_reaches_a_task_from_before_the_restart() {
    let mut rig = GatewayRig::new(LONG);
    let id = start(&mut rig.client(), "motors", "arm", "7 60000");
    rig.kill();
    rig.start_again();
    let mut client = rig.client();
    // The answer arrives when the task has stopped or is stopping.
    assert!(client.abort(id).is_ok());
    assert_eq!(client.wait(id, LIMIT), Ok(status(State::Aborted, "7")));
    let stopped = Deed {
        begun: 1,
        finished: 0,
    };
    assert_eq!(rig.device.deed("7 60000"), stopped);
}

#[test]
fn a_removed_devices_task_ends_like_that_of_a_silent_one() {
    let mut rig = GatewayRig::new(MEDIUM);
    let mut client = rig.client();
    let arm = start(&mut client, "motors", "arm", "7 60000");
    rig.kill();
    let mut command = ztl();
    let words = format!("gateway -p {} -s {SCOPE} -d gripper=sim:gripper", rig.port);
    command.args(words.split(' '));
    command.arg("--journal").arg(rig.journal());
    let process = Process::start(&mut command);
    process.wait_for("Serving ");
    let mut client = rig.client();
    let absent = status(State::Accepted, "device 'motors' is not served any more");
    assert_eq!(client.status(arm), Ok(absent));
    let end = status(State::Failed, "device is not answering");
    assert_eq!(client.wait(arm, LIMIT), Ok(end));
    let refused = client.trigger("motors", "arm", "8 1").unwrap_err();
    assert!(
        refused.to_string().contains("no device 'motors'"),
        "{refused}"
    );
}

#[test]
fn a_second_gateway_on_the_same_journal_exits_with_the_reason() {
    let rig = GatewayRig::new(USUAL);
    let [soft, hard] = ["soft", "hard"].map(|name| rig.scratch.path(name));
    std::os::unix::fs::symlink(rig.journal(), &soft).unwrap();
    std::fs::hard_link(rig.journal(), &hard).unwrap();
    for name in [rig.journal(), soft, hard] {
        let mut command = command(&rig.device, reserve_port());
        let ended = Process::run(command.arg("--journal").arg(name));
        assert_eq!(ended.code, Some(1));
        let who = format!(
            "is another gateway's (process {})",
            rig.gateway.process.id()
        );
        assert!(ended.stderr.contains(&who), "{}", ended.stderr);
    }
    // The first one keeps serving.
    let mut client = rig.client();
    let id = start(&mut client, "motors", "arm", "7 1");
    assert_eq!(client.wait(id, LIMIT), Ok(status(State::Completed, "7")));
}

/// xorshift: small, and the same everywhere.
fn dice(state: &mut u64, below: u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state % below
}

/// Kills at random moments, with tasks on both motors all the time.
#[test]
fn a_kill_at_any_time_gives_each_task_one_outcome_and_motion() {
    let mut rig = GatewayRig::new(LONG);
    let endpoint = rig.gateway.endpoint();
    let stop = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let stopped = std::sync::Arc::clone(&stop);
    let ends = std::sync::Arc::new(std::sync::atomic::AtomicUsize::new(0));
    // Runs one task after the other and records the replies.
    let clients: Vec<_> = ["arm", "belt"]
        .into_iter()
        .zip([1000, 2000])
        .map(|(motor, first)| {
            let (endpoint, stopped) = (endpoint.clone(), std::sync::Arc::clone(&stopped));
            let ended = std::sync::Arc::clone(&ends);
            std::thread::spawn(move || {
                let client = RemoteTask::connect(&endpoint, SCOPE).unwrap();
                let mut client = client.with_timeout(Duration::from_millis(500));
                let mut told = BTreeMap::new();
                let mut state = first;
                for number in first.. {
                    if stopped.load(std::sync::atomic::Ordering::SeqCst) {
                        break;
                    }
                    let goal = format!("{number} {}", dice(&mut state, 60));
                    if let Ok(task) = client.trigger("motors", motor, &goal) {
                        // Its outcome may arrive after many kills.
                        let end = client.wait(&task.id, LIMIT).expect("its end");
                        told.insert(task.id.number().unwrap(), (goal, end));
                        ended.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
                    }
                }
                told
            })
        })
        .collect();
    let mut state = 4711;
    for _ in 0..12 {
        std::thread::sleep(Duration::from_millis(dice(&mut state, 400)));
        rig.kill();
        rig.start_again();
        if dice(&mut state, 2) == 0 {
            rig.gateway.wait_ready("motors");
        }
    }
    // A busy machine may have completed only a few by then.
    until("enough tasks", PATIENCE, || {
        (ends.load(std::sync::atomic::Ordering::SeqCst) > 20).then_some(())
    });
    stop.store(true, std::sync::atomic::Ordering::SeqCst);
    for client in clients {
        let told = client.join().unwrap();
        let mut again = rig.client();
        for (id, (goal, end)) in told {
            assert_eq!(again.status(id), Ok(end.clone()), "{goal}");
            let deed = rig.device.deed(&goal);
            let fits = match end.state {
                State::Completed => deed == ONCE,
                // Killed after it was journaled and before it was sent.
                State::Failed => end.text.starts_with("never started") && deed == Deed::default(),
                _ => false,
            };
            assert!(fits, "{goal}: told {end:?}, and did {deed:?}");
        }
    }
    // Also tasks whose ids never reached their clients.
    assert!(
        rig.device
            .world()
            .deeds
            .values()
            .all(|deed| deed.begun == 1)
    );
}
