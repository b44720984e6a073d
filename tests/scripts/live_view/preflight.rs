//! Probes of servers before the first scene.

use ztl_tests::lab::{Process, SCOPE, Server, Terminal, reserve_port, ztl};

use super::stage::Stage;

const SHOW: &str = "\
one: {a: {test: {echo: 1}, robot: {echo: 1}}}
two: {b: {nobody: {x: 1}}}
";

#[test]
fn missing_servers_and_their_return_are_shown_before_the_first_scene() {
    for server in [Server::ours(), Server::original()] {
        let (here, gone) = (server.port, reserve_port());
        let stage = Stage::with(SHOW, &[("test", here), ("robot", gone)]);
        let mut terminal = stage.play();
        terminal.shows(" Next: one");
        terminal.shows("test ✓");
        terminal.shows("robot ✗ MISSING");
        let text = format!("MISSING: server 'robot': no answer from tcp://127.0.0.1:{gone}");
        let screen = terminal.shows(&text);
        assert!(screen.contains(" Next: one"), "{screen}");
        // Not in the configuration.
        terminal.shows("nobody ✗ MISSING");
        // Keys work meanwhile.
        terminal.type_in("s");
        terminal.shows(" Next: two");
        let mut robot = ztl();
        robot.args(["task-server", "-p", &gone.to_string(), "-s", SCOPE]);
        let robot = Process::start(&mut robot);
        robot.wait_for("Registering controller");
        terminal.shows("robot ✓");
        drop(robot);
        terminal.shows_that("that it has gone", |screen| {
            screen.contains("robot ✗ MISSING") || screen.contains("robot silent")
        });
        terminal.type_in("\x03");
        terminal.end();
        // Probes start nothing.
        let port = here.to_string();
        let tasks = Process::run(ztl().args(["ps", "--all", "-p", &port]));
        assert!(!tasks.stdout.contains("echo"), "{tasks:?}");
        let sent = |line: &serde_json::Value| line["event"] == "request_sent";
        assert!(!stage.record().iter().any(sent));
    }
}

#[test]
fn a_server_without_the_scope_is_missing() {
    let server = Server::ours();
    let port = server.port;
    let stage = Stage::with("one: {a: {test: {echo: 1}}}\n", &[]);
    let remotes = format!("remotes: {{test: {{host: 127.0.0.1, port: {port}, scope: /other}}}}\n");
    std::fs::write(stage.files.path("remotes.yaml"), remotes).unwrap();
    let mut terminal = stage.play();
    terminal.shows("test ✗ MISSING");
    terminal.shows(&format!("tcp://127.0.0.1:{port} has no scope"));
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn an_unreadable_configuration_is_shown_once_however_many_servers_the_script_uses() {
    let tasks: Vec<String> = (1..=25).map(|n| format!("server{n}: {{x: 1}}")).collect();
    let script = format!("one: {{a: {{{}}}}}\n", tasks.join(", "));
    let stage = Stage::with(&script, &[]);
    std::fs::write(
        stage.files.path("broken.yaml"),
        "remotes:\n  a: {host: h\n  b: 1\n",
    )
    .unwrap();
    for (config, why) in [
        ("none.yaml", "none.yaml: cannot read it: No such file"),
        ("broken.yaml", "broken.yaml:2:6: this '{' is not closed"),
    ] {
        let mut command = ztl();
        command.args(["run-script", "-s", "show.yaml", "-c", config]);
        command.current_dir(stage.files.path(""));
        let mut terminal = Terminal::start(command.env("LANG", "C.UTF-8"), (80, 24));
        // The view may be drawn before all is known; when it asks, it is.
        let screen = terminal.shows("Enter  start");
        assert_eq!(screen.matches(why).count(), 1, "{screen}");
        assert_eq!(screen.matches("MISSING: ").count(), 1, "{screen}");
        assert!(screen.contains("and 23 more: no valid entry"), "{screen}");
        assert!(!screen.contains("names no server"), "{screen}");
        terminal.type_in("\x03");
        terminal.end();
        // Without the view, it is printed once, too.
        command.args(["--plain", "--yes"]);
        let ended = Process::run(&mut command);
        assert_eq!(ended.stderr.matches(why).count(), 1, "{ended:?}");
        assert!(!ended.stderr.contains("names no server"), "{ended:?}");
    }
}

#[test]
fn a_stopped_server_is_noticed_and_keys_still_work() {
    let server = Server::ours();
    let port = server.port;
    let stage = Stage::with(
        "one: {a: {test: {echo: 1}}}\ntwo: {a: {test: {echo: 1}}}\n",
        &[("test", port)],
    );
    let mut terminal = stage.play();
    terminal.shows("test ✓");
    server.process.signal("STOP");
    terminal.shows("MISSING: server 'test' is silent for");
    terminal.type_in("s");
    terminal.shows(" Next: two");
    server.process.signal("CONT");
    terminal.shows("test ✓");
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn check_live_reports_missing_servers_despite_mistakes_in_the_script() {
    let server = Server::ours();
    let gone = reserve_port();
    let mistaken = "one: {a (dealy=2): {test: {echo: 1}, robot: {echo: 1}}}\n";
    let unreadable = "one: {a: {test: {echo: 1}, robot: {echo: 1}}\n";
    for script in [mistaken, unreadable] {
        let stage = Stage::with(script, &[("test", server.port), ("robot", gone)]);
        let mut check = ztl();
        check.current_dir(stage.files.path(""));
        check.args(["check", "show.yaml", "-c", "remotes.yaml", "--live"]);
        let ended = Process::run(&mut check);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        for words in [
            format!("test: at tcp://127.0.0.1:{}, ztl ", server.port),
            format!("robot: MISSING: no answer from tcp://127.0.0.1:{gone}"),
            "show.yaml:1:".to_owned(),
        ] {
            assert!(ended.stdout.contains(&words), "{words}: {ended:?}");
        }
    }
}
