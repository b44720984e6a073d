//! The page in Chromium, driven by `driver.mjs`.

use ztl_pickle::{DType, Pickle};
use ztl_std::Publisher;
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Scratch, Server, busy, reserve_port, until, ztl};

use crate::console::{
    Console, DESCRIBED, ROBOT, certificate_and_key, drive, from_port, has_marks, node, passes,
    port, robot, web,
};

/// Components that describe themselves with texts wider than a phone.
const LONG: &str = "    long:
      about: {built-in: echo, about: 'see https://wiki.example.org/display/robots/gripper-force-control-and-calibration', goal: text}
      number: {built-in: echo, about: 'see https://example.org', goal: {type: number, least: 0, most: 5, unit: newton_per_square_millimetre_of_the_finger_pad_surface_area}}
      words: {built-in: echo, about: 'see https://example.org', goal: {one-of: [a_word_that_is_as_long_as_the_name_of_a_recording_can_be.wav, b]}}
      fields: {built-in: echo, about: 'see https://example.org', goal: {fields: {the_force_of_the_finger_as_it_was_measured_by_its_pad: {list-of: text}, the_name_of_the_object_that_is_to_be_grasped_by_the_hand: {type: text, default: an_object_that_was_grasped_before_this_one_by_the_hand}}}}
";

/// A client of the robot that is not the console.
fn client(console: &Console, task: &str) -> Process {
    let port = console.robot.port.to_string();
    let mut client = ztl();
    client.args([
        "task-client",
        "-r",
        "127.0.0.1",
        "-p",
        &port,
        "-s",
        SCOPE,
        task,
    ]);
    Process::start(&mut client)
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
    let console = Console::of(&[ROBOT, LONG].concat());
    passes("hostile", &console.url, &console);
}

#[test]
fn two_pages_see_and_stop_the_same_tasks() {
    let _busy = busy();
    let console = Console::of_one();
    passes("two", &console.url, &console);
}

#[test]
fn one_press_starts_one_task() {
    let _busy = busy();
    until("presses that follow each other", PATIENCE * 3, || {
        let console = Console::of_one();
        let ended = drive("presses", &console.url, &console).end(PATIENCE * 3);
        // On a busy machine a press may come so late that it counts.
        if ended.stdout.contains("a press came late") {
            return None;
        }
        assert!(ended.stdout.contains("passed"), "{ended:?}");
        console.has_marks(6);
        Some(())
    });
}

