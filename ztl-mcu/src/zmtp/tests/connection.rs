//! One connection, tested from the peer's side.

mod handshake;

use core::time::Duration;
use std::vec::Vec;

use super::{BOTH, End, NOW, Pieces, command, frame, greeting, ready, request};
use crate::zmtp::{Connection, Content, Dealer, Fault, Rep, Req, SKIPPED, Socket};
use ztl_zmtp::GREETING;

type Server = Connection<Rep, [u8; 128]>;

fn open() -> Server {
    let mut server = Server::new([0xA5; 128]);
    server.open(NOW);
    server
}

/// A connection whose handshake is done.
fn handshaken(socket: &str) -> Server {
    let mut server = open();
    let heard = server.talk(Pieces::Whole, &[greeting(), ready(socket)].concat());
    assert_eq!(heard, [GREETING, Rep::READY].concat());
    assert!(server.is_ready());
    server
}

/// Replies to the current message.
fn answer(server: &mut Server, text: &str) -> Vec<u8> {
    server.reply(&mut |sink| sink.put(text.as_bytes()));
    server.drain()
}

#[track_caller]
fn assert_body(server: &Server, body: &[u8]) {
    let message = server.message().expect("a message");
    assert_eq!(message.content, Content::One(body));
}

#[test]
fn a_request_is_answered_however_its_bytes_are_split() {
    for pieces in BOTH {
        let mut server = open();
        let all = [greeting(), ready("REQ"), request(b"what?")].concat();
        let heard = server.talk(pieces, &all);
        assert_eq!(heard, [GREETING, Rep::READY].concat());
        assert_body(&server, b"what?");
        assert_eq!(answer(&mut server, "that"), b"\x01\0\0\x04that");
        assert_eq!(server.message(), None);
    }
}

#[test]
fn a_ping_is_answered_with_its_context() {
    for pieces in BOTH {
        let mut server = handshaken("DEALER");
        for context in [&b""[..], b"x", b"sixteen bytes ..", b"\0\xFF"] {
            let ping = command("PING", &[b"\0\0", context].concat());
            let pong = command("PONG", context);
            assert_eq!(server.talk(pieces, &ping), pong);
        }
        // Each is answered before the next is read.
        let pings = [command("PING", b"\0\0one"), command("PING", b"\0\0two")].concat();
        let pongs = [command("PONG", b"one"), command("PONG", b"two")].concat();
        assert_eq!(server.talk(pieces, &pings), pongs);
    }
}

#[test]
fn a_ping_is_answered_between_frames_and_while_a_reply_is_held() {
    let ping = command("PING", b"\0\0hi");
    let pong = command("PONG", b"hi");
    for pieces in BOTH {
        let mut server = handshaken("DEALER");
        assert!(server.talk(pieces, &frame(1, b"me")).is_empty());
        assert_eq!(server.talk(pieces, &ping), pong);
        server.talk(pieces, &request(&[b'x'; 60]));
        server.hold();
        assert_eq!(server.talk(pieces, &ping), pong);
        assert_eq!(
            answer(&mut server, "yes"),
            [&frame(1, b"me")[..], b"\x01\0\0\x03yes"].concat()
        );
        assert_eq!(server.talk(pieces, &ping), pong);
    }
}

#[test]
fn a_silent_peer_is_closed_after_its_time_to_live() {
    let mut server = handshaken("REQ");
    server.talk(Pieces::Whole, &command("PING", b"\0\x05"));
    let later = NOW + Duration::from_millis(500);
    assert_eq!(server.poll_timeout(), later);
    server.handle_bytes(
        NOW + Duration::from_millis(400),
        &request(b"still here")[..4],
    );
    server.handle_timeout(later);
    assert!(server.is_open());
    server.handle_timeout(NOW + Duration::from_millis(900));
    assert_eq!(server.fault(), Some(Fault::Silent));
    // The longest time to live is 109 minutes.
    let mut server = handshaken("REQ");
    server.talk(Pieces::Whole, &command("PING", b"\xFF\xFF"));
    assert_eq!(
        server.poll_timeout(),
        NOW + Duration::from_millis(6_553_500)
    );
    // A time to live of 0 revokes it.
    let mut server = handshaken("REQ");
    server.talk(Pieces::Whole, &command("PING", b"\0\x05"));
    server.talk(Pieces::Whole, &command("PING", b"\0\0"));
    assert_eq!(server.poll_timeout(), crate::Instant::NEVER);
}

