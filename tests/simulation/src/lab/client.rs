//! A client: the real rules of a client, driven by a simulated person.

use std::collections::VecDeque;
use std::time::Duration;

use ztl_core::client::{Answer, Client, Heard, Late, Server};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::integer::Integer;
use ztl_core::sink::Sink;
use ztl_core::{Instant, Request, State, TaskId, TaskSpec};

use super::gateway::{Letter, SCOPE};

/// Timeout of requests, as in the original's client.
const TIMEOUT: Duration = Duration::from_secs(2);
/// Pause between two STATUS requests about a task.
const PAUSE: Duration = Duration::from_millis(120);

/// What a client knows about its task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Known {
    /// No answer yet.
    Asked,
    /// It was rejected, or never arrived and is void.
    Never(String),
    /// Its outcome is unknown: it may run.
    Unknown,
    /// It has this id and no final state yet.
    Open(TaskId),
    /// It has this final state.
    Ended(TaskId, State, String),
    /// It had this id, and a restarted gateway does not know it.
    Forgotten(TaskId),
}

impl Known {
    pub(super) fn id(&self) -> Option<TaskId> {
        match self {
            Self::Open(id) | Self::Ended(id, ..) | Self::Forgotten(id) => Some(*id),
            _ => None,
        }
    }
}

/// A task to start.
#[derive(Debug, Clone)]
pub(super) struct Wish {
    pub(super) task: usize,
    pub(super) device: String,
    pub(super) component: &'static str,
    pub(super) goal: String,
    pub(super) to_end: bool,
}

/// The pending request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Asked {
    Probe,
    Init(usize),
    Status(usize),
    Abort(usize),
}

pub(super) struct Person {
    client: Client,
    wishes: VecDeque<Wish>,
    aborts: VecDeque<(usize, TaskId)>,
    /// Tasks to ask about, with the earliest time.
    watched: VecDeque<(usize, TaskId, Instant)>,
    asked: Option<Asked>,
    /// The body of the last request.
    sent: Vec<u8>,
    /// Whether to probe the server.
    stranger: bool,
    /// Messages to send.
    pub(super) out: Vec<Letter>,
    /// New knowledge about tasks.
    pub(super) news: Vec<(usize, Known)>,
}

impl Person {
    pub(super) fn new(number: usize) -> Self {
        Self {
            client: Client::new(ClientId([number as u8 + 1; 16]), TIMEOUT),
            wishes: VecDeque::new(),
            aborts: VecDeque::new(),
            watched: VecDeque::new(),
            asked: None,
            sent: Vec::new(),
            stranger: true,
            out: Vec::new(),
            news: Vec::new(),
        }
    }

    pub(super) fn wish(&mut self, wish: Wish) {
        self.wishes.push_back(wish);
    }

    pub(super) fn abort(&mut self, task: usize, id: TaskId) {
        self.aborts.push_back((task, id));
    }

    /// Asks for the state of a task until it is final.
    pub(super) fn watch(&mut self, now: Instant, task: usize, id: TaskId) {
        self.watched.push_back((task, id, now));
    }

    /// Handles a reply.
    pub(super) fn handle_reply(&mut self, now: Instant, letter: &Letter) {
        let (envelope, body) = letter;
        let Some(heard) = self.client.handle_reply(*envelope, &self.sent, body) else {
            return;
        };
        let asked = self.asked.take();
        match (asked, heard) {
            (Some(Asked::Init(task)), heard) => self.on_init(now, task, heard),
            (Some(Asked::Status(task)), Heard::Answer(answer)) => self.on_status(now, task, answer),
            (Some(Asked::Probe), _) => {
                let server = self.client.server();
                assert!(matches!(server, Server::Ours { .. }), "{server:?}");
                self.stranger = false;
            }
            (Some(Asked::Abort(_)) | None, _) => {}
            (Some(Asked::Status(task)), heard) => {
                panic!("task {task}: a STATUS is answered by {heard:?}")
            }
        }
    }

