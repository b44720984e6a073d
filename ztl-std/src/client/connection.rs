//! A client's connection: sends one request at a time and receives its answer, connecting first if needed.

mod together;

use std::io;
use std::time::{Duration, Instant};

use serde::Deserialize;
use tracing::warn;
use ztl_core::State;
use ztl_core::client::{Answer, Client, Heard, Late, Server};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::goal;
use ztl_core::sink::Sink;

use super::error::RequestError;
use super::socket::Socket;
use super::status::{ServerInfo, Status};
use crate::keys::{KeyPair, PublicKey};
use crate::log_targets::TASKS;
use crate::random;
use crate::remote_id::RemoteId;
use crate::time::now;
use crate::transport::Transport;

pub use together::server_answer;
pub(super) use together::{ABORT, Open, Question, STATUS};

/// Default time limit for an answer, as in the original.
const TIMEOUT: Duration = Duration::from_secs(2);

/// Longest accepted answer in bytes. The original's client takes any, but memory is limited.
const LONGEST_ANSWER: usize = 64 << 20;

/// How often `wanted` is called: soon enough for a person who has pressed Ctrl-C.
const ASK_WANTED: Duration = Duration::from_millis(50);

/// Bytes that encryption adds to a message (RFC 26, MESSAGE: a name, a nonce, a signature, flags).
const ENCRYPTION: usize = 8 + 8 + 16 + 1;

/// Most bytes in the original's answer to an INIT per byte of the INIT: it quotes the goal as Python does.
const QUOTED: usize = 4;

/// Whether a request may still be sent, and whether its answer is still wanted; `None` if both always are.
pub(super) type Wanted<'a> = Option<(&'a dyn Fn() -> bool, &'a dyn Fn() -> bool)>;

/// A connection to one server, and the rules that decide what is sent over it.
pub(super) struct Connection {
    socket: Option<Socket>,
    transport: Transport,
    endpoint: String,
    timeout: Duration,
    /// The client's own keys, and the server's.
    keys: Option<(KeyPair, PublicKey)>,
    client: Client,
    /// Whether the server was probed over the current connection.
    probed: bool,
    /// The server's version, if the server is one of this project.
    version: Option<String>,
    /// Longest accepted answer in bytes.
    longest_answer: usize,
}

impl Connection {
    /// Connects in the background.
    pub(super) fn new(endpoint: &str) -> Result<Self, RequestError> {
        let mut connection = Self {
            socket: None,
            transport: Transport::default(),
            endpoint: endpoint.to_owned(),
            timeout: TIMEOUT,
            keys: None,
            client: Client::new(random_id(), TIMEOUT),
            probed: false,
            version: None,
            longest_answer: LONGEST_ANSWER,
        };
        connection.socket = Some(connection.open()?);
        Ok(connection)
    }

    /// Another client of the same server, which connects when it is first used.
    pub(super) fn another(&self) -> Self {
        Self {
            socket: None,
            transport: self.transport,
            endpoint: self.endpoint.clone(),
            timeout: self.timeout,
            keys: self.keys.clone(),
            client: Client::new(random_id(), self.timeout),
            probed: false,
            version: None,
            longest_answer: self.longest_answer,
        }
    }

    pub(super) fn endpoint(&self) -> &str {
        &self.endpoint
    }

    pub(super) const fn timeout(&self) -> Duration {
        self.timeout
    }

