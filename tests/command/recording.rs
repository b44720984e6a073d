//! `ztl record`, `ztl replay`, and the files between them.

mod replayed_tasks;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ztl_pickle::Pickle;
use ztl_record::{Content, Formats, Read, Reader, Recording, Source};
use ztl_std::{Publisher, Subscriber};
use ztl_tests::lab::{
    Ended, PATIENCE, Process, Random, SCOPE, Scratch, Server, Terminal, busy, our_client_at,
    port_of, reserve_port, run_python, seed, until, ztl,
};

/// Prints a line for each message of each file that PyPI's `mcap` reads from its start: file, topic, schema, log time,
/// publish time, message. A file without an end is read up to there.
const READ: &str = r"
import json, sys
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader

for path in sys.argv[1:]:
    schemas, channels, whole = {}, {}, True
    with open(path, 'rb') as file:
        try:
            for record in StreamReader(file).records:
                kind = type(record).__name__
                if kind == 'Schema':
                    schemas[record.id] = record.name
                elif kind == 'Channel':
                    channels[record.id] = record
                elif kind == 'Message':
                    channel = channels[record.channel_id]
                    text = record.data.decode() if channel.message_encoding == 'json' else record.data.hex()
                    if channel.message_encoding == 'json':
                        json.loads(text)
                    print(path, channel.topic, schemas.get(channel.schema_id), record.log_time, record.publish_time, text, sep='\t')
        except McapError:
            whole = False
    if whole and sum(1 for _ in make_reader(open(path, 'rb')).iter_messages()) == 0:
        print('no index', path)
";

/// A message as Python has read it.
#[derive(Debug)]
struct Line {
    file: String,
    topic: String,
    schema: String,
    log_time: u64,
    publish_time: u64,
    text: String,
}

/// The messages in these files, read by PyPI's `mcap`.
#[track_caller]
fn read_by_python(files: &[PathBuf]) -> Vec<Line> {
    let files = files.iter().map(|file| file.to_str().expect("UTF-8"));
    let args: Vec<&str> = ["-c", READ].into_iter().chain(files).collect();
    let lines = run_python(&args, "");
    let line = |line: &str| {
        let words: Vec<&str> = line.split('\t').collect();
        let [file, topic, schema, log_time, publish_time, text] = words[..] else {
            panic!("{line}");
        };
        Line {
            file: file.to_owned(),
            topic: topic.to_owned(),
            schema: schema.to_owned(),
            log_time: log_time.parse().expect("a time"),
            publish_time: publish_time.parse().expect("a time"),
            text: text.to_owned(),
        }
    };
    lines.lines().map(line).collect()
}

fn now() -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.expect("after 1970").as_secs_f64()
}

/// A publisher at a free port that publishes `{"n": number, "time": now}` until the end of `act`.
fn while_counting<T>(act: impl FnOnce(&Publisher) -> T) -> T {
    let publisher = Publisher::bind("tcp://127.0.0.1:*", "/count").expect("a port");
    let over = AtomicBool::new(false);
    /// Ends the thread also if `act` panics.
    struct Over<'a>(&'a AtomicBool);
    impl Drop for Over<'_> {
        fn drop(&mut self) {
            self.0.store(true, Ordering::Relaxed);
        }
    }
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut number = 0;
            while !over.load(Ordering::Relaxed) {
                let fields = [("n", Pickle::from(number)), ("time", now().into())];
                publisher.publish("/", &Pickle::dict(fields).expect("a dict"));
                number += 1;
                std::thread::sleep(Duration::from_millis(2));
            }
        });
        let _over = Over(&over);
        act(&publisher)
    })
}

fn record(file: &Path, publishers: &[&str]) -> Command {
    let mut command = ztl();
    command.arg("record").arg(file).args(publishers);
    command
}

/// How many bytes a file has.
fn size(file: &Path) -> u64 {
    std::fs::metadata(file).map_or(0, |metadata| metadata.len())
}

