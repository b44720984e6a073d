//! Bytes over TCP that no ZeroMQ socket sends.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;

use ztl_tests::lab::{Server, shake_hands};

use crate::socket::{Socket, assert_serves};

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

#[test]
fn bytes_that_are_not_zmtp_affect_no_client() {
    let server = Server::ours();
    for bytes in [
        &b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"[..],
        &[0; 200],
        &[0xFF; 200],
        b"",
    ] {
        let mut stream = TcpStream::connect(("127.0.0.1", server.port)).unwrap();
        let _ = stream.write_all(bytes);
        assert_serves(&server.endpoint(), "bytes that are no ZMTP");
        drop(stream);
        assert_serves(&server.endpoint(), "a connection that broke");
    }
}
