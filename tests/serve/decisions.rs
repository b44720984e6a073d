//! When and how an INIT is answered.

use std::time::Duration;

use ztl_std::State::{Completed, Failed};
use ztl_std::TriggerError;
use ztl_tests::lab::{COMPLETED, PATIENCE, in_time, until};

use crate::rig::{Rig, abort, abort_originally, end, is_starved, start_originally, trigger};

#[test]
fn a_program_that_cannot_start_is_rejected_with_the_remedy() {
    let rig = Rig::new(
        "
        missing: [no-such-program, x]
        path: [./no/such/program]
        plain: [./plain]
        odd: [./odd]
        nowhere: {run: [sh], directory: no/such}
        ",
    );
    let path = rig.scratch.path("");
    let file = path.join("robot.yaml").display().to_string();
    std::fs::write(path.join("plain"), "#!/bin/sh\n").expect("to write");
    write_executable(&path.join("odd"), "#!/no/such/interpreter\n");
    for (component, line, part) in [
        (
            "missing",
            4,
            "no-such-program: not found; install it or correct the path at ",
        ),
        (
            "path",
            5,
            "/no/such/program: not found; install it or correct the path at ",
        ),
        ("plain", 6, "plain: not executable; use chmod +x, "),
        (
            "odd",
            7,
            "odd: there is no interpreter as its first line (#!) names; install it or correct the line at ",
        ),
        ("nowhere", 8, "sh: there is no directory "),
    ] {
        let reason = rig.rejection(component, "x");
        assert!(reason.contains(part), "{component}: {reason}");
        assert!(
            reason.ends_with(&format!("at {file}:{line}")),
            "{component}: {reason}"
        );
    }
    // The program is looked up at each start.
    write_executable(&path.join("odd"), "#!/bin/sh\necho mended\n");
    assert_eq!(rig.run("odd", ""), (Completed, "mended".to_owned()));
    assert_eq!(
        rig.server
            .original_client()
            .trigger("p", "missing", "x")
            .number,
        -1
    );
}

fn write_executable(path: &std::path::Path, text: &str) {
    use std::os::unix::fs::PermissionsExt;
    std::fs::write(path, text).expect("to write");
    let executable = std::fs::Permissions::from_mode(0o755);
    std::fs::set_permissions(path, executable).expect("to change");
}

#[test]
fn an_unknown_handler_or_component_is_rejected_with_the_known_ones() {
    let rig = Rig::new("one: echo\ntwo: echo");
    assert_eq!(
        rig.rejection("three", ""),
        "no component 'three' on 'p'; it has: one, two"
    );
    let other = rig
        .remote()
        .trigger("q", "one", "")
        .expect_err("no such handler");
    assert_eq!(other.to_string(), "rejected: no handler 'q'; there are: p");
}

/// Why a program rejects its task. On a busy machine, it may decide too late.
#[track_caller]
fn decision(rig: &Rig, component: &str) -> String {
    let mut remote = rig.remote();
    until("a decision in time", PATIENCE, || {
        match remote.trigger("p", component, "") {
            Err(TriggerError::Rejected { reason, .. }) => (!is_starved(&reason)).then_some(reason),
            taken => {
                let late = remote.wait(taken.expect("an answer").id, Some(PATIENCE));
                assert_ne!(late.expect("its end").state, Completed);
                None
            }
        }
    })
}

#[test]
fn a_program_rejects_by_its_exit_code_before_it_is_accepted() {
    let rig = Rig::new(
        r#"
        rejects: {run: [sh, -c, 'echo "the arm is locked" >&2; exit 2'], rejected-by: [2, 3], decide: 1500 ms}
        fails: {run: [sh, -c, 'exit 1'], rejected-by: 2}
        works: {run: [echo, fine], rejected-by: 2}
        late: {run: [sh, -c, 'echo "@ moving"; sleep 0.2; exit 2'], rejected-by: 2, progress: '@ ', decide: 1500 ms}
        slow: {run: [sh, -c, 'until [ -e go ]; do sleep 0.01; done; exit 2'], rejected-by: 2, decide: 50 ms}
        "#,
    );
    assert_eq!(decision(&rig, "rejects"), "the arm is locked");
    assert_eq!(rig.run("fails", ""), (Failed, "exit code 1".to_owned()));
    assert_eq!(rig.run("works", ""), (Completed, "fine".to_owned()));
    assert_eq!(
        rig.run("late", ""),
        (Failed, "exit code 2: @ moving".replace(": @ moving", ""))
    );
    let mut remote = rig.remote();
    let mut last = None;
    // The default would be 1.5 s.
    let id = in_time(Duration::from_secs(1), || {
        if let Some(late) = last {
            abort(&mut remote, late);
        }
        let id = trigger(&mut remote, "slow", "");
        last = Some(id);
        id
    });
    std::fs::write(rig.scratch.path("go"), "").expect("to write");
    assert_eq!(end(&mut remote, id), (Failed, "exit code 2".to_owned()));
    let mut client = rig.server.original_client();
    until("a decision in time", PATIENCE, || {
        let answer = client.trigger("p", "rejects", "");
        (answer == (-1, "the arm is locked")).then_some(())
    });
}

#[test]
fn built_in_components_need_no_program() {
    let rig =
        Rig::new("echo: echo\nsleep: sleep\nprint: print\n'*': {built-in: echo, goal: whole}");
    assert_eq!(rig.run("echo", "a;b:c"), (Completed, "a;b:c".to_owned()));
    assert_eq!(rig.run("sleep", "0.05"), (Completed, "True".to_owned()));
    assert_eq!(
        rig.rejection("sleep", "-1"),
        "p:sleep: the goal '-1' is not a number of at least 0"
    );
    assert_eq!(rig.run("print", "hello"), (Completed, "True".to_owned()));
    until("it is printed", PATIENCE, || {
        rig.server
            .process
            .stdout()
            .contains("component: print\ngoal: hello\n")
            .then_some(())
    });
    // A goal cannot forge a line or control the terminal that shows the file later.
    let forged = "x\ngoal: y\r\x1b[2Jä";
    assert_eq!(rig.run("print", forged), (Completed, "True".to_owned()));
    until("it is printed", PATIENCE, || {
        rig.server
            .process
            .stdout()
            .contains("component: print\ngoal: x\\ngoal: y\\r\\u001b[2Jä\n")
            .then_some(())
    });
    assert_eq!(rig.run("any", "12"), (Completed, "12".to_owned()));
    assert!(rig.rejection("any", "x").contains("a whole number"));
    let (mut client, mut remote) = (rig.server.original_client(), rig.remote());
    abort_originally(&mut client, &mut remote, ["p", "sleep", "60"]);
    let id = start_originally(&mut client, &mut remote, ["p", "echo", "hi"]);
    assert_eq!(client.end(id), (COMPLETED, "hi"));
}
