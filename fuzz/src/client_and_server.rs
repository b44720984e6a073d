//! A client and a server of this project on a line that delays, repeats and loses messages. The client must learn
//! the true outcome of its INIT.
//!
//! | line | step |
//! |---|---|
//! | `i`, `I` | the client sends an INIT; `I` waits for an early final state |
//! | `o` | it asks for the outcome of its last unanswered INIT |
//! | `s0` | it asks for the state of the first task |
//! | `>0` | the first of the requests on the line arrives; `<0` the first of the answers |
//! | `}0` | the request arrives and stays on the line, to arrive again |
//! | `x0` | the request is lost, `y0` the answer |
//! | `A`, `B` | another client of this project sends an INIT |
//! | `a0 ok` | a handler's event, as in [`dispatcher`](crate::dispatcher): `a` `r` `p` `c` `f` `o`…; here `O` is aborted |
//! | `t1500` | this many milliseconds pass |
//! | `R` | the server restarts, and all connections break |

use core::time::Duration;
use std::collections::BTreeMap;

use ztl_core::client::{Answer, Client, Heard, Server};
use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, KEEP_INIT, TaskEvent};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::integer::Integer;
use ztl_core::memory::Fixed;
use ztl_core::reply::Reply;
use ztl_core::{Instant, Request, State, TaskId};

use crate::script::{number, pick, steps, text};

const OURS: ClientId = ClientId([7; 16]);
const TIMEOUT: Duration = Duration::from_secs(2);

/// Plays a scenario.
pub fn check(script: &[u8]) {
    let mut line = Line::new();
    line.meet();
    for (verb, mut rest) in steps(script) {
        match verb {
            b'i' | b'I' => line.trigger(verb == b'I'),
            b'o' => line.outcome(),
            b's' => line.status(number(&mut rest)),
            b'>' | b'}' | b'x' => line.arrive(verb, number(&mut rest)),
            b'<' | b'y' => line.answer(verb, number(&mut rest)),
            b'A' | b'B' => line.stranger(verb),
            b't' => line.pass(Duration::from_millis(number(&mut rest).min(100_000))),
            b'R' => line.restart(),
            _ => line.event(verb, rest),
        }
    }
}

type Room = Fixed<Envelope, 1, 3, 16, 2>;

/// A message on the line, in its envelope.
type InTransit = (Envelope, Vec<u8>);

/// What a server did with an INIT.
#[derive(Debug, Clone, Copy)]
struct Started {
    id: TaskId,
    boot: u32,
    state: State,
}

/// What the client requested.
#[derive(Debug, Clone)]
enum Asked {
    Init { at: Instant },
    Outcome { of: u64, at: Instant },
    Other,
}

struct Line {
    client: Client,
    server: Dispatcher<Room>,
    boot: u32,
    now: Instant,
    requests: Vec<InTransit>,
    answers: Vec<InTransit>,
    asked: BTreeMap<u64, Asked>,
    /// The bodies of the requests, by number.
    sent: BTreeMap<u64, Vec<u8>>,
    /// The tasks of the client's INITs, by number.
    started: BTreeMap<u64, Started>,
    /// INITs that the server declared void, and when the client had asked. The server keeps that promise for at least
    /// [`KEEP_INIT`].
    void: BTreeMap<u64, Instant>,
    /// Every task of the current server.
    tasks: Vec<TaskId>,
    strangers: u64,
}

impl Line {
    fn new() -> Self {
        let boot = 1;
        Self {
            client: Client::new(OURS, TIMEOUT),
            server: server(boot),
            boot,
            now: Instant::ZERO,
            requests: Vec::new(),
            answers: Vec::new(),
            asked: BTreeMap::new(),
            sent: BTreeMap::new(),
            started: BTreeMap::new(),
            void: BTreeMap::new(),
            tasks: Vec::new(),
            strangers: 0,
        }
    }