#[test]
fn unknown_commands_and_a_ping_without_a_time_to_live_are_ignored() {
    for pieces in BOTH {
        let mut server = handshaken("REQ");
        for strange in [
            command("SUBSCRIBE", b"all"),
            command("X", &[0xEE; 300]),
            command("READY", b""),
            command("PING", b"\0"),
            frame(4, b""),
            frame(4, b"\xFF"),
            frame(6, b"\x04PANG"),
        ] {
            assert!(server.talk(pieces, &strange).is_empty());
        }
        server.talk(pieces, &request(b"well?"));
        assert_body(&server, b"well?");
    }
}

#[test]
fn an_envelope_is_returned_unchanged() {
    for pieces in BOTH {
        let mut server = handshaken("DEALER");
        let envelope = [frame(1, b"c"), frame(1, b"\0u\xFF"), frame(1, b"")].concat();
        server.talk(pieces, &[envelope.clone(), frame(0, b"body")].concat());
        let message = server.message().unwrap();
        let frames: Vec<&[u8]> = message.envelope.collect();
        assert_eq!(frames, [&b"c"[..], b"\0u\xFF"]);
        assert_eq!(message.content, Content::One(b"body"));
        assert_eq!(
            answer(&mut server, "reply"),
            [envelope, frame(0, b"reply")].concat()
        );
    }
}

#[test]
fn long_frames_are_read_and_written_only_where_needed() {
    for pieces in BOTH {
        let mut server = Connection::<Rep, _>::new(std::vec![0xA5; 1000]);
        server.open(NOW);
        server.talk(pieces, &[greeting(), ready("DEALER")].concat());
        let (address, body) = ([b'a'; 300], [b'b'; 400]);
        // A size of 8 bytes where one is enough is read, and answered with one.
        let wordy = [
            frame(3, b"id"),
            frame(1, &address),
            frame(3, b""),
            frame(0, &body),
        ];
        server.talk(pieces, &wordy.concat());
        assert_eq!(server.message().unwrap().content, Content::One(&body));
        server.reply(&mut |sink| sink.put(&[b'r'; 256]));
        let plain = [
            frame(1, b"id"),
            frame(1, &address),
            frame(1, b""),
            frame(0, &[b'r'; 256]),
        ];
        assert_eq!(server.drain(), plain.concat());
    }
}

#[test]
fn a_message_beyond_65535_bytes_has_its_full_size() {
    let mut client = Connection::<Req, _>::new(std::vec![0; 70_000]);
    let mut server = Connection::<Rep, _>::new(std::vec![0; 70_000]);
    server.open(NOW);
    client.open(NOW);
    server.talk(Pieces::Whole, &[greeting(), ready("REQ")].concat());
    client.talk(Pieces::Whole, &[greeting(), ready("REP")].concat());
    let body = [b'b'; 65_536];
    assert!(client.request(&[], &mut |sink| sink.put(&body)));
    server.talk(Pieces::Whole, &client.drain());
    // `assert_eq` would print them.
    assert!(server.message().unwrap().content == Content::One(&body));
}

#[test]
fn a_body_of_several_frames_is_answered_once() {
    for pieces in BOTH {
        let mut server = handshaken("REQ");
        let frames = [
            frame(1, b""),
            frame(1, b"one"),
            frame(1, b""),
            frame(0, &[0; 300]),
        ];
        server.talk(pieces, &frames.concat());
        assert_eq!(server.message().unwrap().content, Content::Several);
        assert_eq!(answer(&mut server, "no"), b"\x01\0\0\x02no");
        server.talk(pieces, &request(b"one"));
        assert_body(&server, b"one");
    }
}

