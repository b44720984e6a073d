//! `ztl serve` with a robot of ROS 1: its kinds of components, and what becomes of a robot that moves.

use ztl_std::State::{Aborted, Completed, Failed, Rejected};
use ztl_std::{RemoteTask, State, Subscriber, TaskId};
use ztl_tests::lab::{
    PATIENCE, Process, Scratch, Server, connect, our_client_at, outcome, reserve_port, start,
    until, ztl,
};

use crate::rig::{Master, unique, wait};

/// A stand-in for a robot, and `ztl serve` for it.
pub(crate) struct Robot {
    pub(crate) name: String,
    pub(crate) node: Process,
    pub(crate) server: Server,
    publish: u16,
    _scratch: Scratch,
}

impl Robot {
    /// Serves this file, in which `NAME` is the robot's.
    #[track_caller]
    pub(crate) fn new(text: &str) -> Self {
        let master = Master::shared();
        let name = unique("robot");
        let mut python = master.debian_python();
        python.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/ros1/stand_in.py"));
        let node = Process::start(python.arg(&name));
        node.wait_for("ready");
        let scratch = Scratch::new();
        let path = scratch.path("robot.yaml");
        let publish = reserve_port();
        let ros1 = format!(
            "{{master: 'http://127.0.0.1:{}', host: 127.0.0.1}}",
            master.port
        );
        let text = text.replace("NAME", &name);
        let text = format!("publish: {publish}\nros1: {ros1}\n{text}");
        std::fs::write(&path, text).expect("to write");
        let mut command = ztl();
        command.arg("serve").arg(&path).args(["-p", "0"]);
        Self {
            name,
            node,
            server: Server::start(&mut command),
            publish,
            _scratch: scratch,
        }
    }

    #[track_caller]
    pub(crate) fn remote(&self) -> RemoteTask {
        connect(&self.server.endpoint())
    }

    /// [`run`] of the handler `p`.
    #[track_caller]
    pub(crate) fn run(&self, component: &str, goal: &str) -> Ended {
        run(|| self.remote(), "p", component, goal)
    }

    /// The same at once.
    #[track_caller]
    pub(crate) fn run_once(&self, component: &str, goal: &str) -> Ended {
        run_once(&mut self.remote(), "p", component, goal)
    }

    fn twists(&self) -> Vec<String> {
        let lines = self.node.stdout();
        let lines = lines.lines().filter(|line| line.starts_with("twist"));
        lines.map(str::to_owned).collect()
    }
}

/// A task's outcome, or the reason of its rejection.
pub(crate) type Ended = Result<(State, String), String>;

/// Runs a task once it is connected: on a busy machine that may take longer than a task waits.
#[track_caller]
pub(crate) fn run(
    remote: impl Fn() -> RemoteTask,
    handler: &str,
    component: &str,
    goal: &str,
) -> Ended {
    const NOT_CONNECTED: [&str; 6] = [
        "has not connected",
        "no node subscribes",
        "no controller receives",
        "no joint state",
        "is not connected",
        "no action server",
    ];
    until("it is connected", PATIENCE, || {
        let ended = run_once(&mut remote(), handler, component, goal);
        let is_early = |reason: &String| NOT_CONNECTED.iter().any(|part| reason.contains(part));
        (!ended.as_ref().is_err_and(is_early)).then_some(ended)
    })
}

#[track_caller]
pub(crate) fn run_once(
    remote: &mut RemoteTask,
    handler: &str,
    component: &str,
    goal: &str,
) -> Ended {
    match outcome(remote, handler, component, goal) {
        (Rejected, reason) => Err(reason),
        ended => Ok(ended),
    }
}

#[track_caller]
fn trigger(remote: &mut RemoteTask, component: &str, goal: &str) -> TaskId {
    start(remote, "p", component, goal)
}

