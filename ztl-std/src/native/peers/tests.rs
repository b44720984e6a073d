//! Whole servers with their clients.

use std::io::Read as _;
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use ztl_zmtp::{Dealer, GREETING, HANDSHAKE, Router, Socket as _};

use super::*;

const LIMIT: Option<Duration> = Some(Duration::from_secs(20));

/// A server that answers each request with its body, but `hold` only together with the next other one.
struct Echo {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    waker: mio::Waker,
    thread: Option<JoinHandle<usize>>,
}

impl Echo {
    fn new(rules: Rules) -> Self {
        let endpoint = Endpoint::parse("tcp://127.0.0.1:*").unwrap();
        let peers = Peers::<Router>::bind(&endpoint, rules).unwrap();
        let (endpoint, waker) = (peers.endpoint().unwrap(), peers.waker().unwrap());
        let address = endpoint.strip_prefix("tcp://").unwrap().parse().unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        Self {
            address,
            stop,
            waker,
            thread: Some(std::thread::spawn(move || serve(peers, &stopped))),
        }
    }

    fn endpoint(&self) -> String {
        format!("tcp://{}", self.address)
    }

    /// Stops it; returns the most bytes that its buffers took.
    fn stop(&mut self) -> usize {
        self.stop.store(true, Ordering::SeqCst);
        self.waker.wake().unwrap();
        self.thread
            .take()
            .map_or(0, |thread| thread.join().unwrap())
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        self.stop();
    }
}

fn serve(mut peers: Peers<Router>, stop: &AtomicBool) -> usize {
    let mut most = 0;
    let mut held = Vec::new();
    while !stop.load(Ordering::SeqCst) {
        peers.wait(None).unwrap();
        while let Some(message) = peers.next(&mut |_, _| true) {
            let body = message.body.unwrap_or(Box::from(*b"several"));
            if body.starts_with(b"hold") {
                held.push((message.peer, message.envelope.unwrap(), body));
                continue;
            }
            for (peer, envelope, body) in held.drain(..) {
                peers.send(peer, &envelope, &body);
            }
            peers.send(message.peer, &message.envelope.unwrap(), &body);
            most = most.max(peers.held);
        }
        most = most.max(peers.held);
    }
    most
}

fn rules() -> Rules {
    Rules {
        security: Security::Null,
        message: 1 << 20,
        connections: 50,
        handshake: HANDSHAKE,
        idle: Duration::from_secs(3600),
        memory: 8 << 20,
    }
}

fn libzmq(context: &zmq::Context, endpoint: &str) -> zmq::Socket {
    let socket = context.socket(zmq::DEALER).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_rcvtimeo(20_000).unwrap();
    socket.connect(endpoint).unwrap();
    socket
}

#[track_caller]
fn is_served(socket: &zmq::Socket, body: &[u8]) {
    let frames = [&b"one"[..], b"", body];
    socket.send_multipart(frames, 0).unwrap();
    assert_eq!(socket.recv_multipart(0).unwrap(), frames);
}

/// A client that has shaken hands.
fn raw(echo: &Echo) -> TcpStream {
    shaken(TcpStream::connect(echo.address).unwrap())
}

/// The same from another address of this machine.
fn raw_from(source: [u8; 4], echo: &Echo) -> TcpStream {
    use rustix::net::{AddressFamily, SocketType, bind, connect, socket};
    let socket = socket(AddressFamily::INET, SocketType::STREAM, None).unwrap();
    bind(&socket, &SocketAddr::from((source, 0))).unwrap();
    connect(&socket, &echo.address).unwrap();
    shaken(socket.into())
}

fn shaken(mut stream: TcpStream) -> TcpStream {
    stream.set_read_timeout(LIMIT).unwrap();
    stream.set_write_timeout(LIMIT).unwrap();
    stream.write_all(GREETING).unwrap();
    stream.write_all(Dealer::READY).unwrap();
    let mut heard = vec![0; GREETING.len() + Router::READY.len()];
    stream.read_exact(&mut heard).unwrap();
    stream
}

