//! Streams and events of tasks, from a robot's publisher to subscribers at an endpoint.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use ztl_std::keys::KeyPair;
use ztl_std::publish::Heard;
use ztl_std::{Publisher, State, Subscriber};
use ztl_tests::lab::{
    PATIENCE, Process, Scratch, Server, end, in_time, original_tool, reserve_port, until, ztl,
};

use crate::line::{Line, Mode};
use crate::requests::{abort, start, status};
use crate::web_client::Client;
use crate::{Fleet, fleet, python};

/// A request takes no longer, whatever flows beside it.
const SOON: Duration = Duration::from_millis(500);
/// How long a test waits for one message before it looks at something else.
pub(crate) const TURN: Duration = Duration::from_millis(20);

/// A fleet whose endpoint publishes, and whose robot has a publisher in this process.
pub(crate) struct Streaming {
    fleet: Fleet,
    _server: Server,
    publisher: Publisher,
    agent: Process,
    /// The endpoint's port for subscribers.
    port: u16,
}

impl Streaming {
    fn new() -> Self {
        let fleet = Self::fleet(Scratch::new(), "robots: arm\n");
        let router = fleet.address.clone();
        Self::of(fleet, "", &router)
    }

    /// A fleet whose endpoint publishes; with more lines in its file.
    pub(crate) fn fleet(scratch: Scratch, more: &str) -> Fleet {
        Fleet::with(scratch, &format!("publish: 0\n{more}"))
    }

    /// A fleet with a robot whose agent's file has these lines, and connects to this router.
    fn of(fleet: Fleet, agent: &str, router: &str) -> Self {
        let port = fleet.endpoint.wait_for_port("Publishing ");
        let server = Server::naps();
        // A test binds it twice: no connection gets a reserved port between.
        let endpoint = format!("tcp://127.0.0.1:{}", reserve_port());
        let publisher = Publisher::bind(&endpoint, "/test").unwrap();
        let more = format!("publish: {}\n{agent}", publisher.endpoint());
        let file = fleet.agent_file("arm", &server.endpoint(), &more);
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, text.replace(&fleet.address, router)).unwrap();
        let agent = Process::start(&mut self::fleet(&["join"], &file));
        agent.wait_for("has joined");
        Self {
            fleet,
            _server: server,
            publisher,
            agent,
            port,
        }
    }

    fn restart_agent(&mut self) {
        let file = self.fleet.scratch.path("arm.yaml");
        self.agent.kill();
        self.agent = Process::start(&mut fleet(&["join"], &file));
        self.agent.wait_for("has joined");
    }

    fn subscribe(&self, scope: &str) -> Subscriber {
        Subscriber::connect(&format!("tcp://127.0.0.1:{}", self.port), scope).unwrap()
    }

    fn publish(&self, path: &str, number: i64, is_state: bool) {
        let value = number.into();
        assert!(match is_state {
            true => self.publisher.publish_state(path, &value),
            false => self.publisher.publish(path, &value),
        });
    }

    /// Publishes until the subscriber hears it, so that its subscription has arrived.
    fn until_heard(&self, subscriber: &mut Subscriber) {
        until("the subscriber hears the robot", PATIENCE, || {
            self.publish("/begin", 0, false);
            number(&next_within(subscriber, TURN)?, "/begin")
        });
    }
}

pub(crate) fn next_within(subscriber: &mut Subscriber, limit: Duration) -> Option<Heard> {
    subscriber.next_within(limit).unwrap()
}

/// The number in a message of this path.
pub(crate) fn number(heard: &Heard, path: &str) -> Option<i64> {
    let is_it = heard.topic == format!("/arm/test{path}");
    is_it.then(|| heard.value().unwrap().value().as_f64().unwrap() as i64)
}

/// The next number of this path.
#[track_caller]
pub(crate) fn next(subscriber: &mut Subscriber, path: &str) -> i64 {
    until(&format!("a message {path}"), PATIENCE, || {
        number(&next_within(subscriber, TURN)?, path)
    })
}

