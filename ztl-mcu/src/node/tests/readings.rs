//! Readings and the log: what goes over the line when nothing else does.

use super::*;
use crate::component::Reading;
use crate::reading::{Latest, Queued};
use core::cell::{Cell, RefCell};

/// Has readings, and carries out nothing.
#[derive(Default)]
struct Sensor {
    topics: &'static str,
    readings: Queued<4, 200>,
    /// Makes a reading of this length whenever it is asked, if any.
    always: Option<usize>,
    topic: u8,
}

impl Component for Sensor {
    fn offer(&self) -> Offer<'_> {
        Offer::new("sensor").with_topics(self.topics)
    }

    fn check(&self, _: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        why.text("a sensor does nothing");
        Err(Refused)
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Err(Refused)
    }

    fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
        Run::Failed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}

    fn poll_timeout(&self, now: Instant) -> Instant {
        now + Duration::from_millis(3)
    }

    fn poll_reading(&mut self, _: Instant, buffer: &mut [u8]) -> Option<Reading> {
        if let Some(len) = self.always
            && !self.readings.is_full()
        {
            self.readings.push(&[b'x'; 200][..len]).unwrap();
        }
        self.readings.take(self.topic, buffer)
    }
}

fn sensor(topics: &'static str) -> Sensor {
    Sensor {
        topics,
        ..Sensor::default()
    }
}

type SensorNode<const N: usize> = Node<'static, [Sensor; N], 2, 128>;

fn node<const N: usize>(sensors: [Sensor; N]) -> SensorNode<N> {
    let identity = Identity {
        reading_interval: Duration::ZERO,
        ..Identity::new("desk", "1", 77)
    };
    SensorNode::new(identity, sensors)
}

/// A log that grows when the test says so.
#[derive(Default)]
struct Pages {
    text: RefCell<Grown<u8>>,
    lost: Cell<u32>,
}

impl LogSource for Pages {
    fn read(&self, buffer: &mut [u8]) -> usize {
        let mut text = self.text.borrow_mut();
        let count = text.len().min(buffer.len());
        for (to, from) in buffer.iter_mut().zip(text.drain(..count)) {
            *to = from;
        }
        count
    }

    fn lost(&self) -> u32 {
        self.lost.get()
    }
}

/// The next frame, and how long it is on the line.
fn next<const N: usize>(
    node: &mut SensorNode<N>,
    now: Instant,
    log: &Pages,
) -> Option<(String, usize)> {
    let bytes = node.transmit_buf(now, log).to_vec();
    node.consume(bytes.len());
    let mut decoder = Decoder::<160>::new();
    for byte in &bytes {
        if decoder.push(*byte) == Ok(true) {
            let (_, frame) = decoder.frame(&[key(5), 5]).unwrap();
            let text = match frame.body {
                Body::Publish { topic, bytes } => format!("Publish {topic} {}", bytes.len()),
                Body::Log { lost, bytes } => format!("Log {lost} {}", bytes.len()),
                Body::Pong { .. } => "Pong".into(),
                Body::Welcome(_) => "Welcome".into(),
                other => format!("{other:?}"),
            };
            return Some((text, bytes.len()));
        }
    }
    None
}

