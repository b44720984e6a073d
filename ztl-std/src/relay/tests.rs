use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::thread::JoinHandle;

use ztl_core::envelope::ClientId;
use ztl_tests::lab::{PATIENCE, port_of, reserve_port, shake_hands, until};

use super::*;

/// A relay that hands its requests to the test.
struct Relay {
    endpoint: String,
    answers: RelayAnswers,
    requests: Receiver<RelayedRequest>,
    thread: JoinHandle<()>,
}

impl Relay {
    fn start(endpoint: &str) -> Self {
        let server = RelayServer::bind(endpoint, Access::everybody(), Limits::default()).unwrap();
        let (sender, requests) = channel();
        Self {
            endpoint: server.endpoint().to_owned(),
            answers: server.answers(),
            requests,
            thread: std::thread::spawn(move || {
                server
                    .listen(|request| sender.send(request).unwrap())
                    .unwrap();
            }),
        }
    }

    fn client(&self) -> RelayClient {
        RelayClient::new(&self.endpoint, None).unwrap()
    }

    fn next(&self) -> RelayedRequest {
        self.requests.recv_timeout(PATIENCE).unwrap()
    }

    /// The next request with this body.
    fn next_with(&self, body: &[u8]) -> RelayedRequest {
        loop {
            let next = self.next();
            if next.body.as_deref() == Some(body) {
                return next;
            }
        }
    }

    /// Repeats the next request to its client. Returns its length.
    fn echo(&self) -> usize {
        let request = self.next();
        let body = request.body.unwrap();
        let length = body.len();
        self.answers.send(request.path, body);
        length
    }

    fn stop(self) {
        self.answers.stop();
        self.thread.join().unwrap();
    }
}

fn envelope(number: u64) -> Option<Envelope> {
    Some(Envelope {
        client: ClientId([7; 16]),
        number,
        early_end: false,
    })
}

/// Bytes of memory that this process occupies.
fn resident() -> usize {
    // Pages of 4 KiB are the least that a system has.
    let pages = std::fs::read_to_string("/proc/self/statm").unwrap();
    let pages: usize = pages.split(' ').nth(1).unwrap().parse().unwrap();
    pages * 4096
}

#[test]
fn long_bodies_pass_whole_and_too_long_ones_end_their_connection_only() {
    let relay = Relay::start("tcp://127.0.0.1:*");
    let client = relay.client();
    let long: Vec<u8> = (0..MAX_MESSAGE - 100).map(|at| at as u8).collect();
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(1), &long, PATIENCE));
        assert_eq!(relay.echo(), long.len());
        assert_eq!(asked.join().unwrap().unwrap(), long);
        let short = client.ask(None, &vec![0; 2 * MAX_MESSAGE], Duration::from_millis(300));
        assert_eq!(short, Err(NotRelayed::NoAnswer));
        let asked = scope.spawn(|| client.ask(envelope(2), b"again", PATIENCE));
        assert_eq!(relay.echo(), 5);
        assert_eq!(asked.join().unwrap(), Ok(b"again".to_vec()));
    });
    relay.stop();
}

#[test]
fn an_answer_for_a_client_that_is_gone_is_dropped() {
    let relay = Relay::start("tcp://127.0.0.1:*");
    let client = relay.client();
    // On a busy machine, it may not be connected in time, or not be heard at once.
    let late = until("the first request", PATIENCE, || {
        let gone = client.ask(envelope(1), b"first", Duration::from_millis(200));
        if gone != Err(NotRelayed::NotSent) {
            assert_eq!(gone, Err(NotRelayed::NoAnswer));
        }
        relay.requests.try_recv().ok()
    });
    // Its connection is closed; its answer must not reach the next request.
    let late = late.path;
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(2), b"second", PATIENCE));
        let request = relay.next_with(b"second");
        relay.answers.send(late, b"too late".to_vec());
        relay.answers.send(request.path, b"in time".to_vec());
        assert_eq!(asked.join().unwrap(), Ok(b"in time".to_vec()));
    });
    relay.stop();
}

