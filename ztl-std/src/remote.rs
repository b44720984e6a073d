//! The client: tasks on a server that may be ours or the original's.

use std::time::{Duration, Instant};

use tracing::{info, warn};
use ztl_core::integer::Integer;
use ztl_core::{Message, Request, State, TaskId, TaskSpec};

use crate::random;

/// Default longest time for a server to answer, as the original's.
const TIMEOUT: Duration = Duration::from_secs(2);

/// Pause between two questions of [`RemoteTask::wait`].
const PAUSE: Duration = Duration::from_millis(50);

/// First frame of the envelope, before the client's 16 bytes.
const ENVELOPE: &[u8; 4] = b"ztl1";

/// Name under which the original logs.
const LOG: &str = "remote-task";

/// Tasks on one scope of one server.
///
/// Each request carries a number in a ZeroMQ envelope, which every server returns, so a late answer
/// is never taken for the next one. Nothing is sent to a server that is not connected, and an INIT
/// is never sent twice: what was not answered is *unknown*, which is an error of its own and never
/// a state.
pub struct RemoteTask {
    context: zmq::Context,
    socket: Option<zmq::Socket>,
    endpoint: String,
    scope: String,
    timeout: Duration,
    client: Vec<u8>,
    number: u64,
}

/// A server took a task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Triggered {
    /// Its id there.
    pub id: TaskId,
    /// The server's text.
    pub reply: String,
}

/// What a server says of a task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status {
    /// Where the task is in its life.
    pub state: State,
    /// Progress, result or reason; `None` in words when nothing is known.
    pub text: String,
}

/// Why a request got no answer that could be used.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum RequestError {
    /// No connection within the time: nothing was sent.
    NotConnected {
        /// The server.
        endpoint: String,
        /// How long it was tried.
        waited: Duration,
    },
    /// Sent, and not answered within the time: whether it was acted on is unknown.
    NoAnswer {
        /// The server.
        endpoint: String,
        /// How long it was waited for.
        waited: Duration,
    },
    /// The answer is no ZTL message, or tells a state that does not exist.
    Unreadable {
        /// The answer, as far as it is text.
        answer: String,
    },
    /// ZeroMQ failed.
    Transport(zmq::Error),
}

impl std::fmt::Display for RequestError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotConnected { endpoint, waited } => write!(
                f,
                "no server at {endpoint} (tried for {:.1} s); nothing was sent",
                waited.as_secs_f32()
            ),
            Self::NoAnswer { endpoint, waited } => write!(
                f,
                "no answer from {endpoint} within {:.1} s; whether it acted is unknown",
                waited.as_secs_f32()
            ),
            Self::Unreadable { answer } => write!(f, "the answer is no ZTL message: {answer:?}"),
            Self::Transport(cause) => write!(f, "ZeroMQ: {}", cause.message()),
        }
    }
}

impl std::error::Error for RequestError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Transport(cause) => Some(cause),
            _ => None,
        }
    }
}

impl From<zmq::Error> for RequestError {
    fn from(cause: zmq::Error) -> Self {
        Self::Transport(cause)
    }
}

/// Why a task was not started.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum TriggerError {
    /// The server refused it; nothing was done.
    Refused {
        /// The id of the answer: 0 or below.
        id: i64,
        /// The server's reason.
        reason: String,
    },
    /// There was no usable answer; see there whether it may run.
    Request(RequestError),
}

impl std::fmt::Display for TriggerError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Refused { reason, .. } => write!(f, "refused: {reason}"),
            Self::Request(cause) => cause.fmt(f),
        }
    }
}

impl std::error::Error for TriggerError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Refused { .. } => None,
            Self::Request(cause) => Some(cause),
        }
    }
}

/// The task had not ended when the limit of the wait had passed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WaitError {
    /// What the server said last: `Err` when it did not answer the last question.
    pub last: Result<Status, RequestError>,
}

impl std::fmt::Display for WaitError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.last {
            Ok(status) => write!(f, "still {} ({})", status.state, status.text),
            Err(cause) => write!(f, "unknown: {cause}"),
        }
    }
}

impl std::error::Error for WaitError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.last.as_ref().err().map(|cause| cause as _)
    }
}

/// An answer, taken apart.
struct Answer {
    state: i64,
    id: i64,
    text: String,
}