#[test]
fn what_ztl_serve_publishes_is_heard_at_the_endpoint_and_its_programs_run_only_meanwhile() {
    let fleet = Streaming::fleet(Scratch::new(), "robots: arm\n");
    let port = fleet.endpoint.wait_for_port("Publishing ");
    let file = fleet.scratch.path("robot.yaml");
    let log = fleet.scratch.path("runs");
    let text = format!(
        "port: 0\npublish: 0\nscopes: {{/test: {{nap: {{for: sleep}}}}}}\nstreams: {{/test: {{count: {{shell: 'echo run >> {}; while sleep 0.02; do echo 7; done', frame: json, when-watched: 1 s}}}}}}\n",
        log.display()
    );
    std::fs::write(&file, text).unwrap();
    let server = Server::start(ztl().arg("serve").arg(&file));
    let at = server.process.wait_for_port("Publishing ");
    let _agent = fleet.join(&server, &format!("publish: tcp://127.0.0.1:{at}\n"));
    let mut remote = fleet.client();
    let unheard = start(&mut remote, "nap", "for", "0");
    end(&mut remote, unheard);
    assert!(!log.exists(), "nobody watches");

    let address = format!("tcp://127.0.0.1:{port}");
    let subscriber = Process::start(ztl().args(["subscribe", &address, "/arm/test", "--json"]));
    subscriber.wait_for("\"topic\": \"/arm/test/count\"");
    let id = start(&mut remote, "nap", "for", "0");
    assert_eq!(end(&mut remote, id).0, State::Completed);
    // The topic has the endpoint's scope, and the id is the robot's own.
    let topic = format!("\"topic\": \"/arm/test/$tasks/{id}\"");
    until("the task's end is told", PATIENCE, || {
        let told = subscriber.stdout();
        let mut events = told.lines().filter(|line| line.contains(&topic));
        events.find(|line| line.contains("\"COMPLETED\"")).map(drop)
    });
    let told = subscriber.stdout();
    let asked = told.lines().find(|line| line.contains(&topic)).unwrap();
    assert!(asked.contains("\"handler\": \"nap\""), "{asked}");
    assert!(asked.contains("\"INITIATED\""), "{asked}");
    assert!(!told.contains(&format!("$tasks/{unheard}\"")), "{told}");
    let listed = Process::run(&mut self::fleet(
        &["ls"],
        &fleet.scratch.path("endpoint.yaml"),
    ));
    assert!(
        listed.stdout.trim_end().ends_with("  streams"),
        "{listed:?}"
    );
}

#[test]
fn the_web_console_and_the_originals_subscriber_show_a_robots_stream() {
    const TOPIC: &str = "/ztl/streams/fleet/arm/test/pose";
    let streaming = Streaming::new();
    let (port, tasks) = (streaming.port.to_string(), streaming.fleet.port.to_string());
    let args = ["-r", "localhost", "-p", &port, "-s", "/arm/test"];
    let original = Process::start(original_tool("ztl_simple_subscriber").args(args));
    until("the original's subscriber shows a value", PATIENCE, || {
        streaming.publish("/word", 6, false);
        // Other robots' topics and other scopes are not its own.
        streaming
            .publisher
            .under("/other")
            .publish("/word", &8.into());
        std::thread::sleep(TURN);
        let shown = "INFO:object-subscriber:Received data: 6";
        original.stderr().contains(shown).then_some(())
    });
    assert!(!original.stderr().contains("Received data: 8"));

    let mut console = ztl();
    console.args(["web", "-c", "/dev/null", "-p", "0"]);
    console.args(["--task", "arm", "127.0.0.1", &tasks, "/arm/test"]);
    console.args(["--publisher", "fleet", "127.0.0.1", &port, "/arm"]);
    let console = Process::start(&mut console);
    let link = console.wait_for("://127.0.0.1:");
    let (_, console_port) = link.rsplit_once(':').unwrap();
    let console_port = console_port
        .trim_end()
        .trim_end_matches('/')
        .parse()
        .unwrap();
    let mut client = Client::open(console_port);
    client.subscribe(TOPIC);
    streaming.publish("/pose", 1, true);
    let told = client.topic(TOPIC, |told| told["value"] == 1);
    assert_eq!(told["topic"], "/arm/test/pose", "{told}");
    streaming.publish("/pose", 2, true);
    client.topic(TOPIC, |told| told["value"] == 2);
    // Whoever looks later sees the newest value.
    let mut late = Client::open(console_port);
    late.subscribe(TOPIC);
    late.topic(TOPIC, |told| told["value"] == 2);
}

