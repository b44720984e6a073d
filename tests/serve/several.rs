//! Many tasks at once: limits, queues and replacement.

use ztl_std::State::{Aborted, Accepted, Completed};
use ztl_std::{RemoteTask, TaskId};
use ztl_tests::lab::{PATIENCE, busy, until};

use crate::rig::{Rig, abort, end, is_starved, progress, rejection, run_task, trigger};

/// Runs until a file named like its goal exists.
const WAITS: &str = r#"run: [sh, -c, 'echo "@ on"; until [ -e "$0" ]; do sleep 0.02; done; echo "$0 done"', '{goal}'], progress: '@ '"#;

#[track_caller]
fn started(remote: &mut RemoteTask, goal: &str) -> TaskId {
    let id = trigger(remote, "go", goal);
    progress(remote, id, "on");
    id
}

/// Waits until a task that waited runs. `false` if the machine was too busy to start it.
#[track_caller]
fn begins(remote: &mut RemoteTask, id: TaskId) -> bool {
    until("it runs", PATIENCE, || {
        let status = remote.status(id).ok()?;
        if is_starved(&status.text) {
            return Some(false);
        }
        assert_eq!(status.state, Accepted, "{status:?}");
        (status.text == "on").then_some(true)
    })
}

fn rig(rules: &str) -> Rig {
    Rig::new(&format!("go: {{{WAITS}, {rules}}}"))
}

fn let_go(rig: &Rig, goal: &str) {
    std::fs::write(rig.scratch.path(goal), "").expect("to write");
}

#[test]
fn tasks_beyond_the_allowed_number_are_rejected() {
    let rig = rig("at-once: 2");
    let mut remote = rig.remote();
    let one = started(&mut remote, "one");
    let two = started(&mut remote, "two");
    let said = format!("p:go is busy with task {two}");
    assert_eq!(rejection(&mut remote, "go", "three"), said);
    let_go(&rig, "one");
    assert_eq!(end(&mut remote, one), (Completed, "one done".to_owned()));
    let three = started(&mut remote, "three");
    for (goal, id) in [("two", two), ("three", three)] {
        let_go(&rig, goal);
        assert_eq!(end(&mut remote, id).0, Completed);
    }
}

#[test]
fn queued_tasks_run_in_order() {
    until("what waits is started in time", PATIENCE, || {
        let rig = rig("busy: queue 2");
        let mut remote = rig.remote();
        let one = started(&mut remote, "one");
        let two = trigger(&mut remote, "go", "two");
        let three = trigger(&mut remote, "go", "three");
        progress(&mut remote, three, "waiting, 1 before it");
        rejection(&mut remote, "go", "four");
        let_go(&rig, "one");
        assert_eq!(end(&mut remote, one).0, Completed);
        if !begins(&mut remote, two) {
            return None;
        }
        progress(&mut remote, three, "waiting");
        let_go(&rig, "two");
        let_go(&rig, "three");
        let (state, text) = end(&mut remote, three);
        if is_starved(&text) {
            return None;
        }
        assert_eq!((state, text.as_str()), (Completed, "three done"));
        assert_eq!(end(&mut remote, two), (Completed, "two done".to_owned()));
        Some(())
    });
}

#[test]
fn the_latest_task_starts_once_the_replaced_one_has_ended() {
    until("what waits is started in time", PATIENCE, || {
        let rig = Rig::new(
            r#"
            go: {run: [sh, -c, 'trap "until [ -e ends ]; do sleep 0.02; done; rmdir lock; exit" TERM; mkdir lock || exit 9; echo "@ on"; while :; do sleep 0.02; done'], progress: '@ ', busy: replace, abort: {signal: TERM, grace: 20 s}}
            "#,
        );
        let mut remote = rig.remote();
        let one = started(&mut remote, "one");
        let two = trigger(&mut remote, "go", "two");
        let three = trigger(&mut remote, "go", "three");
        let_go(&rig, "ends");
        let text = format!("replaced by task {three} before it began");
        assert_eq!(end(&mut remote, two), (Aborted, text));
        let text = format!("replaced by task {two}");
        assert_eq!(end(&mut remote, one), (Aborted, text));
        if !begins(&mut remote, three) {
            return None;
        }
        remote.abort(three).expect("an answer");
        assert_eq!(end(&mut remote, three), (Aborted, "aborted".to_owned()));
        Some(())
    });
}

