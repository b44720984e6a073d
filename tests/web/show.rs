//! The show: the scenes of a script, played by `ztl web --script`.

use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use ztl_std::{ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest};
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, busy, port_of, serve, until, ztl};

use crate::client::Client;
use crate::console::{Console, node, port, web};

const SCRIPT: &str = "\
first:
  wait a little: {test(remote=ours): {sleep: 1}}
  mark: {test(remote=ours): {mark: one}}
second:
  mark: {test(remote=ours): {mark: two}}
quick (operator_gone=stop 5):
  sleep: {test(remote=ours): {sleep: 61}}
cues:
  hold (key=h): {test(remote=ours): {mark: cue}}
  leave (key=l, operator_gone=stop 5): {test(remote=ours): {sleep: 62}}
  say (key=s): {test(remote=ours): {echo: hello}}
";

/// A console that plays a script.
struct Stage {
    console: Console,
    process: Process,
    url: String,
}

impl Stage {
    fn new(script: &str, options: &[&str]) -> Self {
        Self::on(Console::of_one(), script, options)
    }

    /// On the robot of a console.
    fn on(console: Console, script: &str, options: &[&str]) -> Self {
        let path = console.files.path("show.yaml");
        fs::write(&path, script).expect("a file");
        let path = path.display().to_string();
        let options: Vec<&str> = [&["--script", &path], options].concat();
        let (process, url) = web(0, &[("ours", console.robot.port)], &options);
        Self {
            console,
            process,
            url,
        }
    }

    /// A client that hears of the show.
    fn client(&self) -> Client {
        let mut client = Client::open(port(&self.url));
        client.subscribe("/ztl/show");
        client
    }
}

/// The number of the open question about a scene.
pub(crate) fn asked(client: &mut Client, scene: usize) -> Value {
    asked_after(client, scene, &Value::Null)
}

/// The same of a question that came after another one.
fn asked_after(client: &mut Client, scene: usize, before: &Value) -> Value {
    let fits = |show: &Value| {
        let question = &show["question"];
        let is_later = question["number"].as_u64() > before.as_u64();
        is_later && question["about"] == "scene" && show["scene"] == scene
    };
    client.topic("/ztl/show", fits)["question"]["number"].take()
}

/// The answer to a command: whether it was carried out, and the text.
pub(crate) fn command(client: &mut Client, command: &str, question: &Value) -> (bool, String) {
    let args = json!({ "do": command, "question": question });
    told(client, "/ztl/show/command", &args)
}

fn told(client: &mut Client, service: &str, args: &Value) -> (bool, String) {
    client.ask("it", service, args);
    let answer = client.answer("it");
    (answer["result"] == true, answer["values"].to_string())
}

/// Waits until a task runs. `test:mark` has left its mark then.
fn runs(client: &mut Client, name: &str) {
    client.subscribe("/ztl/tasks");
    let begun = |task: &Value| !name.starts_with("test:mark") || task["text"] == "begun";
    client.task(|task| task["runs"] == true && task["task"] == name && begun(task));
}

/// Whether a list of tasks has this one.
fn is(list: &Value, name: &str, state: &str) -> bool {
    let tasks = list["tasks"].as_array().expect("a list");
    let is = |task: &Value| task["task"] == name && task["state"] == state;
    tasks.iter().any(is)
}

#[test]
fn no_step_starts_after_stop_and_the_show_stays() {
    let _busy = busy();
    // The first step must still run when Stop is pressed.
    let stage = Stage::new(&SCRIPT.replace("{sleep: 1}", "{sleep: 5}"), &[]);
    let mut client = stage.client();
    let question = asked(&mut client, 0);
    assert!(command(&mut client, "start", &question).0);
    client.subscribe("/ztl/tasks");
    let by = |task: &Value| task["task"] == "test:sleep:5" && task["by"] == "the show";
    client.task(by);
    let stopped = client.call("/ztl/stop", &json!({}));
    assert_eq!(stopped["robots"][0]["confirmed"], true, "{stopped}");
    // The next step would have begun when the first has ended.
    let question = asked_after(&mut client, 0, &question);
    let show = client.call("/ztl/show", &json!({}));
    assert_eq!(show["plays"], false);
    assert_eq!(show["scenes"][0]["state"], "stopped");
    stage.console.has_marks(0);
    // It can go on, and nothing of before comes later.
    assert!(command(&mut client, "start", &question).0);
    runs(&mut client, "test:mark:one");
    stage.console.has_marks(1);
    let stopped = client.call("/ztl/stop", &json!({}));
    assert_eq!(stopped["robots"][0]["confirmed"], true, "{stopped}");
}

