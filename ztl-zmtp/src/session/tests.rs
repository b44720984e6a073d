//! Two sessions against each other, and against bytes that no peer would send.

use std::vec::Vec;

use ztl_core::Instant;

#[cfg(feature = "curve")]
use super::Stage;
use super::{BEFORE, ENVELOPES, Inbound, Obstacle, Outbound, Security, Step};
use crate::{Dealer, Fault, Pub, Router, Socket, Sub};

const MOST: usize = 1000;

/// One end, and the messages that it has received.
struct End<S> {
    inbound: Inbound<S>,
    out: Outbound,
    heard: Vec<Vec<Vec<u8>>>,
    fault: Option<Fault>,
    accepts: bool,
}

impl<S: Socket> End<S> {
    fn new(security: Security) -> Self {
        let mut out = Outbound::default();
        Self {
            inbound: Inbound::open(Instant::NEVER, security, MOST, &mut out),
            out,
            heard: Vec::new(),
            fault: None,
            accepts: true,
        }
    }

    fn take(&mut self, mut bytes: &[u8]) {
        while self.fault.is_none() {
            match self.inbound.next(&mut bytes, &mut self.out) {
                Ok(Step::Taken) => return,
                Ok(Step::Asks) if self.accepts => self.inbound.accept(&mut self.out),
                Ok(Step::Asks) => return,
                Ok(Step::Message(message)) => {
                    let frames = message.frames().map(<[u8]>::to_vec);
                    self.heard.push(frames.collect());
                }
                Ok(Step::Subscription(begins, topic)) => {
                    self.heard
                        .push(std::vec![std::vec![u8::from(begins)], topic]);
                }
                Err(fault) => self.fault = Some(fault),
            }
        }
    }
}

/// Passes on what each sends, in pieces of this length, until both are silent; `change` may change it.
fn talk<A: Socket, B: Socket>(
    one: &mut End<A>,
    other: &mut End<B>,
    piece: usize,
    change: &mut dyn FnMut(&mut Vec<u8>),
) {
    loop {
        let mut there = one.out.transmit_buf().to_vec();
        one.out.consume(there.len());
        let mut back = other.out.transmit_buf().to_vec();
        other.out.consume(back.len());
        if there.is_empty() && back.is_empty() {
            return;
        }
        change(&mut there);
        change(&mut back);
        there.chunks(piece).for_each(|piece| other.take(piece));
        back.chunks(piece).for_each(|piece| one.take(piece));
    }
}

fn securities() -> Vec<[Security; 2]> {
    let null = [Security::Null, Security::Null];
    #[cfg(feature = "curve")]
    return std::vec![null, curve()];
    #[cfg(not(feature = "curve"))]
    std::vec![null]
}

#[cfg(feature = "curve")]
fn curve() -> [Security; 2] {
    use core::sync::atomic::{AtomicU8, Ordering};
    fn random() -> [u8; 32] {
        static NEXT: AtomicU8 = AtomicU8::new(50);
        [NEXT.fetch_add(1, Ordering::SeqCst); 32]
    }
    let server = crate::curve::Keys::server([1; 32], random);
    let public = crate::curve::public_key(&[1; 32]);
    let client = crate::curve::Keys::client([2; 32], public, random);
    [Security::Curve(server), Security::Curve(client)]
}

/// A message's envelope: a frame, and the empty one.
const ENVELOPE: &[u8] = b"\x01\x02id\x01\0";

#[test]
fn messages_of_any_length_arrive_in_pieces_of_any_length() {
    for [server, client] in securities() {
        for piece in [1, 2, 7, 64, 100_000] {
            let mut server = End::<Router>::new(server.clone());
            let mut client = End::<Dealer>::new(client.clone());
            talk(&mut server, &mut client, piece, &mut |_| ());
            assert_eq!((server.fault, client.fault), (None, None));
            assert!(server.inbound.is_ready() && client.inbound.is_ready());
            let lengths = [0, 1, 200, 255, 256, 900];
            for length in lengths {
                client.out.message(ENVELOPE, &std::vec![7; length]);
            }
            server.out.message(ENVELOPE, b"an answer");
            talk(&mut server, &mut client, piece, &mut |_| ());
            let expected =
                lengths.map(|length| std::vec![b"id".to_vec(), b"".to_vec(), std::vec![7; length]]);
            assert_eq!(server.heard, expected);
            let answer = [b"id".to_vec(), b"".to_vec(), b"an answer".to_vec()];
            assert_eq!(client.heard, [answer]);
        }
    }
}

