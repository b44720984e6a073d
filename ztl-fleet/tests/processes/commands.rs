//! The commands that look at a fleet, and the end of those that serve it.

use std::io::Read as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;

use zenoh::Wait as _;
use zenoh::query::Query;
use ztl_fleet::caller::Caller;
use ztl_fleet::config::Links;
use ztl_fleet::session::{self, key};
use ztl_fleet::wire::{AgentQuery, Verdict};
use ztl_std::{ExecutableTask, State, TaskContext, TaskController, TaskError, TaskRequest};
use ztl_tests::lab::{
    ACCEPTED, Ended, OriginalClient, PATIENCE, Process, Scratch, Server, connect_to, end,
    reserve_port, serve, until, ztl,
};

use crate::requests::start;
use crate::{Fleet, fleet};

/// Ends a process by one signal.
#[track_caller]
fn ended(process: Process, signal: &str) -> Ended {
    process.signal(signal);
    process.end(PATIENCE)
}

#[test]
fn watch_tells_who_comes_and_what_starts_and_ends_and_abort_ends_a_task() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let file = fleet.scratch.path("endpoint.yaml");
    let text = std::fs::read_to_string(&file).unwrap();
    let watch = Process::start(&mut self::fleet(&["watch"], &file));
    watch.wait_for("arm  is not there");
    let agent = fleet.join(&server, "");
    watch.wait_for("arm  is there");
    let mut remote = fleet.client();
    let id = start(&mut remote, "nap", "for", "60");
    watch.wait_for(&format!("{id}  /arm/test  started  nap:for:60"));
    let listed = Process::run(&mut self::fleet(&["ps"], &file)).stdout;
    assert!(
        listed.contains(&format!("{id}  /arm/test  nap:for:60")),
        "{listed}"
    );
    let abort = |scope: &str, id: &str| {
        let mut abort = self::fleet(&["abort"], &file);
        Process::run(abort.args([scope, id]))
    };
    let aborted = abort("arm/test", &id.to_string());
    assert_eq!(aborted.code, Some(0), "{aborted:?}");
    assert!(aborted.stdout.contains("ABORTED"), "{aborted:?}");
    assert_eq!(end(&mut remote, id).0, State::Aborted);
    watch.wait_for(&format!("{id}  /arm/test  ABORTED"));
    // A task that is quicker than a look.
    let id = start(&mut remote, "nap", "for", "0");
    watch.wait_for(&format!("{id}  /arm/test  COMPLETED"));
    for (scope, id, told) in [
        ("arm/test", "7", "unknown: Invalid ID '7'"),
        ("leg/test", "7", "robot 'leg' is not there; there are: arm"),
        ("arm", "7", "'arm' is not the scope of a robot"),
        (
            "\u{1b}[2J\nforged",
            "7",
            "'\\u001b[2J\\nforged' is not the scope of a robot",
        ),
    ] {
        let ended = abort(scope, id);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        let said = format!("{}{}", ended.stdout, ended.stderr);
        assert!(said.contains(told), "{ended:?}");
    }
    // A group that is misspelled is not a group that has stopped.
    std::fs::write(&file, text.replace("robots: [arm, leg]\n", "")).unwrap();
    let told = "no robot is known to belong to group 'flor'";
    // It asks for groups once, and a robot may be too late.
    until(told, PATIENCE, || {
        let stopped = Process::run(self::fleet(&["stop-all"], &file).args(["--group", "flor"]));
        assert_eq!(stopped.code, Some(1), "{stopped:?}");
        stopped.stderr.contains(told).then_some(())
    });
    let agent = ended(agent, "TERM");
    assert_eq!(agent.code, Some(143), "{agent:?}");
    let stopped = Process::run(&mut self::fleet(&["stop-all"], &file));
    assert_eq!(stopped.code, Some(1), "{stopped:?}");
    watch.wait_for("arm  is not there");
    let watch = ended(watch, "INT");
    assert_eq!(watch.code, Some(0), "{watch:?}");
}

/// Its server does not learn how its tasks end.
struct Lost;

impl TaskController for Lost {
    fn assign(&self, _: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        Ok(Box::new(|_: &TaskContext| -> Result<String, TaskError> {
            Err("unknown: the arm was restarted".into())
        }))
    }
}