#[test]
fn a_request_is_not_sent_to_a_server_that_is_reached_too_late() {
    // It never answers the handshake.
    let mute = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let at = format!("tcp://127.0.0.1:{}", mute.local_addr().unwrap().port());
    let client = RelayClient::new(&at, None).unwrap();
    let (begun, send) = (Instant::now(), Duration::from_millis(100));
    let told = client.ask_before(envelope(1), b"late", send, PATIENCE);
    assert_eq!(told, Err(NotRelayed::NotSent));
    assert!(begun.elapsed() < PATIENCE / 2);
}

#[test]
fn requests_tell_which_came_over_the_same_connection() {
    let relay = Relay::start("tcp://127.0.0.1:*");
    let (first, other) = (relay.client(), relay.client());
    let ask = |client: &RelayClient, number| {
        std::thread::scope(|scope| {
            let asked = scope.spawn(|| client.ask(envelope(number), b"ask", PATIENCE));
            let RelayedRequest {
                connection, path, ..
            } = relay.next();
            relay.answers.send(path, b"answer".to_vec());
            assert_eq!(asked.join().unwrap(), Ok(b"answer".to_vec()));
            connection
        })
    };
    let (one, two) = (ask(&first, 1), ask(&other, 1));
    assert!(two > one, "{two} and {one}");
    assert_eq!([ask(&first, 2), ask(&other, 2)], [one, two]);
    relay.stop();
}

#[test]
fn a_server_that_is_gone_and_back_is_reached_again() {
    // It is bound twice: no connection gets a reserved port between.
    let relay = Relay::start(&format!("tcp://127.0.0.1:{}", reserve_port()));
    let client = relay.client();
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(1), b"one", PATIENCE));
        relay.echo();
        assert_eq!(asked.join().unwrap(), Ok(b"one".to_vec()));
    });
    let endpoint = relay.endpoint.clone();
    relay.stop();
    // The idle connection may not know it yet; a new one does.
    let _ = client.ask(envelope(2), b"two", Duration::from_millis(200));
    let gone = client.ask(envelope(3), b"three", Duration::from_millis(200));
    assert_eq!(gone, Err(NotRelayed::NotSent));
    let relay = Relay::start(&endpoint);
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(4), b"four", PATIENCE));
        // What was asked while nobody was there does not arrive later.
        let request = relay.next();
        assert_eq!(request.body.as_deref(), Some(&b"four"[..]));
        relay.answers.send(request.path, b"here".to_vec());
        assert_eq!(asked.join().unwrap(), Ok(b"here".to_vec()));
    });
    relay.stop();
}

#[test]
fn a_second_answer_is_not_taken_for_the_next_one() {
    let router = zmq::Context::new().socket(zmq::ROUTER).unwrap();
    router.set_linger(0).unwrap();
    router.bind("tcp://127.0.0.1:*").unwrap();
    let endpoint = router.get_last_endpoint().unwrap().unwrap();
    let client = RelayClient::new(&endpoint, None).unwrap();
    let answer = |times: usize, text: &str| {
        let mut frames = router.recv_multipart(0).unwrap();
        frames.pop();
        frames.push(text.as_bytes().to_vec());
        for _ in 0..times {
            router.send_multipart(&frames, 0).unwrap();
        }
    };
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(1), b"a", PATIENCE));
        answer(2, "first");
        assert_eq!(asked.join().unwrap(), Ok(b"first".to_vec()));
        let asked = scope.spawn(|| client.ask(envelope(2), b"b", PATIENCE));
        answer(1, "second");
        assert_eq!(asked.join().unwrap(), Ok(b"second".to_vec()));
    });
}

