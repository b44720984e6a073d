//! Ports that are queues, on virtual time.

#[cfg(feature = "async")]
mod run;

use super::turn::LOG_AGAIN;
use super::*;
use crate::component::{Component, Reading, Refused, Report, Run};
use crate::log::LogSource;
use crate::{Identity, Instant, Node};
use core::cell::Cell;
use core::time::Duration;
use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};
use std::collections::VecDeque;
use std::format;
use std::string::String;
use std::vec::Vec;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Decoder, Frame, Hello, LinkId, NO_SEQ, NO_SESSION, Offer, VERSION,
    encode, session_key,
};

/// Moves until it is stopped, with endless readings if configured.
#[derive(Default)]
pub(super) struct Belt {
    moves: Cell<bool>,
    polls: Cell<u32>,
    endless: bool,
}

impl Component for Belt {
    fn offer(&self) -> Offer<'_> {
        Offer::new("belt").with_words("on").with_topics("speed")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.moves.set(true);
        Ok(())
    }

    fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
        self.polls.set(self.polls.get() + 1);
        if self.moves.get() {
            Run::Running
        } else {
            Run::Aborted
        }
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {
        self.moves.set(false);
    }

    fn poll_reading(&mut self, _: Instant, buffer: &mut [u8]) -> Option<Reading> {
        self.endless.then_some(())?;
        buffer.get_mut(..40)?.fill(b'r');
        Some(Reading { topic: 0, len: 40 })
    }
}

type BeltNode = Node<'static, [Belt; 1], 2, 128>;

fn node() -> BeltNode {
    let identity = Identity {
        reading_interval: Duration::ZERO,
        ..Identity::new("desk", "1", 77)
    };
    BeltNode::new(identity, [Belt::default()])
}

fn belt(node: &BeltNode) -> &Belt {
    let [belt] = node.components();
    belt
}

const KEY: u32 = session_key(5, 77);

fn frame(session: u32, seq: u8, body: Body<'_>) -> Vec<u8> {
    let mut buffer = [0xA5; 160];
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq,
        body,
    };
    let len = encode(session, &frame, &mut buffer).unwrap();
    buffer[..len].to_vec()
}

fn hello() -> Vec<u8> {
    let hello = Hello {
        version: VERSION,
        session: 5,
        gateway: 1,
    };
    frame(NO_SESSION, NO_SEQ, Body::Hello(hello))
}

/// A task for the belt.
fn start() -> Vec<u8> {
    let start = Body::Start {
        task: LinkId(9),
        component: 0,
        goal: "on",
        before_ms: u64::MAX,
    };
    frame(KEY, 1, start)
}

/// A summary of the sent frames.
fn said(bytes: &[u8]) -> Vec<String> {
    let mut decoder = Decoder::<160>::new();
    let mut said = Vec::new();
    for byte in bytes {
        if decoder.push(*byte) == Ok(true) {
            let (_, frame) = decoder.frame(&[KEY, 5, NO_SESSION]).unwrap();
            said.push(match frame.body {
                Body::Awake { .. } => "Awake".into(),
                Body::Welcome(_) => "Welcome".into(),
                Body::Started { task } => format!("Started {}", task.0),
                Body::Progress { .. } => "Progress".into(),
                Body::Ended { result, .. } => format!("Ended {result}"),
                Body::Publish { .. } => "Publish".into(),
                Body::Log { lost, bytes } => format!("Log {lost} {}", bytes.len()),
                other => format!("{other:?}"),
            });
        }
    }
    said
}

/// Greeted, and with a task under way, by the time 0.
fn begin(pump: &Pump<'_>, node: &mut BeltNode, port: &mut Port) {
    for bytes in [hello(), start()] {
        port.rx.extend(bytes);
        pump.turn(node, port, at(0)).unwrap();
    }
    port.tx.clear();
}

/// A port that takes and gives a few bytes at a time.
#[derive(Default)]
struct Port {
    rx: VecDeque<u8>,
    tx: Vec<u8>,
    /// Writes that fail.
    faults: u32,
    flushes: u32,
}

impl ErrorType for Port {
    type Error = ErrorKind;
}

impl ReadReady for Port {
    fn read_ready(&mut self) -> Result<bool, ErrorKind> {
        Ok(!self.rx.is_empty())
    }
}

impl Read for Port {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, ErrorKind> {
        let count = self.rx.len().min(buffer.len()).min(5);
        for (to, from) in buffer.iter_mut().zip(self.rx.drain(..count)) {
            *to = from;
        }
        Ok(count)
    }
}

impl Write for Port {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        if let Some(faults) = self.faults.checked_sub(1) {
            self.faults = faults;
            return Err(ErrorKind::BrokenPipe);
        }
        let count = bytes.len().min(7);
        self.tx.extend_from_slice(&bytes[..count]);
        Ok(count)
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        self.flushes += 1;
        Ok(())
    }
}

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

#[test]
fn a_turn_reads_moves_and_sends() {
    let (mut node, mut port) = (node(), Port::default());
    let pump = Pump::new();
    pump.turn(&mut node, &mut port, at(0)).unwrap();
    assert_eq!(said(&port.tx), ["Awake"]);
    port.rx.extend(hello());
    pump.turn(&mut node, &mut port, at(1)).unwrap();
    port.rx.extend(start());
    let due = pump.turn(&mut node, &mut port, at(1)).unwrap();
    assert_eq!(said(&port.tx), ["Awake", "Welcome", "Started 9"]);
    assert!(belt(&node).moves.get());
    assert!(due > at(1) && due <= at(50), "{due:?}");
    // Nothing to send: nothing to flush either.
    let before = port.flushes;
    pump.turn(&mut node, &mut port, at(2)).unwrap();
    assert_eq!(port.flushes, before);
}