    pub(super) fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
        self.client.set_timeout(timeout);
    }

    /// Sets the keys and connects again.
    pub(super) fn set_keys(&mut self, own: KeyPair, server: PublicKey) -> Result<(), RequestError> {
        self.keys = Some((own, server));
        self.socket = Some(self.open()?);
        Ok(())
    }

    /// Sets the longest accepted answer in bytes and connects again.
    pub(super) fn set_longest_answer(&mut self, bytes: usize) -> Result<(), RequestError> {
        self.longest_answer = bytes;
        self.socket = Some(self.open()?);
        Ok(())
    }

    /// What kind of server it is, if that is known.
    pub(super) const fn server(&self) -> Server {
        self.client.server()
    }

    /// Identifies a server of this project; `None` for any other. `again` probes even if that is known.
    pub(super) fn server_info(&mut self, again: bool) -> Result<Option<ServerInfo>, RequestError> {
        self.probed &= !again;
        self.probe(None)?;
        Ok(match (self.client.server(), &self.version) {
            (Server::Ours { boot }, Some(version)) => Some(ServerInfo {
                version: version.clone(),
                boot,
            }),
            _ => None,
        })
    }

    pub(super) const fn transport(&self) -> Transport {
        self.transport
    }

    /// Sets the transport and connects again.
    pub(super) fn set_transport(&mut self, transport: Transport) -> Result<(), RequestError> {
        self.transport = transport;
        self.socket = Some(self.open()?);
        Ok(())
    }

    fn open(&self) -> Result<Socket, RequestError> {
        let keys = self.keys.as_ref();
        let socket = Socket::open(self.transport, &self.endpoint, keys, self.longest_answer);
        socket.map_err(|error| match error.kind() {
            // The endpoint is not a valid address, or its kind is unsupported.
            io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported => RequestError::Endpoint {
                endpoint: self.endpoint.clone(),
                why: error.to_string(),
            },
            _ => error.into(),
        })
    }

    /// Connects, and asks the server what it is unless that is known.
    pub(super) fn probe(&mut self, wanted: Wanted<'_>) -> Result<(), RequestError> {
        if self.socket.is_none() || !self.probed {
            let mut body = Vec::new();
            let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
            let start = Instant::now();
            // Sent at any length, because its reply reports the longest message.
            let envelope = self.client.probe(now(), &mut sink);
            let said = self.exchange(wanted, start, envelope, &body);
            if let ClientReply::Task(Status { text, .. }) =
                said.map_err(|unanswered| unanswered.error)?
            {
                self.version = version_of(&text);
            }
            self.probed = true;
        }
        Ok(())
    }

    /// Prepares the connection for an INIT of this length. If the INIT exceeds the server's limit, probes the server
    /// again, which may have been restarted with another one. The original has no limit, but its answer must be
    /// accepted here.
    pub(super) fn make_room(
        &mut self,
        wanted: Wanted<'_>,
        length: usize,
    ) -> Result<(), RequestError> {
        let answer = length.saturating_mul(QUOTED);
        let quotes = self.client.server() == Server::Original && answer > self.longest_answer;
        if quotes {
            self.longest_answer = answer;
            self.socket = None;
        }
        if quotes || self.most().is_some_and(|most| length > most) {
            self.probed = false;
            self.probe(wanted)?;
        }
        Ok(())
    }

    /// The longest message that the server accepts, in bytes, if it reports one.
    fn most(&self) -> Option<usize> {
        let most = usize::try_from(self.client.longest_message()?).ok()?;
        Some(match self.keys {
            Some(_) => most.saturating_sub(ENCRYPTION),
            None => most,
        })
    }

    /// Asks what became of the last INIT; `None` if that cannot be learnt.
    pub(super) fn ask_outcome(&mut self) -> Option<Result<ClientReply, Unanswered>> {
        if !matches!(self.client.server(), Server::Ours { .. }) {
            return None;
        }
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let start = Instant::now();
        let envelope = self.client.outcome(now(), &mut sink)?;
        Some(self.exchange(None, start, envelope, &body))
    }

    /// Whether the system discards what it has not delivered yet when the connection is closed, also because the process
    /// ends. An INIT that nobody waits for any more must not arrive later.
    pub(super) fn discard_unsent(&mut self, on: bool) {
        if let Some(socket) = &mut self.socket {
            socket.discard_unsent(on);
        }
    }

    /// Sends one request and waits for its answer.
    pub(super) fn ask(
        &mut self,
        request: impl FnOnce(&mut Client, &mut dyn Sink) -> Envelope,
    ) -> Result<ClientReply, Unanswered> {
        self.ask_while(None, request)
    }

    /// As [`ask`](Self::ask), while the request is wanted.
    pub(super) fn ask_while(
        &mut self,
        wanted: Wanted<'_>,
        request: impl FnOnce(&mut Client, &mut dyn Sink) -> Envelope,
    ) -> Result<ClientReply, Unanswered> {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let start = Instant::now();
        let envelope = request(&mut self.client, &mut sink);
        self.check_length(body.len())?;
        self.exchange(wanted, start, envelope, &body)
    }

    /// Checks a message's length. The server would end the connection if it was too long.
    pub(super) fn check_length(&self, bytes: usize) -> Result<(), RequestError> {
        match self.most() {
            Some(most) if bytes > most => Err(RequestError::TooLong {
                endpoint: self.endpoint.clone(),
                bytes,
                most,
            }),
            _ => Ok(()),
        }
    }

    /// Sends a request whose time runs since `start`, and waits for its answer.
    fn exchange(
        &mut self,
        wanted: Wanted<'_>,
        start: Instant,
        envelope: Envelope,
        body: &[u8],
    ) -> Result<ClientReply, Unanswered> {
        let mut socket = self.take_socket()?;
        let said = self.converse(wanted, &mut socket, start, envelope, body);
        match &said {
            Ok(_) => self.socket = Some(socket),
            // The next request leaves at once, for example an ABORT to a server that hangs. The late answer is recognised by
            // its number.
            Err(Unanswered {
                unwanted: true,
                can_ask_outcome: false,
                error: RequestError::NoAnswer { .. },
            }) => {
                self.socket = Some(socket);
                return said;
            }
            // Nothing was sent, so no late answer can arrive. ZeroMQ keeps trying to connect.
            Err(Unanswered {
                error: RequestError::NotConnected { .. },
                ..
            }) => {
                self.probed = false;
                self.socket = Some(socket);
            }
            // Drops the socket with any late answer.
            Err(_) => {}
        }
        if let Err(Unanswered { error, .. }) = &said {
            log_failure(error);
        }
        said
    }

    fn take_socket(&mut self) -> Result<Socket, RequestError> {
        match self.socket.take() {
            Some(socket) => Ok(socket),
            None => {
                // A new connection may lead to another server.
                self.probed = false;
                self.open()
            }
        }
    }

    fn converse(
        &mut self,
        wanted: Wanted<'_>,
        socket: &mut Socket,
        start: Instant,
        envelope: Envelope,
        asked: &[u8],
    ) -> Result<ClientReply, Unanswered> {
        loop {
            let ready = self.ready(wanted, socket, Wait::ToSend)?;
            if ready != Ready::Yes {
                return Err(Unanswered {
                    unwanted: ready == Ready::Unwanted,
                    ..self.not_connected(socket, start).into()
                });
            }
            if is_sent(socket.send(envelope, asked))? {
                break;
            }
        }
        loop {
            match self.ready(wanted, socket, Wait::ForAnswer)? {
                Ready::Yes => {}
                Ready::Late => break,
                Ready::Unwanted => {
                    return Err(Unanswered {
                        can_ask_outcome: self.client.give_up() == Late::AskOutcome,
                        unwanted: true,
                        ..self.no_answer(start).into()
                    });
                }
            }
            let frames = socket.receive()?;
            if let [client, number, _delimiter, body] = frames.as_slice()
                && let Some(envelope) = Envelope::parse(client, number)
                && let Some(heard) = self.client.handle_reply(envelope, asked, body)
            {
                return self.reply(heard, body, start);
            }
            // Anything else answers an earlier request, which timed out. However much of it comes, the time limit holds.
            if self
                .client
                .poll_timeout()
                .is_none_or(|deadline| deadline <= now())
            {
                break;
            }
        }
        let late = self.client.handle_timeout(now());
        Err(Unanswered {
            can_ask_outcome: late == Late::AskOutcome,
            ..self.no_answer(start).into()
        })
    }

    fn reply(
        &self,
        heard: Heard<'_>,
        body: &[u8],
        start: Instant,
    ) -> Result<ClientReply, Unanswered> {
        let answer = match heard {
            Heard::Answer(answer) => answer,
            Heard::NeverStarted => return Ok(ClientReply::NeverStarted),
            Heard::OutcomeUnknown => return Err(self.no_answer(start).into()),
            Heard::Unreadable => {
                let answer = String::from_utf8_lossy(body).into_owned();
                return Ok(ClientReply::Unclear(RequestError::Unreadable { answer }));
            }
        };
        let text = answer.text().to_owned();
        Ok(match answer {
            Answer::Accepted { id, ended, .. } => ClientReply::Accepted {
                id: id.into(),
                ended,
                text,
            },
            Answer::Rejected { id, .. } => ClientReply::Rejected {
                id: id.into(),
                text,
            },
            Answer::Task { state, .. } => ClientReply::Task(Status { state, text }),
            Answer::UnknownTask { .. } => ClientReply::UnknownTask { text },
            Answer::UnknownOutcome { .. } => {
                ClientReply::Unclear(RequestError::UnknownOutcome { text })
            }
            Answer::OtherTask {
                state, scope, id, ..
            } => ClientReply::Unclear(RequestError::OtherTask {
                state,
                about: format!("task '{id}' of scope '{scope}'"),
                text,
            }),
            Answer::NotTold { state, .. } => {
                ClientReply::Unclear(RequestError::NotTold { state, text })
            }
            Answer::UndefinedState { state, .. } => {
                ClientReply::Unclear(RequestError::UndefinedState {
                    state: state.into(),
                    text,
                })
            }
        })
    }

    fn not_connected(&self, socket: &Socket, start: Instant) -> RequestError {
        RequestError::NotConnected {
            endpoint: self.endpoint.clone(),
            waited: start.elapsed(),
            obstacle: socket.obstacle(),
        }
    }

    pub(super) fn no_answer(&self, start: Instant) -> RequestError {
        RequestError::NoAnswer {
            endpoint: self.endpoint.clone(),
            waited: start.elapsed(),
        }
    }

    /// Waits until the socket is ready, the request times out, or it is no longer wanted.
    fn ready(&self, wanted: Wanted<'_>, socket: &mut Socket, wait: Wait) -> io::Result<Ready> {
        let sent = wait == Wait::ForAnswer;
        let unwanted = || match wanted {
            Some((may_be_sent, _)) if !sent => !may_be_sent(),
            Some((_, wanted)) => !wanted(),
            None => false,
        };
        loop {
            if unwanted() {
                return Ok(Ready::Unwanted);
            }
            let deadline = self.client.poll_timeout();
            let left = deadline.map_or(Duration::ZERO, |deadline| deadline.since(now()));
            let time = wanted.map_or(left, |_| left.min(ASK_WANTED));
            let ready = match wait {
                Wait::ToSend => socket.can_send(time)?,
                Wait::ForAnswer => socket.can_receive(time)?,
            };
            match ready {
                // Waiting may have taken long, above all if the process or the machine was suspended.
                true if !sent && unwanted() => return Ok(Ready::Unwanted),
                true => return Ok(Ready::Yes),
                false if left.is_zero() => return Ok(Ready::Late),
                false => {}
            }
        }
    }
}

