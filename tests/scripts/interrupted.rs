//! `ztl run-script --plain` with servers that stop or restart, with Ctrl-C, and with keys at the wrong time.

use std::fs;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ztl_std::{ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest};
use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, Server, Terminal, original_tool, port_of, reserve_port,
    serve, signal, until, ztl,
};

use crate::directory::ScriptDirectory;

/// A directory with a script and a configuration with the server `test`.
fn directory(script: &str, server: &Server) -> ScriptDirectory {
    ScriptDirectory::with(script, &[("test", server.port, SCOPE)])
}

/// Plays the script, with these further options.
fn play(directory: &ScriptDirectory, more: &str) -> Command {
    directory.command(&format!(
        "run-script -s show.yaml -c remotes.yaml --plain {more}"
    ))
}

/// The message about the background task shows that both tasks were accepted.
const TWO_STEPS: &str = "s: {a: {test: {sleep: 5, echo(wait=no): x}}, b: {test: {echo: after}}}\n";
const TAKEN: &str =
    "Component 'echo' on handler 'test' for step 'a' TRIGGERED TO RUN IN BACKGROUND.";

fn servers() -> [Server; 2] {
    [Server::ours_at(reserve_port()), Server::original()]
}

#[test]
fn a_step_waits_for_a_suspended_server_and_continues() {
    for server in servers() {
        let files = directory(TWO_STEPS, &server);
        let player = Process::start(&mut play(&files, "--yes"));
        player.wait_for(TAKEN);
        server.process.signal("STOP");
        player.wait_for("Step 'a' waits: 'test' does not answer");
        assert!(!player.stdout().contains("STEP 'b'"), "{}", player.stdout());
        server.process.signal("CONT");
        player.wait_for("Step 'a' goes on.");
        let ended = player.end(PATIENCE);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(
            ended.stdout.ends_with("STARTING STEP 'b'...\n"),
            "{ended:?}"
        );
    }
}

#[test]
fn after_a_server_restart_the_script_waits_for_a_decision() {
    for (ours, mut server) in [true, false].into_iter().zip(servers()) {
        let mut restarted = match ours {
            true => ztl(),
            false => original_tool("ztl_task_server"),
        };
        if ours {
            restarted.arg("task-server");
        }
        restarted.args(["-p", &server.port.to_string(), "-s", SCOPE]);
        let files = directory(TWO_STEPS, &server);
        let player = Process::start(&mut play(&files, "--yes"));
        player.wait_for(TAKEN);
        server.process.kill();
        let _restarted = {
            let process = Process::start(&mut restarted);
            process.wait_for("Registering controller for scope '/test'");
            process
        };
        let ended = player.end(PATIENCE);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        let waits = ended.stderr.contains("Step 'a' waits: ");
        assert!(
            waits && ended.stderr.contains("so the outcome of "),
            "{ended:?}"
        );
        // Only our server reports its boot id.
        let told = ended.stderr.contains("'test' was restarted");
        assert!(told || !ours, "{ended:?}");
        assert!(!ended.stdout.contains("STEP 'b'"), "{ended:?}");
        assert!(
            ended.stdout.contains("NOT CONFIRMED: Component 'sleep'"),
            "{ended:?}"
        );
    }
}

