//! The scripts of `ztl completions` in real shells: the tasks of a server, by its descriptions.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, Server, Terminal, in_time, reserve_port, until, ztl,
};

const COMPONENTS: &str = "
    head: {turn: {built-in: echo, goal: {one-of: [left, right, straight on]}}, stop: {built-in: echo, goal: nothing}}
    hand: {light: {built-in: echo, goal: truth}, say: {built-in: echo, examples: ['it is']}}
";

/// A server with descriptions, and a directory with its configuration and the scripts.
struct Rig {
    server: Server,
    scratch: Scratch,
}

impl Rig {
    fn new() -> Self {
        let scratch = Scratch::new();
        let write =
            |name: &str, text: &str| std::fs::write(scratch.path(name), text).expect("a file");
        write("robot.yaml", &format!("scopes:\n  {SCOPE}:{}", COMPONENTS));
        let mut serve = ztl();
        serve
            .arg("serve")
            .arg(scratch.path("robot.yaml"))
            .args(["-p", "0"]);
        let server = Server::start(&mut serve);
        let port = server.port;
        let lost = reserve_port();
        write(
            "remotes.yaml",
            &format!(
                "remotes:\n  fetch: {{host: localhost, port: {port}, scope: {SCOPE}}}\n  \
                 lost: {{host: localhost, port: {lost}, scope: {SCOPE}}}\n"
            ),
        );
        for shell in ["bash", "zsh", "fish"] {
            let script = Process::run(ztl().args(["completions", shell]));
            let name = if shell == "zsh" { "_ztl" } else { shell };
            write(name, &script.stdout);
        }
        Self { server, scratch }
    }

    /// A shell in which `ztl` is this one.
    fn shell(&self, program: &str, arguments: &[&str]) -> Command {
        let mut shell = Command::new(program);
        let command = ztl();
        let directory = Path::new(command.get_program())
            .parent()
            .expect("a directory");
        let path = std::env::var("PATH").unwrap_or_default();
        shell
            .args(arguments)
            .current_dir(self.scratch.path(""))
            .env("PATH", format!("{}:{path}", directory.display()))
            .env("HOME", self.scratch.path(""))
            .env("PS1", "> ")
            .env_remove("ZTL_PORT")
            .env_remove("ZTL_SCOPE");
        shell
    }
}

/// What is typed, with TABs, and the line that the shell then shows.
fn lines() -> Vec<(String, String)> {
    let fetch = "ztl task-client -c remotes.yaml -r fetch";
    let remote = "ztl remote-task -c remotes.yaml fetch";
    vec![
        (format!("{fetch} he\tX"), format!("{fetch} head:X")),
        (
            format!("{fetch} head:t\tr\tX"),
            format!("{fetch} head:turn:right X"),
        ),
        (
            format!("{fetch} hand:light:T\tX"),
            format!("{fetch} hand:light:True X"),
        ),
        (
            format!("{fetch} 'hand:say:i\tX"),
            format!("{fetch} 'hand:say:it is' X"),
        ),
        (
            format!("{remote} head:turn:l\tX"),
            format!("{remote} head:turn:left X"),
        ),
        (
            "ztl task-client --js\tX".to_owned(),
            "ztl task-client --json X".to_owned(),
        ),
    ]
}

/// Types each line, which ends in X, into a shell with the prompt `ok>`, until it shows what is expected: when the machine
/// is busy, the server may answer too late.
#[track_caller]
fn types(mut shell: Terminal, lines: &[(String, String)]) {
    for (typed, shown) in lines {
        until(shown, PATIENCE, || {
            shell.shows_that("an empty line", |screen| screen.trim() == "ok>");
            shell.type_in(typed);
            let screen = shell.shows_that("the whole line", |screen| screen.trim().ends_with('X'));
            // Clears the line, then the screen.
            shell.type_in("\x15\x0c");
            (screen.trim() == format!("ok> {shown}")).then_some(())
        });
    }
    shell.type_in("exit\r");
    shell.end();
}

