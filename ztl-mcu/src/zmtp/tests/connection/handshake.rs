//! Greetings and the handshake.

use super::super::property;
use super::*;
use crate::zmtp::HANDSHAKE;

#[test]
fn only_the_partial_greeting_is_sent_before_the_peers_version_is_known() {
    let mut server = open();
    assert_eq!(server.drain(), b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03");
    assert!(server.talk(Pieces::Single, &greeting()[..10]).is_empty());
    assert_eq!(
        server.talk(Pieces::Whole, &greeting()[10..11]),
        &GREETING[11..]
    );
}

#[test]
fn padding_as_server_minor_version_and_filler_are_ignored() {
    for place in (1..9).chain([11]).chain(32..64) {
        let mut strange = greeting();
        strange[place] = 0xEE;
        strange[10] = 9;
        let mut server = open();
        server.talk(Pieces::Whole, &[strange, ready("REQ")].concat());
        assert!(server.is_ready(), "byte {place}");
    }
}

#[test]
fn other_protocols_and_zmtp_1_are_closed() {
    let mut old = greeting();
    old[10] = 0;
    let mut even = greeting();
    even[9] = 0x7E;
    for first in [&b"GET / HTTP/1.1\r\n"[..], b"\x01\0", &old, &even] {
        let mut server = open();
        server.talk(Pieces::Whole, first);
        assert!(!server.is_open());
        assert_eq!(server.fault(), Some(Fault::NotZmtp));
    }
}

#[test]
fn a_peer_that_requires_a_password_gets_the_whole_greeting_and_is_closed() {
    for pieces in BOTH {
        let mut plain = greeting();
        plain[12..17].copy_from_slice(b"PLAIN");
        let mut server = open();
        assert_eq!(server.talk(pieces, &plain), GREETING);
        assert!(!server.is_open());
        assert_eq!(server.fault(), Some(Fault::Mechanism));
    }
}

#[test]
fn a_mechanism_that_only_begins_with_null_is_closed() {
    let mut longer = greeting();
    longer[16] = b'S';
    let mut server = open();
    server.talk(Pieces::Whole, &longer);
    assert_eq!(server.fault(), Some(Fault::Mechanism));
}

#[test]
fn properties_may_have_any_order_and_unknown_ones_are_ignored() {
    let metadata = [
        property("Identity", b"me"),
        property("X-Purpose", &[0xFF; 30]),
        property("Resource", b""),
        property("sOCKET-tYPE", b"DEALER"),
    ];
    for pieces in BOTH {
        let mut server = open();
        let all = [greeting(), command("READY", &metadata.concat())].concat();
        server.talk(pieces, &all);
        assert!(server.is_ready());
    }
}

#[test]
fn a_long_ready_is_read_as_far_as_it_fits() {
    let metadata = [
        property("Socket-Type", b"REQ"),
        property("X-Long", &[7; 600]),
    ]
    .concat();
    for pieces in BOTH {
        let mut server = open();
        server.talk(pieces, &[greeting(), command("READY", &metadata)].concat());
        assert!(server.is_ready());
        server.talk(pieces, &request(b"hello"));
        assert_body(&server, b"hello");
    }
}

#[test]
fn an_unsupported_socket_type_gets_an_error_and_is_closed() {
    let cut = &property("Socket-Type", b"REQ")[..14];
    for metadata in [&property("Socket-Type", b"PUB")[..], b"", b"\xFF", cut] {
        let mut server = open();
        let all = [greeting(), command("READY", metadata)].concat();
        let heard = server.talk(Pieces::Whole, &all);
        assert_eq!(heard, [GREETING, Rep::ERROR].concat());
        assert!(!server.is_open());
        assert_eq!(server.fault(), Some(Fault::SocketType));
    }
}

#[test]
fn the_constant_commands_follow_the_grammar() {
    fn check<S: Socket>() {
        let name = std::str::from_utf8(S::NAME).unwrap();
        assert_eq!(S::READY, ready(name));
        let partners: Vec<&str> = S::PARTNERS
            .iter()
            .map(|(name, _)| std::str::from_utf8(name).unwrap())
            .collect();
        let reason = std::format!("{name}-takes-{}", partners.join(","));
        // RFC 37: error-reason = OCTET 0*255VCHAR
        assert!(reason.bytes().all(|byte| (0x21..=0x7E).contains(&byte)));
        let data = [&[reason.len() as u8], reason.as_bytes()].concat();
        assert_eq!(S::ERROR, command("ERROR", &data));
    }
    check::<Rep>();
    check::<Req>();
    check::<Dealer>();
}

#[test]
fn an_error_from_the_peer_closes_at_any_time() {
    let error = command("ERROR", b"\x02no");
    let mut server = open();
    server.talk(Pieces::Whole, &[greeting(), error.clone()].concat());
    assert_eq!(server.fault(), Some(Fault::Refused));
    let mut server = handshaken("REQ");
    server.talk(Pieces::Whole, &error);
    assert_eq!(server.fault(), Some(Fault::Refused));
}

#[test]
fn any_frame_but_ready_in_the_handshake_closes() {
    for first in [
        request(b"early"),
        command("PING", b"\0\0"),
        command("HELLO", b""),
    ] {
        let mut server = open();
        server.talk(Pieces::Whole, &[greeting(), first].concat());
        assert_eq!(server.fault(), Some(Fault::Unexpected));
    }
}

#[test]
fn an_unfinished_handshake_times_out() {
    for first in [0, 5, 30, 64, 70] {
        let mut server = open();
        let all = [greeting(), ready("REQ")].concat();
        server.talk(Pieces::Whole, &all[..first]);
        assert_eq!(server.poll_timeout(), NOW + HANDSHAKE);
        server.handle_timeout(NOW + (HANDSHAKE - Duration::from_micros(1)));
        assert!(server.is_open());
        server.handle_timeout(NOW + HANDSHAKE);
        assert!(!server.is_open());
        assert_eq!(server.fault(), Some(Fault::Silent));
    }
    let server = handshaken("REQ");
    assert_eq!(server.poll_timeout(), crate::Instant::NEVER);
    // A connection that was closed by the peer does not time out later.
    let mut server = open();
    server.close();
    server.handle_timeout(NOW + HANDSHAKE);
    assert_eq!(server.fault(), None);
}

#[test]
fn every_allowed_pair_of_sockets_connects() {
    fn meet<S: Socket, T: Socket>() -> bool {
        let mut one = Connection::<S, _>::new([0xA5; 128]);
        let mut two = Connection::<T, _>::new([0xA5; 128]);
        one.open(NOW);
        two.open(NOW);
        for _ in 0..8 {
            let said = one.drain();
            two.handle_bytes(NOW, &said);
            let said = two.drain();
            one.handle_bytes(NOW, &said);
        }
        assert_eq!(one.is_ready(), two.is_ready());
        assert_eq!(one.is_open(), one.is_ready());
        one.is_ready()
    }
    assert!(meet::<Req, Rep>());
    assert!(meet::<Dealer, Rep>());
    assert!(meet::<Dealer, Dealer>());
    assert!(!meet::<Req, Dealer>());
    assert!(!meet::<Req, Req>());
}
