//! `ztl serve` with libqi itself: methods as tasks, events and signals as streams.

use std::time::Duration;

use ztl_std::State::{Aborted, Completed, Failed, Rejected};
use ztl_std::{RemoteTask, State, Subscriber, TaskId};
use ztl_tests::lab::{
    PATIENCE, Process, Scratch, Server, connect_to, end, outcome, reserve_port, start, until, ztl,
};

use crate::robot::{EXAMPLES_USE, Robot};

/// `ztl serve` for a robot.
struct Served {
    server: Server,
    scope: &'static str,
    publish: u16,
    _scratch: Scratch,
}

/// A file for this robot instead of one on this machine.
fn text_for(endpoint: &str, text: &str) -> String {
    let text = text.replace("\nnaoqi: tcp://127.0.0.1:9559\n", "\n");
    format!("naoqi: {endpoint}\n{text}")
}

fn example(name: &str) -> String {
    let path = format!("{}/../examples/serve/{name}", env!("CARGO_MANIFEST_DIR"));
    std::fs::read_to_string(path).expect("an example")
}

impl Served {
    #[track_caller]
    fn new(endpoint: &str, scope: &'static str, text: &str) -> Self {
        let scratch = Scratch::new();
        let path = scratch.path("robot.yaml");
        std::fs::write(&path, text_for(endpoint, text)).expect("to write");
        let publish = reserve_port();
        let mut command = ztl();
        command.arg("serve").arg(&path).args(["-p", "0"]);
        command.args(["--publish", &publish.to_string()]);
        Self {
            server: Server::start(&mut command),
            scope,
            publish,
            _scratch: scratch,
        }
    }

    /// The components of a handler `p`.
    #[track_caller]
    fn of(robot: &Robot, components: &str) -> Self {
        let text = format!("scopes: {{/test: {{p: {{{components}}}}}}}");
        Self::new(&robot.endpoint, "/test", &text)
    }

    #[track_caller]
    fn remote(&self) -> RemoteTask {
        connect_to(&self.server.endpoint(), self.scope)
    }

    /// Runs a task and returns its outcome, or why it was rejected; not before the service is found, which may take longer
    /// than a task waits on a busy machine.
    #[track_caller]
    fn run(&self, handler: &str, component: &str, goal: &str) -> (State, String) {
        until("the service answers in time", PATIENCE, || {
            let ended = self.run_once(handler, component, goal);
            let is_early =
                ended.1.contains("did not answer in time") || ended.1.contains("not connected to");
            (!is_early).then_some(ended)
        })
    }

    #[track_caller]
    fn run_once(&self, handler: &str, component: &str, goal: &str) -> (State, String) {
        outcome(&mut self.remote(), handler, component, goal)
    }
}

fn completed(text: &str) -> (State, String) {
    (Completed, text.to_owned())
}

