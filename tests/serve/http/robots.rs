//! The files of robots in `examples/serve`, played against stand-ins that behave as their documentation says.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::{Value, json};
use ztl_std::State::{Aborted, Completed, Failed};
use ztl_tests::lab::{PATIENCE, Process, Scratch, end, until, ztl};

use super::web::{Request, Served, Socket, Web, Wire, next, say};
use crate::rig::project;

/// How often a stand-in looks whether it is to send something.
const TICK: Duration = Duration::from_millis(20);

const SUCCESS: &str = r#"{"result": true, "status": "Success"}"#;

/// A stand-in for Misty, as its documentation says.
struct Misty {
    web: Web,
    events: Arc<Mutex<Vec<(&'static str, Value)>>>,
    /// Utterances that have not ended.
    speaks: Arc<Mutex<Vec<String>>>,
}

impl Misty {
    fn start() -> Self {
        let events: Arc<Mutex<Vec<_>>> = Arc::default();
        let speaks: Arc<Mutex<Vec<String>>> = Arc::default();
        let (raised, spoken) = (Arc::clone(&events), Arc::clone(&speaks));
        let web = Web::start(move |request, wire| match request.0.as_str() {
            "GET /pubsub" => pubsub(request, wire, &raised),
            "GET /api/battery" => say(
                wire,
                "200 OK",
                r#"{"result": {"chargePercent": 0.87}, "status": "Success"}"#,
            ),
            "POST /api/images/display" if !request.2.contains(".jpg") => {
                say(
                    wire,
                    "400 Bad Request",
                    r#"{"error": "no such file", "status": "Failed"}"#,
                );
            }
            "POST /api/tts/speak" => {
                let asked: Value = serde_json::from_str(&request.2).expect("JSON");
                // Without it, there is no event.
                if let Some(id) = asked["UtteranceId"].as_str() {
                    spoken.lock().expect("words").push(id.to_owned());
                }
                say(wire, "200 OK", SUCCESS);
            }
            "POST /api/tts/stop" => {
                say(wire, "200 OK", SUCCESS);
                ended(&spoken, &raised, true);
            }
            "POST /api/images/display"
            | "POST /api/arms/set"
            | "POST /api/drive/time"
            | "POST /api/faces/recognition/start"
            | "POST /api/faces/recognition/stop"
            | "POST /api/halt"
            | "POST /api/head"
            | "POST /api/led" => say(wire, "200 OK", SUCCESS),
            _ => say(wire, "404 Not Found", ""),
        });
        Self {
            web,
            events,
            speaks,
        }
    }

    fn raise(&self, kind: &'static str, message: Value) {
        self.events.lock().expect("events").push((kind, message));
    }

