//! Programs as processes: their user, their rights, and what they cannot do to the server.

use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

use ztl_std::State::{Accepted, Completed, Failed};
use ztl_tests::lab::{PATIENCE, Process, processor_time, until, ztl};

use crate::rig::{Rig, dies, end, lives, progress, trigger};

#[test]
fn a_program_of_another_user_has_only_that_users_rights() {
    let mut rig = Rig::new(
        r#"
        own: {run: [sh, -c, 'echo "$(id -un) $(id -G)"'], user: nobody}
        home: {run: [sh, -c, 'echo "$HOME $USER $LOGNAME"'], user: nobody}
        secret: {run: [cat, /etc/shadow], user: nobody, result: nothing}
        mine: [sh, -c, 'echo "$(id -un) $(id -G)"']
        stays: {run: [sh, -c, 'echo "@ $$"; trap "" TERM; until [ -s aborter ]; do sleep 0.02; done'], user: nobody, progress: '@ ', abort: {run: [sh, -c, 'id -un > aborter'], grace: 10 s}}
        "#,
    );
    let id = |options: &str| {
        let ended = Process::run(std::process::Command::new("id").args(options.split(' ')));
        ended.stdout.trim().to_owned()
    };
    if id("-u") != "0" {
        let why = rig.rejection("own", "");
        assert!(why.contains("must run as that user or as root"), "{why}");
        return;
    }
    let everybody = std::fs::Permissions::from_mode(0o777);
    std::fs::set_permissions(rig.scratch.path(""), everybody).expect("to change it");
    let nobody = format!("nobody {}", id("-G nobody"));
    assert_eq!(rig.run("own", ""), (Completed, nobody.clone()));
    let (state, home) = rig.run("home", "");
    assert_eq!(state, Completed);
    assert!(
        home.ends_with(" nobody nobody") && home.starts_with('/'),
        "{home}"
    );
    let (state, why) = rig.run("secret", "");
    assert_eq!(state, Failed);
    assert!(why.ends_with("Permission denied"), "{why}");
    // Only the thread that started them had another user.
    let own = format!("{} {}", id("-un"), id("-G"));
    assert_eq!(rig.run("mine", ""), (Completed, own));
    assert_eq!(rig.run("own", ""), (Completed, nobody));
    let mut remote = rig.remote();
    let task = trigger(&mut remote, "stays", "");
    progress(&mut remote, task, "");
    let process = until("its number", PATIENCE, || {
        remote.status(task).expect("an answer").text.parse().ok()
    });
    // The abort program also runs as that user, even when the watchdog starts it.
    rig.server.process.kill();
    assert_eq!(rig.written("aborter"), "nobody");
    dies(process);
}

#[test]
fn programs_with_children_leave_no_process_behind() {
    let rig = Rig::new(
        r#"
        leaves: [sh, -c, 'for i in 1 2 3; do sleep 60 & done; (sleep 60; sleep 60) & echo done']
        fails: [sh, -c, 'sleep 60 & exit 1']
        ends: {run: [sh, -c, 'true & sleep 60'], limit: 50 ms}
        "#,
    );
    for _ in 0..10 {
        assert_eq!(rig.run("leaves", "").0, Completed);
        assert_eq!(rig.run("fails", "").0, Failed);
        assert_eq!(rig.run("ends", "").0, Failed);
    }
    rig.wait_deserted("after the tasks");
    // No zombie either: only the watchdog is a child of the server.
    assert_eq!(rig.children().len(), 1);
}

