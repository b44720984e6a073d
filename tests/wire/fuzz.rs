//! Random and damaged streams to a server that speaks ZMTP itself, in a process of its own: before, in and after the
//! handshake, with and without encryption. Good clients are served all the time, and the server's memory stays small.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, RequestError};
use ztl_tests::lab::{Keys, Random, Server, connect, gateway, process_status, seed};
use ztl_zmtp::session::{Inbound, Outbound, Security, Step};
use ztl_zmtp::{Dealer, curve};

/// How long each server is attacked at least.
const LONG: Duration = Duration::from_secs(4);

/// The most memory that a server ever takes, in KiB.
const MEMORY: u64 = 64 << 10;

/// How long an attack waits for the server's next bytes; it may have damaged its own so that none come.
const NEXT: Duration = Duration::from_millis(20);

fn random_bytes(random: &mut Random, most: usize) -> Vec<u8> {
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

/// A message from a client of this project, from the original's, or from neither.
fn message(random: &mut Random) -> Vec<u8> {
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
fn damage(bytes: &mut Vec<u8>, random: &mut Random) {
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

/// One connection. It follows the protocol, but damages some of what it sends.
fn attack(port: u16, security: &Security, random: &mut Random) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a connection");
    stream.set_read_timeout(Some(NEXT)).expect("a time");
    stream.set_write_timeout(Some(NEXT)).expect("a time");
    let mut out = Outbound::default();
    let deadline = ztl_core::Instant::NEVER;
    let mut inbound = Inbound::<Dealer>::open(deadline, security.clone(), 1 << 20, &mut out);
    // The greeting, the commands of the handshake, and messages.
    let damaged = random.below(8);
    let mut piece = [0; 4096];
    for step in 0..8 {
        if inbound.is_ready() {
            for _ in 0..random.below(5) {
                out.message(b"\x01\0", &message(random));
            }
        }
        let mut bytes = out.transmit_buf().to_vec();
        out.consume(bytes.len());
        // Without encryption, also messages of any number of frames.
        if inbound.is_ready() && matches!(security, Security::Null) {
            bytes.extend(message(random));
        }
        if step == damaged {
            match random.below(4) {
                0 => bytes.extend(random_bytes(random, 3000)),
                1 => bytes = random_bytes(random, 300),
                2 => bytes.extend(bytes.clone()),
                _ => damage(&mut bytes, random),
            }
        }
        for piece in bytes.chunks(1 + random.below(300)) {
            if stream.write_all(piece).is_err() {
                return;
            }
        }
        // Some never read.
        if random.once_in(10) {
            continue;
        }
        let Ok(count @ 1..) = stream.read(&mut piece) else {
            return;
        };
        let mut heard = &piece[..count];
        loop {
            match inbound.next(&mut heard, &mut out) {
                Ok(Step::Taken) => break,
                Ok(Step::Asks) => inbound.accept(&mut out),
                Ok(_) => {}
                Err(_) => return,
            }
        }
    }
}

/// Attacks a server, while clients that were there before and new ones are served.
#[track_caller]
fn survives(server: &Server, security: &Security, client: &dyn Fn() -> RemoteTask) {
    let mut random = Random::new(seed());
    let mut neighbour = client();
    let mut assert_served = |new: bool| {
        let mut new = new.then(client);
        let asked = new.as_mut().unwrap_or(&mut neighbour);
        let answer = asked.status(99);
        assert!(
            matches!(answer, Err(RequestError::UnknownTask { .. })),
            "{answer:?}"
        );
    };
    let start = Instant::now();
    let mut rounds = 0;
    while start.elapsed() < LONG || rounds <= 10 {
        attack(server.port, security, &mut random);
        rounds += 1;
        assert_served(rounds % 20 == 0);
    }
    let most = process_status(server.process.id(), "VmHWM:");
    assert!(most < MEMORY, "{most} KiB after {rounds} rounds");
}

#[test]
fn damaged_streams_delay_no_client_and_take_no_memory() {
    let server = Server::ours_over("native");
    survives(&server, &Security::Null, &|| connect(&server.endpoint()));
}

#[test]
fn damaged_encrypted_streams_delay_no_client_and_take_no_memory() {
    let keys = Keys::make(&["own", "anna"]);
    let mut command = gateway(&["gripper=sim:gripper"]);
    command.args(["--key", &keys.path("own.key_secret")]);
    command.args(["--client-key", &keys.path("anna.key")]);
    let server = Server::start(&mut command);
    let [own_public, _] = read_keys(&keys.path("own.key_secret"));
    let [_, secret] = read_keys(&keys.path("anna.key_secret"));
    let curve = curve::Keys::client(secret, own_public, random_key);
    let client = || keys.client(&server.endpoint(), "anna", "own");
    survives(&server, &Security::Curve(curve), &client);
}

/// Bytes that differ each time.
fn random_key() -> [u8; 32] {
    let mut bytes = [0; 32];
    let mut urandom = std::fs::File::open("/dev/urandom").expect("random bytes");
    urandom.read_exact(&mut bytes).expect("random bytes");
    bytes
}

/// The public and the secret key in a file.
fn read_keys(file: &str) -> [[u8; 32]; 2] {
    let text = std::fs::read_to_string(file).expect("a file");
    ["public-key", "secret-key"].map(|name| {
        let (_, rest) = text.split_once(&format!("{name} = \"")).expect("a key");
        z85(&rest[..40])
    })
}

/// The bytes of a key as text (RFC 32).
fn z85(text: &str) -> [u8; 32] {
    const DIGITS: &str =
        "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#";
    let digit = |digit| DIGITS.find(digit).expect("a digit") as u32;
    let mut bytes = [0; 32];
    let text: Vec<char> = text.chars().collect();
    for (group, bytes) in text.chunks(5).zip(bytes.chunks_mut(4)) {
        let value = group.iter().fold(0_u32, |value, next| {
            value.wrapping_mul(85).wrapping_add(digit(*next))
        });
        bytes.copy_from_slice(&value.to_be_bytes());
    }
    bytes
}
