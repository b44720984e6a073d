//! Rules that hold whatever is wrong with a fleet: two machines that answer as one robot, strangers that ask everything, and
//! servers that fall silent.

use std::io::Write as _;
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::scope;
use std::time::{Duration, Instant};

use zenoh::Wait as _;
use ztl_core::Message;
use ztl_fleet::config::Links;
use ztl_fleet::session::{self, key};
use ztl_std::keys::KeyPair;
use ztl_std::relay::RelayClient;
use ztl_std::{RemoteTask, State, TriggerError};
use ztl_tests::lab::{
    Ended, PATIENCE, Process, Scratch, Server, connect_to, end, reserve_port, shake_hands, until,
};

use crate::busy::{Ends, Robot, on_wire};
use crate::requests::{TIMEOUT, client, start, status, trigger};
use crate::{Fleet, fleet, tasks};

/// Runs a command with the endpoint's file.
fn command(fleet: &Fleet, words: &[&str]) -> Ended {
    let file = fleet.scratch.path("endpoint.yaml");
    Process::run(self::fleet(&words[..1], &file).args(&words[1..]))
}

fn session(fleet: &Fleet) -> zenoh::Session {
    let links = Links {
        routers: vec![fleet.address.clone()],
        ..Links::default()
    };
    session::open(&links).unwrap()
}

/// Why a task is rejected.
#[track_caller]
fn rejection(remote: &mut RemoteTask) -> String {
    let told = trigger(remote, "nap", "for", "0");
    let reason = match &told {
        Err(TriggerError::Rejected { reason, .. }) => Some(reason.clone()),
        _ => None,
    };
    reason.unwrap_or_else(|| format!("{told:?}"))
}

/// Two machines that have the same name and id.
struct Twins {
    fleet: Fleet,
    servers: [Server; 2],
    agents: [Process; 2],
    _router: Process,
}

impl Twins {
    /// With these lines in the agents' files. The second one comes while the first one is cut off.
    fn new(fleet: Fleet, more: &str, more_of_the_second: &str) -> Self {
        let servers = [Server::naps(), Server::naps()];
        let first = fleet.join(&servers[0], more);
        first.signal("STOP");
        let (state, copy) = (fleet.scratch.path("arm"), fleet.scratch.path("copy"));
        std::fs::create_dir(&copy).unwrap();
        std::fs::copy(state.join("id"), copy.join("id")).unwrap();
        // It has a router of its own.
        let address = format!("tcp/127.0.0.1:{}", reserve_port());
        let file = fleet.scratch.path("router-2.yaml");
        let text = format!("listen: {address}\nrouters: {}\n", fleet.address);
        std::fs::write(&file, text).unwrap();
        let router = Process::start(&mut self::fleet(&["router"], &file));
        router.wait_for("Routing at");
        let file = fleet.agent_file("copy", &servers[1].endpoint(), more_of_the_second);
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, text.replace(&fleet.address, &address)).unwrap();
        let second = Process::start(&mut self::fleet(&["join"], &file));
        second.wait_for("has joined");
        first.signal("CONT");
        Self {
            fleet,
            servers,
            agents: [first, second],
            _router: router,
        }
    }

    /// A client of each server, which has a task.
    fn tasks(&self) -> [(RemoteTask, ztl_std::RemoteId); 2] {
        self.servers.each_ref().map(|server| {
            let mut remote = connect_to(&server.endpoint(), "/test");
            let id = start(&mut remote, "nap", "for", "60");
            (remote, id.into())
        })
    }

    /// `stop-all` stops both, and says that there are two.
    #[track_caller]
    fn assert_stopped(&self) {
        let running = self.tasks();
        let stopped = command(&self.fleet, &["stop-all"]);
        assert_eq!(stopped.code, Some(1), "{stopped:?}");
        let told = "arm  not confirmed: 2 machines have its name and id, and there may be more; \
                    stopped: 1 tasks; stopped: 1 tasks";
        assert!(stopped.stdout.contains(told), "{stopped:?}");
        for (mut remote, id) in running {
            assert_eq!(remote.status(id).unwrap().state, State::Aborted);
        }
    }

    /// A client's ABORTs reach whichever machine has the task. The client is not told so: the other one might have said it.
    #[track_caller]
    fn assert_aborted(&self) {
        let mut client = self.fleet.client();
        for (mut remote, id) in self.tasks() {
            until("it is aborted", PATIENCE, || {
                let told = client.abort(id.clone());
                assert!(told.is_err(), "{told:?}");
                let state = remote.status(id.clone()).unwrap().state;
                (state == State::Aborted).then_some(())
            });
        }
    }

    /// `stop-all` is not confirmed, since the second machine may move.
    #[track_caller]
    fn assert_missed(&self) {
        let stopped = command(&self.fleet, &["stop-all"]);
        assert_eq!(stopped.code, Some(1), "{stopped:?}");
        let told = "arm  not confirmed: an answer is missing";
        assert!(stopped.stdout.contains(told), "{stopped:?}");
    }

    /// The endpoint, the agents and `ls` tell it, and no INIT is sent.
    #[track_caller]
    fn assert_noticed(&self, told: &str) {
        self.fleet.endpoint.wait_for(told);
        for agent in &self.agents {
            agent.wait_for("Another agent has the name 'arm' and this one's key or id");
        }
        let listed = command(&self.fleet, &["ls"]);
        assert_eq!(listed.code, Some(1), "{listed:?}");
        assert!(
            listed.stdout.contains("arm  in doubt  several"),
            "{listed:?}"
        );
        let before = self.servers.each_ref().map(tasks);
        let told = "two machines answer as robot 'arm', so neither gets a task";
        assert_eq!(rejection(&mut self.fleet.client()), told);
        assert_eq!(self.servers.each_ref().map(tasks), before);
    }
}