impl RemoteTask {
    /// A client of `scope` at the server `endpoint`: `tcp://localhost:12345`. The server need not
    /// be there yet.
    ///
    /// # Errors
    /// [`RequestError::Transport`] when the endpoint is no ZeroMQ address.
    pub fn connect(endpoint: &str, scope: &str) -> Result<Self, RequestError> {
        let mut client = ENVELOPE.to_vec();
        client.extend(random::number().to_le_bytes());
        client.extend(random::number().to_le_bytes());
        let mut remote = Self {
            context: zmq::Context::new(),
            socket: None,
            endpoint: endpoint.to_owned(),
            scope: scope.to_owned(),
            timeout: TIMEOUT,
            client,
            number: 0,
        };
        remote.socket = Some(remote.open()?);
        info!(target: LOG, "Remote task interface initialised at '{endpoint}'.");
        Ok(remote)
    }

    /// Sets the longest time for the server to answer; default 2 s, as the original's.
    #[must_use]
    pub fn with_timeout(mut self, timeout: Duration) -> Self {
        self.timeout = timeout;
        self
    }

    /// Asks for a task.
    ///
    /// # Errors
    /// As [`TriggerError`] says. After [`RequestError::NoAnswer`] the task may run.
    pub fn trigger(
        &mut self,
        handler: &str,
        component: &str,
        goal: &str,
    ) -> Result<Triggered, TriggerError> {
        let spec = TaskSpec {
            handler,
            component,
            goal,
        };
        let mut payload = Vec::with_capacity(spec.encoded_len());
        spec.put(&mut |bytes: &[u8]| payload.extend_from_slice(bytes));
        // Base64 is ASCII.
        self.trigger_payload(&String::from_utf8_lossy(&payload))
    }

    /// Asks for a task with a payload that only the server's controller understands.
    ///
    /// # Errors
    /// As [`trigger`](Self::trigger).
    pub fn trigger_payload(&mut self, payload: &str) -> Result<Triggered, TriggerError> {
        let answer = self
            .request(Request::Init, "-1", payload)
            .map_err(TriggerError::Request)?;
        match u32::try_from(answer.id).ok().and_then(TaskId::new) {
            Some(id) => Ok(Triggered {
                id,
                reply: answer.text,
            }),
            None => Err(TriggerError::Refused {
                id: answer.id,
                reason: answer.text,
            }),
        }
    }

    /// Asks where a task is.
    ///
    /// # Errors
    /// As [`RequestError`] says. A task that the server does not know is no error: it says
    /// REJECTED, `Invalid ID`.
    pub fn status(&mut self, id: TaskId) -> Result<Status, RequestError> {
        let answer = self.request(Request::Status, &id.to_string(), "status update")?;
        status(answer)
    }

    /// Asks to stop a task, and says where it is then: ABORTED, or a state that it had already
    /// reached, or ACCEPTED while it is not yet (or cannot be) stopped.
    ///
    /// # Errors
    /// As [`RequestError`] says.
    pub fn abort(&mut self, id: TaskId) -> Result<Status, RequestError> {
        let answer = self.request(Request::Abort, &id.to_string(), "abort command")?;
        status(answer)
    }

    /// Waits for a task to end, at most for `limit`, or for ever.
    ///
    /// A server that does not answer does not end the wait: the task may still run.
    ///
    /// # Errors
    /// [`WaitError`] with what was last known, when the limit has passed.
    pub fn wait(&mut self, id: TaskId, limit: Option<Duration>) -> Result<Status, WaitError> {
        self.wait_with(id, limit, |_| true)
    }

    /// As [`wait`](Self::wait); each answer, or its absence, is shown to `seen`, which ends the wait
    /// with `false`.
    ///
    /// # Errors
    /// As [`wait`](Self::wait), also when `seen` ended it.
    pub fn wait_with(
        &mut self,
        id: TaskId,
        limit: Option<Duration>,
        mut seen: impl FnMut(&Result<Status, RequestError>) -> bool,
    ) -> Result<Status, WaitError> {
        let start = Instant::now();
        loop {
            let last = self.status(id);
            let go_on = seen(&last);
            if let Ok(status) = &last
                && status.state.is_final()
            {
                return Ok(status.clone());
            }
            let left = limit.map(|limit| limit.saturating_sub(start.elapsed()));
            if !go_on || left.is_some_and(|left| left.is_zero()) {
                return Err(WaitError { last });
            }
            std::thread::sleep(left.map_or(PAUSE, |left| left.min(PAUSE)));
        }
    }