#[test]
fn a_late_subscriber_gets_the_newest_state_and_an_idle_fleet_hears_nothing() {
    let streaming = Streaming::new();
    streaming.publish("/pose", 1, true);
    let mut first = streaming.subscribe("/arm/test/pose");
    assert_eq!(next(&mut first, "/pose"), 1);
    streaming.publish("/pose", 2, true);
    assert_eq!(next(&mut first, "/pose"), 2);
    // The robot's publisher need not be asked for it.
    let mut late = streaming.subscribe("/arm/test");
    assert_eq!(next(&mut late, "/pose"), 2);
    streaming.until_heard(&mut late);
    streaming.publish("/word", 1, false);
    assert_eq!(next(&mut late, "/word"), 1);
    let mut later = streaming.subscribe("/arm/test/");
    streaming.publish("/pose", 3, true);
    until("the newest state", PATIENCE, || {
        let heard = next_within(&mut later, TURN)?;
        assert_ne!(heard.topic, "/arm/test/word", "an event is not repeated");
        (number(&heard, "/pose") == Some(3)).then_some(())
    });
    assert_eq!((late.missed(), later.missed()), (0, 0));

    // Without subscribers, the robot's publisher has none either, and no state is kept that goes stale.
    drop((first, late, later));
    until("nobody hears the robot", PATIENCE, || {
        (streaming.publisher.subscribers() == 0).then_some(())
    });
    streaming.publish("/pose", 4, true);
    let mut again = streaming.subscribe("/arm");
    assert_eq!(next(&mut again, "/pose"), 4);
}

#[test]
fn a_cut_tells_a_gap_and_shows_no_stale_state() {
    let fleet = Streaming::fleet(Scratch::new(), "robots: arm\n");
    let line = Line::to(&fleet.address);
    let streaming = Streaming::of(fleet, "", &line.address);
    let mut early = streaming.subscribe("");
    streaming.until_heard(&mut early);
    streaming.publish("/pose", 1, true);
    assert_eq!(next(&mut early, "/pose"), 1);
    assert_eq!(early.missed(), 0);
    let told = "Robot 'arm' has no streams now: it is not connected";
    // On a busy machine, it may have been told before.
    let count = || streaming.fleet.endpoint.stderr().matches(told).count();
    let before = count();
    line.set(Mode::Cut);
    until("the cut is told", PATIENCE, || {
        (count() > before).then_some(())
    });
    // A state may have come twice before the cut.
    while next_within(&mut early, TURN).is_some() {}
    let mut late = streaming.subscribe("/arm/test/pose");
    streaming.publish("/pose", 2, true);
    streaming.publish("/word", 1, false);
    streaming.publish("/pose", 3, true);
    line.set(Mode::Open);
    for subscriber in [&mut late, &mut early] {
        until("the newest state", PATIENCE, || {
            let pose = number(&next_within(subscriber, TURN)?, "/pose")?;
            assert_ne!(pose, 1, "a state from before the cut");
            (pose == 3).then_some(())
        });
    }
    until("the gap is told", PATIENCE, || {
        next_within(&mut early, TURN);
        (early.missed() > 0).then_some(())
    });
}

