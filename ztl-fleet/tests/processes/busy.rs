//! Agents under load: with a full disk, with more requests than they take, and with requests that are held at the robot.

use std::io::Write as _;
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::thread::scope;
use std::time::{Duration, Instant};

use ztl_core::Message;
use ztl_core::envelope::{ClientId, Envelope};
use ztl_std::relay::{RelayAnswers, RelayClient, RelayServer, RelayedRequest};
use ztl_std::server::{Access, Limits};
use ztl_std::{State, TriggerError};
use ztl_tests::lab::{PATIENCE, Process, Server, connect_to, end, in_time, shake_hands, until};

use crate::requests::{TIMEOUT, start, trigger};
use crate::{Fleet, fleet, kill, tasks};

/// A request takes no longer, whatever others wait for.
const SOON: Duration = Duration::from_millis(500);

/// A robot's server whose requests the test answers, in the middle of its threads.
pub(crate) struct Robot {
    pub(crate) endpoint: String,
    pub(crate) answers: RelayAnswers,
    requests: Mutex<Receiver<RelayedRequest>>,
}

impl Robot {
    pub(crate) fn new() -> Self {
        let limits = Limits::default();
        let server = RelayServer::bind("tcp://127.0.0.1:*", Access::everybody(), limits).unwrap();
        let (sender, requests) = channel();
        let robot = Self {
            endpoint: server.endpoint().to_owned(),
            answers: server.answers(),
            requests: Mutex::new(requests),
        };
        std::thread::spawn(move || {
            // The test may have ended.
            server.listen(|request| drop(sender.send(request)))
        });
        robot
    }

    pub(crate) fn next(&self) -> Option<RelayedRequest> {
        let requests = self.requests.lock().unwrap();
        requests.recv_timeout(PATIENCE).ok()
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        self.answers.stop();
    }
}

/// The code of a request.
fn code(request: &RelayedRequest) -> &str {
    let body = str::from_utf8(request.body.as_deref().unwrap()).unwrap();
    Message::parse(body.as_bytes()).unwrap().state
}

#[test]
fn an_init_that_a_full_disk_does_not_take_starts_nothing_also_after_a_restart() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let agent_file = fleet.agent_file("arm", &server.endpoint(), "");
    // A limit for its files has the same effect as a full disk: two blocks of 512 bytes, or of 1024.
    let limited = "trap '' XFSZ; ulimit -f 2; exec \"$0\" join \"$1\"";
    let mut limited = {
        let mut command = Command::new("sh");
        command.args(["-c", limited, env!("CARGO_BIN_EXE_ztl-fleet")]);
        command.arg(&agent_file);
        command
    };
    let agent = fleet.join_by(&mut limited);
    let mut started = 0;
    let reason = loop {
        // Of each client, an agent keeps the last INIT.
        match trigger(&mut fleet.client(), "nap", "for", "60") {
            Ok(_) => started += 1,
            Err(TriggerError::Rejected { reason, .. }) => break reason,
            Err(other) => panic!("{other:?}"),
        }
        assert!(started < 100, "its journal has room");
    };
    assert_eq!(reason, "the journal of the robot's agent cannot be written");
    assert_eq!((started > 0, tasks(&server)), (true, started));
    // What runs can be ended.
    let file = fleet.scratch.path("endpoint.yaml");
    let stopped = Process::run(&mut self::fleet(&["stop-all"], &file)).stdout;
    assert!(
        stopped.contains(&format!("arm  stopped: {started} tasks")),
        "{stopped}"
    );
    kill(agent);
    // It starts again, although it cannot write its journal anew: that has more than a block.
    let limited = "trap '' XFSZ; ulimit -f 1; exec \"$0\" join \"$1\"";
    let mut limited = {
        let mut command = Command::new("sh");
        command.args(["-c", limited, env!("CARGO_BIN_EXE_ztl-fleet")]);
        command.arg(&agent_file);
        command
    };
    let agent = fleet.join_by(&mut limited);
    agent.wait_for("The journal cannot be written, so no task starts until it can");
    assert!(fleet.client().trigger("nap", "for", "60").is_err());
    kill(agent);
    let _agent = fleet.join(&server, "");
    // It does not know who was told so, and may repeat the INIT.
    match trigger(&mut fleet.client(), "nap", "for", "60") {
        Err(TriggerError::Rejected { reason, .. }) => {
            let told = "the journal of the robot's agent could not be written before its restart";
            assert!(reason.starts_with(told), "{reason}");
        }
        other => panic!("{other:?}"),
    }
    assert_eq!(tasks(&server), started);
}

