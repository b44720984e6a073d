//! The input of a program, and the use of its output.

use std::process::Command;

use ztl_std::State::{Completed, Failed};
use ztl_tests::lab::{COMPLETED, FAILED, Process, SCOPE, Scratch, built, ztl};

use crate::rig::{Rig, abort, end, start_originally, trigger};

#[test]
fn the_goal_reaches_a_program_unchanged_and_no_shell_reads_it() {
    let rig = Rig::new(
        r#"
        args: {run: [printf, '<%s>', 'x{goal}', '{handler}', '{component}', '{scope}']}
        env: {run: [sh, -c, 'printf "%s|%s|%s|%s" "$ZTL_GOAL" "$ZTL_HANDLER" "$ZTL_COMPONENT" "$ZTL_SCOPE"'], result: all}
        shell: {shell: 'echo "$ZTL_GOAL" $OWN', environment: {OWN: own}, result: all}
        field: {run: [printf, '<%s>', 'a={goal.a}', '{linear: {x: {goal.b.0}}}']}
        number: {run: [printf, '%s', '{goal}'], goal: {type: number, most: 100}}
        "#,
    );
    for goal in [
        "hi",
        "$(touch owned) `touch owned`; touch owned & '\" \\ *",
        "grüße 👍",
        "a:b:c",
        "",
    ] {
        let said = format!("<x{goal}><p><args></test>");
        assert_eq!(rig.run("args", goal), (Completed, said));
        assert_eq!(
            rig.run("env", goal),
            (Completed, format!("{goal}|p|env|/test"))
        );
        assert_eq!(rig.run("shell", goal), (Completed, format!("{goal} own")));
    }
    assert!(!rig.scratch.path("owned").exists());
    let said = "<a=it's><{linear: {x: -2}}>".to_owned();
    assert_eq!(
        rig.run("field", "{a: 'it''s', b: [-2, 3]}"),
        (Completed, said)
    );
    assert_eq!(
        rig.rejection("field", "{a: 1}"),
        "the goal has no 'b.0'; this task needs a goal with that field or item"
    );
    assert!(rig.rejection("field", "{a: ").contains("has no fields"));
    assert_eq!(rig.run("number", "0x1F"), (Completed, "31".to_owned()));
    assert_eq!(rig.run("number", "-45"), (Completed, "-45".to_owned()));
    let said = "p:number: the goal '101' is not a number of at most 100";
    assert_eq!(rig.rejection("number", "101"), said);
}

#[test]
fn an_option_like_goal_or_invalid_argument_is_rejected() {
    let rig = Rig::new(
        "
        say: [echo, '{goal}']
        bold: {run: [printf, '%s', '{goal}'], dashes: allowed}
        ",
    );
    let rejected = rig.rejection("say", "-n");
    assert!(rejected.starts_with("'-n' begins with '-'"), "{rejected}");
    // A check of a script gets the same reply and starts nothing.
    let scratch = Scratch::new();
    let (script, remotes) = (scratch.path("show.yaml"), scratch.path("remotes.yaml"));
    std::fs::write(&script, "s: {a: {p: {say: -n, bold: -n}}}\n").expect("to write");
    let port = rig.server.port;
    let entry = format!("remotes: {{p: {{host: localhost, port: {port}, scope: {SCOPE}}}}}\n");
    std::fs::write(&remotes, entry).expect("to write");
    let mut check = ztl();
    check
        .arg("check")
        .arg(&script)
        .arg("-c")
        .arg(&remotes)
        .arg("--live");
    let ended = Process::run(&mut check);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended
            .stdout
            .contains("1:18: server 'p': '-n' begins with '-'"),
        "{ended:?}"
    );
    assert!(ended.stdout.contains("1 mistake"), "{ended:?}");
    assert!(rejected.contains("dashes: allowed"), "{rejected}");
    assert_eq!(rig.run("bold", "-n"), (Completed, "-n".to_owned()));
    assert_eq!(rig.run("say", "a-b"), (Completed, "a-b".to_owned()));
    assert!(rig.rejection("say", "a\0b").contains("NUL"));
    let long = "x".repeat(200_000);
    assert!(rig.rejection("say", &long).contains("too long"));
}

#[test]
fn the_result_is_the_last_line_all_json_or_nothing() {
    let script = "sh, -c, 'echo one; echo; echo \"[1, true, {\\\"a\\\": null}]\"; echo'";
    let rig = Rig::new(&format!(
        "last: [{script}]
         all: {{run: [{script}], result: all}}
         json: {{run: [{script}], result: json}}
         nothing: {{run: [{script}], result: nothing}}
         bad: {{run: [echo, '{{goal}}'], result: json}}"
    ));
    let last = "[1, true, {\"a\": null}]";
    assert_eq!(rig.run("last", ""), (Completed, last.to_owned()));
    assert_eq!(rig.run("all", ""), (Completed, format!("one\n\n{last}")));
    assert_eq!(
        rig.run("json", ""),
        (Completed, "[1, True, {'a': None}]".to_owned())
    );
    assert_eq!(rig.run("nothing", ""), (Completed, "None".to_owned()));
    let (state, reason) = rig.run("bad", "{a: 1}");
    assert_eq!(state, Failed);
    assert!(reason.starts_with("its output is not JSON: "), "{reason}");
    let (mut client, mut remote) = (rig.server.original_client(), rig.remote());
    let id = start_originally(&mut client, &mut remote, ["p", "json", ""]);
    let json = client.end(id);
    assert_eq!(json, (COMPLETED, "[1, True, {'a': None}]"));
    let id = start_originally(&mut client, &mut remote, ["p", "bad", "{"]);
    assert_eq!(client.end(id).number, FAILED);
}

