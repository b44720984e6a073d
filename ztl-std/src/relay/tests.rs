use std::io::Write as _;
use std::sync::mpsc::{Receiver, channel};
use std::thread::JoinHandle;

use ztl_core::envelope::ClientId;
use ztl_tests::lab::{PATIENCE, port_of, shake_hands};

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
    let gone = client.ask(envelope(1), b"first", Duration::from_millis(200));
    assert_eq!(gone, Err(NotRelayed::NoAnswer));
    // Its connection is closed; its answer must not reach the next request.
    let late = relay.next().path;
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(2), b"second", PATIENCE));
        let request = relay.next();
        relay.answers.send(late, b"too late".to_vec());
        relay.answers.send(request.path, b"in time".to_vec());
        assert_eq!(asked.join().unwrap(), Ok(b"in time".to_vec()));
    });
    relay.stop();
}

#[test]
fn a_server_that_is_gone_and_back_is_reached_again() {
    let relay = Relay::start("tcp://127.0.0.1:*");
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
    // Another client is served meanwhile.
    let client = relay.client();
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| client.ask(envelope(1), b"hello", PATIENCE));
        assert_eq!(relay.echo(), 5);
        assert_eq!(asked.join().unwrap(), Ok(b"hello".to_vec()));
    });
    relay.stop();
}