#[test]
fn a_flood_of_requests_that_wait_holds_up_neither_an_abort_nor_stop_all() {
    let (fleet, robot) = (Fleet::new(), Robot::new());
    let file = fleet.agent_file("arm", &robot.endpoint, "scopes: /test\n");
    let ends = AtomicBool::new(false);
    let waiting = AtomicUsize::new(0);
    let endpoint = format!("tcp://127.0.0.1:{}", fleet.port);
    let client = || RelayClient::new(&endpoint, None).unwrap();
    scope(|threads| {
        // A server that never answers a STATUS.
        threads.spawn(|| {
            while let Some(request) = robot.next() {
                let body = request.body.as_deref().unwrap();
                let message = Message::parse(body).unwrap();
                match (message.scope, message.state) {
                    ("$ztl", _) => {
                        let answer = match message.payload {
                            "tasks" => "$ztl;5;0;{\"tasks\": []}",
                            _ => "$ztl;2;-1;No controller for scope: $ztl",
                        };
                        robot.answers.send(request.path, answer.as_bytes().to_vec());
                    }
                    (_, "3") => robot.answers.send(request.path, b"/test;4;7;".to_vec()),
                    _ => drop(waiting.fetch_add(1, Ordering::SeqCst)),
                }
            }
        });
        let _agent = fleet.join_by(&mut self::fleet(&["join"], &file));
        let flood = Ends(&ends);
        for _ in 0..200 {
            threads.spawn(|| {
                let client = client();
                while !ends.load(Ordering::SeqCst) {
                    let _ = client.ask(None, b"/arm/test;2;7;", TIMEOUT);
                }
            });
        }
        until(
            "the agent has all the requests that it takes",
            PATIENCE,
            || (waiting.load(Ordering::SeqCst) >= 128).then_some(()),
        );
        // On a busy machine, one may be too late.
        let told = until("an answer to an ABORT", PATIENCE, || {
            client().ask(None, b"/arm/test;3;7;", TIMEOUT).ok()
        });
        let file = fleet.scratch.path("endpoint.yaml");
        let stopped = Process::run(&mut self::fleet(&["stop-all"], &file)).stdout;
        drop(flood);
        robot.answers.stop();
        assert_eq!(told, b"/arm/test;4;7;");
        assert!(stopped.contains("arm  stopped: 0 tasks\n"), "{stopped}");
    });
}

/// What a client without an envelope sends.
pub(crate) fn on_wire(body: &str) -> Vec<u8> {
    let length = u8::try_from(body.len()).unwrap();
    [&[1, 0, 0, length], body.as_bytes()].concat()
}

/// Ends a flood, also if the test fails.
pub(crate) struct Ends<'a>(pub(crate) &'a AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