#[test]
fn a_task_whose_end_the_robot_cannot_learn_may_still_run() {
    let (fleet, server) = (Fleet::new(), serve(Lost));
    let file = fleet.scratch.path("endpoint.yaml");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replace("[arm, leg]", "arm")).unwrap();
    let agent = fleet.agent_file("arm", server.endpoint(), "");
    let _agent = fleet.join_by(&mut self::fleet(&["join"], &agent));
    let mut remote = fleet.client();
    let id = start(&mut remote, "arm", "up", "1");
    let said = |command: &str, words: &[&str]| {
        let ended = Process::run(self::fleet(&[command], &file).args(words));
        (ended.code, ended.stdout)
    };
    until("the end", PATIENCE, || {
        let told = said("ps", &[]);
        let line = format!("{id}  /arm/test  arm:up:1  unknown: the arm was restarted\n");
        (told == (Some(0), line)).then_some(())
    });
    let line = format!("{id}  /arm/test  may still run: unknown: the arm was restarted\n");
    let told = said("abort", &["arm/test", &id.to_string()]);
    assert_eq!(told, (Some(1), line));
    let line = format!(
        "arm  not confirmed: the server could not learn the end of /test {id}, so it may still run\n"
    );
    assert_eq!(said("stop-all", &[]), (Some(1), line));
}

#[test]
fn a_signal_ends_each_part_of_a_fleet_in_order() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let agent = fleet.join(&server, "");
    let agent = ended(agent, "INT");
    assert_eq!(agent.code, Some(0), "{agent:?}");
    assert!(agent.stderr.contains("Robot 'arm' leaves"), "{agent:?}");
    let endpoint = ended(fleet.endpoint, "TERM");
    assert_eq!(endpoint.code, Some(143), "{endpoint:?}");
    let router = ended(fleet.router, "TERM");
    assert_eq!(router.code, Some(143), "{router:?}");
}

/// The file of an endpoint, and of an agent, whose router does not run, and its address.
fn without_router(scratch: &Scratch) -> (PathBuf, PathBuf, String) {
    let address = format!("tcp/127.0.0.1:{}", reserve_port());
    let (endpoint, arm) = (scratch.path("endpoint.yaml"), scratch.path("arm.yaml"));
    let text = format!("port: 0\nrouters: {address}\nrobots: arm\n");
    std::fs::write(&endpoint, text).unwrap();
    let text = format!("name: arm\nserver: tcp://127.0.0.1:9\nrouters: {address}\n");
    std::fs::write(&arm, text).unwrap();
    (endpoint, arm, address)
}

#[test]
fn a_router_whose_port_is_taken_says_so() {
    let fleet = Fleet::new();
    let file = fleet.scratch.path("router.yaml");
    let ended = Process::run(&mut self::fleet(&["router"], &file));
    assert_eq!(ended.code, Some(1), "{ended:?}");
    let told = format!("cannot listen at {}: the port is in use", fleet.address);
    assert!(ended.stderr.contains(&told), "{ended:?}");
}

#[test]
fn a_command_that_reaches_no_router_says_so_and_fails() {
    let scratch = Scratch::new();
    let (file, _, address) = without_router(&scratch);
    let commands = [
        (&["stop-all"][..], &[][..]),
        (&["ls"], &[]),
        (&["abort"], &["arm/test", "7"]),
    ];
    let started = commands.map(|(words, more)| Process::start(fleet(words, &file).args(more)));
    for process in started {
        let ended = process.end(PATIENCE);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        let told = format!(
            "no router is reached within 5 s, so no robot was asked: {address}: Connection refused"
        );
        assert!(ended.stderr.contains(&told), "{ended:?}");
    }
}

#[test]
fn a_part_of_a_fleet_that_waits_for_a_router_says_so_and_a_signal_ends_it() {
    let scratch = Scratch::new();
    let (endpoint, arm, address) = without_router(&scratch);
    let started = [
        ("join", &arm),
        ("endpoint", &endpoint),
        ("watch", &endpoint),
    ]
    .map(|(word, file)| Process::start(&mut fleet(&[word], file)));
    let signals = [("TERM", 143), ("INT", 0), ("TERM", 143)];
    for (process, (signal, code)) in started.into_iter().zip(signals) {
        process.wait_for(&format!(
            "No router is reached yet; trying again. {address}: Connection refused"
        ));
        let ended = ended(process, signal);
        assert_eq!(ended.code, Some(code), "{ended:?}");
    }
}

/// The agent of robots that these tests make up.
const AGENT: &str = "0123456789abcdef0123456789abcdef";

/// A session at a router.
fn session(router: &str) -> zenoh::Session {
    let links = Links {
        routers: vec![router.to_owned()],
        ..Links::default()
    };
    session::open(&links).unwrap()
}