    /// Probes the server without faults.
    fn meet(&mut self) {
        let mut body = Vec::new();
        let envelope = self
            .client
            .probe(self.now, &mut |bytes: &[u8]| body.extend_from_slice(bytes));
        self.post(envelope, Asked::Other, body);
        let last = |messages: &[InTransit]| u64::try_from(messages.len() - 1).expect("few");
        self.arrive(b'>', last(&self.requests));
        self.answer(b'<', last(&self.answers));
        assert_eq!(self.client.server(), Server::Ours { boot: self.boot });
    }

    fn trigger(&mut self, to_end: bool) {
        let mut body = Vec::new();
        let sink = &mut |bytes: &[u8]| body.extend_from_slice(bytes);
        let envelope = match to_end {
            true => self.client.init_to_end(self.now, "/lab", "x", sink),
            false => self
                .client
                .request(self.now, Request::Init, "/lab", None, "x", sink),
        };
        self.post(envelope, Asked::Init { at: self.now }, body);
    }

    fn outcome(&mut self) {
        let mut body = Vec::new();
        let sink = &mut |bytes: &[u8]| body.extend_from_slice(bytes);
        if let Some(envelope) = self.client.outcome(self.now, sink) {
            let said = text(&body);
            let (_, of) = said.rsplit_once(' ').expect("a number");
            let of = of.parse().expect("a number");
            self.post(envelope, Asked::Outcome { of, at: self.now }, body);
        }
    }

    fn status(&mut self, wanted: u64) {
        let Some(task) = pick(&self.tasks, wanted).copied() else {
            return;
        };
        let mut body = Vec::new();
        let sink = &mut |bytes: &[u8]| body.extend_from_slice(bytes);
        let id = task.to_string();
        let envelope = self.client.request(
            self.now,
            Request::Status,
            "/lab",
            Integer::parse(&id).ok(),
            "wait 1000",
            sink,
        );
        self.post(envelope, Asked::Other, body);
    }

    fn post(&mut self, envelope: Envelope, asked: Asked, body: Vec<u8>) {
        self.asked.insert(envelope.number, asked);
        self.sent.insert(envelope.number, body.clone());
        self.requests.push((envelope, body));
    }

    fn stranger(&mut self, name: u8) {
        self.strangers += 1;
        let client = ClientId([name; 16]);
        let number = self.strangers;
        let envelope = Envelope {
            client,
            number,
            early_end: false,
        };
        self.requests.push((envelope, b"/lab;1;-1;x".to_vec()));
    }

    /// A request arrives or is lost.
    fn arrive(&mut self, how: u8, wanted: u64) {
        let Some(index) = index(&self.requests, wanted) else {
            return;
        };
        let (envelope, body) = match how {
            b'}' => self.requests[index].clone(),
            _ => self.requests.remove(index),
        };
        if how == b'x' {
            return;
        }
        let Self {
            server,
            now,
            answers,
            ..
        } = self;
        let body = Body::One(&body);
        let mut out = |peer, reply: &Reply<'_>| answers.push((peer, written(reply)));
        let action = server.handle_request(*now, envelope, Some(envelope), body, &mut out);
        if let Some(Action::Start { id, .. }) = action {
            self.tasks.push(id);
            if envelope.client == OURS {
                self.on_start(envelope.number, id);
            }
        }
    }

    fn on_start(&mut self, number: u64, id: TaskId) {
        let void = self.void.get(&number);
        assert!(
            void.is_none_or(|at| self.now.since(*at) >= KEEP_INIT),
            "INIT {number} starts although the server declared it void"
        );
        let state = State::Initiated;
        let started = Started {
            id,
            boot: self.boot,
            state,
        };
        let before = self.started.insert(number, started);
        // A scenario may delay a request for longer than the server keeps INITs.
        let Asked::Init { at } = self.asked[&number] else {
            panic!("{number} is not an INIT");
        };
        let young = self.now.since(at) < KEEP_INIT;
        let again = before.is_some_and(|before| before.boot == self.boot && young);
        assert!(!again, "INIT {number} started twice");
    }

