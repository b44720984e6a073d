//! Random and damaged streams to a server that speaks ZMTP itself, in a process of its own: before, in and after the
//! handshake, with and without encryption. Good clients are served all the time, and the server's memory stays small.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use ztl_std::keys::{KeyPair, PublicKey};
use ztl_std::{RemoteTask, RequestError};
use ztl_tests::lab::{Random, SCOPE, Scratch, Server, connect, process_status, seed, ztl};
use ztl_zmtp::session::{Inbound, Outbound, Security, Step};
use ztl_zmtp::{Dealer, curve};

use crate::fuzz::{damage, message, random_bytes};

/// How long each server is attacked.
const LONG: Duration = Duration::from_secs(4);

/// The most memory that a server ever takes, in KiB.
const MEMORY: u64 = 64 << 10;

/// How long an attack waits for the server's next bytes; it may have damaged its own so that none come.
const NEXT: Duration = Duration::from_millis(20);

/// One connection. It follows the protocol, but damages some of what it sends.
fn attack(port: u16, security: Security, random: &mut Random) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a connection");
    stream.set_read_timeout(Some(NEXT)).expect("a time");
    stream.set_write_timeout(Some(NEXT)).expect("a time");
    let mut out = Outbound::default();
    let deadline = ztl_core::Instant::NEVER;
    let mut inbound = Inbound::<Dealer>::open(deadline, security, 1 << 20, &mut out);
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
    while start.elapsed() < LONG {
        attack(server.port, security.clone(), &mut random);
        rounds += 1;
        assert_served(rounds % 20 == 0);
    }
    assert!(rounds > 10, "only {rounds} rounds");
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
    let scratch = Scratch::new();
    let [own, anna] = ["own", "anna"].map(|name| {
        let [_, secret] = KeyPair::generate()
            .write(&scratch.path(name))
            .expect("files");
        secret
    });
    let mut command = ztl();
    command.args([
        "gateway",
        "-p",
        "0",
        "-s",
        SCOPE,
        "-d",
        "gripper=sim:gripper",
    ]);
    command.args(["--transport", "native", "--key"]).arg(&own);
    command.arg("--client-key").arg(scratch.path("anna.key"));
    let server = Server::start(&mut command);
    let [own_public, _] = read_keys(&own);
    let [_, secret] = read_keys(&anna);
    let keys = curve::Keys::client(secret, own_public, random_key);
    let client = || {
        let own = PublicKey::read(&scratch.path("own.key")).expect("a key");
        let anna = KeyPair::read(&anna).expect("keys");
        let client = connect(&server.endpoint());
        client.with_keys(anna, own).expect("encryption")
    };
    survives(&server, &Security::Curve(keys), &client);
}

/// Bytes that differ each time.
fn random_key() -> [u8; 32] {
    let mut bytes = [0; 32];
    let mut urandom = std::fs::File::open("/dev/urandom").expect("random bytes");
    urandom.read_exact(&mut bytes).expect("random bytes");
    bytes
}

/// The public and the secret key in a file.
fn read_keys(file: &Path) -> [[u8; 32]; 2] {
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