#[test]
fn of_a_copied_directory_both_machines_are_stopped_and_neither_gets_a_task() {
    let twins = Twins::new(Fleet::new(), "", "");
    twins.assert_noticed("Two agents have the name and the id of robot 'arm'");
    twins.assert_aborted();
    twins.assert_stopped();
    // One that is silent may move as well.
    twins.agents[1].signal("STOP");
    twins.assert_missed();
    twins.agents[1].signal("CONT");
    // A third one does not join.
    let third = twins.fleet.scratch.path("third");
    std::fs::create_dir(&third).unwrap();
    let id = twins.fleet.scratch.path("arm").join("id");
    std::fs::copy(id, third.join("id")).unwrap();
    let third = twins.fleet.start_agent("third", &twins.servers[0], "");
    let third = third.end(PATIENCE);
    assert_eq!(third.code, Some(1), "{third:?}");
    assert!(third.stderr.contains("or its id"), "{third:?}");
    let told = "with a copy of this one's directory or key, and was refused";
    until("one of them tells it", PATIENCE, || {
        let mut agents = twins.agents.iter();
        agents.find(|agent| agent.stderr().contains(told)).map(drop)
    });
}

#[test]
fn of_a_copied_key_both_machines_are_stopped_and_neither_gets_a_task() {
    let scratch = Scratch::new();
    for name in ["arm", "desk"] {
        KeyPair::generate().write(&scratch.path(name)).unwrap();
    }
    let more = "fleet-key: desk.key_secret\nrobots: {arm: {key: arm.key}}\n";
    let fleet = Fleet::with(scratch, more);
    let keys = "fleet-key: arm.key_secret\nclient-keys: desk.key\n";
    let twins = Twins::new(fleet, keys, keys);
    twins.assert_noticed("Two agents have the key of robot 'arm'");
    twins.assert_aborted();
    twins.assert_stopped();
}

