//! Readings, from a device to their subscribers.

use std::process::Command;

use ztl_mcu::link::Loss;
use ztl_std::gateway::{Gateway, Readings};
use ztl_tests::lab::{PATIENCE, Process, Scratch, gateway, port_of, python, until, ztl};

use crate::firmware::{Counter, Endless, Firmware};
use crate::lines::serve;

/// A device whose second component publishes.
fn bench() -> Firmware {
    Firmware::start((Endless::new("arm", Loss::Abort), Counter::default()))
}

/// The next number published as text; checks that its bytes follow.
#[track_caller]
fn next_pair(readings: &Readings) -> u32 {
    let count = readings.next_within(PATIENCE).expect("a reading");
    if count.topic == "bench/counter/raw" {
        return next_pair(readings);
    }
    assert_eq!(count.topic, "bench/counter/count");
    let number: u32 = String::from_utf8_lossy(&count.bytes)
        .parse()
        .expect("a number");
    let raw = readings.next_within(PATIENCE).expect("a reading");
    assert_eq!(raw.topic, "bench/counter/raw");
    assert_eq!(raw.bytes, number.to_le_bytes());
    number
}

#[test]
fn an_observer_gets_all_readings_in_order_despite_a_slow_observer() {
    let firmware = bench();
    let mut gateway = Gateway::new();
    let readings = gateway.observe(1000);
    let slow = gateway.observe(4);
    let url = format!("tcp:{}", firmware.address);
    gateway
        .add("bench", url.parse().expect("a URL"))
        .expect("a thread");
    let first = next_pair(&readings);
    for number in 1..50 {
        assert_eq!(next_pair(&readings), first + number);
    }
    // The slow observer has the latest four, and tasks run as before.
    assert!(slow.lost() > 90, "{}", slow.lost());
    let (server, mut remote) = serve(gateway);
    let id = until("a task is taken", PATIENCE, || {
        remote.trigger("bench", "arm", "go").ok()
    })
    .id;
    assert!(remote.abort(id).is_ok());
    // Readings continue, and end with the gateway.
    next_pair(&readings);
    drop(server);
    assert!(slow.count() <= 4);
    assert!(readings.count() < 1000);
}

/// `ztl gateway` with a publishing port and more options, and that port.
fn publishing(firmware: &Firmware, options: &[&str]) -> (Process, String) {
    let mut command = gateway(&[&format!("bench=tcp:{}", firmware.address)]);
    let gateway = Process::start(command.args(["--publish", "0"]).args(options));
    let line = gateway.wait_for("Publishing readings at ");
    let endpoint = line
        .trim_start_matches("Publishing readings at ")
        .trim_end_matches('.');
    (gateway, endpoint.to_owned())
}

#[test]
fn each_subscriber_gets_its_topics_despite_a_dead_subscriber() {
    let firmware = bench();
    let (gateway, endpoint) = publishing(&firmware, &["--publish-format", "raw"]);
    let context = zmq::Context::new();
    let subscriber = |prefix: &str| {
        let socket = context.socket(zmq::SUB).expect("a socket");
        socket.set_rcvtimeo(20_000).expect("a limit");
        socket.set_linger(0).expect("no limit");
        socket.connect(&endpoint).expect("an endpoint");
        socket.set_subscribe(prefix.as_bytes()).expect("a prefix");
        socket
    };
    // Never reads.
    let dead = subscriber("");
    let counts = subscriber("bench/counter/count");
    let mut last = None;
    for _ in 0..100 {
        let message = counts.recv_multipart(0).expect("a reading");
        assert_eq!(message.len(), 2);
        assert_eq!(message[0], b"bench/counter/count");
        let number: u32 = String::from_utf8_lossy(&message[1])
            .parse()
            .expect("a number");
        assert!(
            last.is_none_or(|last| number == last + 1),
            "{last:?}, {number}"
        );
        last = Some(number);
    }
    gateway.signal("TERM");
    assert_eq!(gateway.end(PATIENCE).code, Some(143));
    drop(dead);
}

