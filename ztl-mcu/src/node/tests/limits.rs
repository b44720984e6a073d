//! Nothing that is to be said is too long for a frame, and nothing is said or polled too often.

use super::*;
use crate::{Latest, Reading};
use core::cell::Cell;

/// A node's reply to one body, as sent on the line.
fn answered<C: Components, const TASKS: usize, const FRAME: usize>(
    node: &mut Node<'_, C, TASKS, FRAME>,
    session: u32,
    seq: u8,
    body: Body<'_>,
) -> Grown<u8> {
    let mut buffer = [0xA5; 1200];
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq,
        body,
    };
    let now = Instant::from_millis(u64::MAX / 1000);
    let len = encode(session, &frame, &mut buffer).unwrap();
    node.handle_bytes(now, &buffer[..len]);
    let len = node.poll_transmit(now, &mut buffer);
    buffer[..len].to_vec()
}

#[test]
fn a_welcome_fits_for_any_name_and_number_of_tasks() {
    fn check<const TASKS: usize, const FRAME: usize>() {
        let trace = Trace::default();
        let mut components = [motor("m", Loss::CarryOn, &trace)];
        components[0].busy = Busy::Queue(u8::MAX);
        let name = "ä".repeat(100);
        let identity = Identity {
            link_timeout: Duration::from_secs(60),
            ..Identity::new(&name, &name, u32::MAX)
        };
        let mut node = Node::<_, TASKS, FRAME>::new(identity, components);
        let hello = |session| {
            Body::Hello(Hello {
                version: VERSION,
                session,
                gateway: 1,
            })
        };
        let number = u32::MAX - 1;
        answered(&mut node, NO_SESSION, NO_SEQ, hello(number));
        let key = session_key(number, u32::MAX);
        for task in 0..TASKS as u32 {
            let start = Body::Start {
                task: LinkId(u32::MAX - TASKS as u32 + task),
                component: 0,
                goal: "5",
                before_ms: u64::MAX,
            };
            answered(&mut node, key, task as u8 + 1, start);
        }
        let bytes = answered(&mut node, NO_SESSION, NO_SEQ, hello(number - 1));
        let mut decoder = Decoder::<LONGEST_FRAME>::new();
        let end = bytes
            .iter()
            .position(|byte| decoder.push(*byte) == Ok(true));
        assert!(end.is_some_and(|end| end < FRAME), "{end:?}");
        let (_, frame) = decoder.frame(&[number - 1]).unwrap();
        let Body::Welcome(welcome) = frame.body else {
            panic!("{frame:?}");
        };
        assert_eq!(welcome.held.len(), TASKS);
        let longest = Node::<'_, [Motor<'_>; 1], TASKS, FRAME>::LONGEST_NAME;
        assert!((16..=100).contains(&longest), "{longest}");
        assert!(usize::from(welcome.max_body) <= 1094);
        assert_eq!(welcome.name, &name[..longest / 2 * 2]);
        assert_eq!(welcome.firmware, welcome.name);
    }
    check::<1, 128>();
    check::<9, 128>();
    check::<34, 256>();
    check::<48, 350>();
    check::<202, LONGEST_FRAME>();
}

#[test]
fn a_description_that_does_not_fit_is_rejected_with_the_reason() {
    let trace = Trace::default();
    let long: &'static str = std::boxed::Box::leak("n".repeat(102).into_boxed_str());
    for (name, fits) in [(&long[..101], true), (long, false)] {
        let motors = [motor(name, Loss::Abort, &trace)];
        let offer = motors[0].offer();
        let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), motors.clone());
        assert_eq!(Node::<[Motor<'_>; 1], 2, 128>::fits(&offer), fits);
        let mut gateway = gateway(&mut node);
        gateway.hello(5, 1);
        let heard = gateway.command(1, Body::Describe { index: 0 });
        let expected = match fits {
            true => format!("1 Component 0 {name}"),
            false => "1 Refused its description is longer than a frame".into(),
        };
        assert_eq!(heard, [expected]);
        assert_said(gateway.command(2, Body::Ping), &["2 Pong 0"]);
    }
}

#[test]
fn a_description_that_fits_the_longest_frame_fits_a_gateway() {
    let words: &'static str = std::boxed::Box::leak("w ".repeat(540).into_boxed_str());
    for (words, fits) in [(&words[..1077], true), (&words[..1078], false)] {
        let offer = Offer::new("x").with_words(words);
        assert_eq!(Node::<[Motor<'_>; 1], 2, LONGEST_FRAME>::fits(&offer), fits);
        let frame = Frame {
            addr: ADDR_ONLY_NODE,
            seq: 1,
            body: Body::Component { index: 0, offer },
        };
        let mut buffer = [0xA5; 1200];
        let len = encode(7, &frame, &mut buffer).unwrap();
        assert_eq!(len <= LONGEST_FRAME, fits, "{len}");
    }
}

#[test]
fn a_moving_component_is_polled_at_its_requested_time() {
    let polls = Cell::new(0);
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), [Chatty::new(&polls)]);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.start(1, 9, 0, "5");
    let mut sent = 0;
    // A main loop that never sleeps.
    for micros in 0..850_000 {
        let now = gateway.now + Duration::from_micros(micros);
        gateway.node.handle_timeout(now);
        let mut buffer = [0xA5; 128];
        let count = gateway.node.poll_transmit(now, &mut buffer);
        sent += buffer[..count].iter().filter(|byte| **byte == 0).count();
    }
    assert_eq!(polls.get(), 85);
    // A reading each 10 ms but in the first ones, and the progress each 50 ms.
    assert_eq!(sent, 84 + 17);
}

/// Moves for ever and has another reading at each poll.
struct Chatty<'p> {
    polls: &'p Cell<u32>,
    speed: Latest<4>,
}

impl<'p> Chatty<'p> {
    fn new(polls: &'p Cell<u32>) -> Self {
        Self {
            polls,
            speed: Latest::new(),
        }
    }
}

impl Component for Chatty<'_> {
    fn offer(&self) -> Offer<'_> {
        Offer::new("belt").with_topics("speed")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run {
        self.polls.set(self.polls.get() + 1);
        report.number(self.polls.get() as f32, 0);
        self.speed.set(&[1, 2, 3, 4]).unwrap();
        Run::Running
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}

    fn poll_reading(&mut self, _: Instant, buffer: &mut [u8]) -> Option<Reading> {
        self.speed.take(0, buffer)
    }
}
