//! Robots with keys, against programs that claim to be them, answer for them or repeat what was said to them.

use ztl_fleet::seal::agent_of;
use ztl_std::keys::KeyPair;
use ztl_std::{RemoteTask, State, TriggerError};
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, connect_to, end, until, ztl};

use crate::requests::{TIMEOUT, abort, start, status, trigger};
use crate::{Fleet, fleet, python, tasks};

/// A fleet whose robot `arm` has a key.
struct Guarded {
    fleet: Fleet,
    server: Server,
    agent: Process,
    arm: KeyPair,
    desk: KeyPair,
}

const ARM: &str = "fleet-key: arm.key_secret\nclient-keys: desk.key\n";

/// Keys in the directory.
fn keys<const N: usize>(scratch: &Scratch, names: [&str; N]) -> [KeyPair; N] {
    names.map(|name| {
        let pair = KeyPair::generate();
        pair.write(&scratch.path(name)).unwrap();
        pair
    })
}

/// Starts somebody hostile who answers for the agent.
fn hostile(fleet: &Fleet, agent: &str) -> Process {
    let args = [fleet.address.as_str(), "arm", agent];
    let hostile = Process::start(&mut python("hostile.py", &args));
    hostile.wait_for("Hostile");
    // Its claims are many, so that they take a moment to arrive.
    hostile.wait_for("Recording");
    hostile
}

impl Guarded {
    /// `robot` and `endpoint` are lines of the files.
    fn new(robot: &str, endpoint: &str) -> Self {
        let scratch = Scratch::new();
        let [arm, desk, _, _] = keys(&scratch, ["arm", "desk", "other", "anna"]);
        let more =
            format!("fleet-key: desk.key_secret\nrobots: {{arm: {{key: arm.key}}}}\n{endpoint}");
        let (fleet, server) = (Fleet::with(scratch, &more), Server::naps());
        let agent = fleet.start_agent("arm", &server, robot);
        agent.wait_for("has joined");
        Self {
            fleet,
            server,
            agent,
            arm,
            desk,
        }
    }

    fn client(&self) -> RemoteTask {
        self.fleet.wait_there();
        self.fleet.client()
    }
}

#[test]
fn neither_a_forged_name_nor_an_answer_for_another_nor_a_recording_does_anything() {
    let guarded = Guarded::new(ARM, "");
    let agent = agent_of(&guarded.arm.public());
    let mut hostile = hostile(&guarded.fleet, &agent);
    // The endpoint meets the hostile one first, and believes the robot only.
    let mut remote = guarded.client();
    let aborted = start(&mut remote, "nap", "for", "60");
    abort(&mut remote, aborted);
    assert_eq!(end(&mut remote, aborted).0, State::Aborted);
    let file = guarded.fleet.scratch.path("endpoint.yaml");
    start(&mut remote, "nap", "for", "61");
    let stopped = Process::run(&mut fleet(&["stop-all"], &file));
    assert_eq!(stopped.code, Some(0), "{stopped:?}");
    assert!(
        stopped.stdout.contains("arm  stopped: 1 tasks"),
        "{stopped:?}"
    );
    let running = start(&mut remote, "nap", "for", "62");

    hostile.write_line("again");
    hostile.wait_for("replayed");
    assert_eq!(status(&mut remote, running).state, State::Accepted);
    assert_eq!(tasks(&guarded.server), 3);
    assert!(!hostile.stdout().contains("asked"), "{}", hostile.stdout());
    let told = guarded.fleet.endpoint.stderr();
    assert!(told.contains("does not have its key"), "{told}");
    assert!(told.contains("which belongs to the key of agent"), "{told}");
    // Nor does the robot answer anybody without a key.
    let args = [guarded.fleet.address.as_str(), "arm", "/test", "nap:for:0"];
    let client = Process::run(&mut python("client.py", &args));
    assert_ne!(client.code, Some(0));
    assert_eq!(tasks(&guarded.server), 3);
}

#[test]
fn a_second_robot_with_another_key_is_never_asked_and_both_are_told() {
    let guarded = Guarded::new(ARM, "");
    guarded.fleet.wait_there();
    let other = Server::naps();
    let more = "fleet-key: other.key_secret\nclient-keys: desk.key\n";
    let second = guarded.fleet.start_agent("second", &other, more);
    second.wait_for("refuses the other");
    guarded.agent.wait_for("refuses the other");
    let file = guarded.fleet.scratch.path("endpoint.yaml");
    let listed = Process::run(&mut fleet(&["ls"], &file)).stdout;
    assert!(listed.contains("arm  refused  agent"), "{listed}");
    assert!(listed.contains("arm  ready  /test"), "{listed}");
    // Also when it is the only one.
    drop(guarded.agent);
    let mut remote = guarded.fleet.client();
    until("the robot is gone", PATIENCE, || {
        let refused = remote.trigger("nap", "for", "0");
        matches!(refused, Err(TriggerError::Rejected { reason, .. }) if reason == "robot 'arm' is not connected")
            .then_some(())
    });
    assert_eq!(tasks(&other), 0);
}

#[test]
fn a_copy_of_a_robot_with_its_key_does_not_join() {
    let guarded = Guarded::new(ARM, "");
    // The router knows it then.
    guarded.fleet.wait_there();
    let copy = guarded.fleet.start_agent("copy", &guarded.server, ARM);
    let copy = copy.end(PATIENCE);
    assert_eq!(copy.code, Some(1), "{copy:?}");
    let told = "another agent has the name and the key of robot 'arm'";
    assert!(copy.stderr.contains(told), "{copy:?}");
    let mut remote = guarded.client();
    let id = start(&mut remote, "nap", "for", "0");
    assert_eq!(end(&mut remote, id).0, State::Completed);
}

