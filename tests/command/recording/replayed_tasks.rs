//! Recorded tasks, which `ztl replay` sends only after a yes.

use super::*;

/// A server, a recording of two of its tasks by two publishers, and a configuration file that names it.
struct Stage {
    server: Server,
    scratch: Scratch,
}

impl Stage {
    fn new() -> Self {
        let (server, scratch) = (Server::ours(), Scratch::new());
        let (one, two) = (topic(1), topic(2));
        written(
            &scratch.path("run.mcap"),
            &[
                ("robot", &one, event(1, "INITIATED", "one")),
                // The same event, recorded twice.
                ("again", &one, event(1, "INITIATED", "one")),
                ("robot", &one, event(1, "COMPLETED", "")),
                ("robot", &two, event(2, "INITIATED", "two")),
            ],
        );
        let port = server.port;
        let remotes =
            format!("remotes: {{robot: {{host: localhost, port: {port}, scope: {SCOPE}}}}}\n");
        std::fs::write(scratch.path("remotes.yaml"), remotes).expect("a file");
        Self { server, scratch }
    }

    fn replay(&self, options: &[&str]) -> Command {
        let mut command = ztl();
        command.arg("replay").arg(self.scratch.path("run.mcap"));
        command.arg("--tasks").arg("-c");
        command.arg(self.scratch.path("remotes.yaml")).args(options);
        command
    }

    /// The tasks that the server has got.
    fn tasks(&self) -> Ended {
        let port = self.server.port.to_string();
        Process::run(ztl().args(["ps", "-p", &port, "--json"]))
    }

    #[track_caller]
    fn nothing_was_sent(&self) {
        let tasks = self.tasks();
        assert!(tasks.stdout.contains("\"tasks\":[]"), "{tasks:?}");
    }
}

#[test]
fn tasks_are_not_replayed_without_a_yes() {
    let stage = Stage::new();
    let ended = Process::run(&mut stage.replay(&[]));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(ended.stderr.contains("nothing was sent"), "{ended:?}");
    stage.nothing_was_sent();
    for answer in ["\r", "n\r", "yess\r", "\u{4}"] {
        let mut terminal = Terminal::start(&stage.replay(&[]), (100, 24));
        let screen = terminal.shows("Send them? [y/N]");
        assert!(
            screen.contains("1 x 'test:echo:one'") && screen.contains("1 x 'test:echo:two'"),
            "{screen}"
        );
        terminal.type_in(answer);
        assert_eq!(terminal.end().code(), Some(2), "{answer:?}");
        stage.nothing_was_sent();
    }
    // Without --tasks, not even with a yes on the command line.
    let ended = Process::run(ztl().args(["replay", "run.mcap", "-p", "0", "--yes"]));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    // Robots do not move faster than they did.
    let ended = Process::run(&mut stage.replay(&["--yes", "--speed", "2"]));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    stage.nothing_was_sent();
}

#[test]
fn keys_typed_before_the_question_are_no_yes() {
    let stage = Stage::new();
    let replay = stage.replay(&[]);
    let mut command = Command::new("sh");
    // `read` takes the first line; the others wait for the replay.
    let script = "echo waiting; read line; exec \"$@\"";
    command.args(["-c", script, "sh"]).arg(replay.get_program());
    command.args(replay.get_args());
    let mut terminal = Terminal::start(&command, (100, 24));
    terminal.shows("waiting");
    terminal.type_in("go\ry\ryes\r");
    terminal.shows("Send them? [y/N]");
    terminal.type_in("n\r");
    assert_eq!(terminal.end().code(), Some(2), "{}", terminal.screen());
    stage.nothing_was_sent();
}

#[test]
fn a_signal_at_the_question_is_a_no() {
    let stage = Stage::new();
    for signal in ["INT", "TERM", "HUP"] {
        let mut terminal = Terminal::start(&stage.replay(&[]), (100, 24));
        terminal.shows("Send them? [y/N]");
        terminal.signal(signal);
        assert_eq!(terminal.end().code(), Some(2), "{signal}");
        terminal.shows("nothing was sent");
        stage.nothing_was_sent();
    }
}

