//! A ZMTP connection without libzmq.

use std::io::{Read, Write};
use std::net::TcpStream;

use super::PATIENCE;

/// A TCP stream to a port of this machine that has shaken hands as a libzmq REQ socket does. Reading from it
/// fails after [`PATIENCE`].
///
/// # Panics
/// If no peer speaks ZMTP 3 within that time.
#[track_caller]
pub fn shake_hands(port: u16) -> TcpStream {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a time");
    let mut greeting = [0; 64];
    greeting[0] = 0xFF;
    greeting[9] = 0x7F;
    greeting[10] = 3;
    greeting[12..16].copy_from_slice(b"NULL");
    stream.write_all(&greeting).expect("to write");
    let mut theirs = [0xA5; 64];
    stream.read_exact(&mut theirs).expect("their greeting");
    assert_eq!((theirs[0], theirs[9], theirs[10]), (0xFF, 0x7F, 3));
    let ready = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ";
    stream.write_all(ready).expect("to write");
    // Theirs: a command of so many bytes.
    let mut head = [0xA5; 2];
    stream.read_exact(&mut head).expect("their READY");
    assert_eq!(head[0], 4);
    let mut rest = vec![0xA5; head[1].into()];
    stream.read_exact(&mut rest).expect("their READY");
    stream
}