#[test]
fn unwritten_bytes_are_sent_in_the_next_turn() {
    let (mut node, mut port) = (node(), Port::default());
    port.faults = 1;
    let pump = Pump::new();
    let failed = pump.turn(&mut node, &mut port, at(0));
    assert_eq!(failed, Err(ErrorKind::BrokenPipe));
    pump.turn(&mut node, &mut port, at(1)).unwrap();
    assert_eq!(said(&port.tx), ["Awake"]);
}

#[test]
fn a_turn_ends_despite_endless_readings_and_bytes() {
    let (mut node, mut port) = (node(), Port::default());
    let pump = Pump::new();
    begin(&pump, &mut node, &mut port);
    node.components_mut()[0].endless = true;
    // It asked to be asked then.
    let now = at(11);
    assert_eq!(
        pump.turn(&mut node, &mut port, now),
        Ok(now),
        "more is to be sent"
    );
    assert!((50..=128).contains(&port.tx.len()));
    port.rx.extend([7; 1000]);
    assert_eq!(
        pump.turn(&mut node, &mut port, now),
        Ok(now),
        "more is ready"
    );
    assert!(port.rx.len() >= 744);
}

/// A log of these bytes.
struct Page(Cell<usize>);

impl LogSource for Page {
    fn read(&self, buffer: &mut [u8]) -> usize {
        let count = self.0.get().min(buffer.len());
        self.0.set(self.0.get() - count);
        buffer[..count].fill(b'l');
        count
    }

    fn lost(&self) -> u32 {
        3
    }
}

#[test]
fn the_log_is_polled_every_10_ms() {
    let (mut node, mut port) = (node(), Port::default());
    let page = Page(Cell::new(0));
    let pump = Pump::new().with_log(&page);
    begin(&pump, &mut node, &mut port);
    let now = at(1);
    assert!(pump.turn(&mut node, &mut port, now).unwrap() <= now + LOG_AGAIN);
    page.0.set(20);
    pump.turn(&mut node, &mut port, now).unwrap();
    assert_eq!(said(&port.tx), ["Log 3 20"]);
}

#[cfg(feature = "critical-section")]
#[test]
fn interrupts_can_receive_bytes_and_stop_the_node() {
    use crate::shared::{ReceiveQueue, StopFlag};

    static RECEIVED: ReceiveQueue<64> = ReceiveQueue::new();
    static STOP: StopFlag = StopFlag::new();
    let (mut node, mut port) = (node(), Port::default());
    let pump = Pump::new().with_stop(&STOP);
    for bytes in [hello(), start()] {
        let interrupt = || bytes.into_iter().for_each(|byte| RECEIVED.push(byte));
        std::thread::spawn(interrupt).join().unwrap();
        pump.turn_split(&mut node, &mut &RECEIVED, &mut port, at(4))
            .unwrap();
    }
    assert_eq!(said(&port.tx), ["Welcome", "Started 9"]);
    assert!(belt(&node).moves.get());
    std::thread::spawn(|| STOP.raise()).join().unwrap();
    pump.turn_split(&mut node, &mut &RECEIVED, &mut port, at(5))
        .unwrap();
    assert!(!belt(&node).moves.get() && node.is_stopped());
    assert!(!STOP.is_raised());
    assert_eq!(said(&port.tx).last().unwrap(), "Ended emergency stop");
}

/// The same port, as older HALs implement it.
#[cfg(feature = "embedded-io-06")]
mod older {
    use super::*;
    use crate::pump::{Error06, Io06};
    use embedded_io_06 as io06;

    struct Older(Port);

    impl io06::ErrorType for Older {
        type Error = io06::ErrorKind;
    }

    impl io06::ReadReady for Older {
        fn read_ready(&mut self) -> Result<bool, io06::ErrorKind> {
            self.0.read_ready().map_err(|_| io06::ErrorKind::Other)
        }
    }

    impl io06::Read for Older {
        fn read(&mut self, buffer: &mut [u8]) -> Result<usize, io06::ErrorKind> {
            self.0.read(buffer).map_err(|_| io06::ErrorKind::Other)
        }
    }

    impl io06::Write for Older {
        fn write(&mut self, bytes: &[u8]) -> Result<usize, io06::ErrorKind> {
            self.0.write(bytes).map_err(|_| io06::ErrorKind::BrokenPipe)
        }

        fn flush(&mut self) -> Result<(), io06::ErrorKind> {
            self.0.flush().map_err(|_| io06::ErrorKind::Other)
        }
    }

    #[test]
    fn a_port_of_an_older_hal_reads_writes_and_reports_its_error() {
        let (mut node, mut port) = (node(), Io06(Older(Port::default())));
        let pump = Pump::new();
        port.0.0.faults = 1;
        let failed = pump.turn(&mut node, &mut port, at(0));
        assert_eq!(failed, Err(Error06(io06::ErrorKind::BrokenPipe)));
        port.0.0.rx.extend(hello());
        pump.turn(&mut node, &mut port, at(1)).unwrap();
        pump.turn(&mut node, &mut port, at(1)).unwrap();
        assert_eq!(said(&port.0.0.tx), ["Welcome"]);
        assert!(port.0.0.flushes > 0);
    }
}