#[test]
fn libzmqs_clients_get_messages_of_any_length() {
    let echo = Echo::new(rules());
    let context = zmq::Context::new();
    let socket = libzmq(&context, &echo.endpoint());
    for length in [0, 1, 255, 256, 100_000, 1_000_000] {
        is_served(&socket, &vec![7; length]);
    }
    let request = context.socket(zmq::REQ).unwrap();
    request.set_linger(0).unwrap();
    request.set_rcvtimeo(20_000).unwrap();
    request.connect(&echo.endpoint()).unwrap();
    request.send("hi", 0).unwrap();
    assert_eq!(request.recv_bytes(0).unwrap(), b"hi");
}

#[test]
fn a_message_without_end_takes_little_memory_and_ends_its_connection() {
    let mut echo = Echo::new(rules());
    let context = zmq::Context::new();
    let socket = libzmq(&context, &echo.endpoint());
    is_served(&socket, b"before");
    let mut endless = raw(&echo);
    let frames = b"\x01\x01x".repeat(10_000);
    let mut sent = 0;
    while endless.write_all(&frames).is_ok() {
        sent += frames.len();
        assert!(sent < 64 << 20, "it is not ended");
    }
    is_served(&socket, b"after");
    let most = echo.stop();
    assert!(most < 8 << 20, "{most} bytes");
}

#[test]
fn every_held_answer_arrives() {
    let echo = Echo::new(rules());
    let context = zmq::Context::new();
    let socket = libzmq(&context, &echo.endpoint());
    for number in 0..1000 {
        let body = format!("hold {number}");
        socket
            .send_multipart([&b"one"[..], b"", body.as_bytes()], 0)
            .unwrap();
    }
    socket
        .send_multipart([&b"one"[..], b"", b"now"], 0)
        .unwrap();
    for number in 0..1000 {
        let frames = socket.recv_multipart(0).unwrap();
        assert_eq!(frames[2], format!("hold {number}").as_bytes());
    }
    assert_eq!(socket.recv_multipart(0).unwrap()[2], b"now");
}

#[test]
fn a_client_that_does_not_read_is_not_read_from_and_takes_no_more_than_its_share() {
    let mut echo = Echo::new(rules());
    let context = zmq::Context::new();
    let socket = libzmq(&context, &echo.endpoint());
    is_served(&socket, b"before");
    let mut deaf = raw(&echo);
    deaf.set_write_timeout(Some(Duration::from_millis(300)))
        .unwrap();
    // A request of 60,000 bytes, again and again, until it is not taken any more.
    let mut request = b"\x01\0\x02\0\0\0\0\0\0\xEA\x60".to_vec();
    request.extend([7; 60_000]);
    let mut sent = 0;
    while deaf.write_all(&request).is_ok() {
        sent += request.len();
        assert!(sent < 64 << 20, "it is read from without end");
    }
    is_served(&socket, b"after");
    let most = echo.stop();
    assert!(most < 4 << 20, "{most} bytes");
}

#[test]
fn connections_that_never_shake_hands_displace_nobody_and_let_others_in() {
    let echo = Echo::new(rules());
    let context = zmq::Context::new();
    let socket = libzmq(&context, &echo.endpoint());
    is_served(&socket, b"before");
    let idle: Vec<_> = (0..200)
        .map(|_| TcpStream::connect(echo.address).unwrap())
        .collect();
    is_served(&socket, b"still");
    let other = libzmq(&context, &echo.endpoint());
    is_served(&other, b"in");
    drop(idle);
}

#[test]
fn a_client_that_comes_after_a_long_time_has_time_to_shake_hands() {
    let echo = Echo::new(rules());
    std::thread::sleep(HANDSHAKE + Duration::from_millis(100));
    let context = zmq::Context::new();
    is_served(&libzmq(&context, &echo.endpoint()), b"late");
    let mut raw = raw(&echo);
    raw.write_all(b"\x01\0\0\x02hi").unwrap();
    let mut heard = [0; 6];
    raw.read_exact(&mut heard).unwrap();
    assert_eq!(&heard, b"\x01\0\0\x02hi");
}

