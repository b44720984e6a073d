//! `ztl run-script --record` writes what `docs/record.md` describes, and a record is readable after a crash.

use std::fs;

use serde_json::Value;
use ztl_record::{Content, Read, Reader};
use ztl_std::Publisher;
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Scratch, Server, port_of, until, ztl};

const DOCS: &str = include_str!("../../docs/record.md");

/// The first block of the documentation in this language.
#[track_caller]
fn block(language: &str) -> &'static str {
    let (_, rest) = DOCS
        .split_once(&format!("```{language}\n"))
        .expect(language);
    rest.split_once("```").expect("its end").0
}

/// A record as values, without the parts that differ between runs.
fn lasting(lines: &str) -> Vec<Value> {
    fn settle(value: &mut Value) {
        match value {
            Value::Object(fields) => {
                for (name, value) in fields {
                    match (name.as_str(), &*value) {
                        ("at_ms" | "latency_ms" | "id", Value::Number(_)) => *value = 0.into(),
                        ("wall" | "sha256" | "endpoint" | "versions" | "text", _) => {
                            settle_text(value)
                        }
                        _ => settle(value),
                    }
                }
            }
            Value::Array(all) => all.iter_mut().for_each(settle),
            _ => {}
        }
    }
    /// Numbers of several digits, and all of a hash.
    fn settle_text(value: &mut Value) {
        match value {
            Value::String(text) if text.len() == 64 => "hash".clone_into(text),
            Value::String(text) => *text = text.replace(|char: char| char.is_ascii_digit(), ""),
            // The programs without their versions.
            Value::Array(versions) => versions
                .iter_mut()
                .for_each(|version| version[1] = Value::Null),
            _ => {}
        }
    }
    let values = lines.lines().map(|line| {
        let mut value =
            serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
        settle(&mut value);
        value
    });
    values.collect()
}

/// A server, and a script and its configuration in a directory.
fn stage(script: &str) -> (Server, Scratch) {
    let server = Server::ours();
    let files = Scratch::new();
    fs::write(files.path("one.yaml"), script).unwrap();
    let port = server.port;
    let remotes = format!("remotes: {{test: {{host: 127.0.0.1, port: {port}, scope: /test}}}}\n");
    fs::write(files.path("remotes.yaml"), remotes).unwrap();
    (server, files)
}

const PLAY: &str = "run-script -s one.yaml -c remotes.yaml --yes --record one.jsonl";

#[test]
fn the_documented_record_matches_a_written_one() {
    let (_server, files) = stage(block("yaml"));
    assert!(DOCS.contains(&format!("`ztl {PLAY}`")));
    let ended = Process::run(ztl().current_dir(files.path("")).args(PLAY.split(' ')));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let written = lasting(&fs::read_to_string(files.path("one.jsonl")).unwrap());
    // Joins lines that were wrapped for reading.
    let told = lasting(&block("json").replace("\n    ", ""));
    for (written, told) in written.iter().zip(&told) {
        assert_eq!(written, told);
    }
    assert_eq!(written.len(), told.len());
    for line in &written {
        let event = line["event"].as_str().unwrap();
        assert!(DOCS.contains(&format!("`{event}`")), "{event} is explained");
    }
}

#[test]
fn a_record_is_readable_up_to_a_crash() {
    let (_server, files) =
        stage("one:\n  first: {test: {echo: hello}}\n  second: {test: {sleep: 60}}\n");
    let mut play = Process::start(ztl().current_dir(files.path("")).args(PLAY.split(' ')));
    let path = files.path("one.jsonl");
    until("the second task", PATIENCE, || {
        let text = fs::read_to_string(&path).unwrap_or_default();
        text.contains("test:sleep:60").then_some(())
    });
    play.kill();
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.ends_with('\n'), "whole lines: {text:?}");
    let ended =
        Process::run(
            ztl()
                .current_dir(files.path(""))
                .args(["report", "one.jsonl", "--csv"]),
        );
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended.stderr.contains("the end of one.jsonl is lacking"),
        "{ended:?}"
    );
    let tasks = fs::read_to_string(files.path("one.tasks.csv")).unwrap();
    let states: Vec<&str> = tasks
        .lines()
        .skip(1)
        .map(|line| line.rsplit(',').nth(1).unwrap())
        .collect();
    assert_eq!(states[0], "completed", "{tasks}");
    assert_eq!(states.len(), 2, "{tasks}");
}

