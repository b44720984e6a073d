//! The page in Chromium, driven by `driver.mjs`.

use ztl_tests::lab::{PATIENCE, Process, busy};

use crate::console::{Console, node, web};

/// Starts a scenario of the driver.
fn drive(scenario: &str, url: &str, console: &Console) -> Process {
    let directory = console.files.path("");
    let mut command = node("driver.mjs");
    Process::start(command.args([scenario, url]).arg(directory))
}

/// Plays a scenario to its end.
#[track_caller]
fn passes(scenario: &str, url: &str, console: &Console) {
    let ended = drive(scenario, url, console).end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn each_part_works_on_a_phone_a_tablet_and_a_desk() {
    let _busy = busy();
    let console = Console::new();
    passes("parts", &console.url, &console);
}

#[test]
fn hostile_text_is_text() {
    let _busy = busy();
    let console = Console::of_one();
    passes("hostile", &console.url, &console);
}

#[test]
fn two_pages_see_and_stop_the_same_tasks() {
    let _busy = busy();
    let console = Console::of_one();
    passes("two", &console.url, &console);
}

#[test]
fn a_double_click_and_a_held_enter_start_one_task_each() {
    let _busy = busy();
    let console = Console::of_one();
    passes("presses", &console.url, &console);
    assert_eq!(console.marks(), 2);
}

#[test]
fn a_killed_console_and_a_killed_server_return_and_start_nothing_twice() {
    let _busy = busy();
    let mut console = Console::new();
    let mut driver = drive("killed", &console.url, &console);
    driver.wait_for("do: kill the console");
    console.process.kill();
    driver.write_line("done");
    driver.wait_for("do: start the console");
    console.start_again();
    driver.write_line("done");
    driver.wait_for("do: kill the server");
    assert_eq!(console.marks(), 1);
    console.robot.process.kill();
    driver.write_line("done");
    driver.wait_for("do: start the server");
    console.start_robot_again();
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    assert_eq!(console.marks(), 1, "started twice");
}

#[test]
fn a_page_of_another_origin_gets_nothing() {
    let _busy = busy();
    let console = Console::of_one();
    passes("origin", &console.url, &console);
}

#[test]
fn a_watchers_link_becomes_a_cookie_and_its_page_only_looks() {
    let _busy = busy();
    let console = Console::of_one();
    let robots = [("ours", console.robot.port)];
    let (process, _) = web(0, &robots, &["--bind", "0.0.0.0"]);
    let line = process.wait_for("watchers:");
    let (_, link) = line
        .split_once("http://ADDRESS-OF-THIS-MACHINE")
        .expect("a link");
    passes("watcher", &format!("http://127.0.0.1{link}"), &console);
}
