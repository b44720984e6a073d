//! Publishers and subscribers of the original, and of other ZeroMQ implementations, against ours, both ways.

use std::process::Command;
use std::time::Duration;

use ztl_pickle::Pickle;
use ztl_std::{Publisher, Subscriber};
use ztl_tests::lab::{
    PATIENCE, Peer, Process, Scratch, original_tool, ours_named, port_of, python, reserve_port,
    until, ztl,
};

/// A simple publisher, and its port.
#[track_caller]
fn publisher(tool: impl Fn() -> Command) -> (Process, u16) {
    loop {
        let port = reserve_port();
        let process = Process::start(tool().args(["-p", &port.to_string(), "-s", "/sensor"]));
        if process.wait_for_unless_taken("created at").is_some() {
            return (process, port);
        }
    }
}

/// A log, without the parts that differ from run to run.
fn log(process: &Process, port: u16) -> Vec<String> {
    let text = process.stderr().replace(&port.to_string(), "PORT");
    text.lines().map(str::to_owned).collect()
}

/// The counts that a subscriber has received.
fn counts(subscriber: &Process) -> Vec<u32> {
    let log = subscriber.stderr();
    let lines = log.lines().filter_map(|line| {
        line.strip_prefix("INFO:object-subscriber:Received data: {'one': 1, 'more': 2, 'count': ")
    });
    let counts = lines.map(|rest| rest.strip_suffix("}...").expect("its end"));
    counts
        .map(|count| count.parse().expect("a number"))
        .collect()
}

#[test]
fn simple_publishers_and_subscribers_print_the_same() {
    let scratch = Scratch::new();
    let ours = |name: &'static str| ours_named(&scratch, name);
    let publishers = [
        publisher(|| original_tool("ztl_simple_publisher")),
        publisher(|| ours("ztl_simple_publisher")),
    ];
    for (process, _) in &publishers {
        process.wait_for("INFO:simple-pub:Skip publishing (no subscribers)...");
    }
    for (process, port) in publishers {
        let port_text = port.to_string();
        let args = ["-r", "localhost", "-p", &port_text, "-s", "/sensor"];
        let subscribers = [
            Process::start(original_tool("ztl_simple_subscriber").args(args)),
            Process::start(ours("ztl_simple_subscriber").args(args)),
            Process::start(ztl().arg("simple-subscriber").args(args)),
        ];
        process.wait_for("INFO:object-publisher:Subscriber joined! Total connected: 3");
        process.wait_for(
            "INFO:simple-pub:Publishing data to 3 subscribers: {'one': 1, 'more': 2, 'count': ",
        );
        for subscriber in &subscribers {
            let counts = until("three messages", PATIENCE, || {
                let counts = counts(subscriber);
                (counts.len() >= 3).then_some(counts)
            });
            let steps = counts.windows(2).all(|pair| pair[1] == pair[0] + 1);
            assert!(steps, "{counts:?}");
            let head: Vec<String> = log(subscriber, port).into_iter().take(2).collect();
            assert_eq!(
                head,
                [
                    "INFO:object-subscriber:Subscriber '/sensor' established at 'tcp://localhost:PORT'",
                    "INFO:object-subscriber:Start listening...",
                ]
            );
        }
        for subscriber in subscribers {
            subscriber.signal("INT");
            assert_eq!(subscriber.end(PATIENCE).code, Some(0));
        }
        process.wait_for("INFO:object-publisher:Subscriber left! Total connected: 0");
        let log = log(&process, port);
        let created = "INFO:object-publisher:Publisher '/sensor' created at 'tcp://*:PORT'";
        assert_eq!(log.first().map(String::as_str), Some(created));
        process.signal("INT");
        let ended = process.end(PATIENCE);
        assert_eq!((ended.code, ended.stdout.as_str()), (Some(0), ""));
        let last = ended.stderr.lines().last();
        assert_eq!(
            last,
            Some("ERROR:simple-pub:Exit signal received, exiting.")
        );
    }
}