#[test]
fn a_client_with_1000_requests_that_nobody_answers_delays_no_other_client() {
    /// STATUSes and ABORTs that it may have under way.
    const SHARE: usize = 64 + 64;
    let (fleet, robot) = (Fleet::new(), Robot::new());
    let file = fleet.agent_file("arm", &robot.endpoint, "scopes: /test\n");
    let endpoint = format!("tcp://127.0.0.1:{}", fleet.port);
    let client = || RelayClient::new(&endpoint, None).unwrap();
    let (waiting, ends) = (AtomicUsize::new(0), AtomicBool::new(false));
    let mut flooding = shake_hands(fleet.port);
    scope(|threads| {
        // A server that never answers a request about task 8.
        threads.spawn(|| {
            while let Some(request) = robot.next() {
                let body = request.body.as_deref().unwrap();
                let message = Message::parse(body).unwrap();
                let answer = match (message.scope, message.state, message.id) {
                    (_, _, "8") => {
                        waiting.fetch_add(1, Ordering::SeqCst);
                        continue;
                    }
                    ("$ztl", ..) => "$ztl;2;-1;No controller for scope: $ztl".to_owned(),
                    (_, "1", _) => "/test;1;7;".to_owned(),
                    (_, state, _) => format!("/test;{};7;", if state == "2" { 1 } else { 4 }),
                };
                robot.answers.send(request.path, answer.into_bytes());
            }
        });
        let _agent = fleet.join_by(&mut self::fleet(&["join"], &file));
        let flood = Ends(&ends);
        threads.spawn(|| {
            let request = [
                on_wire("/arm/test;2;8;"),
                on_wire("/arm/test;3;8;"),
                on_wire("/leg/test;2;8;"),
                on_wire("$ztl;2;-1;probe"),
            ];
            while !ends.load(Ordering::SeqCst) {
                flooding
                    .write_all(&request[..2].concat().repeat(500))
                    .unwrap();
                flooding.write_all(&request.concat()).unwrap();
                std::thread::sleep(Duration::from_millis(200));
            }
        });
        until("the robot has its share of the flood", PATIENCE, || {
            (waiting.load(Ordering::SeqCst) >= SHARE).then_some(())
        });
        let other = client();
        let told = [
            "/arm/test;3;7;",
            "/arm/test;2;7;",
            "/arm/test;1;-1;",
            "/arm/test;3;7;",
        ];
        let told = told.map(|body| in_time(SOON, || other.ask(None, body.as_bytes(), TIMEOUT)));
        drop(flood);
        robot.answers.stop();
        let expected = [4, 1, 1, 4];
        let expected = expected.map(|state| Ok(format!("/arm/test;{state};7;").into_bytes()));
        assert_eq!(told, expected);
    });
}

#[test]
fn a_status_is_held_at_the_robot_until_its_task_ends() {
    const HELD: Duration = Duration::from_millis(1500);
    let (fleet, robot, server) = (Fleet::new(), Robot::new(), Server::naps());
    let file = fleet.agent_file("arm", &robot.endpoint, "");
    let asked = AtomicUsize::new(0);
    let (arrived, arrival) = channel();
    scope(|threads| {
        // The robot's server, with somebody on its line who counts.
        threads.spawn(|| {
            scope(|each| {
                while let Some(request) = robot.next() {
                    let is_held = request.body.as_deref().unwrap().ends_with(b";wait 1500");
                    if is_held {
                        assert_eq!(code(&request), "2");
                        asked.fetch_add(1, Ordering::SeqCst);
                        let _ = arrived.send(());
                    }
                    let (server, answers) = (server.endpoint(), robot.answers.clone());
                    each.spawn(move || {
                        let server = RelayClient::new(&server, None).unwrap();
                        let body = request.body.unwrap();
                        if let Ok(answer) = server.ask(request.envelope, &body, PATIENCE) {
                            answers.send(request.path, answer);
                        }
                    });
                }
            });
        });
        let _agent = fleet.join_by(&mut self::fleet(&["join"], &file));
        let mut remote = fleet.client();
        let id = start(&mut remote, "nap", "for", "60");
        let endpoint = format!("tcp://127.0.0.1:{}", fleet.port);
        let held = threads.spawn(move || {
            let client = RelayClient::new(&endpoint, None).unwrap();
            let body = format!("/arm/test;2;{id};wait 60000");
            // Silence is possible on a machine that is too busy.
            let (mut times, mut silent) = (0_usize, 0);
            loop {
                times += 1;
                let envelope = Some(Envelope {
                    client: ClientId([7; 16]),
                    number: times as u64,
                    early_end: false,
                });
                let sent = Instant::now();
                let Ok(answer) = client.ask(envelope, body.as_bytes(), TIMEOUT) else {
                    silent += 1;
                    continue;
                };
                let state = Message::parse(&answer).unwrap().state.to_owned();
                if state == "1" {
                    assert!(sent.elapsed() >= HELD);
                    continue;
                }
                return (state, times, silent);
            }
        });
        arrival.recv_timeout(PATIENCE).unwrap();
        // Time itself is tested here: whoever is not held is answered in much less.
        std::thread::sleep(HELD / 5);
        connect_to(&server.endpoint(), "/test").abort(id).unwrap();
        let (state, times, silent) = held.join().unwrap();
        assert_eq!(state, State::Aborted.code().to_string());
        // Nobody asks the robot more often than its client asks.
        assert!(silent > 0 || asked.load(Ordering::SeqCst) == times);
        assert_eq!(end(&mut remote, id).0, State::Aborted);
        robot.answers.stop();
    });
}