#[test]
fn a_connection_that_ends_right_after_its_bytes_is_closed() {
    let echo = Echo::new(rules());
    for (bytes, answer) in [(&b"\x01\0\0\x02hi"[..], 6), (b"\x01\0\0", 0)] {
        let mut stream = raw(&echo);
        stream.write_all(bytes).unwrap();
        stream.shutdown(std::net::Shutdown::Write).unwrap();
        let mut heard = Vec::new();
        stream.read_to_end(&mut heard).unwrap();
        assert_eq!(heard.len(), answer);
    }
}

#[test]
fn commands_without_end_stop_nobody() {
    let echo = Echo::new(rules());
    let context = zmq::Context::new();
    let socket = libzmq(&context, &echo.endpoint());
    is_served(&socket, b"before");
    let served = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for command in [
            &b"\x04\x06\x05HELLO"[..],
            b"\x04\0",
            b"\x04\x0A\x09SUBSCRIBE",
        ] {
            for _ in 0..2 {
                let mut flood = raw(&echo);
                let served = &served;
                scope.spawn(move || {
                    let commands = command.repeat(20_000);
                    // Until the others were served, at most for 20 s.
                    let begin = std::time::Instant::now();
                    while !served.load(Ordering::SeqCst)
                        && begin.elapsed() < Duration::from_secs(20)
                    {
                        flood.write_all(&commands).unwrap();
                    }
                });
            }
        }
        for _ in 0..20 {
            is_served(&socket, b"meanwhile");
        }
        is_served(&libzmq(&context, &echo.endpoint()), b"a new one");
        served.store(true, Ordering::SeqCst);
    });
}

#[test]
fn a_client_that_has_ended_its_stream_gets_all_answers() {
    let endpoint = Endpoint::parse("tcp://127.0.0.1:*").unwrap();
    let mut peers = Peers::<Router>::bind(&endpoint, rules()).unwrap();
    let address: SocketAddr = peers.endpoint().unwrap()[6..].parse().unwrap();
    let mut client = TcpStream::connect(address).unwrap();
    client.write_all(GREETING).unwrap();
    client.write_all(Dealer::READY).unwrap();
    client.write_all(b"\x01\0\0\x02hi").unwrap();
    let request = loop {
        peers.wait(Some(Duration::from_secs(20))).unwrap();
        if let Some(request) = peers.next(&mut |_, _| true) {
            break request;
        }
    };
    // More than the system takes.
    let answer = vec![7; 100_000];
    let mut sent = GREETING.len() + Router::READY.len();
    while peers.waiting(request.peer).unwrap() < 50_000 {
        peers.send(request.peer, &request.envelope.clone().unwrap(), &answer);
        sent += 2 + 9 + answer.len();
        for _ in 0..10 {
            peers.wait(Some(Duration::from_millis(1))).unwrap();
        }
    }
    client.shutdown(std::net::Shutdown::Write).unwrap();
    let has_ended = |peers: &Peers<Router>| {
        let peer = peers.slots[request.peer.slot].as_ref();
        peer.is_none_or(|peer| peer.is_leaving)
    };
    while !has_ended(&peers) {
        peers.wait(Some(Duration::from_secs(20))).unwrap();
        assert!(peers.next(&mut |_, _| true).is_none());
    }
    let reading = std::thread::spawn(move || {
        let mut heard = Vec::new();
        client.read_to_end(&mut heard).unwrap();
        heard.len()
    });
    while peers.waiting(request.peer).is_some() {
        peers.wait(Some(Duration::from_secs(20))).unwrap();
        assert!(peers.next(&mut |_, _| true).is_none());
    }
    assert_eq!(reading.join().unwrap(), sent);
}

#[test]
fn a_stream_that_is_not_zmtp_ends_and_harms_nobody() {
    let echo = Echo::new(rules());
    let context = zmq::Context::new();
    let socket = libzmq(&context, &echo.endpoint());
    for bytes in [&b"GET / HTTP/1.1\r\n\r\n"[..], &[0xFF; 3000], &[0; 3000]] {
        let mut stream = TcpStream::connect(echo.address).unwrap();
        stream.set_read_timeout(LIMIT).unwrap();
        let _ = stream.write_all(bytes);
        let mut heard = Vec::new();
        // Closed, perhaps with a reset.
        let _ = stream.read_to_end(&mut heard);
        is_served(&socket, bytes);
    }
}

