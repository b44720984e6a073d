//! A client on a slow network beside strangers that connect by the hundred a second, to a server with few places.

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::net::{AddressFamily, SocketType, bind, connect, socket};
use ztl_std::RemoteTask;
use ztl_std::keys::KeyPair;
use ztl_tests::lab::{Keys, PATIENCE, busy, until};
use ztl_zmtp::session::{Inbound, Outbound, Security};
use ztl_zmtp::{Dealer, curve};

use super::crowd::is_closed;
use super::{Kind, Subject, is_served};

/// How long bytes take in each direction.
const DELAY: Duration = Duration::from_millis(50);
/// Strangers in a second.
const RATE: f64 = 500.0;
/// Clients that connect one after another, and how long the median of them may take.
const CLIENTS: usize = 5;
const SOON: Duration = Duration::from_secs(5);

/// A slow network between clients and a server: it connects at once, and delays bytes.
struct SlowNetwork {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl SlowNetwork {
    fn to(port: u16) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
        let address = listener.local_addr().expect("bound");
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            for client in listener.incoming() {
                if stopped.load(Ordering::SeqCst) {
                    return;
                }
                if let (Ok(client), Ok(server)) = (client, TcpStream::connect(("127.0.0.1", port)))
                {
                    delay(&client, &server);
                    delay(&server, &client);
                }
            }
        });
        Self {
            address,
            stop,
            thread: Some(thread),
        }
    }

    fn endpoint(&self) -> String {
        format!("tcp://{}", self.address)
    }
}

