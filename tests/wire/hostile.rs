//! Broken and hostile clients: a good client is answered before the original's would give up.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::thread;
use std::time::{Duration, Instant};

use ztl_std::{Limits, TaskServer, Transport};
use ztl_tests::lab::{PATIENCE, Server, port_of, shake_hands, until};

use crate::socket::{Socket, assert_serves, in_time_for_the_original};

const ASK: &[u8] = b"\x01\x00\x00\x0c/test;2;99;x";
const ANSWER: usize = 30;

fn connect(port: u16) -> TcpStream {
    TcpStream::connect(("127.0.0.1", port)).expect("a connection")
}

#[test]
fn a_connection_without_a_handshake_is_closed() {
    let mut limits = Limits::default();
    limits.handshake = Duration::from_millis(300);
    let server = TaskServer::builder()
        .limits(limits)
        .bind("tcp://127.0.0.1:*");
    let server = server.expect("a port").spawn().expect("a thread");
    let port = port_of(server.endpoint());
    for said in [&b""[..], b"\xff", &[0xff, 0, 0, 0, 0, 0, 0, 0, 0, 0x7f, 3]] {
        let mut stream = connect(port);
        stream.write_all(said).expect("to write");
        stream.set_read_timeout(Some(PATIENCE)).expect("a time");
        let mut theirs = Vec::new();
        match stream.read_to_end(&mut theirs) {
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::ConnectionReset => {}
            Err(error) => panic!("{said:?}: the connection lives: {error}"),
        }
    }
}

/// A stream that has shaken hands as a REQ socket of libzmq 3.2 does: ZMTP 2.0 (RFC 15).
fn shake_hands_as_zmtp_2(port: u16) -> TcpStream {
    let mut stream = connect(port);
    stream.set_read_timeout(Some(PATIENCE)).expect("a time");
    let greeting = b"\xff\0\0\0\0\0\0\0\x01\x7f\x01\x03\0\0";
    stream.write_all(greeting).expect("to write");
    let mut theirs = [0xA5; 14];
    stream.read_exact(&mut theirs).expect("their greeting");
    // A ROUTER without an identity.
    assert_eq!(theirs[11..], [6, 0, 0]);
    stream
}

#[test]
fn an_old_peer_is_not_closed_after_the_time_for_a_handshake() {
    let mut limits = Limits::default();
    limits.handshake = Duration::from_millis(500);
    for (name, transport) in Transport::ALL {
        let server = TaskServer::builder().limits(limits).transport(*transport);
        let server = server.bind("tcp://127.0.0.1:*").expect("a port");
        let server = server.spawn().expect("a thread");
        let port = port_of(server.endpoint());
        // On a busy machine, a handshake may take longer than that.
        let mut stream = until("a quick handshake", PATIENCE, || {
            let start = Instant::now();
            let stream = shake_hands_as_zmtp_2(port);
            (start.elapsed() < limits.handshake).then_some(stream)
        });
        thread::sleep(2 * limits.handshake);
        stream.write_all(ASK).expect("to write");
        let answered = stream.read_exact(&mut [0; ANSWER]);
        answered.unwrap_or_else(|error| panic!("{name}: {error}"));
    }
}

/// Returns how long a good client waited at most.
fn beside_slow_senders(server: &Server) -> Duration {
    let half_open: Vec<TcpStream> = (0..100).map(|_| connect(server.port)).collect();
    let mut slow: Vec<TcpStream> = (0..20).map(|_| shake_hands(server.port)).collect();
    let mut longest = Duration::ZERO;
    for place in 0..ASK.len() {
        for stream in &mut slow {
            stream.write_all(&ASK[place..=place]).expect("to write");
        }
        longest = longest.max(assert_serves(
            &server.endpoint(),
            "a byte of each slow sender",
        ));
    }
    for stream in &mut slow {
        stream.read_exact(&mut [0; ANSWER]).expect("an answer");
    }
    drop(half_open);
    longest
}

#[test]
fn slow_senders_and_half_open_connections_delay_no_other() {
    let server = Server::ours();
    in_time_for_the_original(|| beside_slow_senders(&server));
}

/// Returns how long a good client waited at most.
fn beside_a_thousand_connections(server: &Server) -> Duration {
    let start = Instant::now();
    let mut streams: Vec<TcpStream> = (0..1000).map(|_| shake_hands(server.port)).collect();
    let shaken = start.elapsed();
    for stream in &mut streams {
        stream.write_all(ASK).expect("to write");
    }
    let asked = assert_serves(&server.endpoint(), "a thousand questions");
    for stream in &mut streams {
        stream.read_exact(&mut [0; ANSWER]).expect("an answer");
    }
    println!("1000 handshakes in {shaken:?}");
    drop(streams);
    asked.max(assert_serves(&server.endpoint(), "a thousand farewells"))
}