/// A server without keys and its four clients: the first waits for an answer, the second has its one, the others have asked
/// nothing.
fn crowded(rules: Rules) -> (Echo, [TcpStream; 4]) {
    let echo = Echo::new(Rules {
        connections: 4,
        ..rules
    });
    let mut clients = [(); 4].map(|()| raw(&echo));
    ask(&mut clients[1], b"hi");
    // Both are read at once, and the first is answered.
    let both = b"\x01\x00\x00\x02hi\x01\x00\x00\x04hold";
    clients[0].write_all(both).unwrap();
    clients[0].read_exact(&mut [0; 6]).unwrap();
    (echo, clients)
}

fn ask(client: &mut TcpStream, body: &[u8; 2]) {
    let message = [&b"\x01\x00\x00\x02"[..], body].concat();
    client.write_all(&message).unwrap();
    let mut heard = [0; 6];
    client.read_exact(&mut heard).unwrap();
    assert_eq!(heard, *message);
}

fn is_closed(client: &mut TcpStream) -> bool {
    client.read(&mut [0; 9]).unwrap() == 0
}

#[test]
fn without_keys_idle_connections_make_room_and_those_with_a_request_stay() {
    let (echo, mut clients) = crowded(Rules {
        idle: Duration::ZERO,
        ..rules()
    });
    let mut third = raw(&echo);
    assert!(
        is_closed(&mut clients[2]),
        "it never asked, and is the oldest of these"
    );
    let mut fourth = raw(&echo);
    assert!(is_closed(&mut clients[3]));
    ask(&mut third, b"on");
    let mut answer = [0; 8];
    clients[0].read_exact(&mut answer).unwrap();
    assert_eq!(&answer[4..], b"hold");
    ask(&mut fourth, b"on");
    ask(&mut clients[1], b"on");
}

#[test]
fn connections_that_are_not_idle_for_long_are_kept() {
    let (echo, mut clients) = crowded(rules());
    let mut newcomer = TcpStream::connect(echo.address).unwrap();
    newcomer.set_read_timeout(LIMIT).unwrap();
    assert!(is_closed(&mut newcomer), "no place");
    for client in &mut clients[1..] {
        ask(client, b"on");
    }
}

#[test]
fn a_connection_that_waits_for_an_answer_is_not_idle() {
    let echo = Echo::new(Rules {
        connections: 1,
        idle: Duration::ZERO,
        ..rules()
    });
    let mut client = raw(&echo);
    let both = b"\x01\x00\x00\x02hi\x01\x00\x00\x04hold";
    client.write_all(both).unwrap();
    client.read_exact(&mut [0; 6]).unwrap();
    let mut newcomer = TcpStream::connect(echo.address).unwrap();
    newcomer.set_read_timeout(LIMIT).unwrap();
    assert!(is_closed(&mut newcomer), "no place");
    client.write_all(b"\x01\x00\x00\x02on").unwrap();
    let mut answers = [0; 14];
    client.read_exact(&mut answers).unwrap();
    assert_eq!((&answers[4..8], &answers[12..]), (&b"hold"[..], &b"on"[..]));
}

#[test]
#[cfg(target_os = "linux")]
fn who_has_many_idle_connections_makes_room_before_who_has_one() {
    let echo = Echo::new(Rules {
        connections: 4,
        idle: Duration::ZERO,
        ..rules()
    });
    let mut oldest = raw_from([127, 0, 0, 1], &echo);
    let mut many = [(); 3].map(|()| raw_from([127, 0, 0, 2], &echo));
    let mut newcomer = raw_from([127, 0, 0, 3], &echo);
    assert!(is_closed(&mut many[0]));
    ask(&mut oldest, b"on");
    ask(&mut newcomer, b"on");
}