    fn open(&self) -> Result<zmq::Socket, zmq::Error> {
        let socket = self.context.socket(zmq::DEALER)?;
        socket.set_linger(0)?;
        // Nothing is queued for a server that is not there: it would act on it when it comes.
        socket.set_immediate(true)?;
        socket.set_maxmsgsize(crate::server::MAX_MESSAGE as i64)?;
        socket.connect(&self.endpoint)?;
        Ok(socket)
    }

    /// Sends one request and waits for its answer.
    fn request(
        &mut self,
        request: Request,
        id: &str,
        payload: &str,
    ) -> Result<Answer, RequestError> {
        let socket = match self.socket.take() {
            Some(socket) => socket,
            None => self.open()?,
        };
        let answer = self.exchange(&socket, request, id, payload);
        match &answer {
            Ok(_) => self.socket = Some(socket),
            // What is still on its way in this socket is dropped with it.
            Err(cause) => warn!(target: LOG, "Networking error, disconnecting: {cause}"),
        }
        answer
    }

    fn exchange(
        &mut self,
        socket: &zmq::Socket,
        request: Request,
        id: &str,
        payload: &str,
    ) -> Result<Answer, RequestError> {
        let start = Instant::now();
        let code = request.code().to_string();
        let message = Message {
            scope: &self.scope,
            state: &code,
            id,
            payload,
        };
        let mut body = Vec::with_capacity(message.encoded_len());
        message.put(&mut |bytes: &[u8]| body.extend_from_slice(bytes));
        self.number += 1;
        let number = self.number.to_be_bytes();
        if !self.ready(socket, zmq::POLLOUT, start)? {
            return Err(RequestError::NotConnected {
                endpoint: self.endpoint.clone(),
                waited: start.elapsed(),
            });
        }
        let frames: [&[u8]; 4] = [&self.client, &number, b"", &body];
        socket.send_multipart(frames, zmq::DONTWAIT)?;
        while self.ready(socket, zmq::POLLIN, start)? {
            let frames = socket.recv_multipart(zmq::DONTWAIT)?;
            // Anything else answers an earlier request, which has been given up.
            if let [client, answered, delimiter, body] = frames.as_slice()
                && (client, answered.as_slice()) == (&self.client, &number)
                && delimiter.is_empty()
            {
                return read(body);
            }
        }
        Err(RequestError::NoAnswer {
            endpoint: self.endpoint.clone(),
            waited: start.elapsed(),
        })
    }

    /// Waits until the socket is ready, or the request's time has passed.
    fn ready(
        &self,
        socket: &zmq::Socket,
        events: zmq::PollEvents,
        start: Instant,
    ) -> Result<bool, zmq::Error> {
        loop {
            let left = self.timeout.saturating_sub(start.elapsed());
            let millis = i64::try_from(left.as_micros().div_ceil(1000)).unwrap_or(i64::MAX);
            match socket.poll(events, millis) {
                Ok(0) if left.is_zero() => return Ok(false),
                Ok(0) | Err(zmq::Error::EINTR) => {}
                Ok(_) => return Ok(true),
                Err(cause) => return Err(cause),
            }
        }
    }
}

impl std::fmt::Debug for RemoteTask {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RemoteTask")
            .field("endpoint", &self.endpoint)
            .field("scope", &self.scope)
            .finish_non_exhaustive()
    }
}

fn read(body: &[u8]) -> Result<Answer, RequestError> {
    let unreadable = || RequestError::Unreadable {
        answer: String::from_utf8_lossy(body).into_owned(),
    };
    let message = Message::parse(body).map_err(|_| unreadable())?;
    let number = |field: Result<Integer<'_>, _>| field.ok().and_then(Integer::value);
    Ok(Answer {
        state: number(message.code()).ok_or_else(unreadable)?,
        id: number(message.number()).ok_or_else(unreadable)?,
        text: message.payload.to_owned(),
    })
}

fn status(answer: Answer) -> Result<Status, RequestError> {
    match State::from_code(answer.state) {
        Some(state) => Ok(Status {
            state,
            text: answer.text,
        }),
        None => Err(RequestError::Unreadable {
            answer: format!("state {}: {}", answer.state, answer.text),
        }),
    }
}