#[test]
fn states_of_a_publisher_that_was_restarted_do_not_come_back() {
    let mut streaming = Streaming::new();
    let mut early = streaming.subscribe("/arm/test");
    streaming.until_heard(&mut early);
    streaming.publish("/pose", 1, true);
    assert_eq!(next(&mut early, "/pose"), 1);
    let endpoint = streaming.publisher.endpoint().to_owned();
    // Closes the first one.
    streaming.publisher = Publisher::bind("tcp://127.0.0.1:*", "/test").unwrap();
    streaming.publisher = Publisher::bind(&endpoint, "/test").unwrap();
    streaming.until_heard(&mut early);
    let mut late = streaming.subscribe("/arm/test");
    until("the late subscriber hears the robot", PATIENCE, || {
        streaming.publish("/begin", 0, false);
        let heard = next_within(&mut late, TURN)?;
        assert_ne!(heard.topic, "/arm/test/pose", "of the publisher before");
        number(&heard, "/begin")
    });
}

#[test]
fn an_agent_that_was_killed_begins_anew_and_the_gap_is_told() {
    let mut streaming = Streaming::new();
    let mut subscriber = streaming.subscribe("/arm/test");
    streaming.until_heard(&mut subscriber);
    streaming.publish("/pose", 1, true);
    assert_eq!(next(&mut subscriber, "/pose"), 1);
    streaming.restart_agent();
    streaming.publish("/pose", 2, true);
    until("the newest state", PATIENCE, || {
        let heard = next_within(&mut subscriber, TURN)?;
        (number(&heard, "/pose") == Some(2)).then_some(())
    });
    until("the gap is told", PATIENCE, || {
        streaming.publish("/begin", 0, false);
        next_within(&mut subscriber, TURN);
        (subscriber.missed() > 0).then_some(())
    });
}

#[test]
fn a_python_program_without_our_code_reads_a_stream() {
    let streaming = Streaming::new();
    streaming.publish("/pose", 1, true);
    let args = [streaming.fleet.address.as_str(), "arm", "/test/pose", "2"];
    let program = Process::start(&mut python("stream.py", &args));
    program.wait_for("/test/pose 1 state missed 0");
    streaming.publish("/word", 1, false);
    streaming.publish("/pose", 2, true);
    program.wait_for("/test/pose 2 state missed 0");
    assert_eq!(program.end(PATIENCE).code, Some(0));
}

/// Keys of a robot, an endpoint and a client.
pub(crate) fn keys(scratch: &Scratch) -> [KeyPair; 4] {
    ["arm", "desk", "anna", "other"].map(|name| {
        let pair = KeyPair::generate();
        pair.write(&scratch.path(name)).unwrap();
        pair
    })
}

pub(crate) const DESK: &str = "fleet-key: desk.key_secret\nrobots: {arm: {key: arm.key}}\n";