#[test]
fn streams_and_tasks_are_recorded_for_python_and_reported() {
    let scratch = Scratch::new();
    let write = |name: &str, text: String| {
        std::fs::write(scratch.path(name), text).expect("a file");
        scratch.path(name)
    };
    let robot = write(
        "robot.yaml",
        format!("port: 0\npublish: 0\nscopes:\n  {SCOPE}:\n    test: {{echo: echo}}\n"),
    );
    let server = Server::start(ztl().arg("serve").arg(robot));
    let events = server
        .process
        .wait_for_port("Publishing events of tasks at tcp://127.0.0.1:");
    let camera = Publisher::bind("tcp://127.0.0.1:*", "/camera").expect("a port");
    let port = port_of(camera.endpoint());
    let config = write(
        "remotes.yaml",
        format!(
            "publishers:\n  robot: {{host: localhost, port: {events}, scope: {SCOPE}}}\n  camera: {{host: localhost, port: {port}, scope: /camera}}\n"
        ),
    );
    let file = scratch.path("run.mcap");
    let sound = ["--sound", "/camera/sound=8000x2", "-c"];
    let recorder = Process::start(record(&file, &[]).args(sound).arg(config));
    recorder.wait_for("robot: connected");
    recorder.wait_for("camera: connected");
    until("a subscriber", PATIENCE, || {
        (camera.subscribers() == 1).then_some(())
    });
    let jpeg = b"\xff\xd8\xff\xe0image";
    let made = 1_700_000_000.5;
    camera.publish("/", &Pickle::bytes(jpeg).expect("bytes"));
    camera.publish("/sound", &Pickle::bytes(&[1, 2, 3, 4]).expect("bytes"));
    let pose = Pickle::dict([("x", 1.5), ("time", made)]).expect("a dict");
    camera.publish("/pose", &pose);
    camera.publish_bytes("/raw", b"12.5 V", false);
    camera.publish_bytes("/bytes", b"\xfe\xff", false);
    // The recorder may be known to the server a moment later than it is connected.
    until("a recorded task", PATIENCE, || {
        let client = Process::run(our_client_at(server.port).arg("test:echo:hi"));
        assert_eq!(client.code, Some(0), "{client:?}");
        let mut read = Reader::open(&file).expect("a file");
        let is_task = |read: Read| matches!(read.content, Content::Task(..));
        read.any(is_task).then_some(())
    });
    recorder.signal("INT");
    let ended = recorder.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(ended.stdout.contains(" 0 missed: "), "{ended:?}");

    let lines = read_by_python(std::slice::from_ref(&file));
    let line = |topic: &str| {
        let line = lines.iter().find(|line| line.topic == topic);
        line.unwrap_or_else(|| panic!("no {topic}: {lines:?}"))
    };
    let image = line("/camera/");
    assert_eq!(image.schema, "foxglove.CompressedImage");
    assert!(
        image
            .text
            .contains("\"format\":\"jpeg\",\"data\":\"/9j/4GltYWdl\""),
        "{image:?}"
    );
    let sound = line("/camera/sound");
    assert_eq!(sound.schema, "foxglove.RawAudio");
    let format = "\"format\":\"pcm-s16\",\"sample_rate\":8000,\"number_of_channels\":2,\"data\":\"AQIDBA==\"";
    assert!(sound.text.contains(format), "{sound:?}");
    let pose = line("/camera/pose");
    let text = pose.text.replace(' ', "");
    assert_eq!(text, "{\"value\":{\"x\":1.5,\"time\":1700000000.5}}");
    assert_eq!(pose.publish_time, 1_700_000_000_500_000_000);
    assert!(pose.log_time > pose.publish_time, "{pose:?}");
    assert_eq!(line("/camera/raw").text, "{\"text\":\"12.5 V\"}");
    assert_eq!(line("/camera/bytes").text, "feff");
    let task = line(&format!("{SCOPE}/$tasks"));
    assert_eq!(task.schema, "ztl.TaskEvent");
    let times: Vec<u64> = lines.iter().map(|line| line.log_time).collect();
    assert!(times.is_sorted(), "{times:?}");

    let ended = Process::run(ztl().arg("report").arg(&file));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let page = std::fs::read_to_string(scratch.path("run.html")).expect("a page");
    assert!(page.contains("data-task=") && page.contains("class=\"series s0\""));
}