    /// Waits for an utterance, and ends it.
    #[track_caller]
    fn finish_speaking(&self) {
        until("an utterance", PATIENCE, || {
            ended(&self.speaks, &self.events, false).then_some(())
        });
    }
}

/// Ends the oldest utterance, if there is one.
fn ended(
    speaks: &Mutex<Vec<String>>,
    events: &Mutex<Vec<(&'static str, Value)>>,
    interrupted: bool,
) -> bool {
    let mut speaks = speaks.lock().expect("words");
    if speaks.is_empty() {
        return false;
    }
    let id = speaks.remove(0);
    let message = json!({"error": interrupted, "interrupted": interrupted, "utteranceId": id});
    let mut events = events.lock().expect("events");
    events.push(("TextToSpeechComplete", message));
    true
}

/// A subscription to a type of events.
fn pubsub(request: &Request, wire: &mut Wire, events: &Mutex<Vec<(&'static str, Value)>>) {
    let mut socket = Socket::accept(request, wire);
    let Ok(Some(wish)) = socket.next(PATIENCE) else {
        return;
    };
    let wish: Value = serde_json::from_str(&wish).expect("JSON");
    assert_eq!(wish["Operation"], "subscribe", "{wish}");
    assert!(wish["DebounceMs"].is_u64(), "{wish}");
    let name = wish["EventName"].as_str().expect("a name").to_owned();
    let mut told = events.lock().expect("events").len();
    let status = "Registration Status: API event registered.";
    socket.send(&json!({"eventName": name, "message": status}).to_string());
    while socket.next(TICK).is_ok() {
        let new: Vec<_> = events.lock().expect("events")[told..].to_vec();
        told += new.len();
        for (kind, message) in new {
            if wish["Type"] == kind {
                socket.send(&json!({"eventName": name, "message": message}).to_string());
            }
        }
    }
}

/// `ztl serve` with an example, for a stand-in instead of this host.
#[track_caller]
fn example(name: &str, scope: &'static str, host: &str, web: &Web) -> Served {
    let path = project("examples/serve").join(name);
    let text = std::fs::read_to_string(path).expect("an example");
    assert!(text.contains(host), "{text}");
    let text = text.replace(host, &format!("'127.0.0.1:{}'", web.port));
    Served::file(scope, &text)
}

#[test]
fn the_example_for_misty_shows_moves_drives_and_halts() {
    let robot = Misty::start();
    let web = &robot.web;
    let misty = example("misty.yaml", "/misty", "192.168.1.50", web);
    let success = (
        Completed,
        "{'result': True, 'status': 'Success'}".to_owned(),
    );
    for (handler, component, goal, request, body) in [
        (
            "face",
            "show",
            "e_Joy.jpg",
            "POST /api/images/display",
            r#"{"FileName":"e_Joy.jpg"}"#,
        ),
        (
            "face",
            "led",
            "{red: 255, green: 0, blue: 7}",
            "POST /api/led",
            r#"{"red":255,"green":0,"blue":7}"#,
        ),
        (
            "arms",
            "move",
            "{left: -29, right: 90}",
            "POST /api/arms/set",
            r#"{"LeftArmPosition":-29,"RightArmPosition":90,"LeftArmVelocity":60,"RightArmVelocity":60,"Units":"degrees"}"#,
        ),
        (
            "head",
            "look",
            "{yaw: 10.5}",
            "POST /api/head",
            r#"{"Pitch":0,"Roll":0,"Yaw":10.5,"Velocity":60,"Units":"degrees"}"#,
        ),
        (
            "base",
            "drive",
            "{speed: 10, ms: 100}",
            "POST /api/drive/time",
            r#"{"LinearVelocity":10,"AngularVelocity":0,"TimeMs":100}"#,
        ),
    ] {
        assert_eq!(misty.run(handler, component, goal), success, "{component}");
        let (_, headers, sent) = web.wait_for(request);
        assert_eq!(sent, body, "{component}");
        assert!(
            headers
                .to_lowercase()
                .contains("content-type: application/json"),
            "{headers}"
        );
    }
    assert_eq!(misty.run("faces", "recognize", ""), success);
    assert_eq!(misty.run("faces", "stop", ""), success);
    assert_eq!(
        misty.run("battery", "level", ""),
        (Completed, "0.87".to_owned())
    );
    let failed = "status 400: {'error': 'no such file', 'status': 'Failed'}";
    assert_eq!(
        misty.run("face", "show", "joy"),
        (Failed, failed.to_owned())
    );

    let (mut remote, task) = misty.trigger("base", "drive", "{speed: 10, ms: 10000}");
    until("the second drive", PATIENCE, || {
        web.asked("POST /api/drive/time").get(1).cloned()
    });
    remote.abort(task).expect("an answer");
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));
    assert!(!web.asked("POST /api/halt").is_empty());
}

#[test]
fn misty_has_spoken_when_its_event_says_so_and_its_events_are_streams() {
    let robot = Misty::start();
    let misty = example("misty.yaml", "/misty", "192.168.1.50", &robot.web);
    let (mut remote, task) = misty.trigger("tts", "say", "he said \"hi\", {x}");
    let sent = robot.web.wait_for("POST /api/tts/speak").2;
    let expected =
        format!(r#"{{"Text":"he said \"hi\", {{x}}","Flush":false,"UtteranceId":"ztl-{task}"}}"#);
    assert_eq!(sent, expected);
    // Another program's utterance ends.
    robot.raise(
        "TextToSpeechComplete",
        json!({"error": true, "interrupted": true, "utteranceId": "other"}),
    );
    let (mut waits, touch) = misty.trigger("touch", "wait", "");
    robot.finish_speaking();
    let said = (Completed, format!("ztl-say-{task}"));
    assert_eq!(end(&mut remote, task), said);

    let (mut remote, task) = misty.trigger("tts", "say", "a long story");
    until("the second", PATIENCE, || {
        robot.web.asked("POST /api/tts/speak").get(1).cloned()
    });
    remote.abort(task).expect("an answer");
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));