#[test]
fn the_example_for_nao_speaks_moves_and_shows_colors() {
    let mut robot = Robot::start(&EXAMPLES_USE);
    let nao = Served::new(&robot.endpoint, "/nao", &example("nao.yaml"));
    for (handler, component, goal, result, done) in [
        ("tts", "say", "5", "None", "say 5"),
        (
            "motion",
            "stiffness",
            "{part: Head, value: 1}",
            "None",
            "stiffnesses Head 1",
        ),
        (
            "motion",
            "joint",
            "{joint: HeadYaw, angle: 0.5, seconds: 1}",
            "None",
            "angles ['HeadYaw'] [0.5] [1.0] True",
        ),
        ("motion", "walk", "{x: 0.5}", "True", "move 0.5 0.0 0.0"),
        ("motion", "posture", "Stand", "True", "posture Stand 0.5"),
        ("motion", "animation", "short", "over", "run short"),
        ("life", "state", "disabled", "None", "life disabled"),
        (
            "leds",
            "color",
            "{group: FaceLeds, color: 0xFF, seconds: 1}",
            "number 255",
            "",
        ),
        (
            "hearing",
            "words",
            "{words: [yes, '1']}",
            "None",
            "words ['yes', '1'] False",
        ),
        ("hearing", "start", "", "None", "hears ztl"),
        ("hearing", "stop", "", "None", "deaf to ztl"),
        ("sonar", "start", "", "None", "hears ztl"),
        ("motion", "wake-up", "", "None", "awake"),
        ("motion", "rest", "", "None", "rests"),
    ] {
        assert_eq!(
            nao.run(handler, component, goal),
            completed(result),
            "{component}"
        );
        if !done.is_empty() {
            robot.line_with(done);
        }
    }
    let mut remote = nao.remote();
    for (handler, component, goal, begun, stopped) in [
        ("tts", "say", "a long story", "say a long story", "silent"),
        ("motion", "walk", "{x: 2}", "move 2.0", "stopped"),
        (
            "motion",
            "animation",
            "animations/Hey_1",
            "run animations/Hey_1",
            "cancelled",
        ),
        ("behavior", "run", "dance", "behavior dance", "stop dance"),
    ] {
        let task = start(&mut remote, handler, component, goal);
        robot.line_with(begun);
        remote.abort(task).expect("an answer");
        robot.line_with(stopped);
        assert_eq!(
            end(&mut remote, task),
            (Aborted, "aborted".to_owned()),
            "{component}"
        );
    }
}

#[test]
fn both_examples_are_right_for_the_services_of_their_robots() {
    let robot = Robot::start(&EXAMPLES_USE);
    for name in ["nao.yaml", "pepper.yaml"] {
        let ended = check(&robot.endpoint, &example(name));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(!ended.stderr.contains("warning: "), "{ended:?}");
    }
}

#[track_caller]
fn check(endpoint: &str, text: &str) -> ztl_tests::lab::Ended {
    let scratch = Scratch::new();
    let path = scratch.path("robot.yaml");
    std::fs::write(&path, text_for(endpoint, text)).expect("to write");
    let mut command = ztl();
    command.arg("serve").arg(&path).arg("--check");
    Process::run(command.args(["-p", "0", "--publish", "0"]))
}

#[test]
fn check_tells_what_the_robot_lacks_and_what_its_methods_take() {
    let robot = Robot::start(&["ALTextToSpeech", "ALMotion", "ALLeds", "ALMemory"]);
    let text = "scopes: {/test: {p: {
    a: {naoqi: ALTextToSpech.say, arguments: ['{goal}']},
    b: {naoqi: ALTextToSpeech.sai, arguments: ['{goal}']},
    c: {naoqi: ALTextToSpeech.say, arguments: ['{goal}', 1]},
    d: {naoqi: ALMotion.moveTo, arguments: ['{goal}', far, 0], goal: number},
    e: {naoqi: ALMotion.moveTo, arguments: ['{goal}', 0, 0], goal: text},
    f: {naoqi: ALMotion.moveTo, arguments: ['{goal.x}', '{goal.y}', 0], abort: ALMotion.stop},
    g: {naoqi: ALTextToSpeech.say, arguments: ['{goal}'], goal: number},
    h: {naoqi: ALLeds.fadeRGB, arguments: [FaceLeds, '{goal}', 1]},
    i: {naoqi: ALMotion.moveTo, arguments: [1, 0, 0], abort: ALTextToSpeech.say},
    j: {naoqi: 'ALLeds.fadeRGB::(sff)', arguments: [FaceLeds, 1, 1]}}}}