#[test]
fn a_copy_that_comes_while_the_robot_is_cut_off_is_noticed_and_neither_is_used() {
    let guarded = Guarded::new(ARM, "");
    let mut remote = guarded.client();
    guarded.agent.signal("STOP");
    let copy = Server::naps();
    let agent = guarded.fleet.start_agent("copy", &copy, ARM);
    agent.wait_for("has joined");
    guarded.agent.signal("CONT");
    let told = "Two agents have the key of robot 'arm'";
    guarded.fleet.endpoint.wait_for(told);
    assert!(remote.trigger("nap", "for", "0").is_err());
    assert_eq!((tasks(&guarded.server), tasks(&copy)), (0, 0));
}

#[test]
fn rules_of_the_robot_and_of_the_endpoint_name_robot_scope_and_client() {
    let robot = "fleet-key: arm.key_secret\nclient-keys: /test=desk.key\n";
    let endpoint = "key: desk.key_secret\nclient-keys: [/arm=anna.key, /leg/test=other.key]\n";
    let guarded = Guarded::new(robot, endpoint);
    let at = format!("tcp://127.0.0.1:{}", guarded.fleet.port);
    let client = |name: &str, scope: &str| {
        let own = guarded.fleet.scratch.path(format!("{name}.key_secret"));
        let remote = connect_to(&at, scope).with_timeout(TIMEOUT);
        let own = KeyPair::read(&own).unwrap();
        remote.with_keys(own, guarded.desk.public()).unwrap()
    };
    let mut anna = client("anna", "/arm/test");
    until("the robot is served", PATIENCE, || {
        let scopes = anna.describe().ok()??.scopes;
        scopes.contains_key("/arm/test").then_some(())
    });
    let id = start(&mut anna, "nap", "for", "0");
    assert_eq!(end(&mut anna, id).0, State::Completed);
    let known = KeyPair::read(&guarded.fleet.scratch.path("anna.key_secret")).unwrap();
    let (desk, anna) = (guarded.desk.public(), known.public());
    guarded
        .agent
        .wait_for(&format!("for '/test' by {desk} for {anna}"));
    let reason = |client: &mut RemoteTask| match trigger(client, "nap", "for", "0") {
        Err(TriggerError::Rejected { reason, .. }) => reason,
        other => panic!("{other:?}"),
    };
    // The endpoint's rule.
    let other = reason(&mut client("other", "/arm/test"));
    assert_eq!(other, "No controller for scope: /arm/test");
    // The robot's rule.
    let other = reason(&mut client("anna", "/arm/other"));
    assert_eq!(other, "the robot's 'client-keys' do not allow this");
    // Who may use a part of a robot may not stop all of it.
    let file = guarded.fleet.scratch.path("endpoint.yaml");
    let stopped = Process::run(&mut fleet(&["stop-all"], &file));
    assert_eq!(stopped.code, Some(1), "{stopped:?}");
    let told = "arm  refused: the robot's 'client-keys' do not allow this";
    assert!(stopped.stdout.contains(told), "{stopped:?}");

    // A client that the robot does not know is not heard at all.
    let file = guarded.fleet.scratch.path("stranger.yaml");
    let (address, robots) = (&guarded.fleet.address, "robots: {arm: {key: arm.key}}");
    let text = format!("routers: {address}\nfleet-key: anna.key_secret\n{robots}\n");
    std::fs::write(&file, text).unwrap();
    let listed = Process::run(&mut fleet(&["ls"], &file)).stdout;
    assert!(listed.contains("arm  does not answer"), "{listed}");
    guarded
        .agent
        .wait_for("its key is not among the robot's 'client-keys'");
}

#[test]
fn tasks_in_scopes_that_the_agents_key_may_not_use_are_not_taken_for_none() {
    let fleet = Fleet::new();
    let [_, boss, own] = keys(&fleet.scratch, ["agent", "boss", "server"]);
    let file = fleet.scratch.path("serve.yaml");
    let rights = "key: server.key_secret\nclient-keys: [/test=agent.key, boss.key]\n";
    let nap = "{nap: {for: sleep}}";
    let text = format!("port: 0\n{rights}scopes: {{/test: {nap}, /priv: {nap}}}\n");
    std::fs::write(&file, text).unwrap();
    let server = Server::start(ztl().arg("serve").arg(&file));
    let key = "key: agent.key_secret\nserver-key: server.key\n";
    let _agent = fleet.join(&server, key);
    let remote = connect_to(&server.endpoint(), "/priv");
    let mut remote = remote.with_keys(boss, own.public()).unwrap();
    let task = start(&mut remote, "nap", "for", "60");
    let file = fleet.scratch.path("endpoint.yaml");
    let told = |command: &str| Process::run(&mut self::fleet(&[command], &file));
    for (command, says) in [
        ("ps", "arm  unknown: 1 more tasks run"),
        (
            "stop-all",
            "arm  not confirmed: 1 tasks run in scopes that the agent's key may not use",
        ),
    ] {
        let told = told(command);
        assert!(told.stdout.contains(says), "{told:?}");
        assert_eq!(told.code, Some(1), "{told:?}");
    }
    assert_eq!(remote.status(task).unwrap().state, State::Accepted);
    remote.abort(task).unwrap();
    end(&mut remote, task);
    let told = told("stop-all");
    assert!(told.stdout.contains("arm  stopped: 0 tasks"), "{told:?}");
}