const DRIVE: &str = "scopes: {/test: {p: {
    drive: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, rate: 20 Hz, for: '{goal.seconds}', dead-man: 20 s,
            message: {linear: {x: '{goal.speed}'}}, stop: {}},
    whole: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, for: '{goal.seconds}', dead-man: 20 s},
    nowhere: {ros1-publish: /NAME/nowhere, type: geometry_msgs/Twist, message: {}}}}}";

const GO: &str = "twist 0.5 0.0";
const STOP: &str = "twist 0.0 0.0";

#[test]
fn a_drive_ends_with_stop_messages_after_its_time_an_abort_and_sigterm() {
    let robot = Robot::new(DRIVE);
    assert_eq!(
        robot.run("drive", "{speed: 0.5, seconds: 0.3}"),
        Ok((Completed, "True".to_owned()))
    );
    wait("the last stop message", || {
        robot.twists().ends_with(&[STOP; 5].map(str::to_owned))
    });
    let twists = robot.twists();
    let count = twists.iter().filter(|line| *line == GO).count();
    assert!(count > 0 && twists.len() == count + 5, "{twists:?}");

    assert_eq!(
        robot.run("whole", "{linear: {x: 0.7}, seconds: 0.1}"),
        Ok((Completed, "True".to_owned()))
    );
    wait("the goal as the message", || {
        robot
            .twists()
            .last()
            .is_some_and(|line| line == "twist 0.7 0.0")
    });
    let refused = robot.run("whole", "{linear: {x: 0.7}, second: 0.1}");
    assert!(refused.is_err_and(|why| why.contains("second")));

    let mut remote = robot.remote();
    let task = trigger(&mut remote, "drive", "{speed: 0.5, seconds: 60}");
    wait("it drives on", || {
        robot.twists().ends_with(&[GO; 3].map(str::to_owned))
    });
    remote.abort(task).expect("an answer");
    let end = remote.wait(task, Some(PATIENCE)).expect("an end");
    assert_eq!((end.state, end.text), (Aborted, "aborted".to_owned()));
    wait("the last stop message", || {
        robot.twists().ends_with(&[STOP; 5].map(str::to_owned))
    });

    trigger(&mut remote, "drive", "{speed: 0.5, seconds: 60}");
    wait("it drives", || {
        robot.twists().last().is_some_and(|line| line == GO)
    });
    let Robot { node, server, .. } = robot;
    server.process.signal("TERM");
    assert_eq!(server.process.end(PATIENCE).code, Some(143));
    wait("the stop messages of the server", || {
        node.stdout().ends_with(&format!("{STOP}\n").repeat(5))
    });
}

#[test]
fn a_base_stops_when_its_client_is_gone_and_gets_nothing_more_from_a_killed_server() {
    let bound = "bound: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, rate: 20 Hz, dead-man: 20 s,
            message: {linear: {x: 0.5}}, stop: {}, needs-client: 6 s},
    drive: {";
    let robot = Robot::new(&DRIVE.replacen("drive: {", bound, 1));
    let drives = || robot.twists().last().is_some_and(|line| line == GO);
    // Connects.
    assert!(robot.run("drive", "{speed: 0.5, seconds: 0.1}").is_ok());
    let stopped = || robot.twists().ends_with(&[STOP; 5].map(str::to_owned));
    wait("the stop messages of the drive", stopped);
    let mut command = our_client_at(robot.server.port);
    let mut client = Process::start(command.arg("p:bound:"));
    wait("it drives", drives);
    client.kill();
    wait("the stop messages", stopped);

    let mut remote = robot.remote();
    wait("the next drive begins", || {
        let task = remote.trigger("p", "drive", "{speed: 0.5, seconds: 60}");
        task.is_ok()
    });
    wait("it drives", drives);
    let Robot { node, server, .. } = robot;
    server.process.signal("KILL");
    server.process.end(PATIENCE);
    let printed = node.stdout();
    assert!(
        printed.ends_with(&format!("{GO}\n")),
        "nobody sends a stop: {printed}"
    );
}