#[test]
fn a_simple_tool_for_streams_without_arguments_exits_like_the_original() {
    let scratch = Scratch::new();
    for tool in ["ztl_simple_publisher", "ztl_simple_subscriber"] {
        for args in [&[][..], &["-p", "1"], &["-p", "x", "-s", "/x", "-r", "h"]] {
            let original = Process::run(original_tool(tool).args(args));
            let ours = Process::run(ours_named(&scratch, tool).args(args));
            assert_eq!((original.code, ours.code), (Some(2), Some(2)), "{ours:?}");
            assert!(ours.stderr.contains(&format!("usage: {tool}")), "{ours:?}");
        }
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn other_implementations_hear_our_publisher() {
    for peer in Peer::publishers_here() {
        let publisher = Publisher::bind("tcp://127.0.0.1:*", "/lab").expect("a port");
        let heard = peer.subscriber(port_of(publisher.endpoint()), "/lab/arm");
        let long = vec![7; 300_000];
        until("the messages", PATIENCE, || {
            publisher.publish_bytes("/leg", b"other", false);
            publisher.publish_bytes("/arm", b"\x80short", false);
            publisher.publish_bytes("/arm/left", &long, false);
            std::thread::sleep(Duration::from_millis(20));
            let lines = heard.stdout();
            let mut lines = lines.lines();
            let short = format!("{} {}", hex(b"/lab/arm"), hex(b"\x80short"));
            let long = format!("{} {}", hex(b"/lab/arm/left"), hex(&long));
            assert!(
                lines.clone().all(|line| line == short
                    || line == long
                    || !line.contains(' ')
                    || long.starts_with(line)),
                "{peer:?}"
            );
            (lines.any(|line| line == short) && lines.any(|line| line == long)).then_some(())
        });
    }
}

#[test]
fn our_subscriber_hears_other_implementations() {
    for peer in Peer::publishers_here() {
        let (mut publisher, port) = peer.publisher();
        let mut subscriber =
            Subscriber::connect(&format!("tcp://127.0.0.1:{port}"), "/lab/arm").expect("a file");
        let line = |frames: &[&[u8]]| {
            let frames: Vec<String> = frames.iter().map(|frame| hex(frame)).collect();
            frames.join(" ")
        };
        let long = vec![7; 10_000];
        until("the messages", PATIENCE, || {
            publisher.write_line(&line(&[b"/lab/leg", b"other"]));
            publisher.write_line(&line(&[b"/lab/arm"]));
            publisher.write_line(&line(&[b"/lab/arm2", b"other"]));
            publisher.write_line(&line(&[b"/lab/arm/left", &long]));
            let wait = Duration::from_millis(20);
            let heard = subscriber.next_within(wait).expect("it can wait")?;
            assert_eq!(
                (heard.topic.as_str(), &heard.body),
                ("/lab/arm/left", &long)
            );
            (subscriber.damaged() > 0).then_some(())
        });
    }
}

/// Publishes with the original's class what it evaluates of a line, and prints what its subscriber's class gets.
const OBJECTS: &str = r#"
import sys
from ztl.core.publisher import ObjectPublisher
from ztl.core.subscriber import ObjectSubscriber

if sys.argv[1] == "publish":
    publisher = ObjectPublisher(int(sys.argv[2]), "/lab")
    print("ready", flush=True)
    for line in sys.stdin:
        publisher.publish(eval(line), "/object")
else:
    class Shown(ObjectSubscriber):
        def callback(self, obj):
            print(type(obj).__name__, repr(obj), flush=True)
    Shown("localhost", int(sys.argv[2]), "/lab").start()
"#;

/// What Python writes, and how we show it: as Python's `repr`.
const VALUES: [&str; 12] = [
    "None",
    "[True, 1, -2.5, 'it\\'s', \"\\u00e4\", b'\\x00\\xff']",
    "(1, (), (2,))",
    "{'a': {1, 2}, 2: frozenset([3]), (1, 2): [[]]}",
    "2 ** 100",
    "float('inf')",
    "[]",
    "''",
    "{}",
    "bytearray(b'x')",
    "[[1, 2], [3]] * 2",
    "1e300",
];

#[test]
fn the_originals_subscriber_gets_our_values_and_ours_gets_its() {
    let mut original;
    let port = loop {
        let port = reserve_port();
        let mut command = Command::new(python());
        original = Process::start(command.args(["-c", OBJECTS, "publish", &port.to_string()]));
        if original.wait_for_unless_taken("ready").is_some() {
            break port;
        }
    };
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let mut subscriber = Subscriber::connect(&endpoint, "/lab").expect("a file");
    let ours = Publisher::bind("tcp://127.0.0.1:*", "/lab").expect("a port");
    let mut command = Command::new(python());
    let port = port_of(ours.endpoint()).to_string();
    let mut theirs = Process::start(command.args(["-c", OBJECTS, "subscribe", &port]));
    let wait = Duration::from_millis(20);
    until("a connection there", PATIENCE, || {
        original.write_line("'begin'");
        subscriber.next_within(wait).expect("it can wait")
    });
    until("a connection back", PATIENCE, || {
        ours.publish("/object", &Pickle::from("begin"));
        std::thread::sleep(wait);
        (!theirs.stdout().is_empty()).then_some(())
    });
    for value in VALUES {
        original.write_line(value);
        let pickle = until(value, PATIENCE, || {
            let heard = subscriber.next_within(wait).expect("it can wait")?;
            let value = heard.value().expect("plain data");
            (value.value().as_str() != Some("begin")).then_some(value)
        });
        ours.publish("/object", &pickle);
        let line = loop {
            let line = theirs.next_line(PATIENCE);
            if line != "str 'begin'" {
                break line;
            }
        };
        let (_, shown) = line.split_once(' ').expect("a type");
        let python =
            Process::run(Command::new(python()).args(["-c", &format!("print(repr({value}))")]));
        assert_eq!(shown, python.stdout.trim_end(), "there and back");
        assert_eq!(pickle.value().repr().to_string(), python.stdout.trim_end());
    }
}
