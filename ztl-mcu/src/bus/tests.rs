//! A node on a shared line, played by hand on virtual time.

use super::*;
use crate::component::{Component, Refused, Report, Run};
use crate::{Identity, Node};
use std::vec::Vec;
use ztl_core::link::{
    Body, Decoder, Frame, Hello, LinkId, NO_SEQ, NO_SESSION, Offer, Turn, VERSION, encode,
    session_key,
};

const BOOT: u32 = 77;
const ID: u64 = 0xC0FF_EE00_0000_0001;

/// Completes at once.
struct Lamp;

impl Component for Lamp {
    fn offer(&self) -> Offer<'_> {
        Offer::new("lamp")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run {
        report.text("lit");
        Run::Completed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}
}

type BusNode = Node<'static, OnBus<[Lamp; 1]>, 2, 128>;

fn node(address: u8) -> BusNode {
    Node::new(
        Identity::new("lamp", "1", BOOT),
        OnBus::new([Lamp], ID, address),
    )
}

fn ms(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn link_frame(addr: u8, session: u32, seq: u8, body: Body<'_>) -> Vec<u8> {
    let mut buffer = [0; 128];
    let len = encode(session, &Frame { addr, seq, body }, &mut buffer).unwrap();
    buffer[..len].to_vec()
}

fn bus_frame(addr: u8, message: BusMessage<'_>) -> Vec<u8> {
    let mut buffer = [0; 128];
    let len = message.encode(addr, &mut buffer).unwrap();
    buffer[..len].to_vec()
}

fn hello(addr: u8) -> Vec<u8> {
    let hello = Hello {
        version: VERSION,
        session: 5,
        gateway: 1,
    };
    link_frame(addr, NO_SESSION, NO_SEQ, Body::Hello(hello))
}

/// What the node sends: one frame, or nothing.
fn said(node: &mut BusNode, now: Instant) -> Option<std::string::String> {
    node.handle_timeout(now);
    let mut buffer = [0; 300];
    let len = node.poll_transmit(now, &mut buffer);
    if len == 0 {
        assert!(node.poll_timeout(now) > now, "no turn, nothing to do");
        return None;
    }
    let mut decoder = Decoder::<128>::new();
    let (last, before) = buffer[..len].split_last().unwrap();
    for &byte in before {
        assert_eq!(decoder.push(byte), Ok(false), "more than one frame");
    }
    assert_eq!(decoder.push(*last), Ok(true));
    let addr = decoder.address().unwrap();
    if let Some((_, turn)) = decoder.turn() {
        return Some(std::format!("{addr} {turn:?}"));
    }
    if let Ok((_, message)) = decoder.bus_message() {
        return Some(std::format!("{addr} {message:?}"));
    }
    let (_, frame) = decoder
        .frame(&[session_key(5, BOOT), 5, NO_SESSION])
        .unwrap();
    let debug = std::format!("{:?}", frame.body);
    let name = debug.split([' ', '(']).next().unwrap();
    Some(std::format!("{addr} {name}"))
}

fn after(node: &mut BusNode, at: u64, bytes: &[u8]) -> Option<std::string::String> {
    node.handle_bytes(ms(at), bytes);
    said(node, ms(at))
}

#[test]
fn a_node_speaks_only_when_it_is_asked_and_says_one_frame() {
    let mut node = node(3);
    for at in 0..2000 {
        assert_eq!(said(&mut node, ms(at)), None);
    }
    let poll = Turn::Poll.encode(3);
    assert_eq!(after(&mut node, 2000, &poll).unwrap(), "3 Awake");
    assert_eq!(said(&mut node, ms(2001)), None);
    assert_eq!(after(&mut node, 2001, &poll).unwrap(), "3 Awake");
    assert_eq!(after(&mut node, 2002, &hello(3)).unwrap(), "3 Welcome");
    let session = session_key(5, BOOT);
    let start = Body::Start {
        task: LinkId(1),
        component: 0,
        goal: "on",
        before_ms: 9000,
    };
    let start = link_frame(3, session, 1, start);
    assert_eq!(after(&mut node, 2003, &start).unwrap(), "3 Started");
    // The task has ended meanwhile; the node waits until it is asked.
    assert_eq!(said(&mut node, ms(2100)), None);
    assert_eq!(after(&mut node, 2101, &poll).unwrap(), "3 Ended");
    assert_eq!(after(&mut node, 2102, &poll).unwrap(), "3 Idle");
    // An acknowledgement asks for nothing, a command behind it does.
    let ack = link_frame(3, session, NO_SEQ, Body::Ack { task: LinkId(1) });
    assert_eq!(after(&mut node, 2250, &ack), None);
    let both = [ack, link_frame(3, session, 2, Body::Ping)].concat();
    assert_eq!(after(&mut node, 2251, &both).unwrap(), "3 Pong");
    assert_eq!(after(&mut node, 2500, &poll).unwrap(), "3 Idle");
}

#[test]
fn frames_of_others_are_not_answered_and_not_counted_as_errors() {
    let mut node = node(3);
    let others = [
        Turn::Poll.encode(4).to_vec(),
        Turn::Idle.encode(4).to_vec(),
        Turn::Idle.encode(3).to_vec(),
        hello(4),
        link_frame(4, 99, 1, Body::Ping),
        hello(ADDR_ALL),
        hello(0),
    ];
    for bytes in others {
        assert_eq!(after(&mut node, 10, &bytes), None);
    }
    assert_eq!(node.counters().errors, 0);
    // A frame with its own address that it cannot read is an error: damaged, or of another session.
    assert_eq!(
        after(&mut node, 10, &link_frame(3, 99, 1, Body::Ping)),
        None
    );
    assert_eq!(node.counters().errors, 1);
}

#[test]
fn a_turn_ends_when_others_speak_or_its_time_has_passed() {
    let mut node = node(3);
    let (poll, other) = (Turn::Poll.encode(3), Turn::Poll.encode(4));
    node.handle_bytes(ms(0), &poll);
    assert_eq!(said(&mut node, ms(5)), None, "too late");
    node.handle_bytes(ms(10), &[poll, other].concat());
    assert_eq!(said(&mut node, ms(10)), None, "another was asked");
    node.handle_bytes(ms(20), &poll);
    node.handle_bytes(ms(20), &[7, 1, 0]);
    assert_eq!(said(&mut node, ms(20)), None, "somebody speaks");
    node.handle_bytes(ms(30), &poll);
    assert_eq!(said(&mut node, ms(34)).unwrap(), "3 Awake");
}

#[test]
fn a_command_that_came_too_late_to_be_answered_is_answered_when_it_is_repeated() {
    let mut node = node(3);
    assert_eq!(after(&mut node, 0, &hello(3)).unwrap(), "3 Welcome");
    let ping = link_frame(3, session_key(5, BOOT), 1, Body::Ping);
    node.handle_bytes(ms(1), &ping);
    assert_eq!(said(&mut node, ms(9)), None);
    assert_eq!(after(&mut node, 10, &ping).unwrap(), "3 Pong");
    assert_eq!(node.counters().repeats, 1);
}

#[test]
fn a_node_without_an_address_is_found_by_its_id_and_gets_one() {
    let mut node = node(200);
    assert_eq!(node.components().address(), ADDR_NONE);
    let search = |round, bits, prefix| {
        let search = BusMessage::Search {
            round,
            bits,
            prefix,
        };
        bus_frame(ADDR_ALL, search)
    };
    let here = std::format!("Here {{ id: {ID}, name: \"lamp\" }}");
    let here_at = |address: u8| std::format!("{address} {here}");
    assert_eq!(after(&mut node, 0, &search(1, 0, 0)).unwrap(), here_at(0));
    assert_eq!(after(&mut node, 1, &search(1, 1, 0)), None);
    assert_eq!(
        after(&mut node, 2, &search(1, 2, 3 << 62)).unwrap(),
        here_at(0)
    );
    let assign = |id, address| {
        let assign = BusMessage::Assign {
            round: 1,
            id,
            address,
        };
        bus_frame(ADDR_ALL, assign)
    };
    for (id, address) in [(ID + 1, 9), (ID, 33)] {
        assert_eq!(after(&mut node, 3, &assign(id, address)), None);
        assert_eq!(node.components().address(), ADDR_NONE);
    }
    assert_eq!(after(&mut node, 3, &assign(ID, 0)).unwrap(), here_at(0));
    assert_eq!(after(&mut node, 4, &assign(ID, 9)).unwrap(), here_at(9));
    assert_eq!(after(&mut node, 5, &assign(ID, 9)).unwrap(), here_at(9));
    assert_eq!(after(&mut node, 6, &search(1, 0, 0)), None, "found already");
    assert_eq!(after(&mut node, 7, &search(2, 0, 0)).unwrap(), here_at(9));
    assert_eq!(after(&mut node, 8, &hello(9)).unwrap(), "9 Welcome");
}

#[cfg(feature = "components")]
#[test]
fn the_transceiver_sends_from_the_first_byte_until_the_port_is_flushed() {
    use core::convert::Infallible;
    use embedded_io::{ErrorType, Write};
    use std::cell::RefCell;

    struct Traced<'t>(&'t RefCell<Vec<&'static str>>);

    impl ErrorType for Traced<'_> {
        type Error = Infallible;
    }

    impl Write for Traced<'_> {
        fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
            self.0.borrow_mut().push("write");
            Ok(bytes.len())
        }

        fn flush(&mut self) -> Result<(), Infallible> {
            self.0.borrow_mut().push("flush");
            Ok(())
        }
    }

    impl embedded_hal::digital::ErrorType for Traced<'_> {
        type Error = Infallible;
    }

    impl embedded_hal::digital::OutputPin for Traced<'_> {
        fn set_low(&mut self) -> Result<(), Infallible> {
            self.0.borrow_mut().push("low");
            Ok(())
        }

        fn set_high(&mut self) -> Result<(), Infallible> {
            self.0.borrow_mut().push("high");
            Ok(())
        }
    }

    let trace = RefCell::new(Vec::new());
    let mut port = DriverEnable::new(Traced(&trace), Traced(&trace)).unwrap();
    port.write(&[1]).unwrap();
    port.flush().unwrap();
    assert_eq!(*trace.borrow(), ["low", "high", "write", "flush", "low"]);
}
