//! Clients that go away, send nonsense or too much, and robots that cannot tell what they do.

use ztl_tests::lab::{PATIENCE, Process, Server, reserve_port};

use crate::console::{Console, from_port, node, web};

fn start(scenario: &str, url: &str) -> Process {
    Process::start(node("socket.mjs").args([scenario, url]))
}

#[track_caller]
fn passes(scenario: &str, url: &str) {
    let ended = start(scenario, url).end(PATIENCE);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn goals_of_a_client_that_is_gone_are_left_or_aborted_as_it_has_chosen() {
    passes("gone", &Console::of_one().socket());
}

#[test]
fn malformed_messages_harm_no_other_client() {
    passes("garbage", &Console::of_one().socket());
}

#[test]
fn too_many_goals_are_refused_and_one_id_starts_one_task() {
    let console = Console::of_one();
    passes("many", &console.socket());
    console.has_marks(1);
}

#[test]
fn long_messages_of_one_client_do_not_keep_a_stop_waiting() {
    passes("large", &Console::of_one().socket());
}

#[test]
fn a_watcher_stops_and_starts_nothing() {
    let (_process, link) = web(0, &[("ours", reserve_port())], &["--bind", "0.0.0.0"]);
    let link = from_port(&link).replace("/?", "/rosbridge?");
    passes("watcher", &format!("ws://127.0.0.1{link}"));
}

#[test]
fn one_client_at_a_time_starts_tasks_until_another_takes_over() {
    let console = Console::of_one();
    passes("operators", &console.socket());
    console.has_marks(0);
}

#[test]
fn a_server_of_the_original_is_never_called_confirmed() {
    let robot = Server::original();
    let (_console, url) = web(0, &[("theirs", robot.port)], &[]);
    passes(
        "original",
        &format!("{}rosbridge", url.replace("http", "ws")),
    );
}

#[test]
fn a_hanging_server_is_not_confirmed_and_delays_no_other() {
    let console = Console::of_one();
    let hanging = Server::ours();
    hanging.process.signal("STOP");
    let robots = [("hangs", hanging.port), ("ours", console.robot.port)];
    let (_console, url) = web(0, &robots, &[]);
    passes(
        "hanging",
        &format!("{}rosbridge", url.replace("http", "ws")),
    );
}

#[test]
fn a_task_of_a_restarted_server_is_unknown_and_not_started_again() {
    let mut console = Console::of_one();
    let mut client = start("unknown", &console.socket());
    client.wait_for("do: restart the server");
    console.robot.process.kill();
    console.start_robot_again();
    client.write_line("done");
    let ended = client.end(PATIENCE);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    console.has_marks(1);
}
