//! Tasks that are forwarded to another server.

use ztl_std::State::{Aborted, Accepted, Completed, Failed};
use ztl_std::{RequestError, TriggerError};
use ztl_tests::lab::{
    COMPLETED, FAILED, PATIENCE, Process, SCOPE, Scratch, Server, end, our_client, reserve_port,
    until, ztl,
};

use crate::rig::{
    Rig, abort, abort_originally, dies, is_starved, progress, start, start_originally, told,
    trigger,
};

/// A server that forwards everything to another; `p` here is `p` there.
fn relay(far: u16) -> Rig {
    Rig::new(&format!(
        "'*': {{forward: {{to: 'tcp://127.0.0.1:{far}', scope: {SCOPE}}}}}\n\
         other: {{forward: {{to: 'tcp://127.0.0.1:{far}', scope: {SCOPE}, handler: test, component: echo}}}}"
    ))
}

const FAR: &str = r#"
    echo: echo
    go: {run: [sh, -c, 'echo "@ half way"; trap "echo parked; exit" TERM; while :; do sleep 0.02; done'], progress: '@ ', abort: {grace: 20 s}}
    never: {run: [sleep, '60'], abort: no}
    bad: [sh, -c, 'echo broken >&2; exit 1']
    "#;

#[test]
fn a_forwarded_task_behaves_like_a_local_one() {
    let far = Rig::new(FAR);
    let near = relay(far.server.port);
    assert_eq!(near.run("echo", "a:b;c"), (Completed, "a:b;c".to_owned()));
    assert_eq!(
        near.run("bad", ""),
        (Failed, "exit code 1: broken".to_owned())
    );
    assert_eq!(
        near.rejection("nope", ""),
        "no component 'nope' on 'p'; it has: bad, echo, go, never"
    );
    let mut remote = near.remote();
    let id = trigger(&mut remote, "go", "");
    progress(&mut remote, id, "half way");
    abort(&mut remote, id);
    let mut client = near.server.original_client();
    let id = start_originally(&mut client, &mut remote, ["p", "echo", "hi"]);
    assert_eq!(client.end(id), (COMPLETED, "hi"));
    abort_originally(&mut client, &mut remote, ["p", "go", ""]);
    let id = trigger(&mut remote, "never", "");
    until("the ABORT is rejected", PATIENCE, || {
        let answer = told(remote.abort(id).expect("an answer"));
        (answer == (Accepted, "False".to_owned())).then_some(())
    });
    // It continues on both servers.
    assert_eq!(remote.status(id).expect("an answer").state, Accepted);
}

#[test]
fn tasks_are_forwarded_to_the_originals_server() {
    let far = Server::original();
    let near = relay(far.port);
    assert_eq!(near.run("other", "hi"), (Completed, "hi".to_owned()));
    let rejected = near.rejection("echo", "hi");
    assert!(
        rejected.contains("No such handler 'p', try 'test'."),
        "{rejected}"
    );
}

#[test]
fn an_absent_server_causes_a_rejection_and_nothing_is_sent() {
    let near = relay(reserve_port());
    let mut remote = near.remote();
    let text = match remote.trigger("p", "echo", "hi") {
        Ok(task) => {
            let ended = remote.wait(task.id, Some(PATIENCE)).expect("its end");
            assert_ne!(ended.state, Completed);
            ended.text
        }
        // On a busy machine, the task is rejected before its INIT is answered with the id.
        Err(TriggerError::Rejected { reason, .. }) => reason,
        Err(error) => panic!("{error}"),
    };
    assert!(text.contains("nothing was sent"), "{text}");
}

#[test]
fn a_forwarded_task_is_unknown_while_its_server_is_silent() {
    let far = Rig::new(FAR);
    let near = relay(far.server.port);
    let mut remote = near.remote();
    let id = trigger(&mut remote, "go", "");
    progress(&mut remote, id, "half way");
    far.server.process.signal("STOP");
    progress(&mut remote, id, "unknown: no answer from ");
    let answer = remote.abort(id).expect("an answer");
    assert_eq!(told(answer), (Accepted, "aborting".to_owned()));
    far.server.process.signal("CONT");
    // The abort still reaches it.
    assert_eq!(end(&mut remote, id).0, Aborted);
}