#[test]
fn a_body_too_long_for_the_buffer_is_skipped_and_can_be_answered() {
    for pieces in BOTH {
        let mut server = handshaken("REQ");
        for size in [104, 300, SKIPPED as usize] {
            server.talk(pieces, &request(&std::vec![b'x'; size]));
            assert_eq!(
                server.message().unwrap().content,
                Content::TooLong,
                "{size}"
            );
            assert_eq!(answer(&mut server, "no"), b"\x01\0\0\x02no");
        }
        server.talk(pieces, &request(&[b'x'; 103]));
        assert_body(&server, &[b'x'; 103]);
    }
}

#[test]
fn a_frame_beyond_the_limit_closes_the_connection() {
    for size in [
        u64::from(SKIPPED) + 1,
        1 << 32,
        1 << 40,
        1 << 56,
        1 << 63,
        u64::MAX,
    ] {
        for flags in [2, 3, 6] {
            let mut server = handshaken("REQ");
            let header = [&[1, 0, flags][..], &size.to_be_bytes()].concat();
            server.talk(Pieces::Single, &header);
            assert_eq!(server.fault(), Some(Fault::TooLong), "{size} {flags}");
        }
    }
}

#[test]
fn an_envelope_that_does_not_fit_closes_the_connection() {
    let mut server = handshaken("DEALER");
    server.talk(Pieces::Whole, &frame(1, &[1; 100]));
    assert_eq!(server.fault(), Some(Fault::TooLong));
    let mut server = handshaken("DEALER");
    server.talk(Pieces::Whole, &frame(1, b"x").repeat(40));
    assert_eq!(server.fault(), Some(Fault::TooLong));
}

#[test]
fn a_message_without_delimiter_or_body_is_dropped() {
    for pieces in BOTH {
        let mut server = handshaken("DEALER");
        for strange in [
            frame(0, b"body"),
            frame(0, b""),
            frame(2, &[0; 300]),
            [frame(1, b"c"), frame(0, b"body")].concat(),
            [frame(1, b"c"), frame(0, b"")].concat(),
        ] {
            assert!(server.talk(pieces, &strange).is_empty());
            assert_eq!(server.message(), None);
        }
        server.talk(pieces, &request(b"good"));
        assert_body(&server, b"good");
    }
}

#[test]
fn undefined_flags_close_the_connection() {
    for flags in (8..=255).chain([5, 7]) {
        let mut server = handshaken("REQ");
        server.talk(Pieces::Whole, &[flags]);
        assert_eq!(server.fault(), Some(Fault::Flags), "{flags}");
    }
}

#[test]
fn pipelined_requests_wait_in_the_stream() {
    for pieces in BOTH {
        let mut server = handshaken("DEALER");
        let two = [request(b"one"), request(b"two")].concat();
        let taken = match pieces {
            Pieces::Whole => server.handle_bytes(NOW, &two),
            Pieces::Single => {
                let one = |byte: &&u8| server.handle_bytes(NOW, &[**byte]) == 1;
                two.iter().take_while(one).count()
            }
        };
        assert_eq!(taken, 7);
        assert_body(&server, b"one");
        server.hold();
        assert_eq!(server.message(), None);
        assert_eq!(server.handle_bytes(NOW, &two[taken..]), 0);
        server.reply(&mut |sink| sink.put(b"1"));
        assert_eq!(server.handle_bytes(NOW, &two[taken..]), 0);
        assert_eq!(server.drain(), b"\x01\0\0\x011");
        assert_eq!(server.handle_bytes(NOW, &two[taken..]), 7);
        assert_body(&server, b"two");
    }
}

#[test]
fn a_reply_that_does_not_fit_is_cut_at_a_character_boundary() {
    let mut server = handshaken("REQ");
    for (unit, kept) in [
        ("x", "x".repeat(91)),
        ("ä", "ä".repeat(45)),
        ("€", "€".repeat(30)),
    ] {
        server.talk(Pieces::Whole, &request(b"?"));
        let heard = answer(&mut server, &unit.repeat(100));
        let body = std::string::String::from_utf8(heard[4..].to_vec()).unwrap();
        assert_eq!(body, std::format!("{kept}…"));
    }
}