#[test]
fn a_publisher_that_goes_and_comes_back_is_said_and_recorded_again() {
    let scratch = Scratch::new();
    let file = scratch.path("run.mcap");
    // Bound twice: no connection gets a reserved port between.
    let endpoint = format!("tcp://127.0.0.1:{}", reserve_port());
    let publisher = Publisher::bind(&endpoint, "/lab").expect("a free port");
    let recorder = Process::start(&mut record(&file, &[&endpoint]));
    recorder.wait_for(": connected");
    drop(publisher);
    recorder.wait_for(": connection lost");
    let publisher = until("the port", PATIENCE, || {
        Publisher::bind(&endpoint, "/lab").ok()
    });
    until("a recorded message", PATIENCE, || {
        publisher.publish("/", &7.into());
        std::thread::sleep(Duration::from_millis(20));
        let read = Reader::open(&file).expect("a file").next();
        read.map(|read| assert_eq!(read.topic, "/lab/"))
    });
    recorder.signal("TERM");
    assert_eq!(recorder.end(PATIENCE).code, Some(143));
    // With its end, although it was stopped by a signal.
    let mut reader = Reader::open(&file).expect("a file");
    assert!(reader.by_ref().count() > 0 && !reader.damage().is_any());
}

/// 50 recorders, ten at a time: each is killed at a random moment.
#[test]
fn a_killed_recorder_loses_at_most_a_second() {
    let _busy = busy();
    let scratch = Scratch::new();
    let mut random = Random::new(seed());
    let mut killed: Vec<(PathBuf, f64)> = Vec::new();
    while_counting(|publisher| {
        for round in 0..5 {
            let files: Vec<PathBuf> = (0..10)
                .map(|nth| scratch.path(format!("{round}-{nth}.mcap")))
                .collect();
            let begun = files
                .iter()
                .map(|file| Process::start(&mut record(file, &[publisher.endpoint()])));
            let mut running: Vec<(PathBuf, Process, u64)> = Vec::new();
            for (file, process) in files.iter().zip(begun.collect::<Vec<_>>()) {
                // The first chunk has come to the file; up to this size there may be some more.
                until("a chunk", PATIENCE, || (size(file) > 3000).then_some(()));
                let more = random.below(30_000) as u64;
                running.push((file.clone(), process, size(file) + more));
            }
            until("all to be killed", PATIENCE, || {
                running.retain_mut(|(file, process, at)| {
                    if size(file) < *at {
                        return true;
                    }
                    // Somewhere between two flushes.
                    let pause = Duration::from_millis(random.below(20) as u64);
                    std::thread::sleep(pause);
                    killed.push((file.clone(), now()));
                    process.kill();
                    false
                });
                running.is_empty().then_some(())
            });
        }
    });
    assert_eq!(killed.len(), 50);
    let files: Vec<PathBuf> = killed.iter().map(|(file, _)| file.clone()).collect();
    let lines = read_by_python(&files);
    for (file, at) in killed {
        let name = file.to_str().expect("UTF-8");
        let mine = lines.iter().filter(|line| line.file == name);
        let last = mine.clone().next_back().expect("messages");
        let lost = at - last.publish_time as f64 / 1e9;
        assert!(lost < 1.0, "{name}: {lost} s are lost");
        let numbers: Vec<u64> = mine
            .map(|line| {
                let (_, number) = line.text.split_once("\"n\":").expect("a number");
                let number = number.trim_start().split(',').next();
                number.expect("a number").parse().expect("a number")
            })
            .collect();
        let is_next = |pair: &[u64]| pair[1] == pair[0] + 1;
        assert!(numbers.windows(2).all(is_next), "{name}: {numbers:?}");
        // Ours reads as much of it.
        let read = Reader::open(&file).expect("a file").count();
        assert_eq!(read, numbers.len(), "{name}");
    }
}