#[test]
fn forms_are_made_from_what_components_say_of_themselves() {
    let _busy = busy();
    let console = Console::of(DESCRIBED);
    let mut driver = drive("forms", &console.url, &console);
    until("the page to have shown each form", PATIENCE * 3, || {
        assert!(driver.stderr().is_empty(), "{}", driver.stderr());
        driver
            .stdout()
            .contains("do: change the robot")
            .then_some(())
    });
    let mut changed = console.robot;
    changed.process.kill();
    let _changed = robot(
        &console.files,
        &DESCRIBED
            .replace("most: 90", "most: 60")
            .replace("unit: N}", "unit: kN}"),
        changed.port,
    );
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn the_demo_has_a_console() {
    let _busy = busy();
    let files = Scratch::new();
    let demo = Process::start(ztl().args(["demo", "--web", "--port", "0"]));
    let line = demo.wait_for("console  at");
    let url = format!("http://127.0.0.1{}", from_port(&line));
    let gateway = port(&demo.wait_for("gateway  at"));
    demo.wait_for("The gateway goes on serving");
    let demo = Server {
        process: demo,
        port: gateway,
    };
    let mut command = node("driver.mjs");
    command.args(["demo", &url]).arg(files.path(""));
    let mut driver = Process::start(&mut command);
    // Its next task must still run when Stop is pressed.
    driver.wait_for("do: slow the gripper");
    demo.set_speed("gripper", "speed", 0.1);
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn a_press_without_an_answer_starts_nothing_more() {
    let _busy = busy();
    let console = Console::of_one();
    let mut driver = drive("impatient", &console.url, &console);
    driver.wait_for("do: suspend the console");
    console.process.signal("STOP");
    driver.write_line("done");
    driver.wait_for("do: continue the console");
    console.process.signal("CONT");
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    console.has_marks(1);
}

#[test]
fn a_component_that_vanishes_stays_chosen_and_nothing_else_is_started() {
    let _busy = busy();
    let console = Console::of_one();
    let files = Scratch::new();
    let mut second = robot(&files, ROBOT, reserve_port());
    let robots = [("ours", console.robot.port), ("second", second.port)];
    let (_process, url) = web(0, &robots, &[]);
    let mut driver = drive("gone", &url, &console);
    driver.wait_for("do: kill the second");
    second.process.kill();
    driver.write_line("done");
    driver.wait_for("do: start the second without mark");
    let without = ROBOT.replace("mark:", "other:");
    let mut changed = robot(&files, &without, second.port);
    driver.write_line("done");
    driver.wait_for("do: start the second with mark");
    changed.process.kill();
    let _back = robot(&files, ROBOT, second.port);
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    has_marks(&files, 1);
    console.has_marks(0);
}

#[test]
fn each_goal_says_until_when_it_may_start_by_the_clock_of_the_console() {
    let _busy = busy();
    let console = Console::of_one();
    passes("deadline", &console.url, &console);
}

#[test]
fn streams_are_subscribed_to_while_a_page_shows_them() {
    let _busy = busy();
    let console = Console::of_one();
    let publisher = Publisher::bind("tcp://127.0.0.1:0", "/lab").expect("a publisher");
    let port = publisher.endpoint().rsplit(':').next().expect("a port");
    let options = ["--publisher", "lab", "127.0.0.1", port, "/lab"];
    let (_process, url) = web(0, &[("ours", console.robot.port)], &options);
    let mut driver = drive("streams", &url, &console);
    driver.wait_for("do: nobody listens");
    assert_eq!(publisher.subscribers(), 0);
    driver.write_line("done");
    let picture: Vec<u8> = (0..64 * 48 * 3).map(|at| (at % 251) as u8).collect();
    let picture = Pickle::array(DType::UINT8, &[48, 64, 3], &picture).expect("an array");
    let word = Pickle::text("<b>hostile</b>").expect("a text");
    let mut time = 0.0_f64;
    until("the page to close the streams", PATIENCE * 3, || {
        assert!(driver.stderr().is_empty(), "{}", driver.stderr());
        time += 0.1;
        let pose = [("x", time.sin()), ("y", time.cos())];
        let pose = pose.map(|(name, value)| (Pickle::text(name).expect("a name"), value));
        publisher.publish("/pose", &Pickle::dict(pose).expect("a dict"));
        publisher.publish("/word", &word);
        publisher.publish("/camera", &picture);
        (driver.stdout().matches("do: nobody listens").count() == 2).then_some(())
    });
    until("nobody to subscribe", PATIENCE, || {
        (publisher.subscribers() == 0).then_some(())
    });
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn tasks_that_have_ended_are_kept_for_every_page() {
    let _busy = busy();
    let console = Console::of_one();
    let mut driver = drive("past", &console.url, &console);
    driver.wait_for("do: start a task");
    client(&console, "test:echo:other").end(PATIENCE);
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn goals_that_were_kept_fill_in_the_form() {
    let _busy = busy();
    let console = Console::of_one();
    passes("ready", &console.url, &console);
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
    console.has_marks(1);
    console.robot.process.kill();
    driver.write_line("done");
    driver.wait_for("do: start the server");
    console.start_robot_again();
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    // Not started twice.
    console.has_marks(1);
}

#[test]
fn a_page_of_another_origin_gets_nothing() {
    let _busy = busy();
    let console = Console::of_one();
    passes("origin", &console.url, &console);
}

#[test]
fn a_watchers_link_becomes_a_cookie_and_its_page_looks_and_stops() {
    let _busy = busy();
    let console = Console::of_one();
    let robots = [("ours", console.robot.port)];
    let (_process, link) = web(0, &robots, &["--bind", "0.0.0.0"]);
    let url = format!("http://127.0.0.1{}", from_port(&link));
    let mut driver = drive("watcher", &url, &console);
    driver.wait_for("do: start a task");
    let _task = client(&console, "test:sleep:60");
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn a_page_without_its_link_says_how_to_come_in() {
    let _busy = busy();
    let console = Console::of_one();
    let port = reserve_port();
    let robots = [("ours", console.robot.port)];
    let options = ["--bind", "0.0.0.0", "--host", "localhost"];
    let (mut process, url) = web(port, &robots, &options);
    let mut driver = drive("locked", &url, &console);
    driver.wait_for("do: start the console again");
    process.kill();
    let _again = web(port, &robots, &options);
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn a_page_goes_on_when_a_console_with_kept_tokens_is_killed() {
    let _busy = busy();
    let mut console = Console::of_one();
    let tokens = console.files.path("tokens").display().to_string();
    let (port, robots) = (reserve_port(), [("ours", console.robot.port)]);
    let options = ["--host", "localhost", "--tokens", &tokens];
    let (process, _) = web(port, &robots, &options);
    let link = process.wait_for("operators:");
    let url = format!("http://localhost{}", from_port(&link));
    console.process = process;
    let mut driver = drive("returns", &url, &console);
    driver.wait_for("do: kill the console");
    console.process.kill();
    console.process = web(port, &robots, &options).0;
    assert_eq!(console.process.wait_for("operators:"), link);
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    console.has_marks(2);
}

#[test]
fn a_button_of_ones_own_page_starts_one_task_a_press() {
    let _busy = busy();
    let console = Console::of_one();
    let page = console.files.path("page.html");
    let form = "<form method=post><button name='test:mark' value='hello'>Go</button></form>";
    std::fs::write(
        &page,
        format!("<style>p {{ color: red }}</style><p>mine</p>{form}"),
    )
    .expect("a file");
    let robots = [("test", console.robot.port)];
    let (_process, url) = web(0, &robots, &["-s", &page.display().to_string()]);
    passes("own", &url, &console);
    console.has_marks(2);
}

#[test]
fn what_a_closed_page_started_is_aborted_if_it_has_chosen_so() {
    let _busy = busy();
    let console = Console::of_one();
    passes("closed", &console.url, &console);
}

#[test]
fn a_page_learns_what_became_of_its_goals_while_the_network_was_cut() {
    let _busy = busy();
    let console = Console::of_one();
    let mut driver = drive("cut", &console.url, &console);
    let line = driver.wait_for("do: abort");
    let id = line.trim().rsplit(' ').next().expect("an id");
    let port = console.robot.port.to_string();
    let aborted = Process::run(ztl().args(["abort", "-r", "127.0.0.1", "-p", &port, id]));
    assert_eq!(aborted.code, Some(0), "{aborted:?}");
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    console.has_marks(1);
}

#[test]
fn the_page_comes_over_tls() {
    let _busy = busy();
    let console = Console::of_one();
    let (certificate, key) = certificate_and_key(&console.files, "localhost");
    let options = [
        "--bind",
        "0.0.0.0",
        "--host",
        "localhost",
        "--tls",
        &certificate,
        &key,
    ];
    let (process, _) = web(0, &[("ours", console.robot.port)], &options);
    let link = process.wait_for("operators:");
    assert!(link.contains("https://localhost:"), "{link}");
    let url = format!("https://localhost{}", from_port(&link));
    passes("encrypted", &url, &console);
}