#[test]
fn a_thousand_connections_at_once_are_all_served() {
    let server = Server::ours();
    in_time_for_the_original(|| beside_a_thousand_connections(&server));
}

/// A client that never reads is closed, and one that reads slowly is not. Returns how long another client waited at most.
fn beside_a_client_that_never_reads(length: usize) -> Duration {
    let server = Server::ours();
    let neighbour = Socket::req(&server.endpoint());
    // Long answers: their text is the goal.
    let goal = "x".repeat(length);
    let mut client = server.original_client();
    let id = client.start("test", "echo", &goal);
    until("its end", PATIENCE, || {
        (client.status(id).number == 5).then_some(())
    });
    let before = server.process.peak_kib();
    let body = format!("/test;2;{id};x");
    let mut ask = vec![0x01, 0x00, 0x00, u8::try_from(body.len()).expect("short")];
    ask.extend(body.as_bytes());
    let mut stream = shake_hands(server.port);
    stream
        .set_write_timeout(Some(Duration::from_millis(100)))
        .expect("a time");
    let many = ask.repeat(1000);
    // Another one reads so slowly that the system hardly ever tells the server of room for more.
    let answers = 12_000_000 / length;
    let mut slow = shake_hands(server.port);
    slow.write_all(&ask.repeat(answers)).expect("to write");
    let mut read = 0;
    let (start, mut asked) = (Instant::now(), 0);
    let mut longest = Duration::ZERO;
    // It is not read from, and then closed.
    let closed = until("it is closed", PATIENCE, || {
        let asked_at = Instant::now();
        assert_eq!(neighbour.ask("/test;2;99;x"), "/test;2;99;Invalid ID '99'");
        longest = longest.max(asked_at.elapsed());
        read += slow.read(&mut [0; 4096]).expect("a part of an answer");
        match stream.write_all(&many) {
            Ok(()) => asked += 1000,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(_) => return Some(start.elapsed()),
        }
        None
    });
    longest = longest.max(assert_serves(
        &server.endpoint(),
        "a client that never reads",
    ));
    let mut piece = vec![0; 1 << 16];
    while read < answers * length {
        match slow.read(&mut piece) {
            Ok(count @ 1..) => read += count,
            ended => panic!("who reads slowly has {read} bytes of {answers} answers: {ended:?}"),
        }
    }
    let grown = server.process.peak_kib().saturating_sub(before);
    println!(
        "{asked} questions of {length} bytes, nothing read: {grown} KiB more, closed after {closed:?}"
    );
    // What waits to be sent, with some room.
    assert!(grown < 16 << 10, "{grown} KiB more");
    // It has ten seconds to read.
    assert!(closed > Duration::from_secs(9), "{closed:?}");
    longest
}

#[test]
fn a_client_that_never_reads_uses_little_memory_and_delays_no_other() {
    in_time_for_the_original(|| beside_a_client_that_never_reads(60_000));
}

#[test]
fn a_client_that_never_reads_very_long_answers_uses_little_memory_too() {
    in_time_for_the_original(|| beside_a_client_that_never_reads(700_000));
}

#[test]
fn a_frame_that_announces_too_much_closes_only_its_connection() {
    for server in [Server::ours(), Server::simulated()] {
        let neighbour = Socket::req(&server.endpoint());
        assert_eq!(neighbour.ask("/test;2;99;x"), "/test;2;99;Invalid ID '99'");

        // By hand, to know that the handshake is right: the delimiter, then a body.
        let mut stream = shake_hands(server.port);
        stream.write_all(b"\x01\x00\x00\x0c/test;2;99;x").unwrap();
        let mut answer = [0xA5; 30];
        stream.read_exact(&mut answer).expect("an answer");
        assert_eq!(&answer[..4], b"\x01\x00\x00\x1a");
        assert_eq!(&answer[4..], b"/test;2;99;Invalid ID '99'");

        // The last two could be had from a generous machine, and cost it just that.
        for length in [u64::MAX, 1 << 63, 1 << 40, 1 << 30, 2 << 20] {
            let mut stream = shake_hands(server.port);
            let mut header = vec![0x01, 0x00, 0x02];
            header.extend(length.to_be_bytes());
            stream.write_all(&header).unwrap();
            match stream.read(&mut [0; 16]) {
                Ok(0) => {}
                Err(error) if error.kind() == ErrorKind::ConnectionReset => {}
                other => panic!("{length}: the connection lives: {other:?}"),
            }
            assert_eq!(neighbour.ask("/test;2;99;x"), "/test;2;99;Invalid ID '99'");
            assert_serves(&server.endpoint(), "a frame that is too long");
        }
    }
}
