//! A scene on five robots through the endpoint, of which one is cut off in the middle.

use std::process::Command;

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{
    LIMIT, PATIENCE, Process, Scratch, Server, Terminal, connect_to, end, original_tool, until, ztl,
};

use crate::requests::{client, start, status};
use crate::{Fleet, fleet};

const ROBOTS: [&str; 5] = ["arm-1", "arm-2", "arm-3", "arm-4", "arm-5"];

/// Five robots, and a scene with two steps for all of them.
struct Stage {
    fleet: Fleet,
    servers: Vec<Server>,
    agents: Vec<Process>,
}

impl Stage {
    fn new() -> Self {
        let robots = format!("robots: [{}]\n", ROBOTS.join(", "));
        let fleet = Fleet::with(Scratch::new(), &robots);
        let (mut servers, mut agents) = (Vec::new(), Vec::new());
        let mut remotes = "remotes:\n".to_owned();
        let mut steps =
            [("wave", 8), ("bow", 0)].map(|(step, time)| (format!("  {step}:\n"), time));
        for robot in ROBOTS {
            let server = Server::naps();
            let file = fleet.scratch.path(format!("{robot}.yaml"));
            let (address, endpoint) = (&fleet.address, server.endpoint());
            let text = format!("name: {robot}\nserver: {endpoint}\nrouters: {address}\n");
            std::fs::write(&file, text).unwrap();
            agents.push(Process::start(&mut self::fleet(&["join"], &file)));
            servers.push(server);
            let port = fleet.port;
            remotes +=
                &format!("  {robot}: {{host: 127.0.0.1, port: {port}, scope: /{robot}/test}}\n");
            for (step, time) in &mut steps {
                *step += &format!("    nap(remote={robot}): {{for: {time}}}\n");
            }
        }
        let script = format!("greeting:\n{}{}", steps[0].0, steps[1].0);
        std::fs::write(fleet.scratch.path("show.yaml"), script).unwrap();
        std::fs::write(fleet.scratch.path("remotes.yaml"), remotes).unwrap();
        let stage = Self {
            fleet,
            servers,
            agents,
        };
        for robot in ROBOTS {
            stage.wait_there(robot);
        }
        stage
    }

    /// A client of this robot through the endpoint.
    fn remote(&self, robot: &str) -> RemoteTask {
        client(self.fleet.port, &format!("/{robot}/test"))
    }

    fn wait_there(&self, robot: &str) {
        let scope = format!("/{robot}/test");
        let mut remote = self.remote(robot);
        until("the robot is served", PATIENCE, || {
            let scopes = remote.describe().ok()??.scopes;
            scopes.contains_key(&scope).then_some(())
        });
    }

    /// Plays the scene with this tool.
    fn play(&self, mut command: Command) -> Command {
        command.args(["-s", "show.yaml", "--config", "remotes.yaml"]);
        command.current_dir(self.fleet.scratch.path("."));
        command
    }

    /// Cuts the last robot off while it does the first step. Its agent has answered the INIT then.
    fn cut(&self) {
        let mut direct = connect_to(&self.servers[4].endpoint(), "/test");
        let id = until("the first step", PATIENCE, || {
            Some(direct.tasks().ok()??.tasks.first()?.id.clone())
        });
        let id = id.number().expect("a number");
        let status = status(&mut self.remote("arm-5"), id);
        assert_eq!(status.state, State::Accepted);
        self.agents[4].signal("STOP");
    }

    fn join(&self) {
        self.agents[4].signal("CONT");
    }

    /// All tasks that a robot's server has had have completed; it has had so many.
    #[track_caller]
    fn assert_completed(&self, robot: usize, count: usize) {
        let known = connect_to(&self.servers[robot].endpoint(), "/test").tasks();
        let known = known.unwrap().expect("a list").tasks;
        let states: Vec<u8> = known
            .iter()
            .map(|task| task.listed.as_ref().unwrap().state)
            .collect();
        assert_eq!(states, vec![State::Completed.code(); count], "{robot}");
    }
}

#[test]
fn our_player_waits_for_a_robot_that_is_cut_off_and_goes_on() {
    let stage = Stage::new();
    let mut ours = stage.play({
        let mut command = ztl();
        command.arg("run-script");
        command
    });
    let player = Process::start(ours.args(["--plain", "--yes"]));
    stage.cut();
    player.wait_for("Step 'wave' waits: 'arm-5' does not answer");
    // The others have gone on, and so has it.
    let mut direct = connect_to(&stage.servers[4].endpoint(), "/test");
    let known = direct.tasks().unwrap().expect("a list").tasks;
    let wave = direct.wait(known[0].id.clone(), LIMIT).unwrap();
    assert_eq!(wave.state, State::Completed);
    assert!(!player.stdout().contains("STEP 'bow'"));
    stage.join();
    let ended = player.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    for robot in 0..ROBOTS.len() {
        stage.assert_completed(robot, 2);
    }
}

#[test]
fn the_originals_player_starts_nothing_twice_and_nothing_late() {
    let stage = Stage::new();
    let original = stage.play(original_tool("ztl_run_script"));
    let mut player = Terminal::start(&original, (160, 60));
    player.shows("PRESS <ENTER> TO CONFIRM");
    player.type_in("\r");
    stage.cut();
    // Its client takes silence for an end, goes on, and cannot start the next step there.
    player.shows("handler 'nap(remote=arm-5)' for step 'bow' COULD NOT BE TRIGGERED");
    player.shows("PRESS <R> TO REPLAY");
    player.type_in("q");
    stage.join();
    stage.wait_there("arm-5");
    let mut remote = stage.remote("arm-5");
    let id = start(&mut remote, "nap", "for", "0");
    assert_eq!(end(&mut remote, id).0, State::Completed);
    // The wave, and the task after it; the bow that could not be triggered did not follow.
    for robot in 0..ROBOTS.len() {
        stage.assert_completed(robot, 2);
    }
}