#[test]
fn a_peer_that_is_not_accepted_is_told_nothing() {
    for [server, client] in securities() {
        let mut server = End::<Router>::new(server);
        server.accepts = false;
        let mut client = End::<Dealer>::new(client);
        talk(&mut server, &mut client, 1000, &mut |_| ());
        assert!(!client.inbound.is_ready() && !server.inbound.is_ready());
        assert!(!server.out.transmit_buf().starts_with(b"\x04"));
    }
}

#[cfg(feature = "curve")]
#[test]
fn a_server_knows_how_far_a_handshake_is() {
    let [security, other] = curve();
    let mut server = End::<Router>::new(security);
    let mut client = End::<Dealer>::new(other);
    assert_eq!(server.inbound.stage(), Stage::Silent);
    server.accepts = false;
    let pass = |from: &mut Outbound| {
        let bytes = from.transmit_buf().to_vec();
        from.consume(bytes.len());
        bytes
    };
    let seen = [(); 3].map(|()| {
        server.take(&pass(&mut client.out));
        client.take(&pass(&mut server.out));
        server.inbound.stage()
    });
    assert_eq!(seen, [Stage::Greeted, Stage::Opened, Stage::Opened]);
}

/// A connection whose handshake is done, without encryption.
fn ready() -> (End<Router>, End<Dealer>) {
    let mut server = End::<Router>::new(Security::Null);
    let mut client = End::<Dealer>::new(Security::Null);
    talk(&mut server, &mut client, 1000, &mut |_| ());
    (server, client)
}

#[test]
fn a_message_without_end_takes_no_more_memory_than_the_longest() {
    for frame in [&b"\x01\0"[..], b"\x01\x01x"] {
        let (mut server, _) = ready();
        let mut taken = 0;
        while server.fault.is_none() {
            server.take(frame);
            taken += frame.len();
            assert!(taken <= MOST + ENVELOPES + 2);
        }
        assert_eq!(server.fault, Some(Fault::TooLong));
        assert!(
            server.inbound.held() < 2 * (MOST + ENVELOPES),
            "{}",
            server.inbound.held()
        );
    }
    // A frame whose length alone is too much takes none.
    let (mut server, _) = ready();
    server.take(b"\x02\0\0\0\x01\0\0\0\0");
    assert_eq!(server.fault, Some(Fault::TooLong));
}

#[test]
fn before_the_handshake_little_is_held() {
    let mut server = End::<Router>::new(Security::Null);
    server.take(crate::GREETING);
    // A command without end.
    server.take(b"\x06\0\0\0\0\0\0\xFF\xFF");
    assert_eq!(server.fault, Some(Fault::TooLong));
    assert!(server.inbound.held() <= BEFORE);
    for bytes in [&b"GET / HTTP/1.1"[..], b"\xFF\0\0\0\0\0\0\0\0\0", b"\0"] {
        let mut server = End::<Router>::new(Security::Null);
        server.take(bytes);
        assert_eq!(server.fault, Some(Fault::NotZmtp));
    }
}

#[test]
fn a_handshake_that_is_not_exact_is_refused() {
    let mut mechanism = crate::GREETING.to_vec();
    mechanism[31] = b'x';
    let ready = |properties: &[u8]| {
        let length = u8::try_from(6 + properties.len()).unwrap();
        let ready = [&[4, length], &b"\x05READY"[..], properties].concat();
        [crate::GREETING.as_slice(), &ready].concat()
    };
    let is_req: &[u8] = b"\x0BSocket-Type\0\0\0\x03REQ";
    let is_sub: &[u8] = b"\x0Bsocket-type\0\0\0\x03SUB";
    for (stream, fault) in [
        (mechanism, Some(Fault::Mechanism)),
        (ready(is_req), None),
        (ready(&[is_req, is_req].concat()), None),
        (ready(&[is_req, is_sub].concat()), Some(Fault::SocketType)),
        (ready(b"\x01X\0\0\0\0"), Some(Fault::SocketType)),
        (ready(&[is_req, b"\x01"].concat()), Some(Fault::Unexpected)),
        (
            ready(&[is_req, b"\x01X\0\0\0\x01"].concat()),
            Some(Fault::Unexpected),
        ),
    ] {
        let mut server = End::<Router>::new(Security::Null);
        server.take(&stream);
        assert_eq!(server.fault, fault, "{}", stream.escape_ascii());
        assert_eq!(server.inbound.is_ready(), fault.is_none());
    }
}

