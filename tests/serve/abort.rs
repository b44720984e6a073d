//! How programs are aborted: none of their processes survives.

use std::time::{Duration, Instant};

use ztl_std::State::{Aborted, Accepted, Completed, Failed};
use ztl_std::TaskId;
use ztl_tests::lab::{ABORTED, ACCEPTED, PATIENCE, Process, busy, our_client, until, ztl};

use crate::rig::{
    CLIENT_LIMIT, Rig, abort, abort_originally, dies, end, is_starved, kill, lives, progress,
    start_originally, told, trigger, was_started,
};

/// Starts `ztl task-client` with a task and waits until it prints this. Repeats it if the machine was too busy to start the
/// task.
#[track_caller]
fn client_that_prints(rig: &Rig, args: &[&str], part: &str) -> Process {
    until("a watchdog that confirms in time", PATIENCE, || {
        let client = rig.server.start_client(our_client(), args);
        let is_started = until(part, PATIENCE, || {
            let text = client.stdout();
            let is_printed = text.contains(part);
            (is_printed || is_starved(&text)).then_some(is_printed)
        });
        is_started.then_some(client)
    })
}

#[test]
fn a_program_that_handles_the_signal_is_aborted_with_its_last_output() {
    let rig = Rig::new(
        r#"
        int: {run: [sh, -c, 'trap "echo stopped at 3; exit 0" INT; echo $$ > pid; while :; do sleep 0.01; done'], abort: {signal: INT, grace: 20 s}}
        term: {run: [sleep, '60'], abort: {grace: 20 s}}
        "#,
    );
    let mut remote = rig.remote();
    let stopped = (Aborted, "stopped at 3".to_owned());
    // A busy machine may answer an ABORT before the end.
    until("the answer to the ABORT tells the end", PATIENCE, || {
        let id = trigger(&mut remote, "int", "");
        let process = rig.process("pid");
        let answer = told(remote.abort(id).expect("an answer"));
        assert_eq!(end(&mut remote, id), stopped);
        assert!(!lives(process));
        std::fs::remove_file(rig.scratch.path("pid")).expect("a file");
        (answer == stopped).then_some(())
    });
    let mut client = rig.server.original_client();
    let id = abort_originally(&mut client, &mut remote, ["p", "term", ""]);
    assert_eq!(client.status(id), (ABORTED, "aborted"));
}

#[test]
fn the_json_client_reports_the_last_output_of_an_aborted_program() {
    let rig = Rig::new(
        r#"
        int: {run: [sh, -c, 'trap "echo stopped at 3; exit 0" INT; echo "@ on"; while :; do sleep 0.01; done'], abort: {signal: INT, grace: 20 s}, progress: '@ '}
        "#,
    );
    let client = client_that_prints(&rig, &["--json", "p:int:"], r#""text":"on""#);
    client.signal("INT");
    let ended = client.end(PATIENCE);
    assert!(
        ended
            .stdout
            .ends_with("\"outcome\":\"aborted\",\"exit_status\":4,\"text\":\"stopped at 3\"}\n"),
        "{ended:?}"
    );
}

/// Each program ends only when all have got the signal. One after another, each ABORT would wait for its answer, which the
/// server holds for up to 1.5 s.
#[test]
fn abort_all_reaches_slow_tasks_at_once() {
    let rig = Rig::new(
        r#"
        slow: {run: [sh, -c, 'trap "touch told-$0; while [ \$(ls told-* | wc -l) -lt 5 ]; do sleep 0.02; done; exit 0" TERM; touch runs-$0; while :; do sleep 0.02; done', '{goal}'], abort: {grace: 20 s}, at-once: 5}
        "#,
    );
    let files = |start: &str| {
        let all = std::fs::read_dir(rig.scratch.path("")).expect("a directory");
        let names = all.flatten().map(|file| file.path());
        let found = names.filter(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with(start)
        });
        found.collect::<Vec<_>>()
    };
    let mut remote = rig.remote();
    // A busy machine may need more than 1.5 s for one of the programs.
    until("all are confirmed at once", PATIENCE, || {
        let ids = [1, 2, 3, 4, 5].map(|goal: u8| trigger(&mut remote, "slow", &goal.to_string()));
        until("all run", PATIENCE, || {
            (files("runs-").len() == 5).then_some(())
        });
        let port = rig.server.port.to_string();
        let ended = Process::run(ztl().args(["abort", "--all", "-p", &port]));
        for id in ids {
            assert_eq!(end(&mut remote, id).0, Aborted);
        }
        for file in files("runs-").into_iter().chain(files("told-")) {
            std::fs::remove_file(file).expect("a file");
        }
        let confirmed = ended.stdout.matches(": ABORTED, ").count() == 5;
        confirmed.then(|| assert_eq!(ended.code, Some(0), "{ended:?}"))
    });
}