#[test]
fn bash_completes_tasks_by_asking_the_server() {
    let rig = Rig::new();
    let bash = rig.shell("bash", &["--norc", "--noprofile", "-i"]);
    let mut bash = Terminal::start(&bash, (150, 24));
    bash.shows(">");
    bash.type_in("source ./bash; PS1='ok> '; clear\r");
    let spaces = [
        (
            "ztl task-client -c remotes.yaml -r fetch head:turn:s\tX",
            "ztl task-client -c remotes.yaml -r fetch head:turn:straight\\ on X",
        ),
        ("ztl task-cl\tX", "ztl task-client X"),
    ];
    let spaces = spaces.map(|(typed, shown)| (typed.to_owned(), shown.to_owned()));
    types(bash, &[lines(), spaces.into()].concat());
}

#[test]
fn zsh_completes_tasks_by_asking_the_server() {
    let rig = Rig::new();
    let mut zsh = Terminal::start(&rig.shell("zsh", &["-f", "-i"]), (150, 24));
    zsh.type_in("fpath=($PWD $fpath); autoload -U compinit; compinit -u -D; PS1='ok> '; clear\r");
    types(zsh, &lines());
}

#[test]
fn fish_completes_tasks_by_asking_the_server() {
    let rig = Rig::new();
    let complete = |line: &str| {
        let script = format!("source ./fish; complete -C {line:?}");
        let ended = Process::run(&mut rig.shell("fish", &["--no-config", "-c", &script]));
        assert_eq!(ended.stderr, "", "{line}");
        let lines = ended.stdout.lines().map(|line| line.split('\t').next());
        lines
            .map(|word| word.unwrap_or_default().to_owned())
            .collect::<Vec<_>>()
    };
    let fetch = "ztl task-client -c remotes.yaml -r fetch ";
    for (word, found) in [
        ("", &["hand:", "head:"][..]),
        ("head:", &["head:stop:", "head:turn:"]),
        (
            "head:turn:",
            &["head:turn:left", "head:turn:right", "head:turn:straight on"],
        ),
        ("head:stop:", &["head:stop:"]),
        ("hand:say:", &["hand:say:it is"]),
    ] {
        // When the machine is busy, the server may answer too late.
        until(word, PATIENCE, || {
            let mut words = complete(&format!("{fetch}{word}"));
            words.retain(|word| word.contains(':'));
            words.sort();
            (words == found).then_some(())
        });
    }
    until("the tasks of a named server", PATIENCE, || {
        let words = complete("ztl remote-task -c remotes.yaml fetch head:turn:r");
        (words == ["head:turn:right"]).then_some(())
    });
    let options = complete("ztl task-client --js");
    assert_eq!(options, ["--json"]);
}

#[test]
fn a_server_that_does_not_answer_delays_no_shell_and_prints_nothing() {
    let rig = Rig::new();
    let complete = |words: &[&str]| {
        let mut command = ztl();
        command.current_dir(rig.scratch.path(""));
        command.args(["complete-goal", "--"]).args(words);
        let ended = Process::run(&mut command);
        assert_eq!(
            (ended.code, ended.stderr.as_str()),
            (Some(0), ""),
            "{words:?}"
        );
        ended.stdout
    };
    let task = ["task-client", "-c", "remotes.yaml", "-r"];
    until("an answer in time", PATIENCE, || {
        let told = complete(&[&task[..], &["fetch", "hand:li"]].concat());
        (told == "hand:light:\n").then_some(())
    });
    rig.server.process.signal("STOP");
    for name in ["fetch", "lost", "nobody"] {
        let told = in_time(Duration::from_secs(2), || {
            complete(&[&task[..], &[name, "he"]].concat())
        });
        assert_eq!(told, "", "{name}");
    }
    rig.server.process.signal("CONT");
    for words in [
        &["task-client", "-r", "fe"][..],
        &["task-client", "-c", "remotes.yaml", "-r", "fetch", "--js"],
        &[
            "task-client",
            "-c",
            "remotes.yaml",
            "-r",
            "fetch",
            "head:turn:left",
            "x",
        ],
        &["remote-task", "-c", "remotes.yaml", "fe"],
        &["task-client", "-c", "missing.yaml", "-r", "fetch", "he"],
        &["describe", ""],
        &[],
    ] {
        assert_eq!(complete(words), "", "{words:?}");
    }
}