/// The messages of a recording.
#[track_caller]
fn recorded(path: &std::path::Path) -> Vec<Read> {
    let mut reader = Reader::open(path).expect("a file");
    let read = reader.by_ref().collect();
    assert!(!reader.damage().is_any(), "{}", reader.damage());
    read
}

/// The events of a run in a recording, a line for each.
fn run_of(read: &[Read]) -> String {
    let events = read.iter().filter_map(|read| match &read.content {
        Content::Run(event) => Some(String::from_utf8(event.clone()).expect("JSON") + "\n"),
        _ => None,
    });
    events.collect()
}

#[test]
fn a_run_is_recorded_beside_the_streams_and_tasks_of_its_servers() {
    let files = Scratch::new();
    // `held` runs until there is a file with its goal as its name.
    let held = "n=0; until test -e \"$ZTL_GOAL\"; do n=$((n+1)); echo waits $n; sleep 0.1; done";
    let robot = format!(
        "port: 0\npublish: 0\nscopes:\n  {SCOPE}:\n    test:\n      echo: echo\n      \
         held: {{shell: '{held}', progress: ''}}\n"
    );
    fs::write(files.path("robot.yaml"), robot).unwrap();
    let mut serve = ztl();
    serve
        .current_dir(files.path(""))
        .args(["serve", "robot.yaml"]);
    let server = Server::start(&mut serve);
    let announced = "Publishing events of tasks at tcp://127.0.0.1:";
    let (port, events) = (server.port, server.process.wait_for_port(announced));
    let sensor = Publisher::bind("tcp://127.0.0.1:*", "/sensor").unwrap();
    sensor.publish_state("/", &12.5.into());
    let sensors = port_of(sensor.endpoint());
    let remotes = format!(
        "remotes: {{test: {{host: localhost, port: {port}, scope: {SCOPE}}}}}\n\
         publishers:\n  robot: {{host: localhost, port: {events}, scope: {SCOPE}}}\n  \
         sensor: {{host: localhost, port: {sensors}, scope: /sensor}}\n"
    );
    fs::write(files.path("remotes.yaml"), remotes).unwrap();
    // The run does not wait for the publishers, so it waits for tasks until both are connected, and until what became of the
    // second task is recorded.
    let script = "one:\n  first: {test: {held: connected}}\n  second: {test: {echo: again}}\n  \
                  third: {test: {held: recorded}}\n";
    fs::write(files.path("one.yaml"), script).unwrap();
    let play = PLAY.replace("one.jsonl", "one.mcap");
    let run = Process::start(ztl().current_dir(files.path("")).args(play.split(' ')));
    let file = files.path("one.mcap");
    let has = |is_it: &dyn Fn(&Read) -> bool| {
        Reader::open(&file).is_ok_and(|mut reader| reader.any(|read| is_it(&read)))
    };
    let is_value = |read: &Read| matches!(&read.content, Content::Value(value) if value.value().as_f64() == Some(12.5));
    let is_told =
        |read: &Read| matches!(&read.content, Content::Task(..)) && read.source.name == "robot";
    let is_again = |read: &Read| matches!(&read.content, Content::Task(event, _) if event.text == "again" && read.source.name == "robot");
    until("both publishers to be recorded", PATIENCE, || {
        (has(&is_value) && has(&is_told)).then_some(())
    });
    fs::write(files.path("connected"), "").unwrap();
    until("the second task to be recorded", PATIENCE, || {
        has(&is_again).then_some(())
    });
    fs::write(files.path("recorded"), "").unwrap();
    let ended = run.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");

    let read = recorded(&file);
    let times: Vec<u64> = read.iter().map(|read| read.log_time).collect();
    assert!(times.is_sorted(), "one clock");
    // The run's events are those of a record, at their times.
    let run = run_of(&read);
    let events: Vec<Value> = run
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(events[0]["event"], "run_started");
    assert_eq!(events.last().unwrap()["event"], "run_ended");
    // Nothing is earlier than what stands before it, which may have come later and be written first.
    let before = [0].into_iter().chain(times.iter().copied());
    let of_run = before
        .zip(&read)
        .filter(|(_, read)| matches!(read.content, Content::Run(_)));
    let begins: Vec<f64> = of_run
        .clone()
        .zip(&events)
        .map(|((_, read), event)| read.log_time as f64 / 1e6 - event["at_ms"].as_f64().unwrap())
        .collect();
    let begin = begins.iter().copied().fold(f64::INFINITY, f64::min);
    for ((before, read), its_begin) in of_run.zip(begins) {
        assert!(
            its_begin - begin < 0.1 || read.log_time == before,
            "{begin} {its_begin}: {read:?}"
        );
        assert_eq!(read.topic, "/$run");
    }
    // Beside them are the value, and the server's events of the second task.
    assert!(read.iter().any(is_value), "{read:?}");
    assert!(read.iter().any(is_again), "{read:?}");

    let mut report = ztl();
    report
        .current_dir(files.path(""))
        .args(["report", "one.mcap", "--csv"]);
    let ended = Process::run(&mut report);
    assert_eq!(
        (ended.code, ended.stderr.as_str()),
        (Some(0), ""),
        "{ended:?}"
    );
    let tasks = fs::read_to_string(files.path("one.tasks.csv")).unwrap();
    assert_eq!(tasks.lines().count(), 4, "{tasks}");
    // It says the same of the run as the report of a record.
    fs::write(files.path("lines.jsonl"), run).unwrap();
    let mut report = ztl();
    report
        .current_dir(files.path(""))
        .args(["report", "lines.jsonl"]);
    assert_eq!(Process::run(&mut report).code, Some(0));
    let page = |name| fs::read_to_string(files.path(name)).unwrap();
    let (recorded, lines) = (
        page("one.html"),
        page("lines.html").replace("lines.jsonl", "one.mcap"),
    );
    let mut rest = recorded.lines();
    for line in lines.lines() {
        assert!(rest.any(|other| other == line), "not in it: {line}");
    }
    assert!(recorded.contains("class=\"series s0\""));
    assert!(!lines.contains("class=\"series s0\""));
}