#[test]
fn a_silent_or_closed_output_uses_no_cpu() {
    let rig = Rig::new(
        r#"
        silent: {run: [sh, -c, 'echo > silent; until [ -e go ]; do sleep 0.2; done; echo end']}
        closes: {run: [sh, -c, 'exec <&- >&- 2>&-; until [ -e go ]; do sleep 0.2; done']}
        half: {run: [sh, -c, 'printf "no end of line"; until [ -e go ]; do sleep 0.2; done']}
        passes: {run: [sh, -c, 'sleep 60 & echo $! > holder; echo end'], left-behind: leave}
        "#,
    );
    let mut remote = rig.remote();
    let tasks = ["silent", "closes", "half"].map(|name| trigger(&mut remote, name, ""));
    // A leftover process holds its output open, which is never read.
    assert_eq!(rig.run("passes", ""), (Completed, "end".to_owned()));
    rig.written("silent");
    let process = rig.server.process.id();
    let before = processor_time(process);
    std::thread::sleep(Duration::from_secs(1));
    let cost = processor_time(process) - before;
    // A busy loop would take the whole second.
    assert!(cost <= Duration::from_millis(100), "{cost:?}");
    for task in tasks {
        assert_eq!(remote.status(task).expect("an answer").state, Accepted);
    }
    std::fs::write(rig.scratch.path("go"), "").expect("to write");
    let [silent, closes, half] = tasks;
    assert_eq!(end(&mut remote, silent), (Completed, "end".to_owned()));
    assert_eq!(end(&mut remote, closes), (Completed, String::new()));
    assert_eq!(
        end(&mut remote, half),
        (Completed, "no end of line".to_owned())
    );
    crate::rig::kill(rig.process("holder"));
}

#[test]
fn many_noisy_children_are_read_within_limits_and_delay_no_other() {
    let rig = Rig::new(
        r#"
        crowd: {run: [sh, -c, 'for i in $(seq 40); do yes "$i is here" & yes >&2 & done; wait'], result: all, output: 4 KiB, abort: {grace: 100 ms}}
        progress: {run: [yes, '@ on'], progress: '@ '}
        echo: echo
        "#,
    );
    let mut remote = rig.remote();
    let crowd = trigger(&mut remote, "crowd", "");
    let other = trigger(&mut remote, "progress", "");
    progress(&mut remote, other, "on");
    for number in 0..5 {
        let said = number.to_string();
        assert_eq!(rig.run("echo", &said), (Completed, said));
    }
    let kept = std::fs::read_to_string(format!("/proc/{}/status", rig.server.process.id()));
    let kept = kept.expect("its status");
    let own = kept.lines().find_map(|line| line.strip_prefix("RssAnon:"));
    let own: u64 = own
        .and_then(|own| own.split_whitespace().next()?.parse().ok())
        .expect("KiB");
    assert!(own < 8 * 1024, "{own} KiB");
    for task in [crowd, other] {
        remote.abort(task).expect("an answer");
        remote.wait(task, Some(PATIENCE)).expect("its end");
    }
    rig.wait_deserted("after the aborts");
}

#[test]
fn ztl_ps_shows_where_a_program_is() {
    let rig = Rig::new("go: {run: [sh, -c, 'echo \"@ 3 of 7\"; sleep 60'], progress: '@ '}");
    let mut remote = rig.remote();
    let task = trigger(&mut remote, "go", "fast");
    progress(&mut remote, task, "3 of 7");
    let port = rig.server.port.to_string();
    let listed = Process::run(ztl().args(["ps", "-r", "127.0.0.1", "-p", &port])).stdout;
    let row = listed
        .lines()
        .find(|line| line.starts_with(&task.to_string()));
    let row = row.unwrap_or_else(|| panic!("{listed}"));
    assert!(row.contains("p:go:fast") && row.contains("3 of 7"), "{row}");
    let ended = Process::run(ztl().args(["abort", "-r", "127.0.0.1", "-p", &port, "--all"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(rig.at_home().is_empty());
}

#[test]
fn no_program_survives_its_server_at_any_signal() {
    for signal in ["ABRT", "QUIT", "HUP"] {
        let mut rig =
            Rig::new("go: {run: [sh, -c, 'echo $$ > pid; exec sleep 60'], abort: {grace: 2 s}}");
        let mut remote = rig.remote();
        trigger(&mut remote, "go", "");
        let process = rig.process("pid");
        assert!(lives(process));
        rig.server.process.signal(signal);
        dies(process);
        rig.server.process.kill();
    }
}
