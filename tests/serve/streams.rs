//! Programs whose output is published as streams.

mod load;

use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use ztl_pickle::{Kind, Pickle};
use ztl_std::Subscriber;
use ztl_tests::lab::{
    Ended, Keys, PATIENCE, Process, Scratch, Server, busy, connect_to, python, until, ztl,
};

use crate::rig::{Rig, dies, is_starved, lives, project, trigger_task};

const WAIT: Duration = Duration::from_millis(20);

/// A server with these streams of `/robot`, one a line.
struct Robot {
    rig: Rig,
    port: u16,
}

impl Robot {
    #[track_caller]
    fn new(streams: &str) -> Self {
        Self::with(streams, &[])
    }

    #[track_caller]
    fn with(streams: &str, options: &[&str]) -> Self {
        Self::of_file(&file(streams), options)
    }

    #[track_caller]
    fn of_file(text: &str, options: &[&str]) -> Self {
        let options = [&["--publish", "0"], options].concat();
        let rig = Rig::of_file(text, &options);
        let said = "Publishing streams and events of tasks at ";
        let port = rig.server.process.wait_for_port(said);
        Self { rig, port }
    }

    #[track_caller]
    fn subscribe(&self, topic: &str) -> Subscriber {
        Subscriber::connect(&self.endpoint(), topic).expect("a file")
    }

    fn endpoint(&self) -> String {
        format!("tcp://127.0.0.1:{}", self.port)
    }

    /// A subscriber in Python with pyzmq alone. It prints a line for each message: the topic, and the value as Python
    /// shows it, or bytes in hexadecimal.
    #[track_caller]
    fn python(&self, topic: &str) -> Process {
        self.run_python(PLAIN, topic)
    }

    #[track_caller]
    fn run_python(&self, script: &str, topic: &str) -> Process {
        let port = self.port.to_string();
        Process::start(Command::new(python()).args(["-c", script, &port, topic]))
    }

    fn touch(&self, name: &str) {
        std::fs::write(self.rig.scratch.path(name), "").expect("to write");
    }

    /// The lines of a file in the directory of the programs.
    fn lines(&self, name: &str) -> Vec<String> {
        let text = std::fs::read_to_string(self.rig.scratch.path(name)).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }
}

fn file(streams: &str) -> String {
    let lines = streams.trim().lines();
    let lines: Vec<String> = lines.map(|line| format!("    {}", line.trim())).collect();
    format!("streams:\n  /robot:\n{}\n", lines.join("\n"))
}

const PLAIN: &str = "
import pickle, sys, zmq
sensor = zmq.Context().socket(zmq.SUB)
sensor.connect('tcp://localhost:' + sys.argv[1])
sensor.subscribe(sys.argv[2])
while True:
    topic, value = sensor.recv_multipart()
    value = pickle.loads(value)
    print(topic.decode(), value.hex() if isinstance(value, bytes) else repr(value), flush=True)
";

const ORIGINALS: &str = "
import sys
from ztl.core.subscriber import ObjectSubscriber
class Shown(ObjectSubscriber):
    def callback(self, obj):
        print(obj.hex() if isinstance(obj, bytes) else repr(obj), flush=True)
Shown('localhost', int(sys.argv[1]), sys.argv[2]).start()
";

/// The next value of a subscriber.
#[track_caller]
fn next(subscriber: &mut Subscriber) -> Pickle {
    let heard = subscriber.next_within(PATIENCE).expect("it can wait");
    heard.expect("a message").value().expect("plain data")
}

