//! Invalid streams over TCP; afterwards a good client is served.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use ztl_tests::lab::PATIENCE;

use super::device::Device;
use crate::socket::{TIMEOUT, in_time_for_the_original};

const READY: &[u8] = b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03REQ";

fn greeting() -> Vec<u8> {
    let mut bytes = b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03\0NULL".to_vec();
    bytes.resize(64, 0);
    bytes
}

fn connect(device: &Device) -> TcpStream {
    let stream = TcpStream::connect(("127.0.0.1", device.port)).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

/// All that comes until the other end closes.
#[track_caller]
fn assert_closed(mut stream: TcpStream, after: &str) {
    let mut rest = Vec::new();
    match stream.read_to_end(&mut rest) {
        Ok(_) => {}
        Err(error) if error.kind() == ErrorKind::ConnectionReset => {}
        Err(error) => panic!("{after}: the connection lives: {error}"),
    }
}

#[test]
fn a_protocol_error_closes_only_its_connection() {
    let device = Device::start();
    let neighbour = device.req();
    let met = [greeting(), READY.to_vec()].concat();
    let mut plain = greeting();
    plain[12..17].copy_from_slice(b"PLAIN");
    let mut huge = vec![1, 0, 2];
    huge.extend((1_u64 << 63).to_be_bytes());
    for (after, bytes) in [
        ("HTTP", b"GET / HTTP/1.1\r\n\r\n".to_vec()),
        ("ZMTP 1.0", b"\x01\0".to_vec()),
        ("a password", plain),
        ("no READY", [greeting(), b"\x01\0\0\x01x".to_vec()].concat()),
        (
            "a PUB",
            [
                greeting(),
                b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03PUB".to_vec(),
            ]
            .concat(),
        ),
        ("strange flags", [met.clone(), b"\x48".to_vec()].concat()),
        ("2^63 bytes", [met, huge].concat()),
    ] {
        let mut stream = connect(&device);
        stream.write_all(&bytes).expect("to write");
        assert_closed(stream, after);
        assert_eq!(
            neighbour.ask("/desk;2;1;x"),
            "/desk;2;1;Invalid ID '1'",
            "{after}"
        );
        device.assert_serves(after);
    }
}

#[test]
fn a_client_that_disconnects_after_any_byte_affects_no_other() {
    let device = Device::start();
    let neighbour = device.req();
    let request = b"\x01\0\0\x1E/desk;1;-1;ZGVzazpzbGlkZTox\x31MA==";
    let whole = [greeting(), READY.to_vec(), request.to_vec()].concat();
    for cut in 0..whole.len() {
        let mut stream = connect(&device);
        stream.write_all(&whole[..cut]).expect("to write");
        drop(stream);
        if cut % 10 == 0 {
            device.assert_serves(&format!("{cut} bytes"));
        }
    }
    assert_eq!(neighbour.ask("/desk;2;1;x"), "/desk;2;1;Invalid ID '1'");
}

#[test]
fn requests_that_the_original_leaves_unanswered_are_answered() {
    let device = Device::start();
    let client = device.req();
    for (body, answer) in [
        (&b"\xFF\xFE"[..], ";2;-1;Unknown protocol"),
        (b"", ";2;-1;Unknown protocol"),
        (b"/desk;2", "/desk;2;-1;Unknown protocol"),
        (b"/desk;x;1;p", "/desk;2;-1;Invalid request"),
        (b"/desk;2;;p", "/desk;2;-1;Invalid request"),
        (
            b"/desk;1;-1;abc",
            "/desk;3;-1;Controller threw exception: Incorrect padding",
        ),
        (
            &[b'x'; 5000],
            ";2;-1;the request is too long for this device",
        ),
    ] {
        assert_eq!(client.ask(body), answer);
    }
    let dealer = device.socket(zmq::DEALER, |_| {});
    dealer.send(&["", "/desk;2;1;x", "more"]);
    assert_eq!(dealer.receive(), [&b""[..], b";2;-1;Unknown protocol"]);
    // No delimiter: no request.
    dealer.send(&["/desk;2;1;x"]);
    dealer.send(&["", "/desk;2;2;x"]);
    assert_eq!(dealer.receive(), [&b""[..], b"/desk;2;2;Invalid ID '2'"]);
}

/// Endless requests whose replies are never read. Returns how long another client waited at most.
fn beside_a_client_that_never_reads(device: &Device) -> Duration {
    let neighbour = device.req();
    let met = [greeting(), READY.to_vec()].concat();
    let request = b"\x01\0\0\x0B/desk;2;1;x".repeat(1000);
    std::thread::scope(|threads| {
        let deaf = threads.spawn(|| {
            let mut stream = connect(device);
            stream.set_write_timeout(Some(20 * TIMEOUT)).unwrap();
            stream.write_all(&met).expect("to write");
            // Ends when the device closes it.
            while stream.write_all(&request).is_ok() {}
        });
        let mut longest = Duration::ZERO;
        while !deaf.is_finished() {
            let start = Instant::now();
            assert_eq!(neighbour.ask("/desk;2;1;x"), "/desk;2;1;Invalid ID '1'");
            longest = longest.max(start.elapsed());
        }
        longest
    })
}

#[test]
fn a_client_that_never_reads_is_closed_and_delays_others_briefly() {
    let device = Device::start();
    // An original's client beside it never gives up.
    in_time_for_the_original(|| beside_a_client_that_never_reads(&device));
}