impl Drop for SlowNetwork {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        let _ = TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Passes bytes on, and the end after them, each after [`DELAY`].
fn delay(from: &TcpStream, to: &TcpStream) {
    let (mut from, mut to) = (
        from.try_clone().expect("a file"),
        to.try_clone().expect("a file"),
    );
    let (send, pieces) = channel();
    std::thread::spawn(move || {
        let mut bytes = [0; 4096];
        loop {
            let count = from.read(&mut bytes).unwrap_or(0);
            let _ = send.send((Instant::now() + DELAY, bytes[..count].to_vec()));
            if count == 0 {
                return;
            }
        }
    });
    std::thread::spawn(move || {
        for (due, piece) in pieces {
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
            if piece.is_empty() || to.write_all(&piece).is_err() {
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Both);
    });
}

/// Strangers that connect, say something, and stay until they are closed.
struct Strangers {
    stop: Arc<AtomicBool>,
    opened: Arc<AtomicUsize>,
    thread: Option<JoinHandle<()>>,
}

impl Strangers {
    /// [`RATE`] of them, in turns from so many addresses.
    fn come(port: u16, says: Vec<u8>, addresses: u8) -> Self {
        let (stop, opened) = (
            Arc::new(AtomicBool::new(false)),
            Arc::new(AtomicUsize::new(0)),
        );
        let (stopped, count) = (Arc::clone(&stop), Arc::clone(&opened));
        let thread = std::thread::spawn(move || {
            let start = Instant::now();
            let mut streams = VecDeque::new();
            let mut from = (1..=addresses).cycle();
            while !stopped.load(Ordering::SeqCst) {
                let due = start.elapsed().as_secs_f64() * RATE;
                while (count.load(Ordering::SeqCst) as f64) < due {
                    let from = Ipv4Addr::new(127, 0, 0, from.next().unwrap_or(1));
                    streams.extend(open_from(from, port, &says));
                    count.fetch_add(1, Ordering::SeqCst);
                }
                streams.retain_mut(|stream| !is_closed(stream));
                std::thread::sleep(Duration::from_millis(2));
            }
        });
        Self {
            stop,
            opened,
            thread: Some(thread),
        }
    }
}

impl Drop for Strangers {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A connection from this address of this machine.
fn open_from(address: Ipv4Addr, port: u16, says: &[u8]) -> Option<TcpStream> {
    let file = socket(AddressFamily::INET, SocketType::STREAM, None).ok()?;
    bind(&file, &SocketAddr::from((address, 0))).ok()?;
    connect(&file, &SocketAddr::from(([127, 0, 0, 1], port))).ok()?;
    let mut stream = TcpStream::from(file);
    let _ = stream.write_all(says);
    stream.set_nonblocking(true).ok()?;
    Some(stream)
}

/// The greeting for this mechanism.
fn greeting(mechanism: &str, is_server: bool) -> Vec<u8> {
    let mut greeting = vec![0; 64];
    greeting[0] = 0xFF;
    greeting[9] = 0x7F;
    greeting[10] = 3;
    greeting[12..12 + mechanism.len()].copy_from_slice(mechanism.as_bytes());
    greeting[32] = u8::from(is_server);
    greeting
}

/// The greeting and the HELLO of a client whose key is not allowed. A server opens them each time they come.
fn hello(server: &KeyPair) -> Vec<u8> {
    let public = zmq::z85_decode(&server.public().to_string()).expect("a key");
    let public = public.try_into().expect("32 bytes");
    let keys = curve::Keys::client([7; 32], public, || [9; 32]);
    let mut out = Outbound::default();
    let security = Security::Curve(keys);
    let mut inbound = Inbound::<Dealer>::open(ztl_core::Instant::NEVER, security, 1024, &mut out);
    let theirs = greeting("CURVE", true);
    inbound
        .next(&mut &theirs[..], &mut out)
        .expect("a greeting");
    assert!(out.waiting() > 250, "greeting and HELLO");
    out.transmit_buf().to_vec()
}

/// Clients through a slow network are served beside strangers that say this, from one address and from several.
fn is_served_soon(subject: &Subject, kind: &str, says: &[u8], client: impl Fn(&str) -> RemoteTask) {
    let network = SlowNetwork::to(subject.server.port);
    for addresses in [1, 8] {
        let strangers = Strangers::come(subject.server.port, says.to_vec(), addresses);
        until("the strangers are there", PATIENCE, || {
            (strangers.opened.load(Ordering::SeqCst) > 200).then_some(())
        });
        // A busy machine delays the clients of some attempts.
        until("the median client is served soon", PATIENCE, || {
            let mut times: Vec<_> = (0..CLIENTS)
                .map(|_| {
                    let start = Instant::now();
                    is_served(&mut client(&network.endpoint()));
                    start.elapsed()
                })
                .collect();
            times.sort();
            println!("{kind}, {addresses} addresses: {times:?}");
            (times[CLIENTS / 2] < SOON).then_some(())
        });
    }
}

#[test]
fn a_slow_client_with_a_key_is_served_beside_strangers() {
    let _one = busy();
    let keys = Keys::make(&["robot", "anna"]);
    let (robot, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    let few = ["--limit", "connections=50"];
    let options = [&["--key", &robot, "--client-key", &anna][..], &few].concat();
    let subject = Subject::start(Kind::Serve, None, &options);
    let client = |endpoint: &str| {
        let client = keys.client(endpoint, "anna", "robot");
        client.with_timeout(3 * PATIENCE)
    };
    is_served_soon(&subject, "silent", b"", client);
    is_served_soon(&subject, "greeting", &greeting("CURVE", false), client);
    is_served_soon(&subject, "HELLO", &hello(&keys.pair("robot")), client);
}

#[test]
fn a_slow_client_of_an_open_server_is_served_beside_strangers() {
    let _one = busy();
    let few = ["--limit", "connections=50"];
    let subject = Subject::start(Kind::TaskServer, None, &few);
    let client = |endpoint: &str| ztl_tests::lab::connect(endpoint).with_timeout(3 * PATIENCE);
    is_served_soon(&subject, "silent", b"", client);
    is_served_soon(&subject, "greeting", &greeting("NULL", false), client);
}
