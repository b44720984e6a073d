//! A device that is a ZTL server by itself, without a gateway: ZMTP over TCP, with the standard library and
//! `ztl-mcu`, as firmware would use it. It moves a slide at 100 mm per second.
//!
//!     cargo run --example zmtp
//!
//! serves /desk at tcp://127.0.0.1:7002, for up to 4 clients of any ZeroMQ library:
//!
//!     ztl task-client -r 127.0.0.1 -p 7002 -s /desk desk:slide:80
//!
//! The arguments `127.0.0.1:7002 20` are another address and another speed.
//!
//! A client that was switched off keeps its slot: the standard library cannot enable TCP's keep-alive.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::process::ExitCode;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ztl_mcu::link::Offer;
use ztl_mcu::zmtp::{Peer, Server};
use ztl_mcu::{Component, Identity, Instant, Refused, Report, Run};

const PEERS: usize = 4;
/// Longest sleep.
const SECOND: Duration = Duration::from_secs(1);
/// How long a client may take to accept a reply while the others wait. The system's buffers hold many, so a
/// client that fills them does not read.
const TAKE: Duration = Duration::from_millis(50);

/// Moves to a position between 0 and 100 mm.
struct Slide {
    /// In mm per second.
    speed: f32,
    from: f32,
    to: f32,
    start: Instant,
    stopped: bool,
}

impl Slide {
    const fn new(speed: f32) -> Self {
        Self {
            speed,
            from: 0.0,
            to: 0.0,
            start: Instant::ZERO,
            stopped: false,
        }
    }

    fn position(&self, now: Instant) -> f32 {
        let way = now.since(self.start).as_secs_f32() * self.speed;
        self.from + (self.to - self.from).clamp(-way, way)
    }
}

impl Component for Slide {
    fn offer(&self) -> Offer<'_> {
        Offer::new("slide").with_range(0.0, 100.0, "mm")
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        let position = goal.parse();
        if !position.is_ok_and(|position: f32| (0.0..=100.0).contains(&position)) {
            why.text("slide takes 0 to 100 mm");
            return Err(Refused);
        }
        Ok(())
    }

    fn start(&mut self, now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.from = self.position(now);
        self.to = goal.parse().map_err(|_| Refused)?;
        self.start = now;
        self.stopped = false;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        let position = self.position(now);
        report.number(position, 1);
        report.text(" mm");
        if self.stopped {
            (self.from, self.to) = (position, position);
            Run::Aborted
        } else if position == self.to {
            Run::Completed
        } else {
            Run::Running
        }
    }

    fn abort(&mut self, _now: Instant) {
        self.stopped = true;
    }

    fn make_safe(&mut self, now: Instant) {
        (self.from, self.to) = (self.position(now), self.position(now));
    }
}

/// The server, and each client's stream.
struct Device {
    server: Server<'static, [Slide; 1], PEERS, 8, 512, PEERS>,
    streams: [Option<TcpStream>; PEERS],
    /// When the main thread wakes up.
    wake: Instant,
}

struct Shared {
    device: Mutex<Device>,
    /// Signals that something was sent, or is due earlier.
    changed: Condvar,
    begin: std::time::Instant,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Device> {
        self.device.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now(&self) -> Instant {
        Instant::from_micros(self.begin.elapsed().as_micros() as u64)
    }
}

impl Device {
    /// Sends the output for each client. Closes one that accepts nothing for [`TAKE`].
    fn send(&mut self) {
        for (slot, stream) in self.streams.iter_mut().enumerate() {
            let peer = Peer(slot as u8);
            let Some(stream) = stream else {
                continue;
            };
            loop {
                let pending = self.server.transmit_buf(peer);
                if pending.is_empty() {
                    break;
                }
                match stream.write(pending) {
                    Ok(count) if count > 0 => self.server.consume(peer, count),
                    _ => self.server.close(peer),
                }
            }
            if !self.server.is_open(peer) {
                // Its thread notices.
                let _ = stream.shutdown(Shutdown::Both);
            }
        }
    }