#[test]
fn a_copy_that_takes_no_stop_from_this_desk_is_not_taken_for_stopped() {
    let scratch = Scratch::new();
    for name in ["arm", "desk", "boss"] {
        KeyPair::generate().write(&scratch.path(name)).unwrap();
    }
    let more = "fleet-key: desk.key_secret\nrobots: {arm: {key: arm.key}}\n";
    let fleet = Fleet::with(scratch, more);
    let keys = |clients: &str| format!("fleet-key: arm.key_secret\nclient-keys: [{clients}]\n");
    let twins = Twins::new(fleet, &keys("desk.key"), &keys("boss.key"));
    twins.agents[0].wait_for("Another agent has the name 'arm' and this one's key or id");
    twins.assert_missed();
}

#[test]
fn stop_all_stops_a_robot_that_comes_meanwhile() {
    let fleet = Fleet::with(Scratch::new(), "robots: [arm, leg]\n");
    let (server, other) = (Server::naps(), Server::naps());
    let leg = fleet.agent_file("leg", &other.endpoint(), "");
    let text = std::fs::read_to_string(&leg).unwrap();
    std::fs::write(&leg, text.replace("name: arm", "name: leg")).unwrap();
    let leg = Process::start(&mut self::fleet(&["join"], &leg));
    leg.wait_for("has joined");
    let file = fleet.scratch.path("endpoint.yaml");
    let mut remote = connect_to(&server.endpoint(), "/test");
    let id = start(&mut remote, "nap", "for", "600");
    until("it is there soon enough", PATIENCE, || {
        let stopped = Process::start(&mut self::fleet(&["stop-all"], &file));
        // It has looked who is there.
        stopped.wait_for("leg  stopped");
        let agent = fleet.start_agent("arm", &server, "");
        let stopped = stopped.end(PATIENCE);
        agent.signal("TERM");
        agent.end(PATIENCE);
        stopped
            .stdout
            .contains("arm  stopped: 1 tasks")
            .then_some(())
    });
    assert_eq!(remote.status(id).unwrap().state, State::Aborted);
}

#[test]
fn who_asks_everything_at_once_stops_and_starts_nothing() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let agent = fleet.join(&server, "");
    let mut remote = fleet.client();
    let id = start(&mut remote, "nap", "for", "60");
    let stranger = session(&fleet);
    for asked in [
        "ztl/**",
        "ztl/*/*/stop",
        "ztl/arm/*/*?agent=0123456789abcdef0123456789abcdef",
    ] {
        let get = stranger.get(asked).payload("/test;3;7;").timeout(PATIENCE);
        let replies = get.wait().unwrap();
        let mut refused = 0;
        while let Ok(reply) = replies.recv() {
            let error = reply
                .result()
                .unwrap_err()
                .payload()
                .to_bytes()
                .into_owned();
            let error = String::from_utf8(error).unwrap();
            assert!(
                error.starts_with("not started: ask exactly ztl/arm/"),
                "{error}"
            );
            refused += 1;
        }
        assert!(refused > 0);
    }
    assert_eq!(status(&mut remote, id).state, State::Accepted);
    assert!(!agent.stderr().contains("stops all tasks"));
    let stopped = command(&fleet, &["stop-all"]);
    assert!(
        stopped.stdout.contains("arm  stopped: 1 tasks"),
        "{stopped:?}"
    );
    agent.wait_for("anybody stops all tasks");
    agent.wait_for("All tasks have ended: 1 were stopped");
}

#[test]
fn an_agent_refuses_digits_that_are_not_ascii() {
    // The original's server reads them.
    let (fleet, server) = (Fleet::new(), Server::original());
    let _agent = fleet.join(&server, "scopes: /test\n");
    let id = std::fs::read_to_string(fleet.scratch.path("arm").join("id")).unwrap();
    let stranger = session(&fleet);
    let client = server.original_client().start("test", "echo", "hi");
    for body in ["/test;\u{ff11};-1;dGVzdDplY2hvOmhp", "/test;3;\u{ff17};"] {
        let get = stranger.get(key("arm", &id, "request")).payload(body);
        let reply = get.timeout(PATIENCE).wait().unwrap().recv().unwrap();
        let told = reply
            .result()
            .unwrap_err()
            .payload()
            .to_bytes()
            .into_owned();
        let told = String::from_utf8(told).unwrap();
        assert_eq!(
            told,
            "not started: its state or its id is not a number of ASCII digits"
        );
    }
    // Nothing was started: its ids are consecutive.
    assert_eq!(
        server.original_client().start("test", "echo", "hi"),
        client + 1
    );
}

