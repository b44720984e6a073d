//! A serial port on which clients come and go unannounced.

use core::time::Duration;
use std::collections::VecDeque;
use std::string::String;
use std::vec::Vec;

use embedded_io::{ErrorType, Read, ReadReady, Write};

use ztl_zmtp::GREETING;

use super::{NOW, TestServer, frame, greeting, init, ready, request, server, text};
use crate::Instant;
use crate::zmtp::{Line, Rep, Socket};

/// Both directions of a port.
#[derive(Default)]
struct Port {
    received: VecDeque<u8>,
    sent: Vec<u8>,
}

impl ErrorType for Port {
    type Error = core::convert::Infallible;
}

impl Read for Port {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Self::Error> {
        let count = buffer.len().min(self.received.len());
        for (to, from) in buffer.iter_mut().zip(self.received.drain(..count)) {
            *to = from;
        }
        Ok(count)
    }
}

impl ReadReady for Port {
    fn read_ready(&mut self) -> Result<bool, Self::Error> {
        Ok(!self.received.is_empty())
    }
}

impl Write for Port {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Self::Error> {
        self.sent.extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }
}

struct Rig {
    now: Instant,
    line: Line,
    server: TestServer,
    port: Port,
}

impl Rig {
    fn new() -> Self {
        Self {
            now: NOW,
            line: Line::new(),
            server: server(),
            port: Port::default(),
        }
    }

    /// Sends the bytes; returns what comes back within a few turns of the main loop.
    fn send(&mut self, bytes: &[u8]) -> Vec<u8> {
        self.port.received.extend(bytes);
        for _ in 0..40 {
            let mut rx = Port::default();
            core::mem::swap(&mut rx.received, &mut self.port.received);
            self.line
                .turn(&mut self.server, &mut rx, &mut self.port, self.now)
                .expect("the port never fails");
            core::mem::swap(&mut rx.received, &mut self.port.received);
        }
        core::mem::take(&mut self.port.sent)
    }

    fn ask(&mut self, body: &str) -> String {
        text(&self.send(&request(body.as_bytes())))
    }
}

#[test]
fn nothing_is_sent_before_a_client_begins() {
    let mut rig = Rig::new();
    assert!(rig.send(b"").is_empty());
    assert!(rig.send(b"noise \xFF\0\0\xFF").is_empty());
    let heard = rig.send(&[greeting(), ready("REQ")].concat());
    assert_eq!(heard, [GREETING, Rep::READY].concat());
    assert_eq!(rig.ask("/lab;2;1;"), "/lab;2;1;Invalid ID '1'");
}

#[test]
fn a_new_client_is_served_after_any_unfinished_stream() {
    let all = [
        greeting(),
        ready("DEALER"),
        frame(1, b"me"),
        request(init("desk:motor:up").as_bytes()),
        // A client that waits for its reply.
        request(b"/lab;3;1;"),
        frame(1, b"")[..1].to_vec(),
    ]
    .concat();
    for cut in 0..=all.len() {
        let mut rig = Rig::new();
        rig.port.received.extend(&all[..cut]);
        rig.send(b"");
        let begin = [greeting(), ready("REQ")].concat();
        // The new one receives nothing meant for the former.
        let heard = rig.send(&begin);
        assert!(heard == [GREETING, Rep::READY].concat(), "cut at {cut}");
        assert_eq!(
            rig.ask("/lab;2;77;"),
            "/lab;2;77;Invalid ID '77'",
            "cut at {cut}"
        );
    }
}

#[test]
fn a_signature_may_hold_an_identity_and_follow_a_stray_ff() {
    let mut rig = Rig::new();
    let mut begin = [&b"\xFF"[..], &greeting(), &ready("REQ")].concat();
    begin[9] = 0x21;
    let heard = rig.send(&begin);
    assert!(heard.ends_with(Rep::READY));
}

#[test]
fn a_request_that_ends_like_a_signature_is_answered_after_a_pause_or_the_next_byte() {
    let mut ready = ready("REQ");
    ready.extend(b"\x08Identity\0\0\0\x01\xFF");
    ready[1] = ready.len() as u8 - 2;
    let mut rig = Rig::new();
    assert_eq!(rig.send(&greeting()), GREETING);
    assert!(rig.send(&ready).is_empty());
    rig.now = NOW + Duration::from_millis(99);
    assert!(rig.send(b"").is_empty());
    let due = rig.line.turn(
        &mut rig.server,
        &mut Port::default(),
        &mut Port::default(),
        rig.now,
    );
    assert_eq!(due, Ok(NOW + Duration::from_millis(100)));
    rig.now = NOW + Duration::from_millis(100);
    assert_eq!(rig.send(b""), Rep::READY);
    assert_eq!(rig.ask("/lab;2;1;"), "/lab;2;1;Invalid ID '1'");

    let heard = rig.send(&request(b"/lab;\xFF;1;\xFF\0\0;"));
    assert_eq!(text(&heard), "/lab;2;-1;Unknown protocol");
}

/// As on a very slow line.
#[test]
fn a_signature_may_arrive_slowly() {
    let mut rig = Rig::new();
    rig.send(
        &[
            greeting(),
            ready("REQ"),
            request(b"/lab;2;1;")[..3].to_vec(),
        ]
        .concat(),
    );
    let begin = [greeting(), ready("REQ")].concat();
    let mut heard = Vec::new();
    let (signature, rest) = begin.split_at(10);
    for byte in signature {
        rig.now = rig.now + Duration::from_millis(99);
        heard.extend(rig.send(&[*byte]));
    }
    heard.extend(rig.send(rest));
    assert!(heard.ends_with(&[GREETING, Rep::READY].concat()));
}