#[test]
fn the_manuals_python_program_receives_the_readings() {
    let firmware = bench();
    let (_gateway, endpoint) = publishing(&firmware, &[]);
    let manual = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/gateway.md");
    let manual = std::fs::read_to_string(manual).expect("the manual");
    let (_, rest) = manual.split_once("```python\n").expect("the program");
    let (program, _) = rest.split_once("```").expect("its end");
    assert!(program.contains("tcp://localhost:12346") && program.contains("gripper/"));
    let program = program
        .replace("tcp://localhost:12346", &endpoint)
        .replace("gripper/", "bench/counter/");
    let mut command = Command::new(python());
    let heard = Process::start(command.args(["-u", "-c", &program]));
    let line = heard.wait_for("bench/counter/count ");
    let number = line.strip_prefix("bench/counter/count ").expect("a topic");
    number.parse::<u32>().expect("a number");
    let line = heard.wait_for("bench/counter/raw ");
    assert!(line.starts_with("bench/counter/raw b'"), "{line}");
}

/// Prints what the original's subscriber gets.
const ORIGINAL: &str = r#"
import sys
from ztl.core.subscriber import ObjectSubscriber

class Shown(ObjectSubscriber):
    def callback(self, obj):
        print(type(obj).__name__, flush=True)
Shown("localhost", int(sys.argv[1]), sys.argv[2]).start()
"#;

#[test]
fn the_originals_subscriber_receives_numbers_and_bytes() {
    let firmware = bench();
    let (_gateway, endpoint) = publishing(&firmware, &[]);
    for (topic, kind) in [
        ("bench/counter/count", "int"),
        ("bench/counter/raw", "bytes"),
    ] {
        let mut command = Command::new(python());
        let port = port_of(&endpoint).to_string();
        let heard = Process::start(command.args(["-c", ORIGINAL, &port, topic]));
        assert_eq!(heard.wait_for(kind), kind);
    }
}

#[test]
fn readings_are_shown_as_numbers_and_bytes_unless_the_file_says_raw() {
    let firmware = bench();
    let (_gateway, endpoint) = publishing(&firmware, &[]);
    let shown = |endpoint: &str, scope: &str, words: &[&str]| {
        let mut command = ztl();
        command.args(["subscribe", endpoint, scope, "-n", "1"]);
        Process::run(command.args(words))
    };
    let ended = shown(&endpoint, "bench/counter/count", &[]);
    let number = ended.stdout.strip_prefix("bench/counter/count ");
    let number = number.and_then(|number| number.trim_end().parse::<u32>().ok());
    assert!(number.is_some(), "{ended:?}");
    let ended = shown(&endpoint, "bench/counter/raw", &["--json"]);
    assert!(
        ended.stdout.contains("\"value\": {\"base64\": \""),
        "{ended:?}"
    );

    // Only one gateway at a time is connected to a device.
    let firmware = bench();
    let scratch = Scratch::new();
    let file = scratch.path("lab.yaml");
    let text = format!(
        "scope: /lab\nport: 0\npublish: 0\npublish-format: raw\njournal: off\ndevices: {{bench: 'tcp:{}'}}\n",
        firmware.address
    );
    std::fs::write(&file, text).expect("to write");
    let gateway = Process::start(ztl().arg("gateway").arg(&file));
    let port = gateway.wait_for_port("Publishing readings at tcp://127.0.0.1:");
    let raw = scratch.path("raw").display().to_string();
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let ended = shown(&endpoint, "bench/counter/count", &["--raw", &raw]);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let text = std::fs::read_to_string(raw).expect("text");
    text.parse::<u32>().expect("a number as text");
}

#[test]
fn a_readings_port_in_use_is_reported() {
    let taken = std::net::TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    let port = taken.local_addr().expect("its address").port().to_string();
    let mut command = gateway(&["head=sim:head"]);
    let ended = Process::start(command.args(["--publish", &port])).end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended
            .stderr
            .contains(&format!(":{port}: the port is in use")),
        "{ended:?}"
    );
}