#[test]
fn a_robot_that_does_not_answer_delays_no_question_to_another() {
    let fleet = Fleet::new();
    let (robots, asker) = (session(&fleet.address), session(&fleet.address));
    let (again, is_asked_again) = channel();
    // It tells its clock first.
    let arm = robots.declare_queryable(key("arm", AGENT, "stop"));
    let stale = std::sync::Mutex::new(Some("stale: boot=7 clock=1"));
    let arm = arm.callback(move |query| match stale.lock().unwrap().take() {
        Some(stale) => query.reply_err(stale).wait().unwrap(),
        None => {
            query.reply(query.key_expr().clone(), "{}").wait().unwrap();
            again.send(()).unwrap();
        }
    });
    let _arm = arm.wait().unwrap();
    // It answers only after the other one was asked again.
    let leg = robots.declare_queryable(key("leg", AGENT, "stop")).wait();
    let leg = leg.unwrap();
    let answers = std::thread::spawn(move || {
        let query = leg.recv().unwrap();
        is_asked_again.recv_timeout(PATIENCE).unwrap();
        query.reply(query.key_expr().clone(), "{}").wait().unwrap();
    });
    // A question to a robot that is not known yet has no answer.
    let tokens = ["arm", "leg"].map(|robot| {
        let token = robots
            .liveliness()
            .declare_token(key(robot, AGENT, "alive"));
        token.wait().unwrap()
    });
    until("both are known", PATIENCE, || {
        let known = asker.liveliness().get(key("*", AGENT, "alive")).wait();
        (known.unwrap().iter().count() == tokens.len()).then_some(())
    });
    let agents = ["arm", "leg"].map(|robot| (robot.to_owned(), AGENT.to_owned()));
    let told = Caller::plain(asker).ask_all(&agents, AgentQuery::Stop, b"", 2 * PATIENCE);
    let answer = Some(Verdict::Answer(b"{}".to_vec()));
    assert_eq!(told, [answer.clone(), answer]);
    answers.join().unwrap();
}

/// Whether a thread of a process is about to write a line to its stdout.
fn writes(process: u32, line: &str) -> bool {
    let threads = std::fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let length = format!("{:#x}", line.len());
    threads.flatten().any(|thread| {
        // The call's number and arguments, or `running`.
        let call = std::fs::read_to_string(thread.path().join("syscall")).unwrap_or_default();
        let words: Vec<&str> = call.split(' ').collect();
        words.get(1) == Some(&"0x1") && words.get(3) == Some(&length.as_str())
    })
}

#[test]
fn robots_are_stopped_also_while_nobody_reads_the_output() {
    const STOPPED: &str = r#"{"boot":7,"stopped":[],"running":[],"unknown":null}"#;
    let scratch = Scratch::new();
    let address = format!("tcp/127.0.0.1:{}", reserve_port());
    let _router = Fleet::start_router(&scratch, &address);
    let (robots, other) = (session(&address), session(&address));
    let answer = |query: Query| query.reply(query.key_expr().clone(), STOPPED).wait();
    let arm = robots.declare_queryable(key("arm", AGENT, "stop"));
    let arm = arm.callback(move |query| answer(query).unwrap());
    let _arm = arm.wait().unwrap();
    let leg = robots.declare_queryable(key("leg", AGENT, "stop")).wait();
    let leg = leg.unwrap();
    let _tokens = ["arm", "leg"].map(|robot| {
        let token = robots
            .liveliness()
            .declare_token(key(robot, AGENT, "alive"));
        token.wait().unwrap()
    });
    until("both are there", PATIENCE, || {
        let present = session::present(&other, "*", PATIENCE).unwrap();
        (present.len() == 2).then_some(())
    });
    let file = scratch.path("endpoint.yaml");
    std::fs::write(
        &file,
        format!("port: 0\nrouters: {address}\nrobots: [arm, leg]\n"),
    )
    .unwrap();
    let mut stop_all = Command::new("sh");
    // The pipe is full then.
    let script = "head -c 65536 /dev/zero; exec \"$0\" stop-all \"$1\"";
    let words = ["-c", script, env!("CARGO_BIN_EXE_ztl-fleet")];
    let stop_all = stop_all.args(words).arg(file).stdout(Stdio::piped());
    let mut stop_all = stop_all.spawn().unwrap();
    let first = leg.recv_timeout(PATIENCE).unwrap();
    let lines = ["arm  stopped: 0 tasks\n", "leg  stopped: 0 tasks\n"];
    until("the output is stuck", PATIENCE, || {
        writes(stop_all.id(), lines[0]).then_some(())
    });
    // It tells its clock first, as robots with keys do.
    let first = first.expect("a question");
    first.reply_err("stale: boot=7 clock=1").wait().unwrap();
    drop(first);
    let second = leg.recv_timeout(PATIENCE).unwrap();
    answer(second.expect("another question")).unwrap();
    let mut told = String::new();
    let mut stdout = stop_all.stdout.take().unwrap();
    stdout.read_to_string(&mut told).unwrap();
    assert_eq!(told.trim_start_matches('\0'), lines.concat());
    assert_eq!(stop_all.wait().unwrap().code(), Some(0));
}