#[test]
fn a_zmtp_2_peer_is_answered() {
    let begin = b"\xFF\0\0\0\0\0\0\0\x01\x7F\x01";
    for identity in [&b"\0\0"[..], b"\0\x02me", b"\x02\0\0\0\0\0\0\0\x03abc"] {
        for pieces in BOTH {
            for socket in [3, 5] {
                let mut server = open();
                let all = [&begin[..], &[socket], identity, &request(b"what?")].concat();
                let heard = server.talk(pieces, &all);
                assert_eq!(heard, [&GREETING[..11], b"\x04\0\0"].concat());
                assert_body(&server, b"what?");
                assert_eq!(answer(&mut server, "that"), b"\x01\0\0\x04that");
            }
        }
    }
    for (rest, fault) in [
        (&b"\x01"[..], Fault::SocketType),
        (b"\x03\x01", Fault::Flags),
        (b"\x03\0\0\x04", Fault::Flags),
    ] {
        let mut server = open();
        server.talk(Pieces::Whole, &[&begin[..], rest].concat());
        assert_eq!(server.fault(), Some(fault));
    }
}

#[test]
fn a_client_talks_to_a_zmtp_2_server() {
    for pieces in BOTH {
        let mut client = Connection::<Req, _>::new([0xA5; 128]);
        client.open(NOW);
        let heard = client.talk(pieces, b"\xFF\0\0\0\0\0\0\0\x01\x7F\x01\x04\0\0");
        assert_eq!(heard, [&GREETING[..11], b"\x03\0\0"].concat());
        assert!(client.request(&[], &mut |sink| sink.put(b"what?")));
        assert_eq!(client.drain(), b"\x01\0\0\x05what?");
        client.talk(pieces, &request(b"that"));
        let message = client.message().unwrap();
        assert_eq!(message.content, Content::One(b"that"));
    }
}

#[test]
fn reopening_resets_all_state() {
    let whole = [
        greeting(),
        ready("DEALER"),
        frame(1, b"me"),
        request(b"what?"),
    ]
    .concat();
    for cut in 0..=whole.len() {
        let mut server = open();
        server.handle_bytes(NOW, &whole[..cut]);
        server.handle_bytes(NOW, &whole[cut..]);
        server.reply(&mut |sink| sink.put(b"never read"));
        server.transmit_buf();
        server.consume(1);
        server.open(NOW);
        let heard = server.talk(
            Pieces::Whole,
            &[greeting(), ready("REQ"), request(b"new")].concat(),
        );
        assert_eq!(heard, [GREETING, Rep::READY].concat(), "cut at {cut}");
        assert_body(&server, b"new");
    }
}

#[test]
fn a_dealer_sends_an_envelope_and_gets_it_back() {
    let mut server = open();
    let mut client = Connection::<Dealer, _>::new([0xA5; 128]);
    client.open(NOW);
    assert!(
        !client.request(&[], &mut |_| {}),
        "not before the handshake"
    );
    for _ in 0..4 {
        let said = client.drain();
        server.handle_bytes(NOW, &said);
        let said = server.drain();
        client.handle_bytes(NOW, &said);
    }
    assert!(!client.request(&[&[0; 99]], &mut |_| {}), "does not fit");
    assert!(client.request(&[b"me", b"7"], &mut |sink| sink.put(b"what?")));
    assert!(!client.request(&[], &mut |_| {}), "one at a time");
    let said = client.drain();
    assert_eq!(said, b"\x01\x02me\x01\x017\x01\0\0\x05what?");
    server.handle_bytes(NOW, &said);
    let said = answer(&mut server, "that");
    client.handle_bytes(NOW, &said);
    let message = client.message().unwrap();
    assert!(message.envelope.eq([&b"me"[..], b"7"]));
    assert_eq!(message.content, Content::One(b"that"));
    client.discard();
    assert!(client.request(&[], &mut |sink| sink.put(b"next")));
}