#[test]
fn a_recording_on_a_full_disk_ends_with_a_warning_and_the_show_goes_on() {
    let (_server, files) =
        stage("one:\n  first: {test: {echo: hello}}\n  second: {test: {echo: again}}\n");
    let play = PLAY.replace("one.jsonl", "one.mcap");
    let show = ztl();
    let mut limited = std::process::Command::new("sh");
    // 1 block of 512 bytes: the beginning of the file, and not the first chunk.
    let script = "trap '' XFSZ; ulimit -f 1; exec \"$@\"";
    limited.args(["-c", script, "sh"]).arg(show.get_program());
    limited.current_dir(files.path("")).args(play.split(' '));
    let ended = Process::run(&mut limited);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let why = "cannot write one.mcap: File too large (os error 27); the recording has ended";
    assert!(ended.stderr.contains(why), "{ended:?}");
    assert!(fs::metadata(files.path("one.mcap")).unwrap().len() <= 512);
}

#[test]
fn a_recording_that_exists_stops_the_run_before_anything_is_sent() {
    let (server, files) = stage("one:\n  first: {test: {echo: hello}}\n");
    fs::write(files.path("one.mcap"), "precious").unwrap();
    let play = PLAY.replace("one.jsonl", "one.mcap");
    let ended = Process::run(ztl().current_dir(files.path("")).args(play.split(' ')));
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stderr.contains("not overwritten"), "{ended:?}");
    assert_eq!(
        fs::read_to_string(files.path("one.mcap")).unwrap(),
        "precious"
    );
    let port = server.port.to_string();
    let tasks = Process::run(ztl().args(["ps", "-p", &port, "--json"]));
    assert!(tasks.stdout.contains("\"tasks\":[]"), "{tasks:?}");
}