#[test]
fn a_grandchild_that_ignores_the_signal_is_killed_with_its_group() {
    let stubborn = "trap '' TERM INT; echo $$ > child; while :; do sleep 0.01; done";
    let rig = Rig::new(&format!(
        r#"
        group: {{run: [sh, -c, '(echo on its way; sh -c "$SCRIPT" & wait)'], environment: {{SCRIPT: "{stubborn}"}}, abort: {{signal: TERM, grace: 300 ms}}}}
        "#
    ));
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "group", "");
    let child = rig.process("child");
    let start = Instant::now();
    let text = abort(&mut remote, id);
    // Its parent ended at once; it got its grace.
    assert!(start.elapsed() >= Duration::from_millis(300));
    dies(child);
    let killed = "on its way (killed: not ended within 300 ms of SIGTERM)";
    assert_eq!(text, killed);
}

#[test]
fn a_child_gets_its_grace_to_stop_its_motors() {
    let careful =
        "trap 'sleep 0.3; echo > parked; exit' TERM; echo $$ > child; while :; do sleep 0.01; done";
    let rig = Rig::new(&format!(
        r#"
        wrapped: {{run: [sh, -c, 'sh -c "$SCRIPT" & wait'], environment: {{SCRIPT: "{careful}"}}, abort: {{grace: 20 s}}}}
        "#
    ));
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "wrapped", "");
    rig.process("child");
    abort(&mut remote, id);
    assert!(
        rig.scratch.path("parked").exists(),
        "it was killed before its time"
    );
}

#[test]
fn a_program_can_be_stopped_by_another_one() {
    let rig = Rig::new(
        r#"
        driver: {run: [sh, -c, 'echo $$ > pid; until [ -e stop ]; do sleep 0.01; done; echo parked'], abort: {run: [sh, -c, 'echo "$0 $ZTL_GOAL" > stop', '{id}'], grace: 10 s}}
        lost: {run: [sleep, '60'], abort: {run: [no-such-program], grace: 10 s}}
        hung: {run: [sleep, '60'], abort: {run: [sh, -c, 'echo $$ > hung; sleep 60'], grace: 4 s}}
        "#,
    );
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "driver", "fast");
    rig.process("pid");
    assert_eq!(abort(&mut remote, id), "parked");
    assert_eq!(rig.written("stop"), format!("{id} fast"));

    // If the abort program cannot start, a signal replaces it. If it hangs, it is killed.
    let id = trigger(&mut remote, "lost", "");
    abort(&mut remote, id);
    rig.server
        .process
        .wait_for("sent SIGTERM instead: no-such-program: not found");
    let id = trigger(&mut remote, "hung", "");
    let killed = "aborted (killed: not ended within 4 s of its abort program)";
    assert_eq!(abort(&mut remote, id), killed);
    dies(rig.process("hung"));
}

#[test]
fn a_slow_abort_is_answered_before_it_completes() {
    let rig = Rig::new(
        r#"
        slow: {run: [sh, -c, 'trap "" TERM; echo $$ > pid; while :; do sleep 0.01; done'], abort: {grace: 6 s}}
        "#,
    );
    let (mut client, mut remote) = (rig.server.original_client(), rig.remote());
    let (id, process) = until("an answer before the client gives up", PATIENCE, || {
        let id = start_originally(&mut client, &mut remote, ["p", "slow", ""]);
        let process = rig.process("pid");
        let asked = Instant::now();
        let answer = client.abort(id);
        if asked.elapsed() >= CLIENT_LIMIT {
            std::fs::remove_file(rig.scratch.path("pid")).expect("a file");
            return None;
        }
        assert_eq!(answer, (ACCEPTED, "aborting"));
        Some((id, process))
    });
    assert_eq!(client.end(id).number, ABORTED);
    dies(process);
}

#[test]
fn a_task_without_abort_continues() {
    let rig = Rig::new(
        r#"
        never: {run: [sh, -c, 'echo > on; until [ -e go ]; do sleep 0.01; done; echo done'], abort: no}
        "#,
    );
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "never", "");
    rig.written("on");
    until("the ABORT is rejected", PATIENCE, || {
        let answer = told(remote.abort(id).expect("an answer"));
        (answer == (Accepted, "False".to_owned())).then_some(())
    });
    std::fs::write(rig.scratch.path("go"), "").expect("to write");
    assert_eq!(end(&mut remote, id), (Completed, "done".to_owned()));
}

#[test]
fn a_time_limit_stops_an_endless_program() {
    let rig = Rig::new(
        r#"
        never: {run: [sh, -c, 'sleep 60 & echo $! > child; wait'], limit: 4 s, abort: {grace: 20 s}}
        stubborn: {run: [sh, -c, 'trap "" TERM; while :; do sleep 0.01; done'], limit: 4 s, abort: {grace: 200 ms}}
        "#,
    );
    assert_eq!(
        rig.run("never", ""),
        (Failed, "not done within 4 s".to_owned())
    );
    assert!(!lives(rig.process("child")));
    let killed = "not done within 4 s (killed: not ended within 200 ms of SIGTERM)";
    assert_eq!(rig.run("stubborn", ""), (Failed, killed.to_owned()));
}