/// Every client of a relay whose server is killed and restarted during a task.
#[test]
fn a_restarted_servers_task_is_unknown_to_us_and_failed_to_originals() {
    let port = reserve_port().to_string();
    let sleeps = |name| format!("{name}: {{run: [sleep, '60'], abort: no}}\n");
    let file: String = ["client", "script", "abort", "original", "after"]
        .map(sleeps)
        .concat();
    let started = || {
        let far = Rig::with(&file, &["-p", &port]);
        let near = relay(far.server.port);
        let mut client = our_client();
        client.args(["--json", "--exit-status"]);
        let client = near.server.start_client(client, &["p:client:"]);
        let script = near.scratch.path("show.yaml");
        let text = "s: {a(on_failure=go on): {p: {script: 1}}, b: {p: {after: 1}}}\n";
        std::fs::write(&script, text).expect("a file");
        let near_port = near.server.port.to_string();
        let mut play = ztl();
        play.args(["run-script", "--yes", "--plain", "-s"]);
        play.arg(&script);
        play.args(["--task", "p", "127.0.0.1", &near_port, SCOPE]);
        let play = Process::start(&mut play);
        let id = trigger(&mut near.remote(), "abort", "");
        let mut original = near.server.original_client();
        let originals = original.trigger("p", "original", "");
        if is_starved(&originals.text) {
            return None;
        }
        assert!(originals.number > 0, "{originals:?}");
        let all_run = until("all of them run there", PATIENCE, || {
            if [&client, &play]
                .map(Process::stdout)
                .iter()
                .any(|text| is_starved(text))
            {
                return Some(false);
            }
            let told = far.remote().describe().ok()??;
            (told.running?.len() == 4).then_some(true)
        });
        all_run.then_some((far, near, client, play, id, original, originals.number))
    };
    let (mut far, near, client, play, id, mut original, originals) =
        until("the machine starts all in time", PATIENCE, started);
    let (mut remote, near_port) = (near.remote(), near.server.port.to_string());
    far.server.process.kill();
    far.server = start(&far.scratch.path("robot.yaml"), &["-p", &port]);

    let ended = client.end(PATIENCE);
    assert_eq!(ended.code, Some(5), "{ended:?}");
    assert!(ended.stdout.contains(r#""outcome":"unknown""#), "{ended:?}");
    let ended = play.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stderr.contains("Step 'a' waits: "), "{ended:?}");
    let named = "NOT CONFIRMED: Component 'script' on handler 'p'";
    assert!(ended.stdout.contains(named), "{ended:?}");
    let running = far.remote().describe().expect("an answer");
    let running = running.and_then(|told| told.running);
    assert_eq!(running, Some(Vec::new()), "the next step never starts");
    let waited = remote
        .wait(id, Some(PATIENCE))
        .expect_err("no end is known");
    assert!(
        matches!(waited.last, Err(RequestError::UnknownOutcome { .. })),
        "{waited:?}"
    );
    let abort = Process::run(ztl().args(["abort", "-p", &near_port, &id.to_string()]));
    assert_eq!(abort.code, Some(1), "{abort:?}");
    assert!(
        abort
            .stdout
            .contains("it may still run: the server could not learn how the task ended"),
        "{abort:?}"
    );
    let answer = original.wait(originals, 20.0);
    assert_eq!(answer.number, FAILED);
    assert!(answer.text.starts_with("unknown: "), "{answer:?}");
}

#[test]
fn earlier_tasks_of_a_restarted_server_are_not_completed() {
    let port = reserve_port().to_string();
    let mut far = Rig::with(FAR, &["-p", &port]);
    let near = relay(far.server.port);
    let mut remote = near.remote();
    // A server that stops waits 2 s at most for those who ask how its tasks ended.
    until("the end is asked for in time", PATIENCE, || {
        let id = trigger(&mut remote, "go", "");
        progress(&mut remote, id, "half way");
        far.server.process.signal("TERM");
        dies(far.server.process.id());
        far.server = start(&far.scratch.path("robot.yaml"), &["-p", &port]);
        let (state, text) = end(&mut remote, id);
        if text.contains("was restarted") {
            return None;
        }
        // It was stopped and reported that.
        assert_eq!((state, text.as_str()), (Aborted, "the server was stopped"));
        Some(())
    });

    let id = trigger(&mut remote, "never", "");
    far.server.process.kill();
    progress(&mut remote, id, "unknown: ");
    far.server = start(&far.scratch.path("robot.yaml"), &["-p", &port]);
    let waited = remote
        .wait(id, Some(PATIENCE))
        .expect_err("no end is known");
    let Err(RequestError::UnknownOutcome { text }) = waited.last else {
        panic!("{waited:?}");
    };
    assert!(text.contains("was restarted"), "{text}");
}

#[test]
fn a_server_that_forwards_to_itself_terminates_the_loop() {
    let port = reserve_port();
    let file = format!(
        "scopes: {{{SCOPE}: {{p: {{'*': {{forward: {{to: 'tcp://127.0.0.1:{port}', scope: {SCOPE}}}}}}}}}}}"
    );
    let rig = Rig::of_file(&file, &["-p", &port.to_string()]);
    let mut remote = rig.remote();
    let ended = until("the server answers itself in time", PATIENCE, || {
        let ended = match remote.trigger("p", "x", "") {
            Ok(task) => remote
                .wait(task.id, Some(PATIENCE))
                .map(|status| status.text)
                .ok(),
            Err(rejected) => Some(rejected.to_string()),
        };
        ended.filter(|text| !is_starved(text))
    });
    assert!(ended.contains("p:x is busy with task"), "{ended}");
}

/// A server with a key, for one client, and the `forward` settings to be that client or another one.
fn encrypted() -> (Rig, Scratch, [String; 2]) {
    let keys = Scratch::new();
    for name in ["far", "near", "mallory"] {
        let ended = Process::run(ztl().arg("keys").arg(keys.path(name)));
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }
    let path = |name: &str| keys.path(name).display().to_string();
    let (own, client) = (path("far.key_secret"), path("near.key"));
    let far = Rig::with(FAR, &["--key", &own, "--client-key", &client]);
    let to = format!("to: 'tcp://127.0.0.1:{}', scope: {SCOPE}", far.server.port);
    let server = path("far.key");
    let forward = ["near", "mallory"].map(|name| {
        let own = path(&format!("{name}.key_secret"));
        format!("{{forward: {{{to}, key: '{own}', server-key: '{server}'}}}}")
    });
    (far, keys, forward)
}

#[test]
fn with_keys_the_forwarding_server_authenticates_as_a_client() {
    let (far, _keys, [near, mallory]) = encrypted();
    let plain = format!(
        "{{forward: {{to: 'tcp://127.0.0.1:{}', scope: {SCOPE}}}}}",
        far.server.port
    );
    let rig = Rig::new(&format!("'*': {near}\necho: {mallory}\nbad: {plain}"));
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "go", "");
    progress(&mut remote, id, "half way");
    abort(&mut remote, id);
    // A client with another key, or none, gets nothing, and nothing is reported as done.
    for component in ["echo", "bad"] {
        let ran = remote.run("p", component, "x", Some(PATIENCE));
        let done = ran.is_ok_and(|status| status.state == Completed);
        assert!(!done, "{component}");
    }
}