#[test]
fn ctrl_c_stops_background_tasks_and_reports_unstoppable_ones() {
    let gateway = Server::simulated();
    // The finger takes 20 s, so that it still moves at Ctrl-C.
    gateway.set_speed("gripper", "speed", 0.1);
    let original = Server::original();
    let files = Scratch::new();
    let script = "s: {a(wait=no): {gripper: {finger: 100}}, b: {test: {sleep: 5, echo(wait=no): x}}, c: {test: {echo: 1}}}\n";
    fs::write(files.path("show.yaml"), script).unwrap();
    let (ours, theirs) = (gateway.port.to_string(), original.port.to_string());
    let mut command = ztl();
    command.current_dir(files.path(""));
    command.args(["run-script", "-s", "show.yaml", "--yes", "--plain"]);
    command.args(["--task", "gripper", "127.0.0.1", &ours, SCOPE]);
    command.args(["--task", "test", "127.0.0.1", &theirs, SCOPE]);
    let player = Process::start(&mut command);
    player.wait_for(&TAKEN.replace("'a'", "'b'"));
    player.signal("INT");
    let ended = player.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended
            .stderr
            .contains("ERROR:script-exec:Interrupted, exiting."),
        "{ended:?}"
    );
    assert!(
        ended
            .stdout
            .contains("STOPPED: Component 'finger' on handler 'gripper' for step 'a': aborted"),
        "{ended:?}"
    );
    assert!(
        ended.stdout.contains(
            "NOT CONFIRMED: Component 'sleep' on handler 'test' for step 'b': it cannot be stopped"
        ),
        "{ended:?}"
    );
    assert!(!ended.stdout.contains("STEP 'c'"), "{ended:?}");
    let tasks = Process::run(ztl().args(["ps", "-p", &ours]));
    assert_eq!(tasks.stdout, "No task is running.\n");
}

const SCENES: &str = "one: {a: {test: {sleep: 4}}}\ntwo: {a: {test: {echo: 1}}}\nthree: {a: {test: {echo: 1}}}\nfour: {a: {test: {echo: 1}}}\n";

#[test]
fn a_key_answers_one_question_and_never_the_next() {
    let server = Server::ours();
    let files = directory(SCENES, &server);
    let mut terminal = Terminal::start(&play(&files, ""), (100, 60));
    terminal.shows("SCENE 'one'");
    terminal.shows("PRESS <ENTER> TO CONFIRM or ANY OTHER KEY TO SKIP");
    // Three keys read together start one scene.
    terminal.type_in("\r\r\r");
    terminal.shows("STARTING STEP 'a'...");
    // Keys typed while it runs are ignored.
    terminal.type_in("x");
    terminal.type_in("\r");
    terminal.shows("ABOUT TO EXECUTE SCENE 'two'");
    terminal.shows("CONFIRM, PRESS <R>");
    // An arrow key skips one scene.
    terminal.type_in("\x1b[A");
    terminal.shows("SKIPPING SCENE 'two'");
    terminal.shows("ABOUT TO EXECUTE SCENE 'three'");
    let screen = terminal.shows_that("a question about scene three", |screen| {
        screen.matches("CONFIRM, PRESS <R>").count() == 2
    });
    assert!(
        !screen.contains("EXECUTING SCENE 'two'") && !screen.contains("'four'"),
        "{screen}"
    );
    terminal.type_in("\x03");
    assert_eq!(terminal.end().code(), Some(1));
    terminal.waits_until_as_before();
}

#[test]
fn the_terminal_is_restored_at_every_kind_of_exit() {
    for (signal, key, code) in [
        (Some("TERM"), "", 143),
        (Some("HUP"), "", 129),
        (None, "\x03", 1),
        (None, "q", 0),
    ] {
        let server = Server::ours();
        let files = directory("one: {a: {test: {echo: 1}}}\n", &server);
        let mut terminal = Terminal::start(&play(&files, ""), (100, 30));
        terminal.shows("PRESS <ENTER>");
        until("single keys", PATIENCE, || {
            (!terminal.is_as_before()).then_some(())
        });
        match signal {
            Some(name) => terminal.signal(name),
            None => terminal.type_in(key),
        }
        if key == "q" {
            terminal.shows("PRESS <A> TO RESTART THE SCRIPT");
            terminal.type_in("q");
        }
        let ended = terminal.end().code();
        assert_eq!(ended, Some(code), "{signal:?} {key:?}");
        terminal.waits_until_as_before();
    }
}

