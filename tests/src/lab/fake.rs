//! A server with replies that a test chooses and no real server would send.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use super::port_of;

/// Pause between two looks whether the server is still wanted, in milliseconds.
const LOOK_AGAIN: i32 = 20;

/// A REP server with a scripted answer to each request.
#[derive(Debug)]
pub struct FakeServer {
    /// Where it listens.
    pub port: u16,
    requests: Arc<Mutex<Vec<String>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl FakeServer {
    /// Answers each request body with the bytes that `answer` returns. Questions to `$ztl` are refused, as by
    /// the original.
    #[track_caller]
    pub fn start(mut answer: impl FnMut(&str) -> Vec<u8> + Send + 'static) -> Self {
        Self::with_questions(move |request| match request.starts_with("$ztl;") {
            true => b"$ztl;2;-1;No controller for scope: $ztl".to_vec(),
            false => answer(request),
        })
    }

    /// The same, but `answer` answers the questions to `$ztl` too.
    #[track_caller]
    pub fn with_questions(mut answer: impl FnMut(&str) -> Vec<u8> + Send + 'static) -> Self {
        let socket = zmq::Context::new().socket(zmq::REP).expect("a socket");
        socket.set_linger(0).expect("an option");
        socket.set_rcvtimeo(LOOK_AGAIN).expect("an option");
        socket.bind("tcp://127.0.0.1:*").expect("a free port");
        let endpoint = socket.get_last_endpoint().expect("it is bound");
        let endpoint = endpoint.expect("UTF-8");
        let requests = Arc::new(Mutex::new(Vec::new()));
        let stop = Arc::new(AtomicBool::new(false));
        let (seen, stopped) = (Arc::clone(&requests), Arc::clone(&stop));
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                let Ok(body) = socket.recv_bytes(0) else {
                    continue;
                };
                let body = String::from_utf8_lossy(&body).into_owned();
                let reply = answer(&body);
                if !body.starts_with("$ztl;") {
                    let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
                    seen.push(body);
                }
                socket.send(reply, 0).expect("a client that listens");
            }
        });
        Self {
            port: port_of(&endpoint),
            requests,
            stop,
            thread: Some(thread),
        }
    }

    /// Answers an INIT, a STATUS and an ABORT with these fields behind the scope.
    #[track_caller]
    pub fn answering(init: &str, status: &str, abort: &str) -> Self {
        let answers = [init, status, abort].map(str::to_owned);
        Self::start(move |request| {
            let mut fields = request.split(';');
            let scope = fields.next().unwrap_or_default();
            let code: usize = fields
                .next()
                .and_then(|code| code.parse().ok())
                .unwrap_or(1);
            format!("{scope};{}", answers[code - 1]).into_bytes()
        })
    }

    /// Its ZeroMQ address.
    #[must_use]
    pub fn endpoint(&self) -> String {
        format!("tcp://127.0.0.1:{}", self.port)
    }

    /// The bodies of the requests so far, without questions to `$ztl`.
    #[must_use]
    pub fn requests(&self) -> Vec<String> {
        let requests = self.requests.lock();
        requests.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// How many of them were INITs.
    #[must_use]
    pub fn inits(&self) -> usize {
        let is_init = |request: &&String| request.split(';').nth(1) == Some("1");
        self.requests().iter().filter(is_init).count()
    }
}

impl Drop for FakeServer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A test that panics already has its own message.
            let _ = thread.join();
        }
    }
}
