//! Requests that are under way at the same time, over one connection.

use std::borrow::Cow;
use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use ztl_core::client::Client;
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::sink::Sink;
use ztl_core::{Request, State};

use super::{ClientReply, Connection, is_sent, log_failure, random_id};
use crate::client::error::RequestError;
use crate::client::reply_status::{after_abort, status_of};
use crate::client::socket::Socket;
use crate::client::status::Status;
use crate::remote_id::RemoteId;
use crate::time::now;

/// Most requests under way. The next one goes out with each answer, so that neither end waits with full buffers for the
/// other to read.
const MOST: usize = 1000;

/// How soon a lost connection is noticed: the socket then connects again.
const LOOK_AGAIN: Duration = Duration::from_millis(50);

/// The original's payloads.
pub(in crate::client) const STATUS: &str = "status update";
pub(in crate::client) const ABORT: &str = "abort command";

/// What is asked.
#[derive(Debug)]
pub(in crate::client) enum Question {
    /// To stop a task; then its STATUS, because the answer to an ABORT does not contain the result.
    Abort { scope: String, id: RemoteId },
    /// The STATUS of a task whose ABORT had this answer.
    StatusAfter {
        scope: String,
        id: RemoteId,
        answer: Status,
    },
    /// A question about the server itself.
    Server(Cow<'static, str>),
}

impl Question {
    fn write(&self, client: &mut Client, sink: &mut dyn Sink) -> Envelope {
        match self {
            Self::Abort { scope, id } => {
                client.request(now(), Request::Abort, scope, id.integer(), ABORT, sink)
            }
            Self::StatusAfter { scope, id, .. } => {
                client.request(now(), Request::Status, scope, id.integer(), STATUS, sink)
            }
            Self::Server(question) => client.ask(now(), question, sink),
        }
    }

    /// What the reply means, or the next question.
    fn handle(self, reply: Result<ClientReply, RequestError>) -> Result<Answered, Self> {
        match self {
            Self::Abort { scope, id } => match reply.and_then(|reply| status_of(reply, &id)) {
                Ok(answer) if answer.state.is_final() => {
                    Err(Self::StatusAfter { scope, id, answer })
                }
                answered => Ok(answered),
            },
            Self::StatusAfter { id, answer, .. } => {
                let status = reply.and_then(|reply| status_of(reply, &id));
                Ok(after_abort(answer, status))
            }
            Self::Server(_) => Ok(reply.and_then(|reply| status_of(reply, &RemoteId::from(0_i64)))),
        }
    }
}

/// The answer to a request, or why there is none.
type Answered = Result<Status, RequestError>;

/// A request that was sent. The rules allow a client one request at a time, so each has a client of its own.
struct Sent<K> {
    key: K,
    question: Question,
    client: Client,
    body: Vec<u8>,
}

/// Requests that have no answer yet, each with the caller's key.
pub(in crate::client) struct Open<K> {
    unsent: VecDeque<(K, Question)>,
    sent: HashMap<ClientId, Sent<K>>,
    /// When the server was last heard, or was first asked.
    heard: Instant,
    /// How many connections the socket had lost when the requests were sent.
    lost: u64,
}

impl<K> Open<K> {
    pub(in crate::client) fn new() -> Self {
        Self {
            unsent: VecDeque::new(),
            sent: HashMap::new(),
            heard: Instant::now(),
            lost: 0,
        }
    }

    pub(in crate::client) fn ask(&mut self, key: K, question: Question) {
        if self.is_empty() {
            self.heard = Instant::now();
        }
        self.unsent.push_back((key, question));
    }

    pub(in crate::client) fn is_empty(&self) -> bool {
        self.unsent.is_empty() && self.sent.is_empty()
    }
}

impl Connection {
    /// Sends what is not sent yet, and returns answers as soon as there are some, at most after `limit`. When the
    /// connection is lost or the server is silent for the timeout, all requests end with that error. The timeout counts from
    /// the last answer, because the original's server handles one request after the other.
    pub(in crate::client) fn converse_together<K>(
        &mut self,
        open: &mut Open<K>,
        limit: Duration,
    ) -> Vec<(K, Answered)> {
        let mut answered = Vec::new();
        if let Err(error) = self.try_together(open, limit, &mut answered) {
            self.end_together(open, error, &mut answered);
        }
        answered
    }

    /// Ends the requests without an answer, and closes the connection over which they were sent.
    pub(in crate::client) fn close_together<K>(
        &mut self,
        open: &mut Open<K>,
    ) -> Vec<(K, Answered)> {
        let mut answered = Vec::new();
        let error = match &self.socket {
            Some(socket) => self.not_connected(socket, open.heard),
            None => self.no_answer(open.heard),
        };
        if !open.sent.is_empty() {
            self.socket = None;
        }
        self.end_together(open, error, &mut answered);
        answered
    }