    let message = json!({"isContacted": true, "sensorPosition": "Chin"});
    let mut touches = misty.subscribe("/misty/touch");
    until("a touch", PATIENCE, || {
        robot.raise("TouchSensor", message.clone());
        let heard = touches.next_within(Duration::from_millis(100));
        let value = heard.expect("it can wait")?.value().expect("plain data");
        let shown = "{'isContacted': True, 'sensorPosition': 'Chin'}";
        assert_eq!(value.value().repr().to_string(), shown);
        Some(())
    });
    // The task may have subscribed later than the stream.
    until("a touch ends the task", PATIENCE, || {
        robot.raise("TouchSensor", message.clone());
        waits.status(touch).ok()?.state.is_final().then_some(())
    });
    assert_eq!(end(&mut waits, touch), (Completed, "Chin".to_owned()));
    until("the level", PATIENCE, || {
        let message = json!({"chargePercent": 0.5, "state": "Charging"});
        robot.raise("BatteryCharge", message);
        // The newest value also reaches who subscribes late.
        let mut level = misty.subscribe("/misty/battery");
        let heard = level.next_within(Duration::from_secs(1));
        let value = heard.expect("it can wait")?.value().expect("plain data");
        let shown = "{'chargePercent': 0.5, 'state': 'Charging'}";
        assert_eq!(value.value().repr().to_string(), shown);
        Some(())
    });
    robot.raise("FaceRecognition", json!({"label": "Ada", "trackId": 0}));
}