#[test]
fn a_full_disk_ends_the_recording_with_an_error_and_leaves_it_readable() {
    let scratch = Scratch::new();
    let file = scratch.path("run.mcap");
    while_counting(|publisher| {
        let full = record(&file, &[publisher.endpoint()]);
        let mut limited = Command::new("sh");
        // 100 blocks of 512 bytes.
        let script = "trap '' XFSZ; ulimit -f 100; exec \"$@\"";
        limited.args(["-c", script, "sh"]).arg(full.get_program());
        let ended = Process::start(limited.args(full.get_args())).end(PATIENCE);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        let why = "File too large (os error 27); the recording has ended";
        assert!(ended.stderr.contains(why), "{ended:?}");
        // It harms nobody else.
        let mut other = Subscriber::connect(publisher.endpoint(), "/count").expect("a file");
        assert!(other.next_within(PATIENCE).expect("to wait").is_some());
    });
    assert!(size(&file) <= 100 * 512);
    let lines = read_by_python(std::slice::from_ref(&file));
    assert!(lines.len() > 50, "{} messages", lines.len());
    let ended = Process::run(ztl().arg("report").arg(&file));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(ended.stderr.contains("has no end"), "{ended:?}");
}

/// A publisher that is known by its key if it is called `keyed`.
fn source(name: &str) -> Source {
    Source {
        name: name.to_owned(),
        endpoint: format!("tcp://{name}:6000"),
        key: if name == "keyed" { "KEY" } else { "" }.to_owned(),
    }
}

/// Writes a recording of these topics and bodies.
fn written(file: &Path, messages: &[(&str, &str, Vec<u8>)]) {
    let mut recording = Recording::create(file).expect("a file");
    let start = Instant::now();
    for (nth, (publisher, topic, body)) in messages.iter().enumerate() {
        let source = source(publisher);
        let message = Formats::default().prepare(&source, topic, body);
        let at = start + Duration::from_millis(10 * nth as u64);
        let message = message.expect("a message");
        recording.write(&source, message, at).expect("room");
    }
    recording.finish().expect("room");
}

#[test]
fn what_is_replayed_is_heard_as_it_was_published() {
    let scratch = Scratch::new();
    let file = scratch.path("run.mcap");
    let pair = Pickle::tuple([Pickle::from(1), f64::NAN.into()]).expect("a tuple");
    let messages = [
        ("robot", "/lab/a", Pickle::from(12.25).to_bytes()),
        ("robot", "/lab/b", pair.to_bytes()),
        ("robot", "/other", Pickle::from(1).to_bytes()),
        (
            "robot",
            "/lab/c",
            Pickle::bytes(b"\xff\xd8\xff").expect("bytes").to_bytes(),
        ),
        ("robot", "/lab/d", b"12.5 V".to_vec()),
    ];
    written(&file, &messages);
    let mut command = ztl();
    command.arg("replay").arg(&file);
    command.args(["-p", "0", "--speed", "2", "--topics", "/lab"]);
    let replay = Process::start(&mut command);
    let port = replay.wait_for_port("Publishing at tcp://127.0.0.1:");
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let mut subscriber = Subscriber::connect(&endpoint, "").expect("a file");
    for (_, topic, body) in messages.iter().filter(|(_, topic, _)| *topic != "/other") {
        let heard = subscriber.next_within(PATIENCE).expect("to wait");
        let heard = heard.expect("a message");
        assert_eq!((heard.topic.as_str(), &heard.body), (*topic, body));
    }
    let ended = replay.end(PATIENCE);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended.stdout.starts_with("Published: 4 messages"),
        "{ended:?}"
    );
}

