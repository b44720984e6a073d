//! How a request goes out and its answer comes back, over a connection that may have to be made.

use std::time::{Duration, Instant};

use tracing::warn;
use ztl_core::State;
use ztl_core::client::{Answer, Client, Heard, Late, Server};
use ztl_core::envelope::Envelope;
use ztl_core::sink::Sink;

use super::{LOG, RemoteId, RemoteTask, RequestError, Status, version_of};
use crate::endpoint::check_port;
use crate::frames;
use crate::time::now;

/// Pauses between two tries to connect to a server that is not there: from, and at most.
const RETRY: (i32, i32) = (20, 1000);

/// How often it is asked whether a request is still wanted: soon enough for whoever has pressed Ctrl-C.
const ASK_WANTED: Duration = Duration::from_millis(50);

/// What encryption adds to a message, in bytes (RFC 26, MESSAGE: a name, a nonce, a signature, flags).
const ENCRYPTION: usize = 8 + 8 + 16 + 1;

/// Bytes that the original's answer to an INIT has for one of the INIT, at most: it quotes the goal as
/// Python writes it.
const QUOTED: usize = 4;

/// How many answers wait to be read, at most: that to the request under way, and one that came too late.
const ANSWERS: i32 = 2;

/// Whether a request is still wanted; `None` for one that is in any case.
pub(super) type Wanted<'a> = Option<&'a dyn Fn() -> bool>;

impl RemoteTask {
    pub(super) fn open(&self) -> Result<zmq::Socket, zmq::Error> {
        check_port(&self.endpoint)?;
        let socket = self.context.socket(zmq::DEALER)?;
        socket.set_linger(0)?;
        // Nothing is queued for a server that is not there: it would act on it when it comes.
        socket.set_immediate(true)?;
        socket.set_maxmsgsize(i64::try_from(self.takes).unwrap_or(i64::MAX))?;
        // One request is under way at a time, so that a server cannot fill the memory with answers.
        socket.set_rcvhwm(ANSWERS)?;
        // A server that comes back is not met by all its clients in the same moment.
        socket.set_reconnect_ivl(RETRY.0)?;
        socket.set_reconnect_ivl_max(RETRY.1)?;
        if let Some((own, server)) = &self.keys {
            socket.set_curve_publickey(own.public().as_bytes())?;
            socket.set_curve_secretkey(own.secret())?;
            socket.set_curve_serverkey(server.as_bytes())?;
        }
        // RFC 6761: this name is this machine, also where no file of the system says so, as in an
        // empty root. ZeroMQ would ask a name server that is not there.
        match self.endpoint.strip_prefix("tcp://localhost:") {
            Some(port) => socket.connect(&format!("tcp://127.0.0.1:{port}"))?,
            None => socket.connect(&self.endpoint)?,
        }
        Ok(socket)
    }

    /// Connects, and asks a server that was not met yet who it is.
    pub(super) fn meet(&mut self, wanted: Wanted<'_>) -> Result<(), RequestError> {
        if self.socket.is_none() || !self.met {
            let mut body = Vec::new();
            let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
            // However long a message may be: it is this that learns it.
            let envelope = self.client.probe(now(), &mut sink);
            let said = self.exchange(wanted, envelope, &body);
            if let Said::Task(Status { text, .. }) = said.map_err(|unanswered| unanswered.error)? {
                self.version = version_of(&text);
            }
            self.met = true;
        }
        Ok(())
    }

    /// Makes the connection fit for an INIT of so many bytes: the server is asked anew how long a message it
    /// takes, since what it said may be true of an earlier start of it; and the answer of an original's server,
    /// which takes any, has to be taken here.
    pub(super) fn make_room(
        &mut self,
        wanted: Wanted<'_>,
        length: usize,
    ) -> Result<(), RequestError> {
        let answer = length.saturating_mul(QUOTED);
        let quotes = self.client.server() == Server::Original && answer > self.takes;
        if quotes {
            self.takes = answer;
            self.socket = None;
        }
        if quotes || self.most().is_some_and(|most| length > most) {
            self.met = false;
            self.meet(wanted)?;
        }
        Ok(())
    }