#[test]
fn a_failed_or_crashed_program_is_reported_with_the_reason() {
    let rig = Rig::new(
        r#"
        exit: [sh, -c, 'echo out; echo "cannot open /dev/dsp" >&2; exit 3']
        quiet: [sh, -c, 'exit 7']
        crash: [sh, -c, 'kill -SEGV $$']
        closes: [sh, -c, 'exec >&- 2>&-; sleep 0.1; exit 4']
        "#,
    );
    assert_eq!(
        rig.run("exit", ""),
        (Failed, "exit code 3: cannot open /dev/dsp".to_owned())
    );
    assert_eq!(rig.run("quiet", ""), (Failed, "exit code 7".to_owned()));
    assert_eq!(
        rig.run("crash", ""),
        (Failed, "ended by SIGSEGV".to_owned())
    );
    assert_eq!(rig.run("closes", ""), (Failed, "exit code 4".to_owned()));
}

#[test]
fn endless_and_non_utf8_output_is_handled() {
    let rig = Rig::new(
        r#"
        flood: {run: [sh, -c, 'yes 0123456789 | head -c 50000000; echo; echo the end']}
        all: {run: [sh, -c, 'yes 0123456789 | head -c 5000000'], result: all, output: 1 KiB}
        line: {run: [sh, -c, 'head -c 5000000 /dev/zero | tr "\0" x'], output: 100 bytes}
        noise: {run: [sh, -c, 'head -c 100000 /dev/urandom; printf "\nb\377\000end\n"']}
        errors: {run: [sh, -c, 'head -c 5000000 /dev/urandom >&2; printf "\nlast\n" >&2; exit 1']}
        endless: {run: [yes], limit: 300 ms, abort: {grace: 20 s}}
        "#,
    );
    assert_eq!(rig.run("flood", ""), (Completed, "the end".to_owned()));
    let (_, all) = rig.run("all", "");
    assert!(all.starts_with("0123456789\n0123456789\n"), "{all}");
    assert!(all.ends_with(" … (cut at 1 KiB)"), "{all}");
    assert!(all.len() < 1100);
    let cut = format!("{} … (cut at 100 bytes)", "x".repeat(100));
    assert_eq!(rig.run("line", ""), (Completed, cut));
    assert_eq!(
        rig.run("noise", ""),
        (Completed, "b\u{fffd}\0end".to_owned())
    );
    assert_eq!(
        rig.run("errors", ""),
        (Failed, "exit code 1: last".to_owned())
    );
    let (state, reason) = rig.run("endless", "");
    assert_eq!((state, reason.as_str()), (Failed, "not done within 300 ms"));
}

#[test]
fn stdin_is_empty_and_signals_are_as_a_program_expects_them() {
    // Signals ignored as by a shell for background processes, by `nohup`, and worse: with SIGCHLD
    // ignored, waiting for a child would be impossible.
    let mut ztl_in_background = Command::new("sh");
    let ignoring = r#"trap '' HUP INT QUIT USR1 PIPE TERM CHLD; exec "$@""#;
    ztl_in_background
        .args(["-c", ignoring, "sh"])
        .arg(built("ztl"));
    let components = r#"
        reads: [sh, -c, 'cat; echo read']
        ignored: [sh, -c, 'grep SigIgn /proc/self/status | cut -f 2']
        pipe: [sh, -c, 'yes | head -n 1']
        quit: {run: [sh, -c, 'trap "echo heard; exit 0" QUIT; echo $$ > pid; while :; do sleep 0.01; done'], abort: {signal: QUIT, grace: 20 s}}
        "#;
    let rig = Rig::of_command(ztl_in_background, components);
    assert_eq!(rig.run("reads", ""), (Completed, "read".to_owned()));
    assert_eq!(rig.run("pipe", ""), (Completed, "y".to_owned()));
    let (_, ignored) = rig.run("ignored", "");
    let ignored = u64::from_str_radix(&ignored, 16).expect("a mask");
    // Except for 32 and 33, which the C library reserves.
    assert_eq!(ignored & !(0b11 << 31), 0, "{ignored:x}");
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "quit", "");
    rig.process("pid");
    assert_eq!(abort(&mut remote, id), "heard");
    // The server itself still ignores them, as configured at its start.
    rig.server.process.signal("QUIT");
    assert_eq!(rig.run("reads", ""), (Completed, "read".to_owned()));
}

#[test]
fn progress_is_reported_when_printed_and_excluded_from_the_result() {
    let rig = Rig::new(
        r#"
        go: {run: [sh, -c, 'echo "@ 1 of 2"; until [ -e go ]; do sleep 0.01; done; echo done; echo "@ 2 of 2"'], progress: '@ '}
        python: {run: [python3, -c, 'import time; print("@ here"); time.sleep(60)'], progress: '@ '}
        "#,
    );
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "go", "");
    crate::rig::progress(&mut remote, id, "1 of 2");
    std::fs::write(rig.scratch.path("go"), "").expect("to write");
    assert_eq!(end(&mut remote, id), (Completed, "done".to_owned()));
    // Python buffers output into a pipe unless told otherwise.
    let id = trigger(&mut remote, "python", "");
    crate::rig::progress(&mut remote, id, "here");
    remote.abort(id).expect("an answer");
}