streams: {/test: {s: {naoqi-signal: ALMotion.stifness}, t: {naoqi-event: FrontTactilTouched}}}";
    let ended = check(&robot.endpoint, text);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let said: Vec<&str> = ended
        .stderr
        .lines()
        .filter(|it| it.contains("warning: "))
        .collect();
    let wanted = [
        (
            ":3:16: ",
            "no service ALTextToSpech at",
            "did you mean 'ALTextToSpeech'?",
        ),
        (
            ":4:16: ",
            "no method ALTextToSpeech.sai",
            "did you mean 'ALTextToSpeech.say'?",
        ),
        (
            ":5:16: ",
            "ALTextToSpeech.say::(s) takes 1 argument, not 2",
            "",
        ),
        (":6:16: ", "argument 2 of ALMotion.moveTo", "must be"),
        (":7:16: ", "argument 1 of ALMotion.moveTo", "must be"),
        (":8:80: ", "no method ALMotion.stop", "stopMove"),
        (
            ":11:62: ",
            "ALTextToSpeech.say::(s) takes 1 argument, not 0",
            "as an abort: {naoqi: ALTextToSpeech.say, arguments: […]}",
        ),
        (
            ":12:16: ",
            "no method ALLeds.fadeRGB::(sff); its signature is (",
            "",
        ),
        (
            ":13:37: ",
            "ALMotion has no signal or property stifness",
            "did you mean 'ALMotion.stiffness'?",
        ),
    ];
    assert_eq!(said.len(), wanted.len(), "{ended:?}");
    for (line, (place, mistake, help)) in said.iter().zip(wanted) {
        let fits = line.contains(place) && line.contains(mistake);
        assert!(
            fits && ended.stderr.contains(help),
            "{place}{mistake}: {ended:?}"
        );
    }
    drop(robot);
    let ended = check("tcp://127.0.0.1:1", text);
    let place = ended.stderr.lines().find(|it| it.contains("warning: "));
    // Not each of its methods is wrong, but its address.
    assert!(
        place.is_some_and(|it| it.contains(":1:8: warning: not connected to")),
        "{ended:?}"
    );
}

#[test]
fn mistakes_of_the_file_have_their_places() {
    let text = "scopes: {/test: {p: {
    a: {naoqi: say},
    b: {naoqi: ALMotion.moveTo, arguments: ['{gaol}']},
    c: {naoqi: ALMotion.moveTo, abort: no, grace: 1 s},
    d: {naoqi: ALMotion.moveTo, abort: {naoqi: stop}},
    e: {naoqi-wait: FrontTactilTouched, abort: no}}}}
streams: {/test: {s: {naoqi-signal: stiffness}, t: {naoqi-event: x, frame: line}, u: {naoqi-event: x, naoqi-signal: A.x}, v: {naoqi-evnt: x}}}";
    let ended = check("{directory: tcp://nao.local, user: nao}", text);
    assert_eq!(ended.code, Some(2), "{ended:?}");
    for part in [
        ":1:20: 'tcp://nao.local' has no port, as tcp://nao.local:9559",
        ":1:43: give both: user: nao, token: token.txt",
        ":3:16: 'say' is not a service and its method, as ALTextToSpeech.say",
        ":4:45: unknown placeholder '{gaol}'",
        ":5:51: grace has no effect with abort: no",
        ":6:48: 'stop' is not a service and its method",
        ":7:48: a wait ends at once when it is aborted; leave abort out",
        ":8:37: 'stiffness' is not a service and its signal",
        ":8:76: each message is a frame; leave this out",
        ":8:117: give only one of: ros1-topic, naoqi-event, naoqi-signal",
        ":8:127: unknown key 'naoqi-evnt'; did you mean 'naoqi-event'?",
    ] {
        assert!(ended.stderr.contains(part), "{part}: {ended:?}");
    }
}