/// Whether a message was sent. libzmq may have lost the connection meanwhile, and then has taken nothing.
fn is_sent(sent: io::Result<()>) -> io::Result<bool> {
    match sent {
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(false),
        sent => sent.map(|()| true),
    }
}

fn log_failure(error: &RequestError) {
    warn!(target: TASKS, "Networking error, disconnecting: {error}");
}

/// What a socket is waited for.
#[derive(Clone, Copy, PartialEq)]
enum Wait {
    ToSend,
    ForAnswer,
}

/// Why waiting for a socket ended.
#[derive(PartialEq)]
enum Ready {
    Yes,
    Late,
    Unwanted,
}

/// What a server's answer says.
pub(super) enum ClientReply {
    /// To an INIT.
    Accepted {
        id: RemoteId,
        ended: Option<State>,
        text: String,
    },
    Rejected {
        id: RemoteId,
        text: String,
    },
    NeverStarted,
    /// To any other request.
    Task(Status),
    UnknownTask {
        text: String,
    },
    /// The answer does not say what was asked.
    Unclear(RequestError),
}

/// A request without an answer.
pub(super) struct Unanswered {
    pub(super) error: RequestError,
    /// Whether the server can be asked for the outcome.
    pub(super) can_ask_outcome: bool,
    /// Whether it was no longer wanted.
    pub(super) unwanted: bool,
}

impl From<RequestError> for Unanswered {
    fn from(error: RequestError) -> Self {
        Self {
            error,
            can_ask_outcome: false,
            unwanted: false,
        }
    }
}

impl From<io::Error> for Unanswered {
    fn from(cause: io::Error) -> Self {
        RequestError::from(cause).into()
    }
}

/// The version in the answer to a probe.
fn version_of(answer: &str) -> Option<String> {
    #[derive(Deserialize)]
    struct Probe<'a> {
        version: &'a str,
    }
    let mut scratch = vec![0; 2 * answer.len()];
    let probe: Probe<'_> = goal::from_str_with(answer, &mut scratch).ok()?;
    Some(probe.version.to_owned())
}

fn random_id() -> ClientId {
    let mut id = [0; 16];
    for (to, from) in id.iter_mut().zip(random::bytes()) {
        *to = from;
    }
    ClientId(id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_port_is_not_truncated() {
        assert!(Connection::new("tcp://localhost:65536").is_err());
    }
}