#[test]
fn a_replayed_task_is_sent_once() {
    let stage = Stage::new();
    let mut terminal = Terminal::start(&stage.replay(&[]), (100, 24));
    terminal.shows("Send them? [y/N]");
    terminal.type_in("y\r");
    assert_eq!(terminal.end().code(), Some(0), "{}", terminal.screen());
    let tasks = stage.tasks().stdout;
    assert_eq!(tasks.matches("\"test:echo:one\"").count(), 1, "{tasks}");
    assert_eq!(tasks.matches("\"test:echo:two\"").count(), 1, "{tasks}");
    let ended = Process::run(&mut stage.replay(&["--yes"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended.stdout.contains("robot test:echo:one COMPLETED"),
        "{ended:?}"
    );
}

#[test]
fn a_task_that_was_recorded_after_the_question_is_not_sent() {
    let stage = Stage::new();
    let file = stage.scratch.path("run.mcap");
    // A recorder that has written some, and writes on.
    let mut recording = Recording::create(&stage.scratch.path("live.mcap")).expect("a file");
    let mut write = |id, goal| {
        let body = event(id, "INITIATED", goal);
        let robot = source("robot");
        let message = Formats::default().prepare(&robot, &topic(id), &body);
        let message = message.expect("a message");
        recording
            .write(&robot, message, Instant::now())
            .expect("room");
        recording.flush().expect("room");
        std::fs::read(stage.scratch.path("live.mcap")).expect("a file")
    };
    let (before, after) = (write(1, "one"), write(3, "three"));
    assert!(after.starts_with(&before) && before.len() < after.len());
    std::fs::write(&file, &before).expect("a file");
    let mut terminal = Terminal::start(&stage.replay(&[]), (100, 24));
    terminal.shows("Send them? [y/N]");
    std::fs::write(&file, &after).expect("a file");
    terminal.type_in("y\r");
    assert_eq!(terminal.end().code(), Some(0), "{}", terminal.screen());
    let tasks = stage.tasks().stdout;
    assert!(tasks.contains("\"test:echo:one\""), "{tasks}");
    assert!(!tasks.contains("three"), "{tasks}");
}

#[test]
fn the_question_says_who_told_of_each_task() {
    let stage = Stage::new();
    let file = stage.scratch.path("run.mcap");
    std::fs::remove_file(&file).expect("a file");
    let (one, two) = (topic(1), topic(2));
    written(
        &file,
        &[
            ("robot", &one, event(1, "INITIATED", "one")),
            ("keyed", &two, event(2, "INITIATED", "two")),
        ],
    );
    let mut terminal = Terminal::start(&stage.replay(&[]), (100, 24));
    let screen = terminal.shows("Send them? [y/N]");
    let lines: Vec<&str> = screen.lines().map(str::trim).collect();
    for (teller, task) in [
        (
            "told by keyed (tcp://keyed:6000, authenticated by its key KEY)",
            "1 x 'test:echo:two'",
        ),
        (
            "told by robot (tcp://robot:6000, not authenticated)",
            "1 x 'test:echo:one'",
        ),
    ] {
        let line = lines.iter().position(|line| *line == teller);
        let line = line.unwrap_or_else(|| panic!("no {teller}: {screen}"));
        assert_eq!(lines[line + 1], task, "{screen}");
    }
    terminal.type_in("n\r");
    assert_eq!(terminal.end().code(), Some(2));
}

#[test]
fn a_task_that_two_publishers_tell_of_differently_is_not_sent() {
    let stage = Stage::new();
    let file = stage.scratch.path("run.mcap");
    std::fs::remove_file(&file).expect("a file");
    let one = topic(1);
    written(
        &file,
        &[
            ("robot", &one, event(1, "INITIATED", "one")),
            ("forger", &one, event(1, "INITIATED", "two")),
        ],
    );
    let ended = Process::run(&mut stage.replay(&["--yes"]));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    let why = "robot (tcp://robot:6000, not authenticated) and forger (tcp://forger:6000, not authenticated) tell of task 1 of /test differently";
    assert!(ended.stderr.contains(why), "{ended:?}");
    stage.nothing_was_sent();
}

#[test]
fn a_robot_that_is_not_configured_gets_no_task() {
    let stage = Stage::new();
    let other = "remotes: {robot: {host: localhost, port: 1, scope: /other}}\n";
    std::fs::write(stage.scratch.path("remotes.yaml"), other).expect("a file");
    let ended = Process::run(&mut stage.replay(&["--yes"]));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(
        ended.stderr.contains(&format!("has the scope {SCOPE}")),
        "{ended:?}"
    );
    stage.nothing_was_sent();
}