#[test]
fn goals_that_do_not_fit_are_rejected_and_exceptions_fail() {
    let mut robot = Robot::start(&["ALTextToSpeech", "ALMotion"]);
    let nao = Served::of(
        &robot,
        "say: {naoqi: ALTextToSpeech.say, arguments: ['{goal}']},
         language: {naoqi: ALTextToSpeech.setLanguage, arguments: ['{goal}']},
         kill: {naoqi: ALMotion.killTask, arguments: ['{goal}']},
         walk: {naoqi: ALMotion.moveTo, arguments: ['{goal.x}', 0, 0]},
         sit: {naoqi: ALRobotPosture.goToPosture, arguments: ['{goal}', 0.5]}",
    );
    assert_eq!(nao.run("p", "say", "[1, 2]"), completed("None"));
    robot.line_with("say [1, 2]");
    let (state, text) = nao.run("p", "language", "Klingon");
    assert_eq!(state, Failed);
    assert!(text.contains("language Klingon is not installed"), "{text}");
    assert_eq!(nao.run("p", "kill", "7"), completed("True"));
    for (component, goal, part) in [
        ("kill", "seven", "argument 1 of ALMotion.killTask must be"),
        (
            "kill",
            "3000000000",
            "an integer from -2147483648 to 2147483647",
        ),
        ("walk", "{x: far}", "argument 1 of ALMotion.moveTo must be"),
        ("walk", "{y: 1}", "the goal '{y: 1}' is not "),
        ("sit", "Sit", "no service ALRobotPosture at"),
    ] {
        let (state, text) = nao.run("p", component, goal);
        assert!(
            state == Rejected && text.contains(part),
            "{component}: {state} {text}"
        );
    }
}

#[test]
fn a_lost_service_leaves_the_outcome_unknown_and_nothing_is_called_twice() {
    let mut robot = Robot::start(&["ALTextToSpeech"]);
    let nao = Served::of(
        &robot,
        "say: {naoqi: ALTextToSpeech.say, arguments: ['{goal}']}",
    );
    let mut remote = nao.remote();
    assert_eq!(nao.run("p", "say", "hello"), completed("None"));
    let task = start(&mut remote, "p", "say", "a long story");
    robot.line_with("say a long story");
    robot.tell("unregister ALTextToSpeech");
    let (state, text) = end(&mut remote, task);
    let expected = "unknown: whether ALTextToSpeech.say was done: ALTextToSpeech was removed";
    assert_eq!((state, text.as_str()), (Failed, expected));
    let (state, text) = nao.run_once("p", "say", "hello");
    assert!(
        state == Rejected && text.contains("no service ALTextToSpeech"),
        "{text}"
    );
    robot.tell("register ALTextToSpeech");
    until("the service is found again", PATIENCE, || {
        (nao.run_once("p", "say", "again") == completed("None")).then_some(())
    });
    let stories = robot.process.stdout();
    assert_eq!(stories.matches("say a long story").count(), 1, "{stories}");
}

#[test]
fn a_directory_that_is_restarted_is_found_again() {
    let endpoint = format!("tcp://127.0.0.1:{}", reserve_port());
    let mut robot = Robot::start_at(&endpoint, &["ALTextToSpeech"]);
    let nao = Served::of(
        &robot,
        "say: {naoqi: ALTextToSpeech.say, arguments: ['{goal}']}",
    );
    let mut remote = nao.remote();
    assert_eq!(nao.run("p", "say", "hello"), completed("None"));
    let task = start(&mut remote, "p", "say", "a long story");
    robot.line_with("say a long story");
    drop(robot);
    let (state, text) = end(&mut remote, task);
    let expected = "unknown: whether ALTextToSpeech.say was done: the connection was lost";
    assert!(state == Failed && text.starts_with(expected), "{text}");
    let (state, text) = nao.run_once("p", "say", "hello");
    assert!(
        state == Rejected && text.contains("not connected to"),
        "{text}"
    );
    let mut robot = Robot::start_at(&endpoint, &["ALTextToSpeech"]);
    assert_eq!(nao.run("p", "say", "back"), completed("None"));
    robot.line_with("say back");
}

/// Aborts a task until the answer says that it goes on: a busy machine may answer before that is certain.
#[track_caller]
fn rejects_an_abort(remote: &mut RemoteTask, task: TaskId) {
    until("the abort is rejected", PATIENCE, || {
        let answer = remote.abort(task).expect("an answer");
        answer.is_abort_rejected().then_some(())
    });
}