/// How many files the server has open, with this client connected.
fn open_files(rig: &Rig, remote: &mut RemoteTask) -> usize {
    assert_eq!(run_task(remote, ["p", "echo", ""]).0, Completed);
    let id = rig.server.process.id();
    let open = std::fs::read_dir(format!("/proc/{id}/fd")).expect("its files");
    open.count()
}

#[test]
fn two_hundred_concurrent_tasks_run_and_the_next_is_rejected() {
    let _busy = busy();
    // A program that looks again and again would leave no time to the others, 200 times.
    let waits = "run: [flock, --shared, lock, echo, '{goal} done']";
    let text = format!(
        "at-once: 200\nscopes: {{/test: {{p: {{go: {{{waits}, at-once: 400}}, echo: echo}}}}}}"
    );
    let rig = Rig::of_file(&text, &[]);
    let lock = std::fs::File::create(rig.scratch.path("lock")).expect("a file");
    lock.lock().expect("a lock");
    let mut remote = rig.remote();
    let before = open_files(&rig, &mut remote);
    let tasks: Vec<TaskId> = (0..200)
        .map(|_| trigger(&mut remote, "go", "all"))
        .collect();
    let said = "200 tasks are under way, and more are not allowed (at-once)";
    assert_eq!(rejection(&mut remote, "go", "all"), said);
    assert_eq!(rejection(&mut remote, "echo", "all"), said);
    // Another client is answered at once meanwhile.
    let one = *tasks.first().expect("200");
    assert_eq!(rig.remote().status(one).expect("an answer").state, Accepted);
    drop(lock);
    for id in tasks {
        assert_eq!(end(&mut remote, id), (Completed, "all done".to_owned()));
    }
    assert_eq!(
        rig.run("echo", "free again"),
        (Completed, "free again".to_owned())
    );
    // No file is left open, and the watchdog is the only child.
    until("its files are closed", PATIENCE, || {
        (open_files(&rig, &mut remote) <= before).then_some(())
    });
    assert_eq!(rig.children().len(), 1);
}

#[test]
fn a_thousand_quick_tasks_in_sequence_all_complete() {
    let rig = Rig::new("echo: {run: [echo, 'said {goal}'], at-once: 8, busy: queue 8}");
    let clients = (0..4).map(|client| {
        let mut remote = rig.remote();
        std::thread::spawn(move || {
            for number in 0..250 {
                let goal = format!("{client}.{number}");
                let ended = run_task(&mut remote, ["p", "echo", &goal]);
                assert_eq!(ended, (Completed, format!("said {goal}")));
            }
        })
    });
    for client in clients.collect::<Vec<_>>() {
        client.join().expect("no client fails");
    }
}

#[test]
fn thirty_concurrent_tasks_are_aborted() {
    let _busy = busy();
    let rig = rig("at-once: 30");
    let mut remote = rig.remote();
    let tasks: Vec<TaskId> = (0..30)
        .map(|_| trigger(&mut remote, "go", "never"))
        .collect();
    for id in tasks {
        abort(&mut remote, id);
    }
    until("only the watchdog is left", PATIENCE, || {
        (rig.children().len() == 1).then_some(())
    });
}

#[test]
fn ending_children_lose_no_reply() {
    let _busy = busy();
    let rig = Rig::new("echo: {run: [echo, 'said {goal}']}");
    // A client that asks once and waits: ZeroMQ used to drop a frame of a reply when a child ended.
    let socket = zmq::Context::new().socket(zmq::REQ).expect("a socket");
    socket.set_rcvtimeo(20_000).expect("a limit");
    socket.connect(&rig.server.endpoint()).expect("an address");
    let ask = |question: &str| -> String {
        socket.send(question, 0).expect("to send");
        let answer = socket.recv_string(0);
        let answer = answer.unwrap_or_else(|error| panic!("{question}: {error}"));
        answer.expect("text")
    };
    for _ in 0..1500 {
        // p:echo:x
        let accepted = until("a watchdog that confirms in time", PATIENCE, || {
            let answer = ask("/test;1;-1;cDplY2hvOng=");
            (!is_starved(&answer)).then_some(answer)
        });
        let id = accepted.split(';').nth(2).expect("an id");
        until("its end", PATIENCE, || {
            let answer = ask(&format!("/test;2;{id};"));
            (answer.ends_with(";said x") || is_starved(&answer)).then_some(())
        });
    }
}