#[test]
fn who_asks_for_what_it_may_not_use_does_not_fill_the_log() {
    const TIMES: usize = 50;
    let scratch = Scratch::new();
    for name in ["arm", "desk"] {
        KeyPair::generate().write(&scratch.path(name)).unwrap();
    }
    let more = "fleet-key: desk.key_secret\nrobots: {arm: {key: arm.key}}\n";
    let (fleet, server) = (Fleet::with(scratch, more), Server::naps());
    let keys = "fleet-key: arm.key_secret\nclient-keys: /test=desk.key\n";
    let agent = fleet.join(&server, keys);
    let mut remote = client(fleet.port, "/arm/other");
    let begin = Instant::now();
    for _ in 0..TIMES {
        assert_eq!(
            rejection(&mut remote),
            "the robot's 'client-keys' do not allow this"
        );
    }
    let seconds = usize::try_from(begin.elapsed().as_secs()).unwrap();
    agent.wait_for("may not use scope");
    let lines = agent.stderr().matches("may not use scope").count();
    assert!((1..=seconds + 2).contains(&lines), "{lines}");
    assert!(seconds + 2 < TIMES, "it took {seconds} s");
}

#[test]
fn stop_all_tells_a_busy_robot_again_and_says_why_another_one_does_not_stop() {
    let scratch = Scratch::new();
    let address = format!("tcp/127.0.0.1:{}", reserve_port());
    let _router = Fleet::start_router(&scratch, &address);
    let links = Links {
        routers: vec![address.clone()],
        ..Links::default()
    };
    let robots = session::open(&links).unwrap();
    let agent = "0123456789abcdef0123456789abcdef";
    let busy = "unknown: too many requests are waiting, try again";
    let offer = |robot: &str, refusals: usize| {
        let asked = AtomicUsize::new(0);
        let queryable = robots.declare_queryable(key(robot, agent, "stop"));
        let queryable = queryable.callback(move |query| {
            if asked.fetch_add(1, Ordering::SeqCst) < refusals {
                query.reply_err(busy).wait().unwrap();
                return;
            }
            let told = r#"{"boot":7,"stopped":["/lab 4"],"running":[],"unknown":null}"#;
            query.reply(query.key_expr().clone(), told).wait().unwrap();
        });
        let alive = key(robot, agent, "alive");
        let alive = robots.liveliness().declare_token(alive);
        (queryable.wait().unwrap(), alive.wait().unwrap())
    };
    let _offered = [offer("arm", usize::MAX), offer("leg", 2)];
    let file = scratch.path("endpoint.yaml");
    let text = format!("routers: {address}\nrobots: [arm, leg]\n");
    std::fs::write(&file, text).unwrap();
    let stopped = Process::start(&mut fleet(&["stop-all"], &file));
    // It is printed while the other one is told again.
    stopped.wait_for("leg  stopped: 1 tasks");
    assert!(!stopped.stdout().contains("arm"), "{}", stopped.stdout());
    let stopped = stopped.end(PATIENCE);
    assert_eq!(stopped.code, Some(1), "{stopped:?}");
    let told = "arm  not confirmed: too many requests are waiting, try again";
    assert!(stopped.stdout.contains(told), "{stopped:?}");
}

#[test]
fn stop_all_without_a_key_says_why_a_robot_with_one_does_not_answer() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    for name in ["arm", "desk"] {
        let keys = KeyPair::generate();
        keys.write(&fleet.scratch.path(name)).unwrap();
    }
    let keys = "fleet-key: arm.key_secret\nclient-keys: [desk.key]\n";
    let agent = fleet.start_agent("arm", &server, keys);
    agent.wait_for("has joined");
    let stopped = command(&fleet, &["stop-all"]);
    assert_eq!(stopped.code, Some(1), "{stopped:?}");
    let told = "arm  not reached: nobody answers there; a robot with a fleet-key";
    assert!(stopped.stdout.contains(told), "{stopped:?}");
}

