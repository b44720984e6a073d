//! Random and damaged bytes on the socket, from a seed. After each attack a neighbour that was there
//! before is answered, and now and then a new client is, within the 2 s of the original's.
//!
//! `ZTL_FUZZ_SEED=7 ZTL_FUZZ_ROUNDS=100000 cargo test -p ztl-tests --test wire fuzz` for more.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use ztl_tests::lab::{Random, Server, number, shake_hands};

use crate::socket::{Socket, assert_serves};

pub(crate) fn random_bytes(random: &mut Random, most: usize) -> Vec<u8> {
    let length = random.below(most);
    (0..length).map(|_| random_byte(random)).collect()
}

fn random_byte(random: &mut Random) -> u8 {
    random.bits().to_le_bytes()[0]
}

const BODIES: &[&[u8]] = &[
    b"/test;2;99;x",
    b"/test;1;-1;dGVzdDplY2hvOmhp",
    b"/test;3;1;abort command",
    b"$ztl;2;-1;probe",
    b"$ztl;2;-1;outcome 1",
    b"/test;abc;1;x",
    b"\xff\xfe;1;1;",
    b"",
    b";;;",
];

/// A message from a client of ours, from the original's, or from neither.
pub(crate) fn message(random: &mut Random) -> Vec<u8> {
    let mut frames: Vec<Vec<u8>> = Vec::new();
    for _ in 0..random.below(4) {
        frames.push(match random.below(3) {
            0 => [b"ztl1".to_vec(), random_bytes(random, 17)].concat(),
            1 => random.bits().to_be_bytes().to_vec(),
            _ => random_bytes(random, 40),
        });
    }
    if random.below(8) > 0 {
        frames.push(Vec::new());
    }
    for _ in 0..1 + random.below(2) {
        frames.push(random.pick(BODIES).to_vec());
    }
    let mut bytes = Vec::new();
    let last = frames.len() - 1;
    for (place, frame) in frames.iter().enumerate() {
        let more = u8::from(place < last);
        match u8::try_from(frame.len()) {
            Ok(length) if random.below(4) > 0 => bytes.extend([more, length]),
            _ => {
                bytes.push(more | 2);
                bytes.extend((frame.len() as u64).to_be_bytes());
            }
        }
        bytes.extend(frame);
    }
    bytes
}

/// Damages some of it.
pub(crate) fn damage(bytes: &mut Vec<u8>, random: &mut Random) {
    for _ in 0..random.below(6) {
        if bytes.is_empty() {
            return;
        }
        let place = random.below(bytes.len());
        match random.below(5) {
            0 => bytes.truncate(place),
            1 => bytes.insert(place, random_byte(random)),
            2 => drop(bytes.remove(place)),
            3 => bytes[place] ^= 1 << random.below(8),
            _ => bytes[place] = random.pick(&[0, 1, 2, 4, 0x7f, 0x80, 0xff]),
        }
    }
}

fn greeting() -> Vec<u8> {
    let mut greeting = vec![0; 64];
    greeting[0] = 0xFF;
    greeting[9] = 0x7F;
    greeting[10] = 3;
    greeting[12..16].copy_from_slice(b"NULL");
    greeting
}

/// One connection that does something; whether it is closed by the server is not looked at.
fn attack(port: u16, random: &mut Random) {
    let mut stream = match random.below(3) {
        0 => {
            let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a connection");
            let mut bytes = greeting();
            bytes.extend(b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER");
            if random.below(4) == 0 {
                bytes = random_bytes(random, 300);
            }
            damage(&mut bytes, random);
            let _ = stream.write_all(&bytes);
            stream
        }
        _ => shake_hands(port),
    };
    let mut bytes = Vec::new();
    for _ in 0..random.below(5) {
        bytes.extend(message(random));
    }
    if random.below(2) == 0 {
        damage(&mut bytes, random);
    }
    // In pieces, as a network may deliver it.
    for piece in bytes.chunks(1 + random.below(200)) {
        if stream.write_all(piece).is_err() {
            return;
        }
    }
    if random.below(2) == 0 {
        let _ = stream.set_read_timeout(Some(Duration::from_millis(2)));
        let _ = stream.read(&mut [0; 512]);
    }
}

#[test]
fn random_bytes_delay_no_valid_client() {
    let (seed, rounds) = (number("ZTL_FUZZ_SEED", 1), number("ZTL_FUZZ_ROUNDS", 400));
    for server in [Server::ours(), Server::simulated()] {
        let neighbour = Socket::req(&server.endpoint());
        for round in 0..rounds {
            let mut random = Random::new(seed.wrapping_mul(1 << 32) + round);
            attack(server.port, &mut random);
            neighbour.send(&["/test;2;99;x"]);
            let answer = neighbour.0.recv_multipart(0);
            let expected = b"/test;2;99;Invalid ID '99'".to_vec();
            assert_eq!(
                answer,
                Ok(vec![expected]),
                "ZTL_FUZZ_SEED={seed}, round {round}"
            );
            if round % 50 == 0 {
                assert_serves(&server.endpoint(), "an attack");
            }
        }
    }
}