#[test]
fn leftover_processes_do_not_delay_the_task_and_are_killed_by_default() {
    let rig = Rig::new(
        r#"
        kills: [sh, -c, 'sleep 60 & echo $! > killed; echo done']
        leaves: {run: [sh, -c, 'sleep 60 & echo $! > left; echo done'], left-behind: leave}
        talks: {run: [sh, -c, 'yes & echo $! > talks; exit 0'], left-behind: leave, result: nothing}
        daemon: [sh, -c, 'setsid sh -c "echo \$\$ > daemon; exec sleep 60" & until [ -s daemon ]; do sleep 0.01; done; echo done']
        "#,
    );
    let done = (Completed, "done".to_owned());
    // Each of them holds its task's pipes open.
    assert_eq!(rig.run("kills", ""), done);
    dies(rig.process("killed"));
    assert_eq!(rig.run("leaves", ""), done);
    assert!(lives(rig.process("left")));
    assert_eq!(rig.run("talks", ""), (Completed, "None".to_owned()));
    dies(rig.process("talks"));
    assert_eq!(rig.run("daemon", ""), done);
    assert!(lives(rig.process("daemon")));
    for name in ["left", "daemon"] {
        kill(rig.process(name));
    }
}

#[test]
fn the_group_of_a_program_that_forks_without_end_is_killed() {
    let _busy = busy();
    // At most a hundred, each starting the next.
    let fork = "if [ $1 -gt 0 ]; then trap '' TERM; sh fork.sh $(($1 - 1)) & fi; echo $$ >> pids; sleep 60; sleep 60";
    let rig = Rig::new("forks: {run: [sh, fork.sh, '100'], abort: {grace: 200 ms}}");
    std::fs::write(rig.scratch.path("fork.sh"), fork).expect("to write");
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "forks", "");
    until("some have been started", PATIENCE, || {
        let pids = std::fs::read_to_string(rig.scratch.path("pids")).ok()?;
        (pids.lines().count() > 20).then_some(())
    });
    remote.abort(id).expect("an answer");
    assert_eq!(end(&mut remote, id).0, Aborted);
    for process in rig.written("pids").lines() {
        dies(process.parse().expect("a number"));
    }
}

#[test]
fn a_suspended_process_can_be_aborted() {
    let rig =
        Rig::new("stops: {run: [sh, -c, 'echo $$ > pid; kill -STOP $$'], abort: {grace: 200 ms}}");
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "stops", "");
    let process = rig.process("pid");
    abort(&mut remote, id);
    dies(process);
}

#[test]
fn a_waiting_task_can_be_aborted_without_starting() {
    let rig = Rig::new(
        "go: {run: [sh, -c, 'echo \"@ $0\"; sleep 60', '{goal}'], progress: '@ ', busy: queue 1}",
    );
    let mut remote = rig.remote();
    let first = trigger(&mut remote, "go", "one");
    progress(&mut remote, first, "one");
    let second = trigger(&mut remote, "go", "two");
    progress(&mut remote, second, "waiting, 0 before it");
    assert_eq!(abort(&mut remote, second), "aborted before it began");
    assert_eq!(remote.status(first).expect("an answer").state, Accepted);
    abort(&mut remote, first);
}

#[test]
fn a_task_that_needs_its_client_is_aborted_without_it() {
    let rig = Rig::new(
        r#"
        needs: {run: [sh, -c, 'echo $$ > needs; exec sleep 60'], needs-client: 6 s}
        carries: {run: [sh, -c, 'echo $$ > carries; exec sleep 60']}
        sleeps: {built-in: sleep, needs-client: 6 s}
        "#,
    );
    let mut other = rig.remote();
    let clients = ["needs:", "carries:", "sleeps:60"].map(|task| {
        let initialised = "Initialised task with ID";
        until("it is started", PATIENCE, || {
            let client = client_that_prints(&rig, &[&format!("p:{task}")], initialised);
            let line = client.wait_for(initialised);
            let id = line.split('\'').nth(1).and_then(|id| id.parse().ok());
            let id = id.and_then(TaskId::new).expect("an id");
            was_started(&mut other, id).then_some((client, id))
        })
    });
    let [needs, carries] = ["needs", "carries"].map(|name| rig.process(name));
    // The client counts as present while it waits.
    std::thread::sleep(Duration::from_secs(9));
    assert!(lives(needs));
    let ids = clients.each_ref().map(|(_, id)| *id);
    for (mut client, _) in clients {
        client.kill();
    }
    assert_eq!(end(&mut other, ids[0]).0, Aborted);
    assert_eq!(end(&mut other, ids[2]).0, Aborted);
    dies(needs);
    assert!(lives(carries));
    assert_eq!(other.status(ids[1]).expect("an answer").state, Accepted);
}