#[track_caller]
fn shown(subscriber: &mut Subscriber) -> String {
    next(subscriber).value().repr().to_string()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn a_tone_is_heard_byte_for_byte_in_python_and_by_the_original() {
    // Without dither, so that it is the same each time.
    let tone = "sox -D -n -r 16000 -b 16 -c 1 -e signed -t raw - synth 2 sine 440";
    let made = Command::new("sh").args(["-c", tone]).output();
    let made = made.expect("`sox`").stdout;
    assert_eq!(made.len(), 2 * 2 * 16_000);
    let robot = Robot::new(&format!(
        "tick: {{shell: 'while sleep 0.02; do echo tick; done', frame: line}}
        microphone: {{shell: 'until [ -e go ]; do sleep 0.01; done; rm go; exec {tone}', frame: 3200 bytes}}"
    ));
    let subscribers = [
        robot.python("/robot"),
        robot.run_python(ORIGINALS, "/robot"),
    ];
    for subscriber in &subscribers {
        subscriber.wait_for("'tick'");
    }
    robot.touch("go");
    for subscriber in subscribers {
        until("the tone", PATIENCE, || {
            let text = subscriber.stdout();
            let blocks = text
                .lines()
                .map(|line| line.strip_prefix("/robot/microphone ").unwrap_or(line))
                .filter(|line| !line.ends_with("'tick'"));
            let blocks: Vec<&str> = blocks.collect();
            // The last line may be incomplete.
            (blocks.len() >= 20 && text.ends_with('\n')).then(|| {
                assert!(blocks.iter().all(|block| block.len() == 6400));
                assert!(blocks.concat() == hex(&made), "it sounds different");
            })
        });
    }
}

#[test]
fn each_kind_of_frame_is_a_value_in_python() {
    let images = ["thumbnail", "progressive"].map(|name| {
        let path = project(&format!("tests/serve/images/{name}.jpg"));
        std::fs::read(path).expect("an image")
    });
    let streams = r#"
        line: {run: [sh, -c, 'until [ -e go ]; do sleep 0.01; done; printf "one\r\n\n\377 2\nrest"; sleep 60'], frame: line}
        json: {shell: 'until [ -e go ]; do sleep 0.01; done; cat json; sleep 60', frame: json}
        blocks: {shell: 'until [ -e go ]; do sleep 0.01; done; printf "\0\1\2\3\4"; sleep 60', frame: 2 bytes}
        length: {shell: 'until [ -e go ]; do sleep 0.01; done; printf "\0\0\0\3abc\0\0\0\0\0\0\0\1d"; sleep 60', frame: length}
        jpeg: {run: [PYTHON, cut.py], frame: jpeg}
        who: {shell: 'until [ -e go ]; do sleep 0.01; done; echo "$ZTL_SCOPE $LANG ${ZTL_GOAL-none}"; sleep 60', environment: {LANG: de}, frame: line}
        tick: {shell: 'while sleep 0.02; do echo tick; done', frame: line}
        "#;
    let python = python().display().to_string();
    let robot = Robot::new(&streams.replace("PYTHON", &python));
    let json = r#"{"x": [1, -2.5, 0.1, 12345678901234567890, true, null], "a": "\u00e4"}

nonsense
"text"
"#;
    std::fs::write(robot.rig.scratch.path("json"), json).expect("to write");
    std::fs::write(
        robot.rig.scratch.path("images"),
        [&images[0][..], b"\r\n--next\r\n", &images[1], &images[0]].concat(),
    )
    .expect("to write");
    // Pieces of many lengths.
    let cut = "
import os, time
while not os.path.exists('go'): time.sleep(0.01)
data, at, size = open('images', 'rb').read(), 0, 1
while at < len(data):
    os.write(1, data[at:at + size])
    at, size = at + size, size % 97 + 1
time.sleep(60)
";
    std::fs::write(robot.rig.scratch.path("cut.py"), cut).expect("to write");
    let subscriber = robot.python("/robot/");
    subscriber.wait_for("'tick'");
    robot.touch("go");
    let [first, second] = images.each_ref().map(|image| hex(image));
    for (name, values) in [
        ("line", &["'one'", "''", "'\u{fffd} 2'"][..]),
        (
            "json",
            &[
                "{'x': [1, -2.5, 0.1, 12345678901234567890, True, None], 'a': 'ä'}",
                "'text'",
            ],
        ),
        ("blocks", &["0001", "0203"]),
        ("length", &["616263", "", "64"]),
        ("jpeg", &[&first, &second, &first]),
        ("who", &["'/robot de none'"]),
    ] {
        let topic = format!("/robot/{name} ");
        let found = until(name, PATIENCE, || {
            let text = subscriber.stdout();
            let lines = text.lines().filter_map(|line| line.strip_prefix(&topic));
            let lines: Vec<String> = lines.map(str::to_owned).collect();
            (lines.len() >= values.len()).then_some(lines)
        });
        assert_eq!(found, values, "{name}");
    }
    let said = "Stream /robot/json: a frame was dropped: it is not JSON: expected ident at line 1";
    robot.rig.server.process.wait_for(said);
}

#[test]
fn a_program_that_ends_is_started_again_after_longer_and_longer_pauses() {
    let robot = Robot::new(
        "fails: {shell: 'echo \"$ZTL_ID\" >> ids; echo oops >&2; exit 3', frame: line}
        missing: {run: [no-such-program], frame: line}
        ends: {shell: 'echo value', frame: line}
        tick: {shell: 'while sleep 0.02; do echo tick; done', frame: line}",
    );
    let process = &robot.rig.server.process;
    for (name, why) in [
        ("fails", "exit code 3: oops"),
        ("ends", "exit code 0"),
        ("missing", "no-such-program: not found; install it"),
    ] {
        let again = format!("Stream /robot/{name} has ended, and begins again in ");
        for pause in ["500 ms", "1 s", "2 s"] {
            process.wait_for(&format!("{again}{pause}: "));
        }
        process.wait_for(&format!(": {why}"));
        let log = process.stderr();
        for line in log.lines().filter(|line| line.contains(&again)) {
            assert!(line.contains(why) || is_starved(line), "{line}");
        }
    }
    let line = process.wait_for("no-such-program: not found; ");
    assert!(line.ends_with("robot.yaml:4"), "{line}");
    until("a third start", PATIENCE, || {
        (robot.lines("ids").len() >= 3).then_some(())
    });
    let ids = robot.lines("ids");
    assert!(ids.iter().all(|id| id.starts_with("stream-")), "{ids:?}");
    assert_ne!(ids[0], ids[1]);
    let mut ends = robot.subscribe("/robot/ends");
    assert_eq!(shown(&mut ends), "'value'");
    assert_eq!(shown(&mut robot.subscribe("/robot/tick")), "'tick'");
}

#[test]
fn a_program_runs_only_while_someone_subscribes() {
    let robot = Robot::new(
        "sound: {shell: 'echo $$ >> starts; while sleep 0.02; do echo on; done', frame: line, when-watched: 1 s}
        other: {shell: 'while sleep 0.02; do echo other; done', frame: line}",
    );
    // Who hears another stream does not start it.
    let mut other = robot.subscribe("/robot/other");
    for _ in 0..10 {
        assert_eq!(shown(&mut other), "'other'");
    }
    assert!(robot.lines("starts").is_empty());
    let mut first = robot.subscribe("/robot/sound");
    assert_eq!(shown(&mut first), "'on'");
    // A topic that begins so, and another kind of subscriber.
    let second = robot.python("/rob");
    second.wait_for("/robot/sound 'on'");
    drop(first);
    let mut third = robot.subscribe("/robot/sound");
    assert_eq!(shown(&mut third), "'on'");
    drop(second);
    // Longer than it waits for others.
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(2000) {
        assert_eq!(shown(&mut third), "'on'");
    }
    let starts = robot.lines("starts");
    assert_eq!(starts.len(), 1, "{starts:?}");
    let process: u32 = starts[0].parse().expect("a number");
    assert!(lives(process));
    let left = Instant::now();
    drop(third);
    dies(process);
    assert!(left.elapsed() >= Duration::from_secs(1));
    assert_eq!(shown(&mut other), "'other'");
    assert_eq!(robot.lines("starts").len(), 1);
    let mut again = robot.subscribe("/robot/sound");
    assert_eq!(shown(&mut again), "'on'");
    assert_eq!(robot.lines("starts").len(), 2);
}

#[test]
fn a_rate_leaves_out_what_is_between_and_keeps_the_last() {
    let robot = Robot::new(
        "fast: {shell: 'for n in $(seq 300); do echo $n; sleep 0.02; done; sleep 60', frame: line, rate: 5 Hz, when-watched: 60 s}",
    );
    let start = Instant::now();
    let mut fast = robot.subscribe("/robot/fast");
    let mut heard = vec![];
    while heard.last().map(String::as_str) != Some("'300'") {
        heard.push(shown(&mut fast));
    }
    let most = 2 + (start.elapsed().as_secs_f64() * 5.0) as usize;
    assert_eq!(heard[0], "'1'");
    assert!((3..=most).contains(&heard.len()), "{most}: {heard:?}");
}

#[test]
fn a_late_subscriber_gets_the_newest_value_of_a_stream_that_has_one() {
    let robot = Robot::new(
        "level: {shell: 'echo 41; echo 42; sleep 60', frame: json, latest: true, when-watched: 60 s}
        word: {shell: 'echo early; sleep 60', frame: line, when-watched: 60 s}",
    );
    let mut early = robot.subscribe("/robot");
    let mut heard = [shown(&mut early), shown(&mut early)];
    if heard.contains(&"41".to_owned()) {
        heard = heard.map(|one| if one == "41" { shown(&mut early) } else { one });
    }
    heard.sort();
    assert_eq!(heard, ["'early'", "42"]);
    let mut late = robot.subscribe("/robot");
    assert_eq!(shown(&mut late), "42");
    let more = late.next_within(Duration::from_millis(100));
    assert_eq!(more.expect("it can wait"), None);
    let python = robot.python("/robot/level");
    python.wait_for("/robot/level 42");
}

#[test]
fn a_killed_server_leaves_no_program_behind() {
    let text = file(
        "one: {shell: 'while sleep 0.02; do echo 1; done', frame: line}
        two: {run: [sh, -c, 'trap \"\" TERM; sleep 60 & wait; sleep 60'], frame: line, abort: {grace: 100 ms}}",
    );
    for delay in 0..12 {
        let scratch = Scratch::new();
        let path = scratch.path("robot.yaml");
        std::fs::write(&path, &text).expect("to write");
        let mut command = ztl();
        command
            .arg("serve")
            .arg(path)
            .args(["-p", "0", "--publish", "0"]);
        let process = Process::start(&mut command);
        process.wait_for("Task Server listening at");
        // At a different moment of their starts each time; the last ones run.
        std::thread::sleep(Duration::from_micros(delay * delay * delay * 100));
        let server = Server { process, port: 0 };
        let mut rig = Rig { server, scratch };
        rig.server.process.kill();
        // That of the watchdog, too.
        rig.server.process.wait_for_end_of_output();
        rig.wait_deserted(format_args!("delay {delay}"));
    }
}

#[test]
fn a_signal_stops_streams_and_tasks_together() {
    let text = "
scopes: {/robot: {h: {c: {run: [sh, -c, 'trap \"\" TERM; echo > task; sleep 60; sleep 60'], abort: {grace: 2 s}}}}}
streams:
  /robot:
    careful: {run: [sh, -c, 'trap \"echo parked > parked; exit\" INT; echo > careful; while :; do sleep 0.02; done'], frame: line, abort: {signal: INT, grace: 20 s}}
    stubborn: {run: [sh, -c, 'trap \"\" TERM; echo > stubborn; sleep 60; sleep 60'], frame: line, abort: {grace: 2 s}}
    driven: {run: [sh, -c, 'echo > driven; until [ -e halt ]; do sleep 0.02; done'], frame: line, abort: {run: [sh, -c, 'echo \"$ZTL_SCOPE\" > halt'], grace: 20 s}}
";
    let rig = Rig::of_file(text, &["--publish", "0"]);
    let served = "Serving 1 component at /robot, 3 streams at /robot at ";
    rig.server.process.wait_for(served);
    let mut remote = connect_to(&rig.server.endpoint(), "/robot");
    trigger_task(&mut remote, ["h", "c", ""]);
    for name in ["task", "careful", "stubborn", "driven"] {
        until(name, PATIENCE, || {
            rig.scratch.path(name).exists().then_some(())
        });
    }
    let start = Instant::now();
    rig.server.process.signal("TERM");
    assert_eq!(rig.written("parked"), "parked");
    assert_eq!(rig.written("halt"), "/robot");
    let Rig { server, scratch } = rig;
    let ended = server.process.end(PATIENCE);
    let took = start.elapsed();
    assert_eq!(ended.code, Some(143), "{ended:?}");
    assert!(ended.stdout.ends_with("Stopped.\n"), "{ended:?}");
    // Not one after the other.
    assert!(took >= Duration::from_secs(2), "{took:?}");
    println!("stopped within {took:?}");
    assert!(
        !ended.stderr.contains("has ended, and begins again"),
        "{ended:?}"
    );
    drop(scratch);
}

#[test]
fn a_key_of_another_scope_neither_hears_a_stream_nor_starts_it() {
    let keys = Keys::make(&["server", "anna", "berta"]);
    let own = keys.path("server.key_secret");
    let [anna, berta] = [("/robot", "anna.key"), ("/other", "berta.key")]
        .map(|(scope, key)| format!("{scope}={}", keys.path(key)));
    let robot = Robot::with(
        "sound: {shell: 'echo >> starts; while sleep 0.02; do echo on; done', frame: line, when-watched: 60 s}",
        &["--key", &own, "--client-key", &anna, "--client-key", &berta],
    );
    let warned =
        "client keys are allowed at scope '/other', which is not served; there are: /robot";
    robot.rig.server.process.wait_for(warned);
    let subscribe = |name: &str| {
        let subscriber = Subscriber::builder().keys(keys.pair(name), keys.pair("server").public());
        let subscriber = subscriber.scope("/robot").connect(&robot.endpoint());
        subscriber.expect("a file")
    };
    let mut berta = subscribe("berta");
    until("her connection", PATIENCE, || {
        assert_eq!(berta.next_within(WAIT).expect("it can wait"), None);
        berta.is_connected().then_some(())
    });
    let silence = berta.next_within(Duration::from_millis(300));
    assert_eq!(silence.expect("it can wait"), None);
    assert!(!robot.rig.scratch.path("starts").exists());
    assert_eq!(shown(&mut subscribe("anna")), "'on'");
    assert_eq!(berta.next_within(WAIT).expect("it can wait"), None);
}

#[test]
fn streams_need_a_port_to_publish_at() {
    let scratch = Scratch::new();
    let path = scratch.path("robot.yaml");
    let check = |text: &str, options: &[&str]| -> Ended {
        std::fs::write(&path, text).expect("to write");
        Process::run(
            ztl()
                .arg("serve")
                .arg(&path)
                .args(["--check", "-p", "0"])
                .args(options),
        )
    };
    let text = "streams:\n  /a: {b: {run: [sh], frame: line}, c: {run: [sh], frame: json}}\n";
    let ended = check(text, &[]);
    let said = format!(
        "{}:2:3: streams need a port where they are published; write publish: 12346, or give --publish\n",
        path.display()
    );
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(ended.stderr.starts_with(&said), "{ended:?}");
    let ended = check(text, &["--publish", "0", "-s", "/x"]);
    let said = "Nothing is wrong: 2 streams at /x, at 127.0.0.1:0.\n";
    assert_eq!(
        (ended.code, ended.stdout.as_str()),
        (Some(0), said),
        "{ended:?}"
    );
    let text = format!("publish: 0\nscopes: {{/b: {{h: {{c: echo}}}}}}\n{text}");
    let ended = check(&text, &[]);
    let said = "Nothing is wrong: 1 component at /b, 2 streams at /a, at 127.0.0.1:0.\n";
    assert_eq!(
        (ended.code, ended.stdout.as_str()),
        (Some(0), said),
        "{ended:?}"
    );
    let ended = check(&text, &["-s", "/x"]);
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(
        ended
            .stderr
            .contains("--scope names the only scope of a file"),
        "{ended:?}"
    );
}

/// A program that closes its output is stopped by its stop rule.
#[test]
fn a_program_that_closes_its_output_is_stopped_and_started_again() {
    let robot = Robot::new(
        "quiet: {shell: 'trap \"echo stopped >> stops; exit\" INT; echo value; exec >&-; while :; do sleep 0.02; done', frame: line, abort: INT, latest: true}",
    );
    let said = "Stream /robot/quiet has ended, and begins again in 500 ms: it closed its output, ran on and was stopped";
    robot.rig.server.process.wait_for(said);
    let stops = robot.rig.written("stops");
    assert!(stops.lines().all(|line| line == "stopped"), "{stops}");
    assert_eq!(shown(&mut robot.subscribe("/robot/quiet")), "'value'");
}

/// Otherwise it may read of programs as if they were left behind.
#[test]
fn the_watchdog_ends_before_a_server_that_stops_regularly() {
    let text = "
scopes: {/r: {h: {c: {run: [sleep, '60']}}}}
streams: {/r: {s: {shell: 'while sleep 0.02; do echo 1; done', frame: line}}}
";
    let rig = Rig::of_file(text, &["--publish", "0"]);
    let mut remote = connect_to(&rig.server.endpoint(), "/r");
    trigger_task(&mut remote, ["h", "c", ""]);
    let watchdog = rig.watchdog();
    rig.server.process.signal("TERM");
    let Rig { server, scratch } = rig;
    // Looks without a pause: a watchdog that the server has not waited for ends soon after it.
    let start = Instant::now();
    while lives(server.process.id()) {
        assert!(start.elapsed() < PATIENCE);
    }
    assert!(!Path::new(&format!("/proc/{watchdog}")).exists());
    let ended = server.process.end(PATIENCE);
    assert_eq!(ended.code, Some(143), "{ended:?}");
    assert!(!ended.stderr.contains("ERROR"), "{ended:?}");
    drop(scratch);
}