#[test]
fn a_ping_is_answered_also_within_a_message() {
    let (mut server, _) = ready();
    server.take(b"\x04\x0a\x04PING\0\x64abc");
    assert_eq!(server.out.transmit_buf(), b"\x04\x08\x04PONGabc");
    // 100 tenths of a second from when it was heard.
    server.inbound.on_heard(Instant::from_micros(7));
    assert_eq!(server.inbound.deadline(), Instant::from_micros(10_000_007));
    server.out.consume(100);
    server.take(b"\x01\x02id\x01\0\x04\x07\x04PING\0\0\0\x02hi");
    assert_eq!(server.out.transmit_buf(), b"\x04\x05\x04PONG");
    assert_eq!(
        server.heard,
        [[b"id".to_vec(), b"".to_vec(), b"hi".to_vec()]]
    );
    assert_eq!(server.inbound.deadline(), Instant::NEVER);
}

#[test]
fn subscriptions_come_as_commands_or_as_messages() {
    let mut publisher = End::<Pub>::new(Security::Null);
    publisher.take(crate::GREETING);
    publisher.take(b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03SUB");
    publisher.take(b"\x04\x0C\x09SUBSCRIBEab\x00\x03\x01cd\x04\x09\x06CANCELab");
    assert_eq!(publisher.fault, None);
    let topics = [(1, "ab"), (0, "ab")].map(|(begins, topic)| [std::vec![begins], topic.into()]);
    let [begun, ended] = topics.map(Vec::from);
    assert_eq!(
        publisher.heard,
        [begun, std::vec![b"\x01cd".to_vec()], ended]
    );
}

#[test]
fn an_idle_connection_holds_no_large_buffer() {
    let (mut server, mut client) = ready();
    client.out.message(ENVELOPE, &[7; 900]);
    talk(&mut server, &mut client, 100, &mut |_| ());
    server.take(b"");
    assert!(server.inbound.held() <= 4096 && server.out.held() <= 4096);
}

#[cfg(feature = "curve")]
#[test]
fn with_a_bit_flipped_anywhere_nothing_is_accepted() {
    // How many bytes both send until the message has arrived.
    let mut all = 0;
    let run = |change: &mut dyn FnMut(&mut Vec<u8>)| {
        let [server, client] = curve();
        let mut server = End::<Router>::new(server);
        let mut client = End::<Dealer>::new(client);
        talk(&mut server, &mut client, 10_000, change);
        client.out.message(ENVELOPE, b"move");
        talk(&mut server, &mut client, 10_000, change);
        server.heard
    };
    assert_eq!(run(&mut |bytes| all += bytes.len()).len(), 1);
    let mut wrong = Vec::new();
    for place in 0..8 * all {
        let mut at = 0;
        let heard = run(&mut |bytes| {
            let here = place / 8;
            if let Some(byte) = here.checked_sub(at).and_then(|here| bytes.get_mut(here)) {
                *byte ^= 1 << (place % 8);
            }
            at += bytes.len();
        });
        if !heard.is_empty() && heard != [[b"id".to_vec(), b"".to_vec(), b"move".to_vec()]] {
            wrong.push(place);
        }
    }
    assert_eq!(wrong, [0; 0]);
}

#[cfg(feature = "curve")]
#[test]
fn a_frame_that_is_repeated_or_comes_in_another_order_is_refused() {
    for order in [&[0, 0][..], &[1, 0], &[0, 1, 1]] {
        let [server, client] = curve();
        let mut server = End::<Router>::new(server);
        let mut client = End::<Dealer>::new(client);
        talk(&mut server, &mut client, 10_000, &mut |_| ());
        let frames = [b"one", b"two"].map(|body| {
            client.out.message(b"", body);
            let frame = client.out.transmit_buf().to_vec();
            client.out.consume(frame.len());
            frame
        });
        for index in order {
            server.take(&frames[*index]);
        }
        assert_eq!(server.fault, Some(Fault::Security), "{order:?}");
    }
}

#[cfg(feature = "curve")]
#[test]
fn a_client_accepts_only_the_server_whose_key_it_has() {
    let [server, _] = curve();
    let wrong = crate::curve::Keys::client([2; 32], [9; 32], || [77; 32]);
    let mut server = End::<Router>::new(server);
    let mut client = End::<Dealer>::new(Security::Curve(wrong));
    talk(&mut server, &mut client, 10_000, &mut |_| ());
    assert_eq!(server.fault, Some(Fault::Security));
    // A client without encryption is rejected, with any mechanism in its greeting.
    let [server, _] = curve();
    let mut server = End::<Router>::new(server);
    let mut client = End::<Dealer>::new(Security::Null);
    talk(&mut server, &mut client, 10_000, &mut |_| ());
    assert_eq!(server.fault, Some(Fault::Mechanism));
}

#[test]
fn a_shared_message_arrives_encrypted_or_not() {
    for [server, client] in securities() {
        let mut server = End::<Pub>::new(server);
        let mut client = End::<Sub>::new(client);
        talk(&mut server, &mut client, 1000, &mut |_| ());
        client.out.message(b"", b"\x01lab");
        talk(&mut server, &mut client, 1000, &mut |_| ());
        assert_eq!(server.heard, [[b"\x01lab".to_vec()]]);
        let wire = [&b"\x01\x04lab/\x00\x05value"[..], b"\x00\x00"];
        for wire in wire {
            server.out.shared(&std::sync::Arc::new(wire.to_vec()));
        }
        talk(&mut server, &mut client, 1000, &mut |_| ());
        let expected = [
            std::vec![b"lab/".to_vec(), b"value".to_vec()],
            std::vec![b"".to_vec()],
        ];
        assert_eq!(client.heard, expected);
    }
}

#[cfg(feature = "curve")]
#[test]
fn a_client_learns_what_keeps_it_from_its_server() {
    let [server, client] = curve();
    let stranger = crate::curve::Keys::client([2; 32], [9; 32], || [77; 32]);
    let stranger = Security::Curve(stranger);
    let null = || Security::Null;
    for (there, here, admitted, obstacle) in [
        (server.clone(), null(), true, Some(Obstacle::PeerEncrypts)),
        (null(), client.clone(), true, Some(Obstacle::PeerIsPlain)),
        (server.clone(), stranger, true, Some(Obstacle::OtherKey)),
        (
            server.clone(),
            client.clone(),
            false,
            Some(Obstacle::KeyNotAdmitted),
        ),
        (null(), null(), false, Some(Obstacle::NotAdmitted)),
        (server, client, true, None),
        (null(), null(), true, None),
    ] {
        let mut server = End::<Router>::new(there);
        server.accepts = admitted;
        let mut client = End::<Dealer>::new(here);
        talk(&mut server, &mut client, 10_000, &mut |_| ());
        // The server closes the connection now, unless the client does.
        assert_eq!(client.inbound.obstacle(client.fault), obstacle);
    }
    let [_, client] = curve();
    let mut client = End::<Dealer>::new(client);
    // A server of ZMTP 2.0.
    client.take(b"\xFF\0\0\0\0\0\0\0\x01\x7F\x01\x06\0\0");
    assert_eq!(client.fault, Some(Fault::Mechanism));
    assert_eq!(
        client.inbound.obstacle(client.fault),
        Some(Obstacle::PeerIsPlain)
    );
}

#[test]
fn a_client_learns_that_its_peer_is_no_server_for_it() {
    let obstacle = |bytes: &[u8]| {
        let mut client = End::<Dealer>::new(Security::Null);
        client.take(bytes);
        client.inbound.obstacle(client.fault)
    };
    let mut plain = crate::GREETING.to_vec();
    plain.get_mut(12..17).unwrap().copy_from_slice(b"PLAIN");
    let mut publisher = crate::GREETING.to_vec();
    publisher.extend_from_slice(Pub::READY);
    let mut refusal = crate::GREETING.to_vec();
    refusal.extend_from_slice(b"\x04\x0a\x05ERROR\x03400");
    let refused = [crate::GREETING.as_slice(), Pub::ERROR].concat();
    for (bytes, expected) in [
        (&b""[..], None),
        (
            b"HTTP/1.1 400 Bad Request",
            Some(Obstacle::Fault(Fault::NotZmtp)),
        ),
        (&plain, Some(Obstacle::OtherMechanism)),
        (&publisher, Some(Obstacle::Fault(Fault::SocketType))),
        (&refusal, Some(Obstacle::NotAdmitted)),
        (&refused, Some(Obstacle::Fault(Fault::Refused))),
    ] {
        assert_eq!(obstacle(bytes), expected, "{bytes:?}");
    }
}

#[test]
fn the_lengths_in_each_error_command_are_right() {
    for error in [
        Pub::ERROR,
        Router::ERROR,
        crate::Rep::ERROR,
        crate::Req::ERROR,
        Dealer::ERROR,
        Sub::ERROR,
    ] {
        let (header, body) = error.split_at(2);
        assert_eq!(header, [4, u8::try_from(body.len()).unwrap()], "{error:?}");
        let (length, reason) = body
            .strip_prefix(b"\x05ERROR")
            .unwrap()
            .split_first()
            .unwrap();
        assert_eq!(usize::from(*length), reason.len(), "{error:?}");
    }
}