#[test]
fn a_second_answer_without_an_envelope_is_not_taken_for_the_next_one() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp://{}", listener.local_addr().unwrap());
    let client = RelayClient::new(&endpoint, None).unwrap();
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(None, b"a", PATIENCE));
        let (mut server, _) = listener.accept().unwrap();
        server.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut greeting = [0; 64];
        (greeting[0], greeting[9], greeting[10]) = (0xFF, 0x7F, 3);
        greeting[12..16].copy_from_slice(b"NULL");
        server.write_all(&greeting).unwrap();
        server.read_exact(&mut greeting).unwrap();
        server
            .write_all(b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06ROUTER")
            .unwrap();
        let mut head = [0; 2];
        server.read_exact(&mut head).unwrap();
        server.read_exact(&mut vec![0; head[1].into()]).unwrap();
        // An empty frame, and one of a byte.
        let mut request = [0; 5];
        server.read_exact(&mut request).unwrap();
        server
            .write_all(b"\x01\x00\x00\x01A\x01\x00\x00\x01A")
            .unwrap();
        assert_eq!(asked.join().unwrap(), Ok(b"A".to_vec()));
        let asked = scope.spawn(|| client.ask(None, b"b", PATIENCE));
        server.read_exact(&mut request).unwrap();
        server.write_all(b"\x01\x00\x00\x01B").unwrap();
        assert_eq!(asked.join().unwrap(), Ok(b"B".to_vec()));
    });
}

#[test]
fn requests_without_end_do_not_hold_up_answers() {
    const REQUEST: &[u8] = b"\x01\x00\x00\x01x";
    let server =
        RelayServer::bind("tcp://127.0.0.1:*", Access::everybody(), Limits::default()).unwrap();
    let (endpoint, answers) = (server.endpoint().to_owned(), server.answers());
    let answered = AtomicBool::new(false);
    let (sender, receiver) = channel::<TcpStream>();
    std::thread::scope(|scope| {
        let (answers, answered) = (&answers, &answered);
        let relay = scope.spawn(move || {
            let mut flood = None;
            server.listen(|request| {
                if request.envelope.is_some() {
                    answers.send(request.path, b"in time".to_vec());
                } else if !answered.load(Ordering::SeqCst) {
                    // There is another one whenever one is taken.
                    let flood = flood.get_or_insert_with(|| receiver.recv().unwrap());
                    flood.write_all(REQUEST).unwrap();
                }
            })
        });
        let mut flood = shake_hands(port_of(&endpoint));
        sender.send(flood.try_clone().unwrap()).unwrap();
        flood.write_all(&REQUEST.repeat(100)).unwrap();
        let client = RelayClient::new(&endpoint, None).unwrap();
        let told = client.ask(envelope(1), b"hello", PATIENCE);
        answered.store(true, Ordering::SeqCst);
        answers.stop();
        assert_eq!(told, Ok(b"in time".to_vec()));
        relay.join().unwrap().unwrap();
    });
}

#[test]
fn answers_that_nobody_takes_occupy_bounded_memory() {
    const ANSWER: usize = 100_000;
    const REQUESTS: usize = 10_000;
    let relay = Relay::start("tcp://127.0.0.1:*");
    let mut deaf = shake_hands(port_of(&relay.endpoint));
    let before = resident();
    for _ in 0..REQUESTS {
        // An empty frame, and one of a byte.
        deaf.write_all(b"\x01\x00\x00\x01x").unwrap();
        // It is read no more once it takes too little: only time tells that nothing comes.
        let Ok(request) = relay.requests.recv_timeout(Duration::from_secs(2)) else {
            break;
        };
        relay.answers.send(request.path, vec![7; ANSWER]);
    }
    let grown = resident().saturating_sub(before);
    assert!(grown < REQUESTS * ANSWER / 4, "{grown} bytes");
    // Another client is served meanwhile. On a busy machine, one more request may come late.
    let client = relay.client();
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(1), b"hello", PATIENCE));
        let request = relay.next_with(b"hello");
        relay.answers.send(request.path, b"hello".to_vec());
        assert_eq!(asked.join().unwrap(), Ok(b"hello".to_vec()));
    });
    relay.stop();
}
