//! What a STATUS costs through `ztl_mcu::zmtp` over plain blocking TCP: beside a bare TCP echo of as many bytes and
//! bare libzmq, in turn, in one run, all on one core. `cargo xtask bench` runs it.

use std::hint::black_box;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::Command;
use std::time::Instant as Clock;

use ztl_mcu::link::Offer;
use ztl_mcu::zmtp::{Peer, Server};
use ztl_mcu::{Component, Identity, Instant, Refused, Report, Run};
use ztl_tests::lab::shake_hands;

/// Measured this often, all in turn.
const ROUNDS: usize = 41;
const TRIPS: u32 = 1000;

/// With this number the first task has the id 1.
const BOOT: u32 = 0x3A2C_BD44;

const STATUS: &str = "/test;2;1;status update";
const ANSWER: &str = "/test;5;1;hello world";

/// A question that is answered.
type Ask = Box<dyn FnMut()>;

/// Says hello.
struct Echo;

impl Component for Echo {
    fn offer(&self) -> Offer<'_> {
        Offer::new("echo")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run {
        report.text("hello world");
        Run::Completed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}
}

/// A request or an answer, as it goes over the wire.
fn message(body: &str) -> Vec<u8> {
    [&[1, 0, 0, body.len() as u8], body.as_bytes()].concat()
}

/// A thread that serves each stream until its end.
fn listen(mut serve: impl FnMut(TcpStream) + Send + 'static) -> u16 {
    let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    let port = listener.local_addr().expect("its address").port();
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            stream.set_nodelay(true).expect("an option");
            serve(stream);
        }
    });
    port
}

/// The engine: input, time, output.
fn ours() -> u16 {
    let start = Clock::now();
    let identity = Identity::new("test", "1", BOOT);
    let mut server = Server::<_, 1, 8, 256, 4>::new("/test", identity, [Echo]);
    let peer = Peer(0);
    listen(move |mut stream| {
        let now = || Instant::from_micros(start.elapsed().as_micros() as u64);
        server.open(now(), peer);
        let mut buffer = [0; 512];
        while let Ok(count @ 1..) = stream.read(&mut buffer) {
            let mut rest = &buffer[..count];
            while !rest.is_empty() {
                let taken = server.handle_bytes(now(), peer, rest);
                rest = &rest[taken..];
                server.handle_timeout(now());
                loop {
                    let pending = server.transmit_buf(peer);
                    if pending.is_empty() {
                        break;
                    }
                    let sent = stream.write(pending).unwrap_or(pending.len());
                    server.consume(peer, sent);
                }
            }
        }
    })
}

/// Answers every piece with as many bytes as the answer has.
fn bare_tcp() -> u16 {
    let answer = message(ANSWER);
    listen(move |mut stream| {
        let mut buffer = [0; 512];
        while let Ok(1..) = stream.read(&mut buffer) {
            black_box(&buffer);
            if stream.write_all(&answer).is_err() {
                break;
            }
        }
    })
}

/// The same through libzmq.
fn bare_libzmq() -> u16 {
    let context = zmq::Context::new();
    let socket = context.socket(zmq::REP).expect("a socket");
    socket.bind("tcp://127.0.0.1:*").expect("a port");
    let endpoint = socket.get_last_endpoint().expect("its address");
    let endpoint = endpoint.expect("a text");
    std::thread::spawn(move || {
        while let Ok(request) = socket.recv_bytes(0) {
            black_box(request);
            socket.send(ANSWER, 0).expect("to send");
        }
    });
    let port = endpoint.rsplit(':').next().expect("a port");
    port.parse().expect("a number")
}

/// A client without libzmq: bytes out, bytes in.
fn raw(port: u16, zmtp: bool) -> impl FnMut() {
    let mut stream = match zmtp {
        true => shake_hands(port),
        false => TcpStream::connect(("127.0.0.1", port)).expect("a connection"),
    };
    stream.set_nodelay(true).expect("an option");
    if zmtp {
        // The task whose end is asked for.
        stream
            .write_all(&message("/test;1;-1;dGVzdDplY2hvOmhp"))
            .expect("to write");
        let count = stream.read(&mut [0; 256]).expect("an answer");
        assert!(count > 0);
    }
    let (request, answer) = (message(STATUS), message(ANSWER));
    let mut heard = vec![0; answer.len()];
    move || {
        stream.write_all(&request).expect("to write");
        stream.read_exact(&mut heard).expect("an answer");
        assert_eq!(heard, answer);
    }
}

fn libzmq(port: u16) -> impl FnMut() {
    let socket = zmq::Context::new().socket(zmq::REQ).expect("a socket");
    socket.set_linger(0).expect("an option");
    socket.set_rcvtimeo(10_000).expect("an option");
    socket
        .connect(&format!("tcp://127.0.0.1:{port}"))
        .expect("an address");
    move || {
        socket.send(STATUS, 0).expect("to send");
        let answer = socket.recv_bytes(0).expect("an answer");
        assert_eq!(answer, ANSWER.as_bytes());
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    // This thread, and so all that it starts.
    let own = std::process::id().to_string();
    let pinned = Command::new("taskset").args(["-cp", "0", &own]).output();
    let pinned = pinned.is_ok_and(|output| output.status.success());
    let cores = if pinned {
        "on one core"
    } else {
        "NOT PINNED: there is no `taskset`"
    };

    // It has the task before another client asks for it.
    let engine = ours();
    let mut raw_engine = raw(engine, true);
    raw_engine();
    let engine_for_libzmq = ours();
    drop(raw(engine_for_libzmq, true));
    let mut subjects: [(&str, Ask); 4] = [
        (
            "bare TCP echo, raw client",
            Box::new(raw(bare_tcp(), false)),
        ),
        ("ztl_mcu::zmtp, raw client", Box::new(raw_engine)),
        (
            "ztl_mcu::zmtp, libzmq REQ",
            Box::new(libzmq(engine_for_libzmq)),
        ),
        ("libzmq REP, libzmq REQ", Box::new(libzmq(bare_libzmq()))),
    ];
    let mut times = [const { Vec::new() }; 4];
    for round in 0..=ROUNDS {
        for ((_, ask), times) in subjects.iter_mut().zip(&mut times) {
            let start = Clock::now();
            for _ in 0..TRIPS {
                ask();
            }
            let took = start.elapsed().as_secs_f64() * 1e6 / f64::from(TRIPS);
            // The first is for warming up.
            if round > 0 {
                times.push(took);
            }
        }
    }
    println!(
        "a STATUS there and back over TCP, {cores}; medians of {ROUNDS} rounds of {TRIPS} in turn,"
    );
    println!(
        "and of the ratios to the bare echo of the same round (aim: below 1.5 with the raw client):"
    );
    let bare = times[0].clone();
    for ((name, _), times) in subjects.iter().zip(&mut times) {
        let mut ratios: Vec<f64> = times
            .iter()
            .zip(&bare)
            .map(|(time, bare)| time / bare)
            .collect();
        let ratio = median(&mut ratios);
        let (low, high) = (ratios[ROUNDS / 4], ratios[ROUNDS * 3 / 4]);
        println!(
            "  {name:<28}{:>6.1} µs  {ratio:.2} times (middle half {low:.2} to {high:.2})",
            median(times)
        );
    }
}
