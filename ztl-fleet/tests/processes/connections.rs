//! Routers that are not reached, that say nothing, that are lost and that come back.

use std::collections::BTreeSet;
use std::net::TcpListener;
use std::process::Stdio;
use std::sync::Mutex;
use std::time::Duration;

use serde_json::json;
use zenoh::Wait as _;
use zenoh::query::Query;
use ztl_fleet::config::Links;
use ztl_fleet::seal::agent_of;
use ztl_fleet::session::{self, key};
use ztl_std::State;
use ztl_std::keys::KeyPair;
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, reserve_port, until};

use crate::line::{Line, Mode};
use crate::requests::{start, status};
use crate::{Fleet, fleet, kill};

/// A router's address where connections are accepted and nothing is said.
fn mute() -> (TcpListener, String) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp/{}", listener.local_addr().unwrap());
    (listener, address)
}

/// A router's address where nothing listens.
fn nowhere() -> String {
    format!("tcp/127.0.0.1:{}", reserve_port())
}

#[test]
fn routers_are_tried_in_turn_also_after_one_that_says_nothing() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let (_mute, mute) = mute();
    let routers = format!("[{}, {mute}, {}]", nowhere(), fleet.address);
    let file = fleet.agent_file("arm", &server.endpoint(), "");
    let text = std::fs::read_to_string(&file).unwrap();
    let text = text.replace(&fleet.address, &routers);
    std::fs::write(&file, text).unwrap();
    let agent = Process::start(&mut self::fleet(&["join"], &file));
    agent.wait_for("has joined");
    let file = fleet.scratch.path("look.yaml");
    std::fs::write(&file, format!("routers: {routers}\nrobots: arm\n")).unwrap();
    for (command, told) in [
        ("ls", "arm  ready  /test"),
        ("ps", ""),
        ("stop-all", "arm  stopped: 0 tasks"),
    ] {
        let ended = Process::run(&mut self::fleet(&[command], &file));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(ended.stdout.starts_with(told), "{ended:?}");
    }
}

#[test]
fn a_router_behind_a_slow_line_is_reached() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let line = Line::to(&fleet.address);
    // Four messages have to pass.
    line.set(Mode::Slow(Duration::from_secs(1)));
    let file = fleet.agent_file("arm", &server.endpoint(), "");
    let text = std::fs::read_to_string(&file).unwrap();
    let text = text.replace(&fleet.address, &line.address);
    std::fs::write(&file, text).unwrap();
    let agent = Process::start(&mut self::fleet(&["join"], &file));
    agent.wait_for("has joined");
}

#[test]
fn zenoh_warns_only_if_the_environment_asks_for_it() {
    let scratch = Scratch::new();
    let file = scratch.path("look.yaml");
    std::fs::write(&file, format!("routers: {}\n", nowhere())).unwrap();
    let look = |log: &str| {
        let ended = Process::run(fleet(&["ls"], &file).env("RUST_LOG", log));
        assert_eq!(ended.code, Some(1), "{ended:?}");
        ended.stderr
    };
    let told = look("");
    assert!(
        told.starts_with("ztl-fleet: no router is reached"),
        "{told}"
    );
    assert_eq!(told.lines().count(), 1, "{told}");
    let told = look("zenoh=warn");
    assert!(told.contains("WARN zenoh"), "{told}");
}

#[test]
fn an_agent_and_an_endpoint_tell_that_their_router_is_lost_and_is_there_again() {
    let (mut fleet, server) = (Fleet::new(), Server::naps());
    let agent = fleet.join(&server, "");
    kill(fleet.router);
    let lost = format!(
        "No router is connected any more; trying again: {}",
        fleet.address
    );
    for part in [&agent, &fleet.endpoint] {
        part.wait_for(&lost);
    }
    fleet.router = Fleet::start_router(&fleet.scratch, &fleet.address);
    for part in [&agent, &fleet.endpoint] {
        part.wait_for("A router is connected again");
        assert_eq!(part.stderr().matches(&lost).count(), 1);
    }
}

#[test]
fn a_router_tells_which_routers_it_waits_for_and_when_they_are_there() {
    let scratch = Scratch::new();
    let [own, far] = [nowhere(), nowhere()];
    let file = scratch.path("near.yaml");
    std::fs::write(&file, format!("listen: {own}\nrouters: [{far}, {own}]\n")).unwrap();
    let near = Process::start(&mut fleet(&["router"], &file));
    near.wait_for(&format!(
        "No router is reached yet; trying again. {far}: Connection refused"
    ));
    near.wait_for(&format!("{own} in 'routers' is this router itself"));
    let other = Fleet::start_router(&scratch, &far);
    near.wait_for(&format!("Router {far} is connected."));
    kill(other);
    near.wait_for(&format!("Router {far} is not connected any more"));
    let _other = Fleet::start_router(&scratch, &far);
    let told = format!("Router {far} is connected.");
    until("it tells that the router is there again", PATIENCE, || {
        (near.stderr().matches(&told).count() == 2).then_some(())
    });
}