#[test]
fn what_nobody_receives_and_a_wrong_goal_are_rejected() {
    let robot = Robot::new(DRIVE);
    let reason = robot.run_once("nowhere", "").expect_err("no subscriber");
    assert!(
        reason.starts_with("no node subscribes to /robot"),
        "{reason}"
    );
    let reason = robot
        .run("drive", "{speed: fast, seconds: 1}")
        .expect_err("a word");
    assert!(
        reason.contains("'fast' for speed is not a number"),
        "{reason}"
    );
    assert!(robot.twists().is_empty());
}

const ARM: &str = "scopes: {/test: {p: {
    pose: {ros1-trajectory: /NAME/command, joint-states: /NAME/joint_states, joints: [shoulder, elbow], time: 1 s,
           poses: {home: [0, 0], up: [0.5, -0.25], far: [200, 0]}}}}}";

#[test]
fn an_arm_moves_to_its_poses_and_an_abort_stops_it() {
    let robot = Robot::new(ARM);
    let (state, text) = robot.run("pose", "up").expect("no rejection");
    assert_eq!(state, Completed, "{text}");
    assert!(text.starts_with("[0.") && text.contains(", -0.2"), "{text}");
    robot
        .node
        .wait_for("trajectory shoulder elbow 0.5 -0.25 1.0");
    assert_eq!(
        robot.run("pose", "down"),
        Err("p:pose: the goal 'down' is not home, up or far".to_owned())
    );

    let mut remote = robot.remote();
    let task = trigger(&mut remote, "pose", "far");
    wait("it moves", || robot.node.stdout().contains("elbow 200"));
    remote.abort(task).expect("an answer");
    let end = remote.wait(task, Some(PATIENCE)).expect("an end");
    assert_eq!((end.state, end.text), (Aborted, "aborted".to_owned()));
    wait("three empty trajectories", || {
        robot.node.stdout().matches("stop\n").count() == 3
    });

    // In 6 s it moves 12 rad at most.
    let (state, text) = robot.run("pose", "far").expect("no rejection");
    assert_eq!(state, Failed, "{text}");
    assert!(
        text.starts_with("shoulder is 1") && text.ends_with(" from its position after 6 s"),
        "{text}"
    );
}

const ASK: &str = "scopes: {/test: {p: {
    light: {ros1-service: /NAME/light, type: std_srvs/SetBool, result: 'the light is {response.message}'},
    nothing: {ros1-service: /NAME/nothing, type: std_srvs/Trigger},
    limits: {ros1-parameter: /NAME/limits},
    unset: {ros1-parameter: /NAME/unset}}}}";

#[test]
fn services_and_parameters_answer() {
    let robot = Robot::new(ASK);
    assert_eq!(
        robot.run("light", "True"),
        Ok((Completed, "the light is on".to_owned()))
    );
    assert_eq!(
        robot.run("light", "False"),
        Ok((Failed, "the lamp is broken".to_owned()))
    );
    let (state, text) = robot.run("nothing", "").expect("no rejection");
    assert_eq!(state, Failed);
    assert!(
        text.starts_with("service /robot"),
        "nothing was sent: {text}"
    );
    let (state, text) = robot.run("limits", "").expect("no rejection");
    assert_eq!(state, Completed);
    assert!(
        text.contains("'speed': 0.5") && text.contains("'joints': ['shoulder', 'elbow']"),
        "{text}"
    );
    assert_eq!(robot.run("unset", "").expect("no rejection").0, Failed);

    let asker = Master::shared().node();
    let name = format!("/{}/limits", robot.name);
    let params = [name[..].into(), "x".repeat(3 << 20)[..].into()];
    asker.ask_master("setParam", &params).expect("an answer");
    let (state, text) = robot.run("limits", "").expect("no rejection");
    let cut = "x … (cut at 1000 KiB; the whole has 3145728 bytes)";
    let end = &text[text.len().saturating_sub(100)..];
    assert!(state == Completed && text.ends_with(cut), "{end}");
}