    fn end_together<K>(
        &self,
        open: &mut Open<K>,
        error: RequestError,
        answered: &mut Vec<(K, Answered)>,
    ) {
        log_failure(&error);
        let unanswered = self.no_answer(open.heard);
        let sent = open.sent.drain().map(|(_, sent)| sent);
        let sent = sent.map(|sent| (sent.key, sent.question, unanswered.clone()));
        let unsent = open.unsent.drain(..);
        let unsent = unsent.map(|(key, question)| (key, question, error.clone()));
        for (key, question, error) in sent.chain(unsent) {
            let outcome = question.handle(Err(error));
            answered.extend(outcome.ok().map(|outcome| (key, outcome)));
        }
    }

    fn try_together<K>(
        &mut self,
        open: &mut Open<K>,
        limit: Duration,
        answered: &mut Vec<(K, Answered)>,
    ) -> Result<(), RequestError> {
        let until = Instant::now().checked_add(limit);
        let mut socket = self.take_socket()?;
        let done = loop {
            if open.is_empty() || !answered.is_empty() {
                break Ok(());
            }
            match self.turn_together(&mut socket, open, until, answered) {
                Ok(true) => {}
                Ok(false) => break Ok(()),
                Err(error) => break Err(error),
            }
        };
        // Drops the socket with any late answer. Before anything was sent, it keeps trying to connect.
        if done.is_ok() || open.sent.is_empty() {
            self.socket = Some(socket);
        }
        done
    }

    /// Sends or receives one message; returns whether there was time for that.
    fn turn_together<K>(
        &self,
        socket: &mut Socket,
        open: &mut Open<K>,
        until: Option<Instant>,
        answered: &mut Vec<(K, Answered)>,
    ) -> Result<bool, RequestError> {
        if socket.can_receive(Duration::ZERO)? {
            self.receive_together(socket, open, answered)?;
            return Ok(true);
        }
        let is_first = open.sent.is_empty();
        if !is_first && open.lost != socket.lost() {
            // The answers that did not come before are lost with their connection.
            return Err(self.no_answer(open.heard));
        }
        let deadline = open.heard + self.timeout;
        let waiting = until.map_or(deadline, |until| until.min(deadline));
        let left = waiting.saturating_duration_since(Instant::now());
        let sends = open.sent.len() < MOST && !open.unsent.is_empty();
        let ready = match sends {
            true => socket.can_send(left)?,
            false => socket.can_receive(left.min(LOOK_AGAIN))?,
        };
        if ready && sends && (is_first || open.lost == socket.lost()) {
            open.lost = socket.lost();
            self.send_together(socket, open, answered)?;
        }
        let now = Instant::now();
        match ready || now < waiting {
            true => Ok(true),
            false if now < deadline => Ok(false),
            false if is_first => Err(self.not_connected(socket, open.heard)),
            false => Err(self.no_answer(open.heard)),
        }
    }

    fn send_together<K>(
        &self,
        socket: &mut Socket,
        open: &mut Open<K>,
        answered: &mut Vec<(K, Answered)>,
    ) -> Result<(), RequestError> {
        let Some((key, question)) = open.unsent.pop_front() else {
            return Ok(());
        };
        let id = random_id();
        let mut client = Client::new(id, self.timeout);
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let envelope = question.write(&mut client, &mut sink);
        if let Err(error) = self.check_length(body.len()) {
            answered.push((key, Err(error)));
            return Ok(());
        }
        if !is_sent(socket.send(envelope, &body))? {
            open.unsent.push_front((key, question));
            return Ok(());
        }
        let sent = Sent {
            key,
            question,
            client,
            body,
        };
        open.sent.insert(id, sent);
        Ok(())
    }

    fn receive_together<K>(
        &self,
        socket: &mut Socket,
        open: &mut Open<K>,
        answered: &mut Vec<(K, Answered)>,
    ) -> Result<(), RequestError> {
        let frames = socket.receive()?;
        let [client, number, _delimiter, body] = frames.as_slice() else {
            return Ok(());
        };
        let Some(envelope) = Envelope::parse(client, number) else {
            return Ok(());
        };
        // Anything else answers an earlier request, which timed out.
        let Some(mut sent) = open.sent.remove(&envelope.client) else {
            return Ok(());
        };
        let Some(heard) = sent.client.handle_reply(envelope, &sent.body, body) else {
            open.sent.insert(envelope.client, sent);
            return Ok(());
        };
        let reply = self.reply(heard, body, open.heard);
        open.heard = Instant::now();
        match sent
            .question
            .handle(reply.map_err(|unanswered| unanswered.error))
        {
            Ok(outcome) => answered.push((sent.key, outcome)),
            Err(next) => open.unsent.push_back((sent.key, next)),
        }
        Ok(())
    }
}

/// The text of an answer to [`ParallelRequests::ask_server`](crate::ParallelRequests::ask_server); `None` if the server does
/// not know the question.
///
/// # Errors
/// If there is no readable answer.
pub fn server_answer(answered: Answered) -> Result<Option<String>, RequestError> {
    match answered {
        Ok(Status {
            state: State::Completed,
            text,
        }) => Ok(Some(text)),
        Ok(_) => Ok(None),
        Err(error) if error.was_answered() && !matches!(error, RequestError::Unreadable { .. }) => {
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