    /// The longest message that can be sent, in bytes, where the server tells one.
    fn most(&self) -> Option<usize> {
        let most = usize::try_from(self.client.longest_message()?).ok()?;
        Some(match self.keys {
            Some(_) => most.saturating_sub(ENCRYPTION),
            None => most,
        })
    }

    pub(super) fn ask_outcome(&mut self) -> Result<Said, Unanswered> {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        match self.client.outcome(now(), &mut sink) {
            Some(envelope) => self.exchange(None, envelope, &body),
            None => Err(self.no_answer(Instant::now()).into()),
        }
    }

    /// Sends one request and waits for its answer.
    pub(super) fn ask(
        &mut self,
        request: impl FnOnce(&mut Client, &str, &mut dyn Sink) -> Envelope,
    ) -> Result<Said, Unanswered> {
        self.ask_while(None, request)
    }

    /// The same for as long as it is wanted.
    pub(super) fn ask_while(
        &mut self,
        wanted: Wanted<'_>,
        request: impl FnOnce(&mut Client, &str, &mut dyn Sink) -> Envelope,
    ) -> Result<Said, Unanswered> {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let envelope = request(&mut self.client, &self.scope, &mut sink);
        self.fits(body.len())?;
        self.exchange(wanted, envelope, &body)
    }

    /// How many bytes the INIT of this task has.
    pub(super) const fn init_length(&self, payload: &str) -> usize {
        self.scope.len() + ";1;-1;".len() + payload.len()
    }

    /// Whether the server would take the INIT of this task, as far as it told how long one may be.
    pub fn takes_length_of(&self, payload: &str) -> Result<(), RequestError> {
        self.fits(self.init_length(payload))
    }

    /// # Errors
    /// A message of so many bytes is too long: the server would only end the connection.
    fn fits(&self, bytes: usize) -> Result<(), RequestError> {
        match self.most() {
            Some(most) if bytes > most => Err(RequestError::TooLong {
                endpoint: self.endpoint.clone(),
                bytes,
                most,
            }),
            _ => Ok(()),
        }
    }

    fn exchange(
        &mut self,
        wanted: Wanted<'_>,
        envelope: Envelope,
        body: &[u8],
    ) -> Result<Said, Unanswered> {
        let start = Instant::now();
        let socket = match self.socket.take() {
            Some(socket) => socket,
            None => {
                // Another connection may lead to another server.
                self.met = false;
                self.open()?
            }
        };
        let said = self.converse(wanted, &socket, start, envelope, body);
        match &said {
            Ok(_) => self.socket = Some(socket),
            // Nothing was sent, so nothing late can come: it goes on trying, ever more slowly.
            Err(Unanswered {
                error: RequestError::NotConnected { .. },
                ..
            }) => {
                self.met = false;
                self.socket = Some(socket);
            }
            // What is still on its way in this socket is dropped with it.
            Err(_) => {}
        }
        if let Err(Unanswered { error, .. }) = &said {
            warn!(target: LOG, "Networking error, disconnecting: {error}");
        }
        said
    }

    fn converse(
        &mut self,
        wanted: Wanted<'_>,
        socket: &zmq::Socket,
        start: Instant,
        envelope: Envelope,
        asked: &[u8],
    ) -> Result<Said, Unanswered> {
        if self.ready(wanted, socket, zmq::POLLOUT)? != Ready::Yes {
            return Err(Unanswered::from(RequestError::NotConnected {
                endpoint: self.endpoint.clone(),
                waited: start.elapsed(),
            }));
        }
        let (client, number) = envelope.frames();
        let frames: [&[u8]; 4] = [&client, &number, b"", asked];
        frames::send(socket, &frames)?;
        loop {
            match self.ready(wanted, socket, zmq::POLLIN)? {
                Ready::Yes => {}
                Ready::Late => break,
                Ready::Unwanted => {
                    return Err(Unanswered {
                        outcome: true,
                        error: self.no_answer(start),
                    });
                }
            }
            let frames = frames::receive(socket)?;
            let [client, number, _delimiter, body] = frames.as_slice() else {
                continue;
            };
            // Anything else answers an earlier request, which has been given up.
            if let Some(envelope) = Envelope::parse(client, number)
                && let Some(heard) = self.client.handle_reply(envelope, asked, body)
            {
                return self.said(heard, body, start);
            }
        }
        let late = self.client.handle_timeout(now());
        Err(Unanswered {
            outcome: late == Late::AskOutcome,
            error: self.no_answer(start),
        })
    }

