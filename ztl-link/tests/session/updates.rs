//! Firmware updates over a line that loses, repeats and delays frames, and with a node that is reset: each piece is stored
//! once and in its place, and nothing but the complete image is verified.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::update::UpdatePhase;
use ztl_link::{LinkEvent, Session, UpdateAnswer, UpdateFailure, UpdateReply, UpdateRequest};
use ztl_mcu::link::Offer;
use ztl_mcu::update::{Firmware, Receiving, Updatable, UpdateError, Updater, Verification};
use ztl_mcu::{Component, Identity, Node, Refused, Report, Run};

/// Longer than a session has commands.
const LENGTH: usize = 300 * 96 + 32;

fn image() -> Vec<u8> {
    (0..LENGTH).map(|at| (at / 96) as u8).collect()
}

/// Never has a task.
struct Part;

impl Component for Part {
    fn offer(&self) -> Offer<'_> {
        Offer::new("part")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Err(Refused)
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Err(Refused)
    }

    fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
        Run::Aborted
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}
}

/// Keeps what it receives over resets.
struct Flash<'t>(&'t RefCell<Vec<u8>>);

impl Updater for Flash<'_> {
    fn firmware(&self) -> Firmware<'_> {
        Firmware {
            board: "desk",
            version: "1",
            confirmed: true,
            trial_ms: 0,
            self_test: None,
        }
    }

    fn begin(&mut self, _: &[u8], _: bool) -> Result<Receiving, UpdateError> {
        Ok(Receiving {
            length: LENGTH as u32,
            offset: self.0.borrow().len() as u32,
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        let mut stored = self.0.borrow_mut();
        assert_eq!(offset as usize, stored.len(), "stored out of its place");
        stored.extend_from_slice(bytes);
        Ok(())
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        assert_eq!(*self.0.borrow(), image());
        Ok(Verification::Done)
    }

    fn restart(&mut self) {}

    fn confirm(&mut self) -> Result<(), UpdateError> {
        Ok(())
    }
}

type DeviceNode<'t> = Node<'static, Updatable<(Part,), Flash<'t>>, 2, 128>;

fn node(stored: &RefCell<Vec<u8>>, boot: u32) -> DeviceNode<'_> {
    let identity = Identity::new("desk", "1", boot << 20);
    Node::new(identity, Updatable::new((Part,), Flash(stored)))
}

/// What follows an answer, as a gateway does it.
fn next(answer: &UpdateAnswer, piece: usize) -> Option<UpdateRequest> {
    let begin = UpdateRequest::Begin {
        now: false,
        downgrade: false,
        manifest: vec![7; 104],
    };
    match answer {
        Ok(UpdateReply::Phase(UpdatePhase::Receiving { offset })) => {
            let at = *offset as usize;
            let bytes = image()[at..(at + piece).min(LENGTH)].to_vec();
            Some(match bytes.is_empty() {
                true => UpdateRequest::Finish,
                false => UpdateRequest::Write {
                    offset: *offset,
                    bytes,
                },
            })
        }
        Ok(UpdateReply::Phase(UpdatePhase::Verifying)) => Some(UpdateRequest::Ask),
        Ok(UpdateReply::Phase(UpdatePhase::Ready)) => None,
        _ => Some(begin),
    }
}

#[test]
fn under_faults_each_piece_is_stored_once_and_in_its_place() {
    let (mut resumed, mut resets) = (0, 0);
    for seed in 0..12 {
        let stored = RefCell::new(Vec::new());
        let mut session = Session::new(7, None, super::numbers);
        let (mut node, mut boot) = (node(&stored, 1), 1);
        let mut now = Instant::ZERO;
        session.handle_connected(now);
        let mut dice = super::parameters::Dice(seed);
        let mut lanes: [VecDeque<(Instant, Vec<u8>)>; 2] = Default::default();
        let mut answer: Option<UpdateAnswer> = Some(Err(UpdateFailure::Lost));
        let mut number = 0;
        let mut sent = None;
        let mut finished = false;
        for step in 0..400_000 {
            now = now + Duration::from_millis(1);
            // A device that is unreachable is asked again when it answers.
            if session.is_up()
                && let Some(last) = answer.take()
            {
                let piece = session.device().expect("it is up").longest_piece();
                // A gateway may also repeat in another session what was not answered.
                let repeated = sent.take().filter(|_| last.is_err());
                let Some(request) = repeated.or_else(|| next(&last, piece)) else {
                    finished = true;
                    break;
                };
                sent = Some(request.clone());
                number += 1;
                session.request_update(now, number, request);
            }
            match dice.below(3000) {
                0 => {
                    boot += 1;
                    resets += 1;
                    node = self::node(&stored, boot);
                }
                1 => {
                    session.handle_disconnected();
                    session.handle_connected(now);
                    resumed += 1;
                }
                _ => {}
            }
            node.handle_timeout(now);
            session.handle_timeout(now);
            let mut buffer = [0; 300];
            let count = node.poll_transmit(now, &mut buffer);
            for (lane, bytes) in [(0, session.poll_transmit()), (1, buffer[..count].to_vec())] {
                for frame in bytes.split_inclusive(|byte| *byte == 0) {
                    let late = now + Duration::from_millis(1 + dice.below(2000));
                    match dice.below(15) {
                        0 => {}
                        1 => lanes[lane].push_back((late, frame.to_vec())),
                        2 => lanes[lane].extend([(now, frame.to_vec()), (late, frame.to_vec())]),
                        _ => lanes[lane].push_back((now, frame.to_vec())),
                    }
                }
            }
            for (lane, frames) in lanes.iter_mut().enumerate() {
                let all = std::mem::take(frames);
                for (at, frame) in all {
                    match (at <= now, lane) {
                        (false, _) => frames.push_back((at, frame)),
                        (true, 0) => node.handle_bytes(now, &frame),
                        (true, _) => session.handle_bytes(now, &frame),
                    }
                }
            }
            while let Some(event) = session.poll_event() {
                if let LinkEvent::Update(asked, told) = event {
                    assert_eq!(
                        (asked, &answer),
                        (number, &None),
                        "step {step}: answered twice"
                    );
                    answer = Some(told);
                }
            }
        }
        assert!(finished, "seed {seed}: {} bytes", stored.borrow().len());
        assert_eq!(*stored.borrow(), image(), "seed {seed}");
    }
    assert!(resumed > 5 && resets > 5, "{resumed} {resets}");
}

#[test]
fn a_node_without_updates_is_never_asked() {
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 1), (Part,));
    let mut session = Session::new(7, None, super::numbers);
    let mut now = Instant::ZERO;
    session.handle_connected(now);
    for millis in 0..3000 {
        now = now + Duration::from_millis(1);
        if millis == 1000 {
            session.request_update(now, 1, UpdateRequest::Read);
        }
        session.handle_timeout(now);
        node.handle_timeout(now);
        node.handle_bytes(now, &session.poll_transmit());
        let mut buffer = [0; 300];
        let count = node.poll_transmit(now, &mut buffer);
        session.handle_bytes(now, &buffer[..count]);
    }
    let events: Vec<LinkEvent> = std::iter::from_fn(|| session.poll_event()).collect();
    let none = LinkEvent::Update(1, Err(UpdateFailure::NoUpdates));
    assert!(events.contains(&none), "{events:?}");
    assert!(!events.contains(&LinkEvent::Lost), "{events:?}");
    assert_eq!(node.counters().errors, 0);
}