#[test]
fn an_abort_that_the_method_ignores_is_rejected_and_the_task_goes_on() {
    let mut robot = Robot::start(&["ALTextToSpeech"]);
    let nao = Served::of(
        &robot,
        "say: {naoqi: ALTextToSpeech.say, arguments: ['{goal}'], grace: 100 ms},
         hush: {naoqi: ALTextToSpeech.stopAll}",
    );
    assert_eq!(nao.run("p", "hush", ""), completed("None"));
    let mut remote = nao.remote();
    let task = start(&mut remote, "p", "say", "a long story");
    robot.line_with("say a long story");
    rejects_an_abort(&mut remote, task);
    let status = remote.status(task).expect("a status");
    let expected = "ALTextToSpeech.say goes on: it has not ended within 100 ms after an abort";
    assert_eq!(status.text, expected);
    let logged = format!("p:say, goes on in spite of an abort: {expected}");
    nao.server.process.wait_for(&logged);
    assert_eq!(nao.run("p", "hush", ""), completed("None"));
    assert_eq!(end(&mut remote, task), completed("None"));
}

#[test]
fn an_abort_is_tried_again_after_a_late_answer_to_the_last() {
    let mut robot = Robot::start(&["ALMotion", "ALTextToSpeech"]);
    let nao = Served::of(
        &robot,
        "walk: {naoqi: ALMotion.moveTo, arguments: [2, 0, 0], grace: 100 ms,
                abort: {naoqi: ALTextToSpeech.say, arguments: ['a long story']}},
         hush: {naoqi: ALTextToSpeech.stopAll},
         stop: {naoqi: ALMotion.stopMove}",
    );
    let mut remote = nao.remote();
    let task = start(&mut remote, "p", "walk", "");
    robot.line_with("move 2.0");
    for _ in 0..3 {
        // What aborts takes longer than the grace, and returns when nobody waits for it any more.
        rejects_an_abort(&mut remote, task);
        robot.line_with("say a long story");
        assert_eq!(nao.run("p", "hush", ""), completed("None"));
        robot.line_with("silent");
    }
    assert_eq!(nao.run("p", "stop", ""), completed("None"));
    // Nobody can tell whether one of the aborts has ended it after all.
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));
}

#[test]
fn sigterm_stops_what_moves() {
    let mut robot = Robot::start(&["ALMotion"]);
    let nao = Served::of(
        &robot,
        "walk: {naoqi: ALMotion.moveTo, arguments: ['{goal}', 0, 0], abort: ALMotion.stopMove}",
    );
    assert_eq!(nao.run("p", "walk", "1"), completed("True"));
    start(&mut nao.remote(), "p", "walk", "2");
    robot.line_with("move 2.0");
    let server = nao.server;
    server.process.signal("TERM");
    robot.line_with("stopped");
    assert_eq!(server.process.end(PATIENCE).code, Some(143));
}

#[test]
fn sigterm_also_cancels_what_does_not_stop() {
    let mut robot = Robot::start(&["ALAnimationPlayer", "ALMotion"]);
    let nao = Served::of(
        &robot,
        "play: {naoqi: ALAnimationPlayer.run, arguments: ['{goal}'], abort: ALMotion.stopMove}",
    );
    assert_eq!(nao.run("p", "play", "short"), completed("over"));
    start(&mut nao.remote(), "p", "play", "long");
    robot.line_with("run long");
    let process = nao.server.process;
    process.signal("TERM");
    robot.line_with("stopped");
    // After the grace.
    robot.line_with("cancelled");
    process.wait_for("p:play, has ended as ABORTED: the server was stopped");
    assert_eq!(process.end(PATIENCE).code, Some(143));
}

