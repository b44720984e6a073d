//! Requests about several tasks that are under way at the same time, over one connection.

use std::collections::{HashMap, VecDeque};
use std::time::Instant;

use ztl_core::Request;
use ztl_core::client::Client;
use ztl_core::envelope::{ClientId, Envelope};

use super::{ClientReply, Connection, is_sent, log_failure, random_id};
use crate::client::error::RequestError;
use crate::client::socket::Socket;
use crate::remote_id::RemoteId;
use crate::time::now;

/// Most requests under way. The next one goes out with each answer, so that neither end waits with full buffers for the
/// other to read.
const MOST: usize = 1000;

/// The original's payloads.
pub(in crate::client) const STATUS: &str = "status update";
pub(in crate::client) const ABORT: &str = "abort command";

/// A request about a task.
#[derive(Clone, Copy)]
pub(in crate::client) struct TaskQuestion<'a> {
    request: Request,
    scope: &'a str,
    pub(in crate::client) id: &'a RemoteId,
    payload: &'static str,
}

impl<'a> TaskQuestion<'a> {
    pub(in crate::client) const fn abort(scope: &'a str, id: &'a RemoteId) -> Self {
        Self {
            request: Request::Abort,
            scope,
            id,
            payload: ABORT,
        }
    }

    /// A STATUS about the same task.
    pub(in crate::client) const fn then_status(self) -> Self {
        Self {
            request: Request::Status,
            payload: STATUS,
            ..self
        }
    }
}

/// The answer to a request, or why there is none.
type Answered = Result<ClientReply, RequestError>;

/// A request that was sent. The rules allow a client one request at a time, so each has a client of its own.
struct Sent<'a> {
    index: usize,
    question: TaskQuestion<'a>,
    client: Client,
    body: Vec<u8>,
}

/// Requests that have no answer yet.
struct Open<'a> {
    unsent: VecDeque<(usize, TaskQuestion<'a>)>,
    sent: HashMap<ClientId, Sent<'a>>,
    start: Instant,
    /// When the server has been silent for too long. Each answer extends it, because the original's server handles one
    /// request after the other.
    deadline: Instant,
}

impl Connection {
    /// Sends numbered requests without waiting for an answer in between. Calls `answered` with each of them and its answer,
    /// as soon as there is one. It may return another request about the same task.
    pub(in crate::client) fn ask_together<'a>(
        &mut self,
        requests: impl IntoIterator<Item = (usize, TaskQuestion<'a>)>,
        mut answered: impl FnMut(usize, TaskQuestion<'a>, Answered) -> Option<TaskQuestion<'a>>,
    ) {
        let start = Instant::now();
        let mut open = Open {
            unsent: requests.into_iter().collect(),
            sent: HashMap::new(),
            start,
            deadline: start + self.timeout,
        };
        let ended = self.take_socket().and_then(|mut socket| {
            self.converse_together(&mut socket, &mut open, &mut answered)?;
            self.socket = Some(socket);
            Ok(())
        });
        let Err(error) = ended else {
            return;
        };
        log_failure(&error);
        for sent in open.sent.into_values() {
            answered(sent.index, sent.question, Err(self.no_answer(start)));
        }
        for (index, question) in open.unsent {
            answered(index, question, Err(error.clone()));
        }
    }

    fn converse_together<'a>(
        &self,
        socket: &mut Socket,
        open: &mut Open<'a>,
        answered: &mut impl FnMut(usize, TaskQuestion<'a>, Answered) -> Option<TaskQuestion<'a>>,
    ) -> Result<(), RequestError> {
        loop {
            while open.sent.len() < MOST
                && let Some((index, question)) = open.unsent.pop_front()
            {
                match self.send_together(socket, open, index, question) {
                    Ok(()) => {}
                    Err(error @ RequestError::TooLong { .. }) => {
                        answered(index, question, Err(error));
                    }
                    Err(error) => {
                        open.unsent.push_front((index, question));
                        return Err(error);
                    }
                }
            }
            if open.sent.is_empty() {
                return Ok(());
            }
            if !socket.can_receive(open.deadline.saturating_duration_since(Instant::now()))? {
                return Err(self.no_answer(open.start));
            }
            let frames = socket.receive()?;
            let [client, number, _delimiter, body] = frames.as_slice() else {
                continue;
            };
            let Some(envelope) = Envelope::parse(client, number) else {
                continue;
            };
            // Anything else answers an earlier request, which timed out.
            let Some(mut sent) = open.sent.remove(&envelope.client) else {
                continue;
            };
            let Some(heard) = sent.client.handle_reply(envelope, &sent.body, body) else {
                open.sent.insert(envelope.client, sent);
                continue;
            };
            open.deadline = Instant::now() + self.timeout;
            let reply = self.reply(heard, body, open.start);
            let reply = reply.map_err(|unanswered| unanswered.error);
            if let Some(next) = answered(sent.index, sent.question, reply) {
                open.unsent.push_back((sent.index, next));
            }
        }
    }

    fn send_together<'a>(
        &self,
        socket: &mut Socket,
        open: &mut Open<'a>,
        index: usize,
        question: TaskQuestion<'a>,
    ) -> Result<(), RequestError> {
        let id = random_id();
        let mut client = Client::new(id, self.timeout);
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let TaskQuestion {
            request,
            scope,
            id: task,
            payload,
        } = question;
        let envelope = client.request(now(), request, scope, task.integer(), payload, &mut sink);
        self.check_length(body.len())?;
        loop {
            if !socket.can_send(open.deadline.saturating_duration_since(Instant::now()))? {
                return Err(self.not_connected(socket, open.start));
            }
            if is_sent(socket.send(envelope, &body))? {
                break;
            }
        }
        let sent = Sent {
            index,
            question,
            client,
            body,
        };
        open.sent.insert(id, sent);
        Ok(())
    }
}