    /// A slot for another client that is free and has no thread any more.
    fn vacant(&self) -> Option<usize> {
        self.streams.iter().position(Option::is_none)
    }
}

/// Serves a client until it disconnects.
fn serve_client(shared: &Shared, slot: usize, mut stream: TcpStream) {
    let peer = Peer(slot as u8);
    let mut buffer = [0; 512];
    while let Ok(count) = stream.read(&mut buffer)
        && count > 0
    {
        let mut rest = &buffer[..count];
        let mut device = shared.lock();
        if !device.server.is_open(peer) {
            // Closed while the client still sends.
            break;
        }
        while !rest.is_empty() {
            let now = shared.now();
            let taken = device.server.handle_bytes(now, peer, rest);
            rest = &rest[taken..];
            device.send();
            if device.server.poll_timeout(now) < device.wake {
                shared.changed.notify_all();
            }
            if taken == 0 {
                // A held reply must be sent before the next request is taken.
                let waited = shared.changed.wait_timeout(device, SECOND);
                device = waited.unwrap_or_else(PoisonError::into_inner).0;
            }
        }
    }
    let mut device = shared.lock();
    device.server.close(peer);
    device.streams[slot] = None;
}

/// Moves the slide and sends held replies when they are due.
fn keep_moving(shared: &Shared) {
    let mut device = shared.lock();
    loop {
        let now = shared.now();
        device.server.handle_timeout(now);
        device.send();
        shared.changed.notify_all();
        device.wake = device.server.poll_timeout(now).min(now + SECOND);
        let pause = device.wake.since(now);
        let waited = shared.changed.wait_timeout(device, pause);
        device = waited.unwrap_or_else(PoisonError::into_inner).0;
    }
}

/// Accepts the next client; returns its stream for reading and for writing.
fn accept(listener: &TcpListener) -> std::io::Result<(TcpStream, TcpStream)> {
    let (stream, _) = listener.accept()?;
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(TAKE))?;
    let second = stream.try_clone()?;
    Ok((stream, second))
}

fn main() -> std::io::Result<ExitCode> {
    let mut words = std::env::args().skip(1);
    let address = words.next();
    let address = address.as_deref().unwrap_or("127.0.0.1:7002");
    let speed = words.next().unwrap_or_else(|| "100".to_owned());
    let speed = match speed.parse::<f32>() {
        Ok(speed) if (0.1..=1000.0).contains(&speed) => speed,
        _ => {
            eprintln!("invalid speed '{speed}': expected 0.1 to 1000 mm per second");
            return Ok(ExitCode::FAILURE);
        }
    };
    let listener = match TcpListener::bind(address) {
        Ok(listener) => listener,
        Err(error) => {
            eprintln!("cannot serve at '{address}': {error} (it takes an ADDRESS:PORT)");
            return Ok(ExitCode::FAILURE);
        }
    };
    println!("serving /desk at tcp://{}", listener.local_addr()?);

    // Firmware would use a random number.
    let identity = Identity::new("desk", "1.0.0", std::process::id());
    let shared = Shared {
        device: Mutex::new(Device {
            server: Server::new("/desk", identity, [Slide::new(speed)]),
            streams: [const { None }; PEERS],
            wake: Instant::ZERO,
        }),
        changed: Condvar::new(),
        begin: std::time::Instant::now(),
    };
    let shared = &shared;
    std::thread::scope(|threads| {
        threads.spawn(|| keep_moving(shared));
        loop {
            let (stream, second) = match accept(&listener) {
                Ok(streams) => streams,
                // The client is already gone, or the system is out of resources; the others are still served.
                Err(error) => {
                    eprintln!("cannot take a client: {error}");
                    std::thread::sleep(TAKE);
                    continue;
                }
            };
            let mut device = shared.lock();
            // No free slot: close it; a ZeroMQ client retries later.
            let Some(slot) = device.vacant() else {
                continue;
            };
            device.streams[slot] = Some(second);
            device.server.open(shared.now(), Peer(slot as u8));
            device.send();
            threads.spawn(move || serve_client(shared, slot, stream));
        }
    })
}