#[test]
fn an_action_runs_with_progress_and_ends_in_the_states_of_its_server() {
    let name = unique("served");
    let _action = Master::shared().action(&name, &name);
    let text = "scopes: {/test: {p: {count: {ros1-action: /ACTION, type: actionlib/TestAction, progress: 'at {feedback.feedback}'},
        lost: {ros1-action: /lots, type: actionlib/TestAction}}}}";
    let robot = Robot::new(&text.replace("ACTION", &name));
    assert_eq!(
        robot.run("count", "1"),
        Ok((Completed, "{'result': 10}".to_owned()))
    );
    assert_eq!(
        robot.run("count", "2"),
        Ok((Failed, "broken; {'result': 20}".to_owned()))
    );
    assert_eq!(
        robot.run("count", "3"),
        Err("no; {'result': 30}".to_owned())
    );
    let mut remote = robot.remote();
    let task = trigger(&mut remote, "count", "4");
    remote.abort(task).expect("an answer");
    let end = remote.wait(task, Some(PATIENCE)).expect("an end");
    assert_eq!(
        (end.state, end.text),
        (Aborted, "stopped; {'result': -1}".to_owned())
    );
    // A busy machine may find out less at first.
    until("it says what exists", PATIENCE, || {
        let reason = robot.run_once("lost", "1").expect_err("no such action");
        println!("{reason}");
        reason.contains(&name).then_some(())
    });
}

#[test]
fn topics_are_published_as_streams() {
    let robot = Robot::new(
        "streams: {/test: {
            battery: {ros1-topic: /NAME/battery, type: sensor_msgs/BatteryState, latest: true},
            camera: {ros1-topic: /NAME/camera, type: sensor_msgs/CompressedImage, field: data, latest: true},
            joints: {ros1-topic: /NAME/joint_states, type: sensor_msgs/JointState, field: position, when-watched: 1 s}}}",
    );
    let endpoint = format!("tcp://127.0.0.1:{}", robot.publish);
    let next = |topic: &str| {
        let mut subscriber = Subscriber::connect(&endpoint, topic).expect("a file");
        let heard = subscriber.next_within(PATIENCE).expect("it can wait");
        let value = heard.expect("a message").value().expect("plain data");
        value.value().repr().to_string()
    };
    let battery = next("/test/battery");
    assert!(
        battery.contains("'percentage': 0.5") && battery.contains("'voltage': None"),
        "{battery}"
    );
    assert_eq!(next("/test/camera"), r"b'\xff\xd8 not quite \xff\xd9'");
    assert_eq!(next("/test/joints"), "[0.0]");
}