#[test]
fn neither_a_forged_nor_a_recorded_message_is_heard() {
    let scratch = Scratch::new();
    keys(&scratch);
    let arm = "fleet-key: arm.key_secret\nclient-keys: desk.key\n";
    let fleet = Streaming::fleet(scratch, DESK);
    let router = fleet.address.clone();
    let mut streaming = Streaming::of(fleet, arm, &router);
    let mut hostile = Process::start(&mut python(
        "hostile_stream.py",
        &[&streaming.fleet.address, "arm"],
    ));
    hostile.wait_for("Hostile");
    let mut subscriber = streaming.subscribe("/arm/test/number");
    streaming.publish("/number", 0, true);
    assert_eq!(next(&mut subscriber, "/number"), 0);
    for number in 1..=5 {
        streaming.publish("/number", number, false);
        assert_eq!(next(&mut subscriber, "/number"), number);
    }
    hostile.wait_for("recorded 6");
    hostile.write_line("first");
    hostile.wait_for("replayed first");
    streaming
        .fleet
        .endpoint
        .wait_for("does not have its key and is dropped");
    streaming.publish("/number", 6, false);
    assert_eq!(next(&mut subscriber, "/number"), 6);
    assert_eq!(subscriber.missed(), 0);
    // Nor after the agent's numbers have begun again.
    streaming.restart_agent();
    until("the new agent is heard", PATIENCE, || {
        streaming.publish("/number", 7, false);
        let number = number(&next_within(&mut subscriber, TURN)?, "/number")?;
        // The newest state comes again.
        assert!([0, 7].contains(&number), "{number}");
        (number == 7).then_some(())
    });
    hostile.write_line("second");
    hostile.wait_for("replayed second");
    streaming.publish("/number", 8, false);
    until("the next number", PATIENCE, || {
        let number = number(&next_within(&mut subscriber, TURN)?, "/number")?;
        assert!([7, 8].contains(&number), "{number}");
        (number == 8).then_some(())
    });
}

#[test]
fn rules_of_the_robot_and_of_the_endpoint_hold_for_streams() {
    let scratch = Scratch::new();
    let [_, desk, anna, other] = keys(&scratch);
    let endpoint =
        format!("{DESK}key: desk.key_secret\nclient-keys: [/arm=anna.key, /leg/test=other.key]\n");
    let arm = "fleet-key: arm.key_secret\nclient-keys: /test=desk.key\n";
    let fleet = Streaming::fleet(scratch, &endpoint);
    let router = fleet.address.clone();
    let streaming = Streaming::of(fleet, arm, &router);
    let at = format!("tcp://127.0.0.1:{}", streaming.port);
    let subscribe = |own: &KeyPair| {
        let builder = Subscriber::builder().keys(own.clone(), desk.public());
        builder.connect(&at).unwrap()
    };
    let (mut anna, mut other) = (subscribe(&anna), subscribe(&other));
    until("the other client is connected", PATIENCE, || {
        next_within(&mut other, TURN);
        other.is_connected().then_some(())
    });
    let secret = streaming.publisher.under("/secret");
    let watched = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&watched);
    secret.watch("/x", move |is_watched| {
        seen.store(is_watched, Ordering::Release)
    });
    streaming.until_heard(&mut anna);
    // A reading of a gateway belongs to the whole robot.
    let reading = streaming.publisher.under("gripper");
    for hidden in [&secret, &reading] {
        assert!(hidden.publish("/x", &1.into()));
    }
    streaming.publish("/word", 1, false);
    until("the scope that is allowed", PATIENCE, || {
        let heard = next_within(&mut anna, TURN)?;
        assert!(heard.topic.starts_with("/arm/test/"), "{}", heard.topic);
        number(&heard, "/word")
    });
    assert_eq!(anna.missed(), 0);
    // What nobody may hear is not asked for, so a stream that runs only while it is watched does not begin.
    assert!(!watched.load(Ordering::Acquire));
    assert_eq!(next_within(&mut other, TURN), None);
    assert!(other.is_connected());
}

#[test]
fn a_flood_holds_up_no_abort_and_the_newest_state_arrives() {
    assert_flood_is_bounded(&Streaming::new());
}

#[test]
fn nor_does_a_flood_on_a_slow_line() {
    let fleet = Streaming::fleet(Scratch::new(), "robots: arm\n");
    let line = Line::to(&fleet.address);
    let streaming = Streaming::of(fleet, "", &line.address);
    // At most 3 MB a second.
    line.set(Mode::Slow(Duration::from_millis(20)));
    assert_flood_is_bounded(&streaming);
}