#[test]
fn events_and_signals_are_streams_also_when_they_flood() {
    let mut robot = Robot::start(&["ALMemory", "ALMotion"]);
    let text = "scopes: {/test: {p: {set: {naoqi: ALMotion.setProperty, arguments: [stiffness, '{goal}']}}}}
streams: {/test: {touch: {naoqi-event: FrontTactilTouched}, stiffness: {naoqi-signal: ALMotion.stiffness},
    flood: {naoqi-signal: ALMemory.changed, latest: true}}}";
    let nao = Served::new(&robot.endpoint, "/test", text);
    let endpoint = format!("tcp://127.0.0.1:{}", nao.publish);
    let [mut touches, mut stiffnesses, mut floods] = ["touch", "stiffness", "flood"].map(|name| {
        let topic = format!("/test/{name}");
        Subscriber::connect(&endpoint, &topic).expect("a file")
    });
    // What is sent before both have subscribed is lost.
    let next = |subscriber: &mut Subscriber, wait| {
        let heard = subscriber.next_within(wait).expect("it can wait")?;
        let value = heard.value().expect("plain data");
        Some(value.value().repr().to_string())
    };
    const MOMENT: Duration = Duration::from_millis(200);
    let touch = until("a touch arrives", PATIENCE, || {
        robot.tell("raise FrontTactilTouched 1.0");
        next(&mut touches, MOMENT)
    });
    assert_eq!(touch, "1.0");
    let stiffness = until("a change arrives", PATIENCE, || {
        assert_eq!(nao.run("p", "set", "0.5"), completed("None"));
        next(&mut stiffnesses, MOMENT)
    });
    assert_eq!(stiffness, "0.5");
    until("the last of a flood", PATIENCE, || {
        robot.tell("flood 20000");
        let mut last = None;
        while let Some(value) = next(&mut floods, MOMENT) {
            last = Some(value);
        }
        (last? == "['flood', 19999]").then_some(())
    });
    assert_eq!(nao.run("p", "set", "0.25"), completed("None"));
}

/// The greeting of a robot, on the services that the examples use.
#[track_caller]
fn greets(name: &str, scope: &'static str) {
    let mut robot = Robot::start(&EXAMPLES_USE);
    let text = example(&format!("{name}.yaml"));
    let served = Served::new(&robot.endpoint, scope, &text);
    let scratch = Scratch::new();
    let remotes = example("greet/remotes.yaml").replace("12345", &served.server.port.to_string());
    std::fs::write(scratch.path("remotes.yaml"), remotes).expect("to write");
    // The real animation ends by itself.
    let scene = example(&format!("greet/{name}.yaml"));
    let short = scene.replace("animations/Stand/Gestures/Hey_1", "short");
    assert_ne!(scene, short);
    std::fs::write(scratch.path("scene.yaml"), short).expect("to write");
    // The service is found, which may take longer than a task waits on a busy machine.
    assert_eq!(served.run("motion", "posture", "Crouch"), completed("True"));
    let mut command = ztl();
    command.current_dir(scratch.path(""));
    let options = "run-script -s scene.yaml -c remotes.yaml --yes --plain";
    let play = Process::start(command.args(options.split(' ')));
    robot.line_with("posture Stand 0.5");
    let mut seen = Vec::new();
    for part in [
        "say Hello! Touch my head",
        "run short",
        "angles ['HeadPitch'] [-0.2",
    ] {
        if !seen.iter().any(|line: &String| line.contains(part)) {
            loop {
                seen.push(robot.process.next_line(PATIENCE));
                if seen.iter().any(|line| line.contains(part)) {
                    break;
                }
            }
        }
    }
    // A release is no touch.
    robot.tell("raise FrontTactilTouched 0.0");
    until("the touch ends it", PATIENCE, || {
        robot.tell("raise FrontTactilTouched 1.0");
        let straight = "angles ['HeadPitch'] [0.0]";
        robot.process.stdout().contains(straight).then_some(())
    });
    let ended = play.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

#[test]
fn nao_greets_until_a_touch() {
    greets("nao", "/nao");
}

#[test]
fn pepper_greets_until_a_touch() {
    greets("pepper", "/pepper");
}