    /// An answer arrives at the client or is lost.
    fn answer(&mut self, how: u8, wanted: u64) {
        let Some(index) = index(&self.answers, wanted) else {
            return;
        };
        let (envelope, body) = self.answers.remove(index);
        if how == b'y' || envelope.client != OURS {
            return;
        }
        let asked = &self.sent[&envelope.number];
        let Some(heard) = self.client.handle_reply(envelope, asked, &body) else {
            return;
        };
        let (init, at) = match self.asked[&envelope.number] {
            Asked::Init { at } => (envelope.number, at),
            Asked::Outcome { of, at } => (of, at),
            Asked::Other => return,
        };
        let started = self.started.get(&init).copied();
        match heard {
            Heard::NeverStarted => {
                let here = started.is_some_and(|started| started.boot == self.boot);
                assert!(!here, "INIT {init} started: {started:?}");
                self.void.insert(init, at);
            }
            Heard::OutcomeUnknown => {}
            Heard::Unreadable => panic!("not a message: {}", text(&body)),
            Heard::Answer(answer) => match answer {
                Answer::Accepted { id, .. } => {
                    let started = started.expect("a started task");
                    let known = Some(i64::from(started.id.get()));
                    assert_eq!(known, id.value(), "another task: {}", text(&body));
                }
                _ => {
                    // Refused: nothing has started, and nothing may start later.
                    let happened = started.filter(|started| started.state != State::Rejected);
                    assert!(happened.is_none(), "told {}, but {happened:?}", text(&body));
                    self.void.insert(init, at);
                }
            },
        }
    }

    fn event(&mut self, verb: u8, mut rest: &[u8]) {
        let wanted = number(&mut rest);
        let Some(id) = pick(&self.tasks, wanted).copied() else {
            return;
        };
        let text = text(rest);
        let (event, state) = match verb {
            b'a' => (TaskEvent::Accepted { reply: &text }, State::Accepted),
            b'r' => (TaskEvent::Rejected { reason: &text }, State::Rejected),
            b'c' => (TaskEvent::Completed { result: &text }, State::Completed),
            b'f' => (TaskEvent::Failed { reason: &text }, State::Failed),
            b'O' => (TaskEvent::Aborted { result: &text }, State::Aborted),
            _ => return,
        };
        let boot = self.boot;
        let here = |started: &&mut Started| started.id == id && started.boot == boot;
        if let Some(started) = self.started.values_mut().find(here) {
            let undecided = started.state == State::Initiated;
            if undecided || (started.state == State::Accepted && state != State::Rejected) {
                started.state = state;
            }
        }
        let Self {
            server,
            now,
            answers,
            ..
        } = self;
        let mut out = |peer, reply: &Reply<'_>| answers.push((peer, written(reply)));
        server.handle_event(*now, id, event, &mut out);
    }

    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        while let Some(wake) = self.server.poll_timeout().filter(|wake| *wake <= end) {
            self.wake(wake.max(self.now));
        }
        self.wake(end);
        let _ = self.client.handle_timeout(end);
    }

    fn wake(&mut self, now: Instant) {
        let Self {
            server, answers, ..
        } = self;
        let mut out = |peer, reply: &Reply<'_>| answers.push((peer, written(reply)));
        server.handle_timeout(now, &mut out);
        self.now = now;
    }

    fn restart(&mut self) {
        self.boot += 1;
        self.server = server(self.boot);
        self.requests.clear();
        self.answers.clear();
        self.tasks.clear();
    }
}

fn server(boot: u32) -> Dispatcher<Room> {
    let first = TaskId::new(boot * 1000).expect("not 0");
    Dispatcher::new(Fixed::new(["/lab"]), Config::new(first, boot))
}

fn index(messages: &[InTransit], wanted: u64) -> Option<usize> {
    let count = u64::try_from(messages.len()).ok()?;
    usize::try_from(wanted.checked_rem(count)?).ok()
}

fn written(reply: &Reply<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    reply.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}