#[test]
fn aborts_of_many_connections_that_nobody_answers_keep_no_stop_all_out() {
    let (fleet, robot) = (Fleet::new(), Robot::new());
    let file = fleet.agent_file("arm", &robot.endpoint, "scopes: /test\n");
    let (waiting, ends) = (AtomicUsize::new(0), AtomicBool::new(false));
    let mut floods = [(); 3].map(|()| shake_hands(fleet.port));
    scope(|threads| {
        threads.spawn(|| {
            while let Some(request) = robot.next() {
                let body = request.body.as_deref().unwrap();
                let message = Message::parse(body).unwrap();
                let answer = match (message.scope, message.payload) {
                    ("$ztl", "tasks") => "$ztl;5;0;{\"tasks\": []}",
                    ("$ztl", _) => "$ztl;2;-1;No controller for scope: $ztl",
                    (_, "other") => "/test;4;7;True",
                    _ => {
                        waiting.fetch_add(1, Ordering::SeqCst);
                        continue;
                    }
                };
                robot.answers.send(request.path, answer.as_bytes().to_vec());
            }
        });
        let _agent = fleet.join_by(&mut self::fleet(&["join"], &file));
        let flood = Ends(&ends);
        threads.spawn(|| {
            let abort = on_wire("/arm/test;3;8;").repeat(100);
            while !ends.load(Ordering::SeqCst) {
                for flood in &mut floods {
                    // An endpoint that takes no more of it is no reason to wait.
                    flood
                        .set_write_timeout(Some(Duration::from_secs(1)))
                        .unwrap();
                    let _ = flood.write_all(&abort);
                }
                std::thread::sleep(Duration::from_millis(200));
            }
        });
        until("the robot has its share of the flood", PATIENCE, || {
            (waiting.load(Ordering::SeqCst) >= 90).then_some(())
        });
        let endpoint = format!("tcp://127.0.0.1:{}", fleet.port);
        let other = RelayClient::new(&endpoint, None).unwrap();
        // On a busy machine, one may be too late.
        let told = until("an answer to an ABORT", PATIENCE, || {
            other.ask(None, b"/arm/test;3;7;other", TIMEOUT).ok()
        });
        let stopped = command(&fleet, &["stop-all"]);
        drop(flood);
        robot.answers.stop();
        assert_eq!(told, b"/arm/test;4;7;True");
        assert!(
            stopped.stdout.contains("arm  stopped: 0 tasks"),
            "{stopped:?}"
        );
    });
}

#[test]
fn a_server_that_falls_silent_has_not_stopped_what_it_was_running() {
    let (fleet, robot) = (Fleet::new(), Robot::new());
    let file = fleet.agent_file("arm", &robot.endpoint, "scopes: /test\n");
    scope(|threads| {
        threads.spawn(|| {
            let mut listed = false;
            while let Some(request) = robot.next() {
                let body = request.body.as_deref().unwrap();
                let message = Message::parse(body).unwrap();
                let answer = match (message.scope, message.payload) {
                    ("$ztl", "probe") if !listed => "$ztl;2;-1;No controller for scope: $ztl",
                    ("$ztl", "tasks") if !listed => {
                        listed = true;
                        r#"$ztl;5;0;{"tasks": [{"id": 7, "scope": "/test", "state": 1}]}"#
                    }
                    _ => continue,
                };
                robot.answers.send(request.path, answer.as_bytes().to_vec());
            }
        });
        let agent = Process::start(&mut self::fleet(&["join"], &file));
        agent.wait_for("Ready");
        let stopped = command(&fleet, &["stop-all"]);
        robot.answers.stop();
        assert_eq!(stopped.code, Some(1), "{stopped:?}");
        let told = "arm  still running: /test 7; the robot's server does not answer";
        assert!(stopped.stdout.contains(told), "{stopped:?}");
        agent.wait_for("0 tasks were stopped, and these still run: /test 7");
    });
}