#[test]
fn misty_greets_until_a_touch() {
    let robot = Misty::start();
    let misty = example("misty.yaml", "/misty", "192.168.1.50", &robot.web);
    let scratch = Scratch::new();
    let greet = project("examples/serve/greet");
    let remotes = std::fs::read_to_string(greet.join("remotes.yaml")).expect("remotes");
    let remotes = remotes.replace("12345", &misty.server.port.to_string());
    std::fs::write(scratch.path("remotes.yaml"), remotes).expect("to write");
    let mut command = ztl();
    command.args(["run-script", "--yes", "--plain", "-s"]);
    command.arg(greet.join("misty.yaml"));
    command.arg("-c").arg(scratch.path("remotes.yaml"));
    let play = Process::start(&mut command);
    for request in [
        "POST /api/images/display",
        "POST /api/arms/set",
        "POST /api/head",
    ] {
        robot.web.wait_for(request);
    }
    robot.finish_speaking();
    until("the touch ends it", PATIENCE, || {
        // A release is none.
        for contact in [false, true] {
            let message = json!({"isContacted": contact, "sensorPosition": "HeadFront"});
            robot.raise("TouchSensor", message);
        }
        (robot.web.asked("POST /api/arms/set").len() == 2).then_some(())
    });
    let ended = play.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

/// A stand-in for the daemon of a Reachy Mini, as its source says: moves have a uuid, and those who listen are told how
/// they end.
fn reachy() -> (Web, Arc<Mutex<Vec<Value>>>) {
    let updates: Arc<Mutex<Vec<Value>>> = Arc::default();
    let told = Arc::clone(&updates);
    let moves = Mutex::new(0);
    let web = Web::start(move |request, wire| {
        let body: Value = serde_json::from_str(&request.2).unwrap_or_default();
        match request.0.as_str() {
            "GET /api/move/ws/updates" => {
                // A move may begin as soon as the client is accepted.
                let mut count = told.lock().expect("updates").len();
                let mut socket = Socket::accept(request, wire);
                while socket.next(TICK).is_ok() {
                    let new: Vec<_> = told.lock().expect("updates")[count..].to_vec();
                    count += new.len();
                    for update in new {
                        socket.send(&update.to_string());
                    }
                }
            }
            "GET /api/state/ws/full?frequency=10" => {
                let mut socket = Socket::accept(request, wire);
                while socket.next(TICK).is_ok() {
                    socket.send(r#"{"control_mode": "enabled", "body_yaw": 0.5}"#);
                }
            }
            "POST /api/move/goto" | "POST /api/move/play/wake_up" => {
                let mut count = moves.lock().expect("a number");
                *count += 1;
                let uuid = format!("7d444840-9dc0-11d1-b245-5ffdce74fa{count:02}");
                let update =
                    |kind: &str| json!({"type": kind, "uuid": uuid, "details": "out of reach"});
                let mut updates = told.lock().expect("updates");
                updates.push(update("move_started"));
                // Long moves go on until they are stopped.
                match body["duration"].as_f64() {
                    Some(seconds) if seconds > 10.0 => {}
                    Some(seconds) if seconds < 0.5 => updates.push(update("move_failed")),
                    _ => updates.push(update("move_completed")),
                }
                drop(updates);
                say(wire, "200 OK", &json!({"uuid": uuid}).to_string());
            }
            "POST /api/move/stop" => {
                let update = json!({"type": "move_cancelled", "uuid": body["uuid"], "details": ""});
                told.lock().expect("updates").push(update);
                let message = format!("Stopped move with UUID: {}", body["uuid"]);
                say(wire, "200 OK", &json!({"message": message}).to_string());
            }
            "GET /api/motors/status" => say(wire, "200 OK", r#"{"mode": "enabled"}"#),
            "POST /api/motors/set_mode/disabled" => {
                say(
                    wire,
                    "200 OK",
                    r#"{"status": "all motors changed to disabled mode"}"#,
                );
            }
            _ => say(wire, "404 Not Found", r#"{"detail": "Not Found"}"#),
        }
    });
    (web, updates)
}

#[test]
fn a_move_of_reachy_mini_ends_by_the_event_with_the_uuid_of_its_answer() {
    let (web, _) = reachy();
    let reachy = example(
        "reachy-mini.yaml",
        "/reachy",
        "\"reachy-mini.local:8000\"",
        &web,
    );
    let completed = |text: &str| (Completed, text.to_owned());
    assert_eq!(reachy.run("motors", "status", ""), completed("enabled"));
    assert_eq!(reachy.run("motors", "mode", "disabled").0, Completed);
    let moved = completed("move_completed");
    assert_eq!(reachy.run("body", "wake-up", ""), moved);
    assert_eq!(reachy.run("body", "move", "{yaw: 0.5, turn: -1}"), moved);
    let sent: Value = serde_json::from_str(&web.wait_for("POST /api/move/goto").2).expect("JSON");
    assert_eq!(sent["head_pose"]["yaw"], 0.5);
    assert_eq!(sent["body_yaw"].as_f64(), Some(-1.0));
    let (state, text) = reachy.run("body", "move", "{seconds: 0.2}");
    assert!(state == Failed && text.contains("out of reach"), "{text}");
    let (mut remote, task) = reachy.trigger("body", "move", "{seconds: 20}");
    until("the move", PATIENCE, || {
        web.asked("POST /api/move/goto").get(2).cloned()
    });
    remote.abort(task).expect("an answer");
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));
    let stopped = web.wait_for("POST /api/move/stop").2;
    assert_eq!(
        stopped,
        r#"{"uuid":"7d444840-9dc0-11d1-b245-5ffdce74fa04"}"#
    );
    let state = next(&mut reachy.subscribe("/reachy/state"));
    assert_eq!(state, "{'control_mode': 'enabled', 'body_yaw': 0.5}");
}