    fn said(&self, heard: Heard<'_>, body: &[u8], start: Instant) -> Result<Said, Unanswered> {
        let answer = match heard {
            Heard::Answer(answer) => answer,
            Heard::NeverStarted => return Ok(Said::NeverStarted),
            Heard::FateUnknown => return Err(self.no_answer(start).into()),
            Heard::Unreadable => {
                let answer = String::from_utf8_lossy(body).into_owned();
                return Ok(Said::Unclear(RequestError::Unreadable { answer }));
            }
        };
        let text = answer.text().to_owned();
        Ok(match answer {
            Answer::Accepted { id, ended, .. } => Said::Accepted {
                id: id.into(),
                ended,
                text,
            },
            Answer::Refused { id, .. } => Said::Refused {
                id: id.into(),
                text,
            },
            Answer::Task { state, .. } => Said::Task(Status { state, text }),
            Answer::UnknownTask { .. } => Said::UnknownTask { text },
            Answer::UnknownEnd { .. } => Said::Unclear(RequestError::UnknownEnd { text }),
            Answer::OtherTask {
                state, scope, id, ..
            } => Said::Unclear(RequestError::OtherTask {
                state,
                about: format!("task '{id}' of scope '{scope}'"),
                text,
            }),
            Answer::NotTold { state, .. } => Said::Unclear(RequestError::NotTold { state, text }),
            Answer::UndefinedState { state, .. } => Said::Unclear(RequestError::UndefinedState {
                state: state.into(),
                text,
            }),
        })
    }

    fn no_answer(&self, start: Instant) -> RequestError {
        RequestError::NoAnswer {
            endpoint: self.endpoint.clone(),
            waited: start.elapsed(),
        }
    }

    /// Waits until the socket is ready, the request's time has passed, or it is not wanted any more and
    /// there is another way to learn what becomes of it.
    fn ready(
        &self,
        wanted: Wanted<'_>,
        socket: &zmq::Socket,
        events: zmq::PollEvents,
    ) -> Result<Ready, zmq::Error> {
        let sent = events == zmq::POLLIN;
        loop {
            let unwanted = wanted.is_some_and(|wanted| !wanted());
            // Only the answer tells the id that an original's server has given.
            if unwanted && !(sent && self.client.server() == Server::Original) {
                return Ok(Ready::Unwanted);
            }
            let deadline = self.client.poll_timeout();
            let left = deadline.map_or(Duration::ZERO, |deadline| deadline.since(now()));
            let time = wanted.map_or(left, |_| left.min(ASK_WANTED));
            let millis = i64::try_from(time.as_micros().div_ceil(1000));
            match socket.poll(events, millis.unwrap_or(i64::MAX)) {
                Ok(0) if left.is_zero() => return Ok(Ready::Late),
                Ok(0) | Err(zmq::Error::EINTR) => {}
                Ok(_) => return Ok(Ready::Yes),
                Err(cause) => return Err(cause),
            }
        }
    }
}

/// What came of waiting for a socket.
#[derive(PartialEq)]
enum Ready {
    Yes,
    Late,
    Unwanted,
}

/// What a server said.
pub(super) enum Said {
    /// To an INIT.
    Accepted {
        id: RemoteId,
        ended: Option<State>,
        text: String,
    },
    Refused {
        id: RemoteId,
        text: String,
    },
    NeverStarted,
    /// To any other request.
    Task(Status),
    UnknownTask {
        text: String,
    },
    /// An answer that does not tell what was asked.
    Unclear(RequestError),
}

/// There was no answer.
pub(super) struct Unanswered {
    pub(super) error: RequestError,
    /// It is worth asking what became of it.
    pub(super) outcome: bool,
}

impl From<RequestError> for Unanswered {
    fn from(error: RequestError) -> Self {
        Self {
            error,
            outcome: false,
        }
    }
}

impl From<zmq::Error> for Unanswered {
    fn from(cause: zmq::Error) -> Self {
        RequestError::from(cause).into()
    }
}