#[test]
fn an_init_for_a_robot_whose_server_does_not_run_is_rejected_at_once() {
    let fleet = Fleet::new();
    let server = format!("tcp://127.0.0.1:{}", reserve_port());
    let file = fleet.agent_file("arm", &server, "scopes: /test\n");
    let agent = fleet.join_by(&mut self::fleet(&["join"], &file));
    agent.wait_for("Not ready: the robot's server is not connected");
    let mut remote = fleet.client();
    for _ in 0..2 {
        assert_eq!(
            rejection(&mut remote),
            "the robot's server is not connected"
        );
    }
}

#[test]
fn an_agent_whose_log_cannot_be_written_goes_on() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let file = fleet.agent_file("arm", &server.endpoint(), "");
    let mut agent = Command::new("sh");
    let unwritten = "exec \"$0\" join \"$1\" 2>/dev/full";
    agent.args(["-c", unwritten, env!("CARGO_BIN_EXE_ztl-fleet")]);
    let _agent = Process::start(agent.arg(file));
    fleet.wait_there();
    let mut remote = fleet.client();
    let id = start(&mut remote, "nap", "for", "0");
    assert_eq!(end(&mut remote, id).0, State::Completed);
}

#[test]
fn what_is_not_there_is_told_with_what_is() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let _agent = fleet.join(&server, "groups: [floor-1, lab]\n");
    let listed = command(&fleet, &["ls"]).stdout;
    assert!(listed.contains("  in floor-1, lab\n"), "{listed}");
    let shown = command(&fleet, &["ps"]);
    assert_eq!(shown.stdout, "leg  unknown: it is not there\n");
    for words in [
        &["ls", "--group", "flor"][..],
        &["stop-all", "--group", "flor"],
    ] {
        let note = "no robot is known to belong to group 'flor'; there are: floor-1, lab\n";
        // It asks for groups once, and a robot may be too late.
        let told = until(note, PATIENCE, || {
            let told = command(&fleet, words);
            assert_eq!(told.code, Some(1), "{told:?}");
            told.stdout.starts_with(note).then_some(told)
        });
        assert!(!told.stdout.contains("arm"), "{told:?}");
    }
    let file = fleet.scratch.path("endpoint.yaml");
    let watch = Process::start(self::fleet(&["watch"], &file).args(["--group", "flor"]));
    watch.wait_for("no robot is known to belong to group 'flor'; there are: floor-1, lab");
    let abort = |scope: &str, id: &str| {
        let mut abort = self::fleet(&["abort"], &file);
        Process::run(abort.args([scope, id]))
    };
    let told = "robot 'arm' has no scope '/tset'; it has: /test";
    until(told, PATIENCE, || {
        let aborted = abort("arm/tset", "7");
        assert_eq!(aborted.code, Some(1), "{aborted:?}");
        aborted.stderr.contains(told).then_some(())
    });
    let mut remote = fleet.client();
    let id = start(&mut remote, "nap", "for", "60");
    let aborted = abort("arm/test", &id.to_string());
    assert_eq!(
        aborted.stdout,
        format!("{id}  /arm/test  ABORTED: it has stopped\n")
    );
    let aborted = abort("arm/test", &id.to_string());
    assert!(aborted.stdout.contains("ABORTED"), "{aborted:?}");

    // Without robots in the file, nobody knows who is missing.
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replace("robots: [arm, leg]\n", "")).unwrap();
    let stopped = command(&fleet, &["stop-all"]);
    assert_eq!(stopped.code, Some(1), "{stopped:?}");
    let told = "arm  stopped: 0 tasks\nothers  unknown: the file names no 'robots'";
    assert!(stopped.stdout.starts_with(told), "{stopped:?}");
}