/// A robot with short tasks, which counts them.
#[derive(Clone, Default)]
struct Short(Arc<AtomicUsize>);

impl TaskController for Short {
    fn assign(&self, _: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        self.0.fetch_add(1, Ordering::SeqCst);
        Ok(Box::new(|context: &TaskContext| {
            let slept = context.sleep(Duration::from_millis(5));
            slept.map(|()| String::new()).map_err(TaskError::from)
        }))
    }
}

#[test]
fn a_stop_at_any_moment_of_a_fast_scene_is_the_end_of_it() {
    let _busy = busy();
    let robot = Short::default();
    let server = serve(robot.clone());
    let files = Scratch::new();
    let mut script = "fast:\n".to_owned();
    for step in 0..300 {
        script += &format!("  step {step}: {{test(remote=ours): {{a: 1, b: 2}}}}\n");
    }
    let path = files.path("show.yaml");
    fs::write(&path, script).expect("a file");
    let path = path.display().to_string();
    let robots = [("ours", port_of(server.endpoint()))];
    let (_console, url) = web(0, &robots, &["--script", &path]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/show");
    let mut question = asked(&mut client, 0);
    for round in 0..8 {
        let before = robot.0.load(Ordering::SeqCst);
        assert!(command(&mut client, "start", &question).0, "{round}");
        until("some steps", PATIENCE, || {
            (robot.0.load(Ordering::SeqCst) > before + round).then_some(())
        });
        let stopped = client.call("/ztl/stop", &json!({}));
        let given = robot.0.load(Ordering::SeqCst);
        assert_eq!(stopped["robots"][0]["confirmed"], true, "{stopped}");
        question = asked_after(&mut client, 0, &question);
        assert_eq!(robot.0.load(Ordering::SeqCst), given, "{round}");
        assert!(given < before + 600, "the scene was over");
    }
}

#[test]
fn impatient_presses_play_a_scene_or_a_cue_once() {
    let _busy = busy();
    let stage = Stage::new(SCRIPT, &[]);
    let mut client = stage.client();
    let question = asked(&mut client, 0);
    let jump = json!({ "do": "jump", "scene": 1, "question": question });
    assert!(told(&mut client, "/ztl/show/command", &jump).0);
    // What is played is what is shown: the answer to the earlier question plays nothing.
    assert!(!command(&mut client, "start", &question).0);
    let question = asked(&mut client, 1);
    let start = json!({ "do": "start", "question": question });
    for id in ["one", "two", "three"] {
        client.ask(id, "/ztl/show/command", &start);
    }
    let done = ["one", "two", "three"].map(|id| client.answer(id)["result"] == true);
    assert_eq!(done, [true, false, false]);
    runs(&mut client, "test:mark:two");
    // A held key, and a press of a page that has connected again.
    let hold = json!({ "cue": 0 });
    for id in ["one", "two", "three"] {
        client.ask(id, "/ztl/show/cue", &hold);
    }
    let done = ["one", "two", "three"].map(|id| client.answer(id)["result"] == true);
    assert_eq!(done, [true, false, false]);
    runs(&mut client, "test:mark:cue");
    drop(client);
    let mut client = stage.client();
    client.call("/ztl/operate", &json!({}));
    assert!(!told(&mut client, "/ztl/show/cue", &hold).0);
    assert!(!command(&mut client, "start", &question).0);
    stage.console.has_marks(2);
    // The scene stops, the cue goes on.
    assert!(told(&mut client, "/ztl/show/stop_scene", &json!({})).0);
    asked_after(&mut client, 1, &question);
    client.subscribe("/ztl/tasks");
    let tasks = client.topic("/ztl/tasks", |list| is(list, "test:mark:two", "ABORTED"));
    assert!(is(&tasks, "test:mark:cue", "ACCEPTED"), "{tasks}");
}

#[test]
fn what_must_not_go_on_without_an_operator_is_stopped() {
    let _busy = busy();
    let stage = Stage::new(SCRIPT, &[]);
    let mut watcher = stage.client();
    let mut operator = stage.client();
    let question = asked(&mut operator, 0);
    let jump = json!({ "do": "jump", "scene": 2, "question": question });
    assert!(told(&mut operator, "/ztl/show/command", &jump).0);
    let question = asked(&mut operator, 2);
    assert!(command(&mut operator, "start", &question).0);
    assert!(told(&mut operator, "/ztl/show/cue", &json!({ "cue": 0 })).0);
    assert!(told(&mut operator, "/ztl/show/cue", &json!({ "cue": 1 })).0);
    runs(&mut operator, "test:sleep:61");
    runs(&mut operator, "test:sleep:62");
    runs(&mut operator, "test:mark:cue");
    let (refused, why) = told(&mut watcher, "/ztl/show/cue", &json!({ "cue": 2 }));
    assert!(!refused && why.contains("operates"), "{why}");
    drop(operator);
    let gone = Instant::now();
    watcher.subscribe("/ztl/tasks");
    let tasks = watcher.topic("/ztl/tasks", |list| {
        is(list, "test:sleep:61", "ABORTED") && is(list, "test:sleep:62", "ABORTED")
    });
    assert!(is(&tasks, "test:mark:cue", "ACCEPTED"), "{tasks}");
    assert!(gone.elapsed() >= Duration::from_secs(4), "{gone:?}");
    let scene = |show: &Value| {
        is_given_up(show)
            && show["question"]["about"] == "scene"
            && show["scenes"][2]["state"] == "stopped"
    };
    watcher.topic("/ztl/show", scene);
}

#[test]
fn a_page_that_hangs_does_not_operate_and_one_with_slow_timers_does() {
    let _busy = busy();
    let stage = Stage::new(SCRIPT, &[]);
    let directory = stage.console.files.path("");
    let mut command = node("driver.mjs");
    let mut driver = Process::start(command.args(["hangs", &stage.url]).arg(directory));
    let mut watcher = stage.client();
    driver.wait_for("do: look: slow");
    // Longer than the 5 s that the scene may play without an operator: it must not stop.
    std::thread::sleep(Duration::from_secs(8));
    assert_eq!(watcher.call("/ztl/show", &json!({}))["plays"], true);
    driver.write_line("done");
    driver.wait_for("do: look: hangs");
    watcher.topic("/ztl/show", |show| {
        show["plays"] == false && is_given_up(show)
    });
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

/// Whether a note says that nobody operates.
fn is_given_up(show: &Value) -> bool {
    show["notes"].to_string().contains("nobody operates for")
}

#[test]
fn a_press_that_reaches_the_show_too_late_does_nothing() {
    let _busy = busy();
    let stage = Stage::new(SCRIPT, &[]);
    let mut client = stage.client();
    let question = asked(&mut client, 0);
    let not_after = client.now_ms() + 500;
    stage.process.signal("STOP");
    let start = json!({ "do": "start", "question": question, "not_after_ms": not_after });
    client.ask("scene", "/ztl/show/command", &start);
    let cue = json!({ "cue": 0, "not_after_ms": not_after });
    client.ask("cue", "/ztl/show/cue", &cue);
    // Until the time of both is over.
    std::thread::sleep(Duration::from_secs(1));
    stage.process.signal("CONT");
    for id in ["scene", "cue"] {
        let answer = client.answer(id);
        let why = answer["values"].as_str().unwrap_or_default();
        assert!(why.contains("too late"), "{answer}");
    }
    let show = client.call("/ztl/show", &json!({}));
    assert_eq!(show["plays"], false, "{show}");
    stage.console.has_marks(0);
}

#[test]
fn what_a_hanging_robot_starts_later_is_aborted_and_nothing_starts_twice() {
    let _busy = busy();
    let stage = Stage::new(SCRIPT, &[]);
    let mut client = stage.client();
    asked(&mut client, 0);
    client.subscribe("/ztl/tasks");
    // The show has a connection.
    assert!(told(&mut client, "/ztl/show/cue", &json!({ "cue": 2 })).0);
    client.topic("/ztl/tasks", |list| {
        is(list, "test:echo:hello", "COMPLETED")
    });
    let robot = &stage.console.robot.process;
    robot.signal("STOP");
    let hold = json!({ "cue": 0 });
    assert!(told(&mut client, "/ztl/show/cue", &hold).0);
    // A start that is answered later than 10 s after the press is aborted. After 12 s a new connection is tried, too.
    std::thread::sleep(Duration::from_secs(14));
    let pressed = told(&mut client, "/ztl/show/cue", &hold);
    let stopped = client.call("/ztl/stop", &json!({}));
    robot.signal("CONT");
    assert_eq!(stopped["robots"][0]["confirmed"], false, "{stopped}");
    assert!(!pressed.0, "the INIT was sent: {pressed:?}");
    let held = |list: &Value, runs: bool| -> Vec<Value> {
        let tasks = list["tasks"].as_array().expect("a list").iter();
        let held = tasks.filter(|task| task["task"] == "test:mark:cue" && task["runs"] == runs);
        held.map(|task| task["id"].clone()).collect()
    };
    let late = until("the cue to be free", PATIENCE, || {
        let tasks = client.call("/ztl/tasks", &json!({}));
        let is_free = held(&tasks, true).is_empty();
        if is_free && told(&mut client, "/ztl/show/cue", &hold).0 {
            return Some(held(&tasks, false));
        }
        std::thread::sleep(Duration::from_millis(700));
        None
    });
    // Now it runs once, and what started late does not.
    let running = |list: &Value| held(list, true);
    let is_new = |list: &Value| running(list).iter().any(|id| !late.contains(id));
    let tasks = client.topic("/ztl/tasks", is_new);
    assert_eq!(running(&tasks).len(), 1, "{tasks}");
}

#[test]
fn a_cue_that_a_killed_console_started_is_not_started_again() {
    let _busy = busy();
    let mut stage = Stage::new(SCRIPT, &[]);
    let mut client = stage.client();
    let hold = json!({ "cue": 0 });
    assert!(told(&mut client, "/ztl/show/cue", &hold).0);
    runs(&mut client, "test:mark:cue");
    stage.process.kill();
    let Stage { console, .. } = stage;
    let stage = Stage::on(console, SCRIPT, &[]);
    let mut client = stage.client();
    runs(&mut client, "test:mark:cue");
    let (done, why) = told(&mut client, "/ztl/show/cue", &hold);
    assert!(
        !done && why.contains("test:mark:cue still runs from before"),
        "{why}"
    );
    client.call("/ztl/stop", &json!({}));
    until("the cue to be free", PATIENCE, || {
        // A press within 0.6 s of another counts as the same.
        std::thread::sleep(Duration::from_millis(700));
        told(&mut client, "/ztl/show/cue", &hold).0.then_some(())
    });
    runs(&mut client, "test:mark:cue");
    stage.console.has_marks(2);
}

#[test]
fn missing_robots_are_shown_and_a_killed_console_leaves_a_record_with_cues_and_notes() {
    let _busy = busy();
    let files = Scratch::new();
    let record = files.path("run.jsonl").display().to_string();
    let gone = ["--task", "gone", "127.0.0.1", "1", "/test"];
    let options = [&["--record", &record], &gone[..]].concat();
    let script = format!("far: {{far: {{test(remote=gone): {{echo: 1}}}}}}\n{SCRIPT}");
    let mut stage = Stage::new(&script, &options);
    let mut client = stage.client();
    // Before the first scene.
    let is_missing = |show: &Value| {
        let servers = show["servers"].as_array().expect("a list");
        let missing = |server: &Value| server["name"] == "gone" && server["state"] == "missing";
        servers.iter().any(missing)
    };
    client.topic("/ztl/show", is_missing);
    let note = json!({ "text": "the <left> arm hesitates" });
    assert!(told(&mut client, "/ztl/show/note", &note).0);
    assert!(told(&mut client, "/ztl/show/cue", &json!({ "cue": 2 })).0);
    let noted = |show: &Value| show["notes"].to_string().contains("hesitates");
    client.topic("/ztl/show", noted);
    let said = |show: &Value| show["cues"][2]["tasks"][0]["state"] == "completed";
    client.topic("/ztl/show", said);
    stage.process.kill();
    let page = files.path("page.html").display().to_string();
    let report = Process::run(ztl().args(["report", &record, "-o", &page]));
    assert_eq!(report.code, Some(0), "{report:?}");
    let page = fs::read_to_string(page).expect("a page");
    assert!(page.contains("the &lt;left&gt; arm hesitates"), "no note");
    assert!(
        page.contains("cue &#39;say&#39;: test:echo:hello")
            || page.contains("cue 'say': test:echo:hello"),
        "no cue"
    );
}

#[test]
fn a_broken_script_is_not_served_and_ctrl_c_aborts_the_tasks_of_the_show() {
    let _busy = busy();
    let stage = Stage::new(SCRIPT, &[]);
    let path = stage.console.files.path("broken.yaml");
    fs::write(
        &path,
        "one: {a: {test: {echo: 1}}}\ncues: {x(key=long): {test: {echo: 1}}}\n",
    )
    .expect("a file");
    let mut broken = ztl();
    broken.args([
        "web",
        "-c",
        "/dev/null",
        "-p",
        "0",
        "--task",
        "test",
        "127.0.0.1",
        "1",
        "/test",
        "--script",
    ]);
    let ended = Process::run(broken.arg(&path));
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended
            .stderr
            .contains("broken.yaml:2:14: 'long' is not a key of a cue"),
        "{ended:?}"
    );
    assert!(!ended.stdout.contains("://"), "{ended:?}");
    let mut client = stage.client();
    asked(&mut client, 0);
    assert!(told(&mut client, "/ztl/show/cue", &json!({ "cue": 0 })).0);
    runs(&mut client, "test:mark:cue");
    let Stage {
        process, console, ..
    } = stage;
    process.signal("INT");
    let ended = process.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let port = console.robot.port.to_string();
    let listed = Process::run(ztl().args(["ps", "-r", "127.0.0.1", "-p", &port]));
    assert!(!listed.stdout.contains("test:mark:cue"), "{listed:?}");
}

#[test]
fn the_page_plays_the_show_on_a_phone_a_tablet_and_a_desk() {
    let _busy = busy();
    let ask = "ask_whether_a_name_that_is_wider_than_the_button_of_a_phone_can_be_read_to_its_very_end:\n  far (on_failure=ask): {test(remote=gone): {echo: 1}}\ncues:";
    let script = SCRIPT.replace("cues:", ask);
    let stage = Stage::new(&script, &[]);
    let directory = stage.console.files.path("");
    let mut command = node("driver.mjs");
    let driver = Process::start(command.args(["show", &stage.url]).arg(directory));
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

/// A robot whose `test:flaky` fails the first time, and whose `test:held` runs until there is a file.
const FLAKY: &str = "\
scopes:
  /test:
    test:
      echo: echo
      held: {shell: 'until test -e released; do sleep 0.1; done'}
      flaky: {shell: 'test -e tried || { touch tried; exit 1; }'}
";

#[test]
fn a_task_of_the_original_without_progress_has_no_text() {
    let robot = Server::original_with_patient_tasks();
    let files = Scratch::new();
    let path = files.path("show.yaml");
    let script = "one: {nap: {nap(remote=ours): {for: x}}}\n";
    fs::write(&path, script).expect("a file");
    let path = path.display().to_string();
    let (_console, url) = web(0, &[("ours", robot.port)], &["--script", &path]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/show");
    let question = asked(&mut client, 0);
    assert!(command(&mut client, "start", &question).0);
    // The answer to the INIT has a text, those to STATUS have none.
    client.topic("/ztl/show", |show| {
        let task = &show["steps"][0]["tasks"][0];
        task["state"] == "accepted" && task["text"] == ""
    });
}

#[test]
fn each_command_of_the_show_works_by_a_tap() {
    let _busy = busy();
    let script = "\
skipped:
  never: {test(remote=ours): {echo: no}}
played:
  wait a little: {test(remote=ours): {held: 1}}
  say: {test(remote=ours): {echo: said}}
flaky:
  try (on_failure=ask): {test(remote=ours): {flaky: 1}}
";
    let stage = Stage::on(Console::of(FLAKY), script, &[]);
    let directory = stage.console.files.path("");
    let mut command = node("driver.mjs");
    let driver = Process::start(command.args(["commands", &stage.url]).arg(directory));
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn a_scene_that_is_stopped_and_played_again_on_a_robot_that_hangs_runs_once() {
    let _busy = busy();
    let stage = Stage::new(SCRIPT, &[]);
    let directory = stage.console.files.path("");
    let mut command = node("driver.mjs");
    let mut driver = Process::start(command.args(["stuck", &stage.url]).arg(directory));
    driver.wait_for("do: suspend the robot");
    stage.console.robot.process.signal("STOP");
    driver.write_line("done");
    driver.wait_for("do: continue the robot");
    stage.console.robot.process.signal("CONT");
    driver.write_line("done");
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
    stage.console.has_marks(2);
}