    fn on_init(&mut self, now: Instant, task: usize, heard: Heard<'_>) {
        let known = match heard {
            Heard::NeverStarted => Known::Never("it never came".to_owned()),
            Heard::OutcomeUnknown => {
                // The gateway has restarted: probe it.
                self.stranger = true;
                Known::Unknown
            }
            Heard::Unreadable => panic!("task {task}: an INIT is answered by no message"),
            Heard::Answer(Answer::Accepted { id, ended, text }) => {
                // Our servers assign no other ids.
                let id = id.value().and_then(|id| u32::try_from(id).ok());
                let id = id.and_then(TaskId::new).expect("a task id");
                match ended {
                    Some(state) => Known::Ended(id, state, text.to_owned()),
                    None => {
                        self.watch(now, task, id);
                        Known::Open(id)
                    }
                }
            }
            Heard::Answer(answer) => Known::Never(answer.text().to_owned()),
        };
        self.news.push((task, known));
    }

    fn on_status(&mut self, now: Instant, task: usize, answer: Answer<'_>) {
        let Some(place) = self.watched.iter().position(|(known, ..)| *known == task) else {
            return;
        };
        let Some((_, id, _)) = self.watched.remove(place) else {
            return;
        };
        let known = match answer {
            Answer::UnknownTask { .. } => Known::Forgotten(id),
            Answer::Task { state, text } if state.is_final() => {
                Known::Ended(id, state, text.to_owned())
            }
            _ => {
                self.watched.push_back((task, id, now + PAUSE));
                return;
            }
        };
        self.news.push((task, known));
    }

    /// Handles timeouts, and sends the next request.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        match self.client.handle_timeout(now) {
            Late::NotYet => {}
            Late::NoAnswer => match self.asked.take() {
                Some(Asked::Init(task)) => self.news.push((task, Known::Unknown)),
                Some(Asked::Abort(task)) => {
                    if let Some((_, id, _)) = self.watched.iter().find(|(known, ..)| *known == task)
                    {
                        self.aborts.push_back((task, *id));
                    }
                }
                _ => {}
            },
            Late::AskOutcome => self.ask_outcome(now),
        }
        if self.asked.is_none() {
            self.ask(now);
        }
    }

    fn ask_outcome(&mut self, now: Instant) {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        if let Some(envelope) = self.client.outcome(now, &mut sink) {
            self.send(envelope, body);
        } else if let Some(Asked::Init(task)) = self.asked.take() {
            self.news.push((task, Known::Unknown));
        }
    }

    fn ask(&mut self, now: Instant) {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let (asked, envelope) = if self.stranger && !self.wishes.is_empty() {
            (Asked::Probe, self.client.probe(now, &mut sink))
        } else if let Some(wish) = self.wishes.pop_front() {
            let spec = TaskSpec {
                handler: &wish.device,
                component: wish.component,
                goal: &wish.goal,
            };
            let mut payload = vec![0; spec.encoded_len()];
            let payload = spec.encode_into(&mut payload).expect("room");
            let envelope = if wish.to_end {
                self.client.init_to_end(now, SCOPE, payload, &mut sink)
            } else {
                self.client
                    .request(now, Request::Init, SCOPE, None, payload, &mut sink)
            };
            (Asked::Init(wish.task), envelope)
        } else if let Some((task, id)) = self.aborts.pop_front() {
            let envelope = self.about(now, Request::Abort, id, "", &mut sink);
            (Asked::Abort(task), envelope)
        } else if let Some((task, id, _)) = self.due(now) {
            let envelope = self.about(now, Request::Status, id, "wait 200", &mut sink);
            (Asked::Status(task), envelope)
        } else {
            return;
        };
        self.asked = Some(asked);
        self.send(envelope, body);
    }

    fn send(&mut self, envelope: Envelope, body: Vec<u8>) {
        self.sent.clone_from(&body);
        self.out.push((envelope, body));
    }

    fn about(
        &mut self,
        now: Instant,
        request: Request,
        id: TaskId,
        payload: &str,
        sink: &mut impl Sink,
    ) -> Envelope {
        let id = id.to_string();
        let id = Integer::parse(&id).ok();
        self.client.request(now, request, SCOPE, id, payload, sink)
    }

    fn due(&self, now: Instant) -> Option<(usize, TaskId, Instant)> {
        self.watched.iter().find(|(.., at)| *at <= now).copied()
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        if self.asked.is_some() {
            return self.client.poll_timeout();
        }
        self.watched.iter().map(|(.., at)| *at).min()
    }
}

/// The client of an envelope.
pub(super) fn person(envelope: &Envelope) -> usize {
    usize::from(envelope.client.0[0]) - 1
}