/// Waits until the router tells others that a robot is there.
#[track_caller]
fn wait_there(links: &Links) {
    let other = session::open(links).unwrap();
    until("the robot is there", PATIENCE, || {
        let present = session::present(&other, "*", PATIENCE).unwrap();
        (!present.is_empty()).then_some(())
    });
}

fn links_to(router: &str) -> Links {
    Links {
        routers: vec![router.to_owned()],
        ..Links::default()
    }
}

#[test]
fn a_list_asks_a_robot_again_whose_questions_are_lost() {
    let scratch = Scratch::new();
    let address = nowhere();
    let _router = Fleet::start_router(&scratch, &address);
    let links = links_to(&address);
    let agent = agent_of(&KeyPair::generate().public());
    let asked = Mutex::new(BTreeSet::new());
    let info = json!({"ztl_fleet": 1, "name": "arm", "agent": agent, "boot": 1, "clock_ms": 1, "since": 1, "ready": true, "scopes": ["/test"]});
    // Each question is lost once.
    let answer = move |query: Query| {
        let body = query.payload().map(|body| body.to_bytes().into_owned());
        let body = String::from_utf8(body.unwrap_or_default()).unwrap();
        let what = (query.key_expr().to_string(), body);
        let answer = match &*what.1 {
            body if body.ends_with("tasks") => r#"$ztl;5;0;{"tasks": [], "more": 0}"#.to_owned(),
            body if body.ends_with("probe") => {
                r#"$ztl;5;0;{ztl: 1, version: "1", boot: 7, message: 1000, scopes: {"/test": {}}, running: {5: "/test"}}"#.to_owned()
            }
            _ => info.to_string(),
        };
        if !asked.lock().unwrap().insert(what) {
            query.reply(query.key_expr(), answer).wait().unwrap();
        }
    };
    let robot = session::open(&links).unwrap();
    let asked = robot.declare_queryable(key("arm", &agent, "*"));
    let _asked = asked.callback(answer).wait().unwrap();
    let alive = robot.liveliness();
    let alive = alive.declare_token(key("arm", &agent, "alive"));
    let _alive = alive.wait().unwrap();
    wait_there(&links);
    let file = scratch.path("endpoint.yaml");
    std::fs::write(&file, format!("routers: {address}\n")).unwrap();
    let listed = Process::run(&mut fleet(&["ls"], &file));
    assert_eq!(listed.code, Some(0), "{listed:?}");
    assert!(listed.stdout.starts_with("arm  ready  /test"), "{listed:?}");
    let listed = Process::run(&mut fleet(&["ps"], &file));
    assert_eq!(listed.code, Some(0), "{listed:?}");
    assert!(listed.stdout.starts_with("5  /arm/test"), "{listed:?}");
}

#[test]
fn a_robot_that_is_late_does_not_refuse_a_request() {
    let scratch = Scratch::new();
    let address = nowhere();
    let _router = Fleet::start_router(&scratch, &address);
    let links = links_to(&address);
    let robot = session::open(&links).unwrap();
    let [arm, _] = ["arm", "desk"].map(|name| {
        let pair = KeyPair::generate();
        pair.write(&scratch.path(name)).unwrap();
        pair
    });
    let agent = agent_of(&arm.public());
    let asked = robot.declare_queryable(key("arm", &agent, "sealed")).wait();
    let _asked = asked.unwrap();
    let alive = robot
        .liveliness()
        .declare_token(key("arm", &agent, "alive"));
    let _alive = alive.wait().unwrap();
    wait_there(&links);
    let file = scratch.path("endpoint.yaml");
    let keys = "fleet-key: desk.key_secret\nrobots: {arm: {key: arm.key}}\n";
    std::fs::write(&file, format!("routers: {address}\n{keys}")).unwrap();
    let listed = Process::run(&mut fleet(&["ls"], &file));
    assert!(listed.stdout.contains("arm  does not answer"), "{listed:?}");
    let told = "Robot 'arm' does not answer a request.";
    assert!(listed.stderr.contains(told), "{listed:?}");
    assert!(!listed.stderr.contains("refuses"), "{listed:?}");
}

#[test]
fn a_command_whose_output_nobody_reads_ends_quietly_and_stops_all_the_same() {
    let (fleet, server) = (Fleet::new(), Server::naps());
    let _agent = fleet.join(&server, "");
    let mut remote = fleet.client();
    let id = start(&mut remote, "nap", "for", "60");
    let file = fleet.scratch.path("endpoint.yaml");
    for command in ["ls", "ps", "stop-all"] {
        let mut command = self::fleet(&[command], &file);
        let mut child = command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(child.stdout.take());
        let ended = child.wait_with_output().unwrap();
        assert_eq!(ended.status.code(), Some(1), "{ended:?}");
        assert!(ended.stderr.is_empty(), "{ended:?}");
    }
    assert_eq!(status(&mut remote, id).state, State::Aborted);
}