#[test]
fn stop_all_asks_nothing_before_it_stops() {
    let scratch = Scratch::new();
    let address = format!("tcp/127.0.0.1:{}", reserve_port());
    let _router = Fleet::start_router(&scratch, &address);
    let robot = session(&address);
    let asked = robot.declare_queryable(key("leg", AGENT, "*")).wait();
    let asked = asked.unwrap();
    let alive = robot.liveliness().declare_token(key("leg", AGENT, "alive"));
    let _alive = alive.wait().unwrap();
    let other = session(&address);
    until("the robot is there", PATIENCE, || {
        let present = session::present(&other, "*", PATIENCE).unwrap();
        (!present.is_empty()).then_some(())
    });
    let file = scratch.path("endpoint.yaml");
    std::fs::write(&file, format!("routers: {address}\n")).unwrap();
    let stop = Process::start(&mut fleet(&["stop-all"], &file));
    let query = asked.recv_timeout(PATIENCE).unwrap().expect("a query");
    assert_eq!(query.key_expr().as_str(), key("leg", AGENT, "stop"));
    let told = r#"{"stopped":[],"running":[],"unknown":null}"#;
    query.reply(query.key_expr().clone(), told).wait().unwrap();
    drop(query);
    let told = stop.end(PATIENCE).stdout;
    assert!(told.contains("leg  stopped: 0 tasks"), "{told}");
}

/// `ztl-fleet demo`, whose files are in the directory.
fn demo(scratch: &Scratch) -> Process {
    let mut demo = Command::new(env!("CARGO_BIN_EXE_ztl-fleet"));
    Process::start(demo.arg("demo").env("TMPDIR", scratch.path(".")))
}

#[track_caller]
fn assert_nothing_left(scratch: &Scratch) {
    let left = std::fs::read_dir(scratch.path(".")).unwrap().count();
    assert_eq!(left, 0);
}

#[test]
fn the_demo_shows_a_robot_that_is_cut_off_and_ends_what_it_started() {
    let scratch = Scratch::new();
    let demo = demo(&scratch).end(PATIENCE);
    assert_eq!(demo.code, Some(0), "{demo:?}");
    for told in [
        "arm-5  unknown: it is not reached",
        "arm-5  COMPLETED  waved",
        "Every task completed, and none ran twice.",
    ] {
        assert!(demo.stdout.contains(told), "{demo:?}");
    }
    assert_nothing_left(&scratch);
}

#[test]
fn a_signal_ends_the_demo_with_all_that_it_started() {
    let scratch = Scratch::new();
    for (signal, code) in [("INT", 130), ("TERM", 143)] {
        let demo = demo(&scratch);
        demo.wait_for("Initiated task");
        let ended = ended(demo, signal);
        assert_eq!(ended.code, Some(code), "{ended:?}");
        assert_nothing_left(&scratch);
    }
}

#[test]
fn a_task_that_needs_its_client_is_aborted_if_that_is_gone_and_not_if_it_is_the_originals() {
    let fleet = Fleet::new();
    let file = fleet.scratch.path("serve.yaml");
    let tasks = "{drive: {far: {built-in: sleep, needs-client: 2 s}}}";
    std::fs::write(&file, format!("port: 0\nscopes: {{/test: {tasks}}}\n")).unwrap();
    let server = Server::start(ztl().arg("serve").arg(&file));
    let _agent = fleet.join(&server, "");
    let mut original = OriginalClient::connect(fleet.port, "/arm/test");
    let id = original.start("drive", "far", "600");
    let gone = start(&mut fleet.client(), "drive", "far", "600");
    let mut direct = connect_to(&server.endpoint(), "/test");
    until("the task of a client that is gone", PATIENCE, || {
        let state = direct.status(gone).ok()?.state;
        (state == State::Aborted).then_some(())
    });
    assert_eq!(original.status(id).number, ACCEPTED);
}