#[track_caller]
fn assert_flood_is_bounded(streaming: &Streaming) {
    let mut slow = streaming.subscribe("/arm");
    let mut quick = streaming.subscribe("/arm");
    streaming.until_heard(&mut quick);
    streaming.until_heard(&mut slow);
    let mut remote = streaming.fleet.client();
    let ends = AtomicBool::new(false);
    let image = vec![7; 300_000];
    std::thread::scope(|threads| {
        let flood = threads.spawn(|| {
            let mut number = 0;
            while !ends.load(Ordering::SeqCst) {
                // As fast as the robot's publisher takes it, which has no room above its own bounds.
                streaming.publisher.publish_bytes("/image", &image, false);
                number += 1;
                // On a busy machine, the publisher itself may have no room.
                while !streaming.publisher.publish_state("/number", &number.into()) {
                    std::thread::sleep(Duration::from_millis(1));
                }
                if !streaming.publisher.has_room() {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
            number
        });
        until("the flood has arrived", PATIENCE, || {
            next_within(&mut quick, TURN).filter(|heard| heard.topic == "/arm/test/image")
        });
        let id = start(&mut remote, "nap", "for", "60");
        in_time(SOON, || status(&mut remote, id));
        let id = in_time(2 * SOON, || {
            let id = start(&mut remote, "nap", "for", "60");
            abort(&mut remote, id);
            id
        });
        assert_eq!(end(&mut remote, id).0, State::Aborted);
        ends.store(true, Ordering::SeqCst);
        let last = flood.join().unwrap();
        for (name, subscriber) in [("quick", &mut quick), ("slow", &mut slow)] {
            until(&format!("the newest state: {name}"), PATIENCE, || {
                let number = number(&next_within(subscriber, TURN)?, "/number")?;
                (number == last).then_some(())
            });
        }
    });
    for part in [&streaming.agent, &streaming.fleet.endpoint] {
        let mib = part.peak_kib() / 1024;
        assert!(mib < 250, "{mib} MiB");
    }
}

#[test]
fn readings_of_a_gateway_are_heard_and_the_tasks_of_a_robot_are_recorded_and_reported() {
    let fleet = Streaming::fleet(Scratch::new(), "robots: arm\n");
    let port = fleet.endpoint.wait_for_port("Publishing ");
    let devices = ["sensor=sim:sensor", "gripper=sim:gripper"];
    let gateway = Server::gateway_with(&devices, &["--publish", "0"]);
    gateway.wait_ready("gripper");
    let at = gateway.process.wait_for_port("Publishing ");
    let more = format!("publish: tcp://127.0.0.1:{at}\n");
    let _agent = fleet.join(&gateway, &more);
    // At the robot, its topic does not begin with a slash.
    let address = format!("tcp://127.0.0.1:{port}");
    let heard = Process::run(ztl().args(["subscribe", &address, "/arm/sensor", "-n", "1"]));
    assert!(heard.stdout.starts_with("/arm/sensor/"), "{heard:?}");

    let file = fleet.scratch.path("run.mcap");
    let recorder = Process::start(ztl().arg("record").arg(&file).arg(&address));
    let mut remote = fleet.client();
    until("a task is recorded", PATIENCE, || {
        let id = start(&mut remote, "gripper", "finger", "40");
        end(&mut remote, id);
        let size = std::fs::read(&file).unwrap_or_default();
        size.windows(6)
            .any(|bytes| bytes == b"$tasks")
            .then_some(())
    });
    let recorder = recorder.signal_until_end("INT", PATIENCE);
    // On a busy machine, it may connect late.
    let mut warnings = recorder.stderr.lines().filter(|line| {
        line.contains("warning") && !line.contains("not connected; it is recorded as soon as")
    });
    assert_eq!(warnings.next(), None, "{recorder:?}");
    let reported = Process::run(ztl().arg("report").arg(&file));
    assert_eq!(reported.code, Some(0), "{reported:?}");
    let page = std::fs::read_to_string(fleet.scratch.path("run.html")).unwrap();
    assert!(page.contains("/arm/test"), "the scope of a task");
}