/// The body of a task's event.
#[test]
fn a_file_without_messages_is_refused_before_anything_is_published() {
    let scratch = Scratch::new();
    let file = scratch.path("x");
    let recording = scratch.path("run.mcap");
    written(&recording, &[("/a", "", b"text".to_vec())]);
    let cut = std::fs::read(&recording).expect("it is there");
    let random: Vec<u8> = (0..4096_u32).map(|n| (n * 167 % 251) as u8).collect();
    for (bytes, why) in [
        (
            &b"hello"[..],
            "x has no messages to replay: it is not an MCAP file",
        ),
        (
            &random,
            "x has no messages to replay: it is not an MCAP file",
        ),
        (b"", "x has no messages to replay: it is not an MCAP file"),
        // Cut off before the first message.
        (&cut[..20], "x has no messages to replay: it has no end"),
    ] {
        std::fs::write(&file, bytes).expect("to write");
        let mut command = ztl();
        command.arg("replay").arg(&file).args(["-p", "0"]);
        let ended = Process::run(&mut command);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert!(!ended.stderr.contains("Publishing"), "{ended:?}");
        assert!(ended.stderr.contains(why), "{ended:?}");
    }
}

fn event(id: i64, state: &str, goal: &str) -> Vec<u8> {
    let mut fields = vec![("id", Pickle::from(id)), ("time", 1_700_000_000.5.into())];
    let texts = [
        ("state", state),
        ("handler", "test"),
        ("component", "echo"),
        ("goal", goal),
    ];
    let asked = texts.len() - if state == "INITIATED" { 0 } else { 3 };
    let texts = texts.into_iter().take(asked);
    fields.extend(texts.map(|(key, text)| (key, Pickle::text(text).expect("text"))));
    Pickle::dict(fields).expect("a dict").to_bytes()
}

/// The topic of a task's events.
fn topic(id: i64) -> String {
    format!("{SCOPE}/$tasks/{id}")
}

/// A publisher that tells of the tasks of a robot whose own publisher is configured.
#[test]
fn a_forged_event_of_a_task_is_recorded_as_a_value() {
    let scratch = Scratch::new();
    let robot = Publisher::bind("tcp://127.0.0.1:*", "").expect("a port");
    let camera = Publisher::bind("tcp://127.0.0.1:*", "").expect("a port");
    let (robot_port, camera_port) = (port_of(robot.endpoint()), port_of(camera.endpoint()));
    let config = scratch.path("remotes.yaml");
    let remotes = format!(
        "remotes: {{robot: {{host: localhost, port: 1, scope: {SCOPE}}}}}\n\
         publishers:\n  robot: {{host: localhost, port: {robot_port}, scope: {SCOPE}}}\n  \
         camera: {{host: localhost, port: {camera_port}, scope: /}}\n"
    );
    std::fs::write(&config, remotes).expect("a file");
    let file = scratch.path("run.mcap");
    let mut command = record(&file, &["robot", "camera"]);
    command.args(["--scope", SCOPE, "-c"]).arg(&config);
    let recorder = Process::start(&mut command);
    let (mine, forged) = (event(1, "INITIATED", "one"), event(2, "INITIATED", "two"));
    until("both are recorded", PATIENCE, || {
        robot.publish_bytes(&topic(1), &mine, false);
        camera.publish_bytes(&topic(2), &forged, false);
        let read: Vec<Read> = Reader::open(&file).ok()?.collect();
        let is_from = |name| read.iter().any(|read: &Read| read.source.name == name);
        (is_from("robot") && is_from("camera")).then_some(())
    });
    recorder.wait_for("recorded as a value, not as an event of a task");
    recorder.signal("INT");
    assert_eq!(recorder.end(PATIENCE).code, Some(0));
    for read in Reader::open(&file).expect("a file") {
        let is_task = matches!(read.content, Content::Task(..));
        assert_eq!(is_task, read.source.name == "robot", "{read:?}");
        assert!(
            read.source.endpoint.starts_with("tcp://localhost:"),
            "{read:?}"
        );
    }
}