#[test]
fn a_check_warns_of_names_that_the_robot_does_not_have() {
    let master = Master::shared();
    let name = unique("checked");
    let _action = master.action(&name, &name);
    let lost = unique("lost");
    let _lost = master.robot_at("no-such-robot.invalid", &["action", &lost, &lost]);
    let scratch = Scratch::new();
    let path = scratch.path("robot.yaml");
    let text = format!(
        "ros1: {{master: 'http://127.0.0.1:{}', host: no-such-ztl.invalid}}
scopes: {{/test: {{p: {{
    right: {{ros1-action: /{name}, type: actionlib/TestAction}},
    typo: {{ros1-action: /{name}x, type: actionlib/TestAction}},
    other: {{ros1-action: /{name}, type: actionlib/TwoIntsAction}},
    dock: {{ros1-service: /no/such/dock, type: std_srvs/Trigger}},
    lost: {{ros1-action: /{lost}, type: actionlib/TestAction}},
    pose: {{ros1-trajectory: /{name}/result, joint-states: /joint_stats, joints: [a]}}}}}}}}",
        master.port
    );
    std::fs::write(&path, text).expect("to write");
    let mut command = ztl();
    let ended = Process::run(command.arg("serve").arg(&path).args(["--check", "-p", "0"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    for part in [
        format!(
            "robot.yaml:4:25: warning: the master knows no action /{name}x; did you mean '/{name}'?"
        ),
        format!(
            "robot.yaml:5:26: warning: action /{name} is of the type actionlib/TestAction, not actionlib/TwoIntsAction; write type: actionlib/TestAction"
        ),
        "robot.yaml:6:26: warning: the master knows no service /no/such/dock; ".to_owned(),
        format!(
            "robot.yaml:7:25: warning: the action server of /{lost}, /{lost}, cannot be reached: \
             this machine cannot resolve the host name 'no-such-robot.invalid'"
        ),
        format!(
            "robot.yaml:3:26: warning: /{name} subscribes to /{name}/goal, but has not connected: "
        ),
        "warning: the master knows no topic /joint_stats; ".to_owned(),
        "warning: this machine cannot resolve its own name 'no-such-ztl.invalid'; ".to_owned(),
    ] {
        assert!(ended.stderr.contains(&part), "{part}: {}", ended.stderr);
    }
    assert_eq!(
        ended.stderr.matches("warning: ").count(),
        8,
        "{}",
        ended.stderr
    );
}

#[test]
fn a_check_names_a_package_path_that_is_not_a_directory() {
    let scratch = Scratch::new();
    let path = scratch.path("robot.yaml");
    let text = "scopes: {/test: {p: {c: {ros1-publish: /c, type: qwerty_msgs/Qwerty}}}}";
    std::fs::write(&path, text).expect("to write");
    let mut command = ztl();
    command.env("ROS_PACKAGE_PATH", "/usr/share:/no/such/src");
    command.arg("serve").arg(&path);
    let ended = Process::run(command.args(["--check", "-p", "0"]));
    let part = "1:50: there is no definition of qwerty_msgs/Qwerty; '/no/such/src' in ROS_PACKAGE_PATH is not the absolute path of a directory";
    assert!(ended.stderr.contains(part), "{ended:?}");
}

#[test]
fn a_check_warns_of_definitions_that_the_robot_has_otherwise() {
    let master = Master::shared();
    let (action, robot) = (unique("defined"), unique("robot"));
    let _action = master.action(&action, &action);
    let mut python = master.debian_python();
    python.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/ros1/stand_in.py"));
    let node = Process::start(python.arg(&robot));
    node.wait_for("ready");
    let scratch = Scratch::new();
    let packages = scratch.path("packages");
    for (package, file, definition) in [
        (
            "actionlib",
            "action/Test.action",
            "int32 goal\n---\nint64 result\n---\nint32 feedback\n",
        ),
        (
            "sensor_msgs",
            "msg/BatteryState.msg",
            "float32 percentage\n",
        ),
        (
            "std_srvs",
            "srv/SetBool.srv",
            "bool data\nuint8 level\n---\nbool success\n",
        ),
    ] {
        let path = std::path::Path::new(&packages).join(package);
        std::fs::create_dir_all(path.join(file).parent().expect("a directory")).expect("to make");
        std::fs::write(path.join("package.xml"), "<package/>").expect("to write");
        std::fs::write(path.join(file), definition).expect("to write");
    }
    let path = scratch.path("robot.yaml");
    let text = format!(
        "ros1: {{master: 'http://127.0.0.1:{}'}}
scopes: {{/test: {{p: {{
    count: {{ros1-action: /{action}, type: actionlib/TestAction}},
    light: {{ros1-service: /{robot}/light, type: std_srvs/SetBool}},
    wrong: {{ros1-service: /{robot}/light, type: std_srvs/Trigger}},
    drive: {{ros1-publish: /{robot}/cmd_vel, type: geometry_msgs/Twist}}}}}}}}
streams: {{/test: {{
    camera: {{ros1-topic: /{robot}/camera, type: sensor_msgs/CompressedImage}},
    battery: {{ros1-topic: /{robot}/battery, type: sensor_msgs/BatteryState}}}}}}",
        master.port
    );
    std::fs::write(&path, text).expect("to write");
    let mut command = ztl();
    command.env("ROS_PACKAGE_PATH", &packages);
    command.arg("serve").arg(&path);
    let ended = Process::run(command.args(["--check", "-p", "0", "--publish", "0"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    for part in [
        format!(
            "robot.yaml:3:26: warning: topic /{action}/result has another definition of actionlib/TestActionResult than this machine: its MD5 sum is 3d669e3a63aa986c667ea7b0f46ce85e, not "
        ),
        format!(
            "robot.yaml:4:27: warning: service /{robot}/light has another definition of std_srvs/SetBool than this machine: its MD5 sum is 09fb03525b03e7ea1fd3992bafd87e16, not "
        ),
        format!(
            "robot.yaml:5:27: warning: service /{robot}/light is of the type std_srvs/SetBool, not std_srvs/Trigger; write type: std_srvs/SetBool"
        ),
        format!(
            "robot.yaml:9:27: warning: topic /{robot}/battery has another definition of sensor_msgs/BatteryState than this machine"
        ),
        "copy the robot's std_srvs package to a directory of ROS_PACKAGE_PATH".to_owned(),
    ] {
        assert!(ended.stderr.contains(&part), "{part}: {}", ended.stderr);
    }
    let count = ended.stderr.matches("warning: ").count();
    assert_eq!(count, 4, "{}", ended.stderr);
}

#[test]
fn the_doctor_says_what_a_master_knows_and_what_cannot_be_reached() {
    let mut master = Master::start();
    let _action = master.action("arm", "move");
    let _lost = master.robot_at("no-such-host.invalid", &["topics", "lost"]);
    let uri = format!("http://127.0.0.1:{}", master.port);
    // A name with a line of its own.
    let script = format!(
        "import xmlrpc.client as x; x.ServerProxy('{uri}').registerPublisher('/x\\nok', '/y', 'std_msgs/String', '{uri}')"
    );
    let done = master.debian_python().args(["-c", &script]).status();
    assert!(done.expect("Python").success());
    let doctor = || {
        let mut command = ztl();
        command.env("ROS_HOSTNAME", "127.0.0.1");
        Process::run(command.args(["doctor", "--ros1", &uri]))
    };
    // On a busy machine, a run may not hear the clock in time.
    let clock = "ok    ros1       the clock of /move is ";
    let ended = until("it hears the clock", PATIENCE, || {
        let ended = doctor();
        ended.stdout.contains(clock).then_some(ended)
    });
    assert_eq!(ended.code, Some(1), "{ended:?}");
    for part in [
        &format!("master {uri}: 3 nodes"),
        r"ok    ros1       node /x\nok at",
        "ok    ros1       node /arm at http://127.0.0.1:",
        "ok    ros1       action /move (actionlib/TestAction)\n",
        "WRONG ros1       node /lost at http://no-such-host.invalid",
        "start it with ROS_HOSTNAME or ROS_IP",
    ] {
        assert!(ended.stdout.contains(part), "{part}: {}", ended.stdout);
    }
    master.kill();
    let ended = doctor();
    let part = format!("WRONG ros1       no answer from the master {uri}: ");
    assert!(ended.stdout.contains(&part), "{}", ended.stdout);
}

#[test]
fn the_examples_are_valid_without_the_robots_files() {
    let directory = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/serve/ros1");
    let mut names: Vec<_> = std::fs::read_dir(directory)
        .expect("examples")
        .flatten()
        .collect();
    names.sort_by_key(std::fs::DirEntry::path);
    assert_eq!(names.len(), 3);
    let scratch = Scratch::new();
    for file in names {
        let mut command = ztl();
        // A port without a master.
        let text = std::fs::read_to_string(file.path()).expect("an example");
        let path = scratch.path("robot.yaml");
        std::fs::write(&path, text.replace("localhost:11311", "localhost:1")).expect("to write");
        command.arg("serve").arg(&path).arg("--check");
        let ended = Process::run(command.args(["-p", "0", "--publish", "0"]));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        // All else is right.
        let warnings: Vec<&str> = ended
            .stderr
            .lines()
            .filter(|line| line.contains("warning: "))
            .collect();
        let [warning] = warnings.as_slice() else {
            panic!("{ended:?}");
        };
        assert!(
            warning.contains("no answer from the master http://localhost:1: "),
            "{ended:?}"
        );
    }
}