#[test]
fn topics_are_numbered_across_components() {
    let mut node = node([sensor("a b"), sensor(""), sensor("c  d")]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.command(1, Body::Ping);
    for (place, topic, heard) in [
        (0, 0, Some(0)),
        (0, 1, Some(1)),
        (0, 2, None),
        (1, 0, None),
        (2, 0, Some(2)),
        (2, 1, Some(3)),
    ] {
        let sensor = &mut gateway.node.components_mut()[place];
        sensor.topic = topic;
        sensor.readings.push(&[7]).unwrap();
        let expected = heard.map(|topic| format!("Publish {{ topic: {topic}, bytes: [7] }}"));
        // It is asked again after 3 ms.
        assert_eq!(
            gateway.pass(3).first(),
            expected.as_ref(),
            "{place} {topic}"
        );
        gateway.node.components_mut()[place].readings = Queued::new();
    }
}

#[test]
fn readings_are_sent_last_and_only_to_a_listener() {
    let log = Pages::default();
    log.text.borrow_mut().extend([1; 200]);
    let mut node = node([sensor("a")]);
    let at = Instant::from_millis;
    node.components_mut()[0].readings.push(&[7; 10]).unwrap();
    let mut gateway = gateway(&mut node);
    gateway.now = at(0);
    gateway.hello(5, 1);
    assert_eq!(next(gateway.node, at(1), &log), None, "no command yet");
    let mut buffer = [0xA5; 64];
    let ping = Frame {
        addr: ADDR_ONLY_NODE,
        seq: 1,
        body: Body::Ping,
    };
    let len = encode(key(5), &ping, &mut buffer).unwrap();
    gateway.node.handle_bytes(at(2), &buffer[..len]);
    let mut next = |time| next(gateway.node, at(time), &log);
    assert_eq!(next(2).unwrap().0, "Pong");
    assert_eq!(next(2).unwrap().0, "Publish 0 10");
    let (text, len) = next(2).unwrap();
    assert_eq!(text, "Log 0 112");
    assert!(len <= 128);
    log.lost.set(300);
    assert_eq!(next(2).unwrap().0, "Log 300 88");
    assert_eq!(next(2), None);
    // The link is lost.
    log.text.borrow_mut().extend([1; 20]);
    gateway.node.components_mut()[0]
        .readings
        .push(&[7])
        .unwrap();
    gateway.node.handle_timeout(at(1002));
    assert_eq!(self::next(gateway.node, at(1002), &log), None);
}

#[test]
fn droppable_frames_wait_while_a_command_arrives() {
    let log = Pages::default();
    log.text.borrow_mut().extend([1; 100]);
    let mut node = node([sensor("a")]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.command(1, Body::Ping);
    let later = gateway.now + Duration::from_millis(3);
    gateway.node.components_mut()[0]
        .readings
        .push(&[7; 5])
        .unwrap();
    // The first bytes of a frame.
    gateway.node.handle_bytes(later, &[3, 1]);
    assert_eq!(next(gateway.node, later, &log), None);
    // An incomplete frame that does not continue is not a command.
    let over = later + Duration::from_millis(20);
    assert_eq!(gateway.node.poll_timeout(later), over);
    assert_eq!(next(gateway.node, over, &log).unwrap().0, "Publish 0 5");
    assert_eq!(next(gateway.node, over, &log).unwrap().0, "Log 0 100");
}

#[test]
fn each_component_keeps_its_own_minimum_reading_interval() {
    let mut sensors = [sensor("a"), sensor("b"), sensor("c")];
    for sensor in &mut sensors[..2] {
        sensor.always = Some(4);
    }
    let identity = Identity {
        reading_interval: Duration::from_millis(20),
        ..Identity::new("desk", "1", 77)
    };
    let mut node = SensorNode::new(identity, sensors);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    let mut sent = gateway.command(1, Body::Ping).len() - 1;
    for _ in 0..999 {
        sent += gateway.pass(1).len();
    }
    assert_eq!(sent, 2 * 50);
}

#[test]
fn a_progress_frame_never_exceeds_the_limit_for_droppable_frames() {
    let mut buffer = [0xA5; 128];
    let text = "x".repeat(tasks::TEXT);
    let progress = Frame {
        addr: ADDR_ONLY_NODE,
        seq: NO_SEQ,
        body: Body::Progress {
            task: LinkId(u32::MAX),
            text: &text,
        },
    };
    assert!(encode(5, &progress, &mut buffer).unwrap() <= 64);
}

#[test]
fn an_oversized_reading_does_not_block_other_readings() {
    let mut node = node([sensor("a"), sensor("b")]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.command(1, Body::Ping);
    let later = gateway.now + Duration::from_millis(3);
    let longest = SensorNode::<2>::LONGEST_READING;
    let sensors = gateway.node.components_mut();
    sensors[0].readings.push(&[7; 200][..=longest]).unwrap();
    sensors[0].readings.push(&[7]).unwrap();
    sensors[1].readings.push(&[7; 200][..longest]).unwrap();
    let log = Pages::default();
    let mut next = || next(gateway.node, later, &log);
    assert_eq!(next(), Some(("Publish 0 1".into(), 12)));
    assert_eq!(next(), Some((format!("Publish 1 {longest}"), 127)));
    assert_eq!(next(), None);
    assert_eq!(gateway.node.components()[0].readings.lost(), 1);
}

#[test]
fn components_take_turns() {
    let mut node = node([sensor("a"), sensor("b"), sensor("c")]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.command(1, Body::Ping);
    let log = Pages::default();
    gateway.node.components_mut()[0].always = Some(4);
    gateway.node.components_mut()[2].always = Some(5);
    // They were asked when the session began.
    gateway.now = gateway.now + Duration::from_millis(3);
    let mut sent = || next(gateway.node, gateway.now, &log).unwrap().0;
    let turns = [sent(), sent(), sent(), sent()];
    let (a, c) = ("Publish 0 4", "Publish 2 5");
    assert_eq!(turns, [a, c, a, c]);
    // There may be more at once, and later when it is asked again.
    assert_eq!(gateway.node.poll_timeout(gateway.now), gateway.now);
    gateway.node.components_mut()[0] = sensor("a");
    gateway.node.components_mut()[2] = sensor("c");
    while next(gateway.node, gateway.now, &log).is_some() {}
    let again = gateway.now + Duration::from_millis(3);
    assert_eq!(gateway.node.poll_timeout(gateway.now), again);
}

/// The share of a line of `baud` that readings of 100 bytes get beside a gateway's pings, while the
/// main loop turns every 200 µs and the port takes 64 bytes at a time.
fn share(baud: u64) -> f64 {
    let mut node = node([sensor("a")]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.command(1, Body::Ping);
    gateway.node.components_mut()[0].always = Some(100);
    let seconds = 2;
    let (mut port, mut buffer) = (std::collections::VecDeque::new(), [0xA5; 64]);
    let mut decoder = Decoder::<160>::new();
    let (mut payload, mut carried, mut seq) = (0, 0, 1);
    let mut ping = Grown::new();
    for turn in 0..seconds * 5000 {
        let now = Instant::from_micros(10_000_000 + turn * 200);
        if turn % 1250 == 0 {
            seq += 1;
            let frame = Frame {
                addr: ADDR_ONLY_NODE,
                seq,
                body: Body::Ping,
            };
            let len = encode(key(5), &frame, &mut buffer).unwrap();
            ping.extend_from_slice(&buffer[..len]);
        }
        // One byte of a command each turn: slower than either line.
        if !ping.is_empty() {
            let byte = ping.remove(0);
            gateway.node.handle_bytes(now, &[byte]);
        }
        gateway.node.handle_timeout(now);
        let room = 64 - port.len();
        let count = gateway.node.poll_transmit(now, &mut buffer[..room]);
        port.extend(&buffer[..count]);
        let end = (turn + 1) * 200 * baud / 10_000_000;
        while carried < end {
            carried += 1;
            let Some(byte) = port.pop_front() else {
                continue;
            };
            if decoder.push(byte) == Ok(true) {
                match decoder.frame(&[key(5)]).unwrap().1.body {
                    Body::Publish { bytes, .. } => payload += bytes.len(),
                    Body::Pong { .. } => {}
                    other => panic!("{other:?}"),
                }
            }
        }
    }
    payload as f64 / carried as f64
}

#[test]
fn readings_of_100_bytes_use_at_least_85_percent_of_the_line() {
    for baud in [115_200, 921_600] {
        let share = share(baud);
        assert!(share > 0.85, "{share} at {baud}");
    }
}

/// Has a reading after each poll and each start. An idle one wants to be asked at `idle`.
struct Scale {
    idle: Instant,
    until: Instant,
    tick: Instant,
    topics: &'static str,
    weight: Latest<4>,
    /// How often it was asked for a reading.
    asked: usize,
}

impl Component for Scale {
    fn offer(&self) -> Offer<'_> {
        Offer::new("scale").with_topics(self.topics)
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, now: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.until = now + Duration::from_millis(100);
        Ok(())
    }

    fn poll(&mut self, now: Instant, _: &mut Report<'_>) -> Run {
        self.weight.set(b"1").unwrap();
        self.tick = Instant::NEVER;
        if now < self.until {
            return Run::Running;
        }
        Run::Completed
    }

    fn abort(&mut self, now: Instant) {
        self.until = now;
    }

    fn make_safe(&mut self, now: Instant) {
        self.until = now;
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        if now < self.until {
            return now + Duration::from_millis(20);
        }
        self.idle
    }

    fn next_tick(&self) -> Instant {
        self.tick
    }

    fn poll_reading(&mut self, _: Instant, buffer: &mut [u8]) -> Option<Reading> {
        self.asked += 1;
        self.weight.take(0, buffer)
    }
}

const SCALE: Scale = Scale {
    idle: Instant::NEVER,
    until: Instant::ZERO,
    tick: Instant::NEVER,
    topics: "weight",
    weight: Latest::new(),
    asked: 0,
};

/// The readings during turns of a main loop that sleeps as long as the node allows, and the number of its turns.
fn readings_in(gateway: &mut TestGateway<'_, [Scale; 1], 2>, millis: u64) -> (usize, usize) {
    let end = gateway.now + Duration::from_millis(millis);
    let (mut readings, mut turns) = (0, 0);
    while gateway.now < end {
        gateway.node.handle_timeout(gateway.now);
        let heard = said(gateway.node, gateway.now, gateway.session);
        readings += heard
            .iter()
            .filter(|line| line.starts_with("Publish"))
            .count();
        turns += 1;
        let next = gateway.node.poll_timeout(gateway.now);
        assert!(next > gateway.now, "sleeps");
        gateway.now = next.min(end);
    }
    (readings, turns)
}

#[test]
fn a_component_that_waits_for_ever_while_idle_publishes_again_after_each_poll() {
    for idle in [Instant::NEVER, Instant::from_millis(60_000)] {
        let mut node =
            Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), [Scale { idle, ..SCALE }]);
        let mut gateway = gateway(&mut node);
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        assert_eq!(readings_in(&mut gateway, 500), (0, 1), "it sleeps");
        // Polls at 0, 20, ... 100 ms.
        gateway.start(2, 9, 0, "");
        assert_eq!(readings_in(&mut gateway, 200).0, 6);
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        gateway.start(3, 10, 0, "");
        readings_in(&mut gateway, 50);
        gateway.command(4, Body::Abort { task: LinkId(10) });
        assert_eq!(readings_in(&mut gateway, 90).0, 1, "aborted");
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(10) });
        assert_eq!(readings_in(&mut gateway, 500), (0, 1), "it sleeps");
        gateway.node.stop_everything(gateway.now);
        assert_eq!(readings_in(&mut gateway, 90).0, 1, "made safe");
        gateway.command(5, Body::Ping);
        let tick = gateway.now + Duration::from_millis(100);
        gateway.node.components_mut()[0].tick = tick;
        assert_eq!(readings_in(&mut gateway, 300).0, 1, "a tick");
        // What firmware hands over, and what came before a new session.
        gateway.node.components_mut()[0].weight.set(b"2").unwrap();
        assert_eq!(readings_in(&mut gateway, 90).0, 1, "handed over");
        assert_eq!(readings_in(&mut gateway, 300), (0, 1), "it sleeps");
    }
}

#[test]
fn a_new_session_asks_each_component_again() {
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), [SCALE]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.command(1, Body::Ping);
    gateway.pass(500);
    assert_eq!(gateway.node.components()[0].asked, 1);
    gateway.hello(6, 1);
    assert_eq!(gateway.node.components()[0].asked, 2);
    gateway.pass(100);
    assert_eq!(gateway.node.components()[0].asked, 2);
}

#[test]
fn a_component_whose_reading_is_too_long_is_asked_again_after_the_interval() {
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), [sensor("a")]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.node.components_mut()[0].topic = 1;
    gateway.node.components_mut()[0].always = Some(5);
    gateway.command(1, Body::Ping);
    let next = gateway.node.poll_timeout(gateway.now);
    assert_eq!(next, gateway.now + Duration::from_millis(10));
}

#[test]
fn a_node_without_topics_is_not_woken_for_readings() {
    let quiet = Scale {
        topics: "",
        ..SCALE
    };
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), [quiet]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.pass(3);
    gateway.start(1, 9, 0, "");
    gateway.pass(0);
    let next = gateway.node.poll_timeout(gateway.now);
    assert_eq!(next, gateway.now + Duration::from_millis(20));
    assert_eq!(gateway.node.components()[0].asked, 0);
}