#[test]
fn the_operator_decides_about_a_waiting_step() {
    let server = Server::ours();
    let script = "one: {a(on_failure=ask): {test: {nonsense: 1}}, b: {test: {echo: 1}}}\n";
    let files = directory(script, &server);
    let mut terminal = Terminal::start(&play(&files, ""), (120, 60));
    terminal.shows("PRESS <ENTER>");
    terminal.type_in("\r");
    let asks = "PRESS <G> TO GO ON ANYWAY, <T> TO TRY AGAIN WHAT FAILED";
    terminal.shows(asks);
    terminal.type_in("t");
    terminal.shows_that("the question again", |screen| {
        screen.matches("PRESS <G>").count() == 2
    });
    terminal.type_in("g");
    terminal.shows("STARTING STEP 'b'...");
    terminal.shows("PRESS <R> TO REPLAY THE LAST SCENE");
    terminal.type_in("x");
    assert_eq!(terminal.end().code(), Some(1), "something failed");
}

/// The started and aborted tasks; `short` ends at once, all others run until aborted.
#[derive(Clone, Default)]
struct Recording(Arc<Mutex<Vec<String>>>);

impl Recording {
    fn wait_for(&self, what: &str) {
        let said = |what: &str| self.0.lock().unwrap().iter().any(|said| said == what);
        until(what, PATIENCE, || said(what).then_some(()));
    }
}

impl TaskController for Recording {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let (record, name) = (self.clone(), request.component.clone());
        Ok(Box::new(move |task: &TaskContext| {
            record.0.lock().unwrap().push(name.clone());
            if name != "short"
                && let Err(aborted) = task.sleep(Duration::from_secs(600))
            {
                record.0.lock().unwrap().push(format!("{name} aborted"));
                return Err(aborted.into());
            }
            Ok(String::new())
        }))
    }
}

/// A program whose output is never read. It is killed when this is dropped.
struct Unread(Child);

impl Unread {
    fn start(command: &mut Command) -> Self {
        Self(command.spawn().unwrap())
    }

    fn interrupt(&self) {
        signal(self.0.id(), "INT");
    }

    fn ended(&mut self) -> Option<ExitStatus> {
        self.0.try_wait().unwrap()
    }
}

impl Drop for Unread {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn ctrl_c_stops_everything_even_if_nobody_reads_the_output() {
    // More than a pipe holds: on stdout the names of scenes, on stderr messages about background tasks.
    let mut script = "first: {a: {robot: {long(wait=no): 1}}}\n".to_owned();
    for nth in 0..80 {
        let name = format!("{nth}-{}", "x".repeat(1000));
        script += &format!("{name}: {{{name}: {{robot: {{short(wait=no): 1}}}}}}\n");
    }
    script += "last: {a: {robot: {last: 1}}}\n";
    for unread in ["stdout", "stderr", "both"] {
        let record = Recording::default();
        let server = serve(record.clone());
        let port = port_of(server.endpoint()).to_string();
        let files = Scratch::new();
        fs::write(files.path("show.yaml"), &script).unwrap();
        let mut command = ztl();
        command
            .current_dir(files.path(""))
            .args(["run-script", "-s", "show.yaml", "--yes"])
            .args(["--task", "robot", "127.0.0.1", &port, SCOPE]);
        let stream = |name| match [name, "both"].contains(&unread) {
            true => Stdio::piped(),
            false => Stdio::null(),
        };
        command.stdout(stream("stdout")).stderr(stream("stderr"));
        command.stdin(Stdio::null());
        let mut player = Unread::start(&mut command);
        record.wait_for("last");
        player.interrupt();
        record.wait_for("long aborted");
        record.wait_for("last aborted");
        let status = until("its end", PATIENCE, || player.ended());
        assert_eq!(status.code(), Some(1), "{unread}");
    }
}

#[test]
fn a_second_ctrl_c_ends_a_player_that_hangs() {
    let mut command = ztl();
    command.args(["run-script", "--yes", "-s", "/dev/stdin"]);
    command.stdout(Stdio::null()).stderr(Stdio::null());
    // No script is ever written.
    command.stdin(Stdio::piped());
    let mut player = Unread::start(&mut command);
    let status = until("its end", PATIENCE, || {
        // Slower than a key repeat.
        std::thread::sleep(Duration::from_secs(1));
        player.ended().or_else(|| {
            player.interrupt();
            None
        })
    });
    assert_eq!(status.code(), Some(130));
}
