//! The client: tasks on a server that may be ours or the original's.

mod background;
mod error;
mod guard;

use std::time::{Duration, Instant};

use tracing::{info, warn};
use ztl_core::client::{Answer, Client, Heard, Late, Server};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::sink::Sink;
use ztl_core::{Request, State, TaskId, TaskSpec};

use crate::clock::now;
use crate::keys::{KeyPair, PublicKey, can_encrypt};
use crate::random;
pub use background::{Fate, InBackground};
pub use error::{RequestError, TriggerError, WaitError};
pub use guard::TaskGuard;

/// Default longest time for a server to answer, as the original's.
const TIMEOUT: Duration = Duration::from_secs(2);

/// Pause between two questions about a running task, where the server does not hold the answer.
const PAUSE: Duration = Duration::from_millis(50);

/// Longest time that a server of ours is asked to hold the answer to a STATUS.
const HELD: Duration = Duration::from_millis(1000);

/// The same when somebody wants to see the progress.
const HELD_FOR_PROGRESS: Duration = Duration::from_millis(100);

/// Pauses between two tries to connect to a server that is not there: from, and at most.
const RETRY: (i32, i32) = (20, 1000);

/// How often it is asked what became of an INIT, each time over a new connection.
const OUTCOMES: u32 = 3;

/// Name under which the original logs.
const LOG: &str = "remote-task";

/// Tasks on one scope of one server.
///
/// The rules are [`ztl_core::client`]'s: a late answer is never taken for the next one, nothing is
/// sent to a server that is not connected, and an INIT is never sent twice. When its answer does not
/// come, a server of ours is asked what it was; else it is *unknown*, which is an error of its own
/// and never a state.
///
/// One is for one thread at a time; a [`clone`](Clone::clone) is another client of the same server,
/// which connects when it is used first.
pub struct RemoteTask {
    context: zmq::Context,
    socket: Option<zmq::Socket>,
    endpoint: String,
    scope: String,
    timeout: Duration,
    /// One's own keys, and the server's.
    keys: Option<(KeyPair, PublicKey)>,
    client: Client,
    /// Whether the server at the other end of the present connection has been asked who it is.
    met: bool,
    /// What it said, if it is ours.
    version: Option<String>,
}

/// Who a server of ours is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerInfo {
    /// Its version.
    pub version: String,
    /// Differs from start to start of the server.
    pub boot: u32,
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

impl RemoteTask {
    /// A client of `scope` at the server `endpoint`: `tcp://localhost:12345`. The server need not
    /// be there yet.
    ///
    /// # Errors
    /// [`RequestError::Transport`] when the endpoint is no ZeroMQ address.
    pub fn connect(endpoint: &str, scope: &str) -> Result<Self, RequestError> {
        Self::connect_in(zmq::Context::new(), endpoint, scope)
    }

    /// The same with ZeroMQ's threads, which several clients may share.
    pub(crate) fn connect_in(
        context: zmq::Context,
        endpoint: &str,
        scope: &str,
    ) -> Result<Self, RequestError> {
        let mut remote = Self {
            context,
            socket: None,
            endpoint: endpoint.to_owned(),
            scope: scope.to_owned(),
            timeout: TIMEOUT,
            keys: None,
            client: Client::new(new_id(), TIMEOUT),
            met: false,
            version: None,
        };
        remote.socket = Some(remote.open()?);
        info!(target: LOG, "Remote task interface initialised at '{endpoint}'.");
        Ok(remote)
    }

    /// Sets the longest time for the server to answer; default 2 s, as the original's.
    #[must_use]
    pub fn with_timeout(mut self, timeout: Duration) -> Self {
        self.timeout = timeout;
        self.client.set_timeout(timeout);
        self
    }

    /// Encrypts with one's own keys, towards the server with this key alone.
    ///
    /// # Errors
    /// [`RequestError::NoCurve`] when this build cannot encrypt.
    pub fn with_keys(mut self, own: KeyPair, server: PublicKey) -> Result<Self, RequestError> {
        if !can_encrypt() {
            return Err(RequestError::NoCurve);
        }
        self.keys = Some((own, server));
        self.socket = Some(self.open()?);
        Ok(self)
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
        self.trigger_payload(&encoded(handler, component, goal))
    }

    /// Asks for a task with a payload that only the server's controller understands.
    ///
    /// # Errors
    /// As [`trigger`](Self::trigger).
    pub fn trigger_payload(&mut self, payload: &str) -> Result<Triggered, TriggerError> {
        let (task, _) = self.init(|client, scope, body| {
            client.request(now(), Request::Init, scope, None, payload, body)
        })?;
        Ok(task)
    }

    /// Asks for a task and waits for it to end, as [`trigger`](Self::trigger) and
    /// [`wait`](Self::wait) do; a quick one in a single round trip.
    ///
    /// # Errors
    /// As those two.
    pub fn run(
        &mut self,
        handler: &str,
        component: &str,
        goal: &str,
        limit: Option<Duration>,
    ) -> Result<Result<Status, WaitError>, TriggerError> {
        let payload = encoded(handler, component, goal);
        let (task, ended) =
            self.init(|client, scope, body| client.init_to_end(now(), scope, &payload, body))?;
        Ok(match ended {
            Some(status) => Ok(status),
            None => self.wait(task.id, limit),
        })
    }

    /// Asks for a task, and for what became of that where no answer comes.
    fn init(
        &mut self,
        request: impl FnOnce(&mut Client, &str, &mut dyn Sink) -> Envelope,
    ) -> Result<(Triggered, Option<Status>), TriggerError> {
        self.meet().map_err(TriggerError::Request)?;
        let mut said = self.ask(request);
        let mut outcomes = 0;
        while let Err(Unanswered { outcome: true, .. }) = said
            && outcomes < OUTCOMES
        {
            outcomes += 1;
            said = self.ask_outcome();
        }
        match said.map_err(|unanswered| TriggerError::Request(unanswered.error))? {
            Said::NeverStarted => Err(TriggerError::NeverCame),
            Said::Answer { state, id, text } => triggered(state, id, text),
        }
    }

    /// Asks where a task is.
    ///
    /// # Errors
    /// As [`RequestError`] says. A task that the server does not know is no error: it says
    /// REJECTED, `Invalid ID`.
    pub fn status(&mut self, id: TaskId) -> Result<Status, RequestError> {
        self.about(Request::Status, id, "status update")
    }

    /// The same with a payload of one's own; to a server of ours, `wait MS` has it hold the answer until the task
    /// ends, at most so many milliseconds (below 2000).
    ///
    /// # Errors
    /// As [`status`](Self::status).
    pub fn status_with(&mut self, id: TaskId, payload: &str) -> Result<Status, RequestError> {
        self.about(Request::Status, id, payload)
    }

    /// Asks the server who it is, unless this connection knows that; `None` when it is not one of ours. A server
    /// that was started anew has another `boot`; `anew`: asks in any case.
    ///
    /// # Errors
    /// As [`RequestError`] says.
    pub fn server_info(&mut self, anew: bool) -> Result<Option<ServerInfo>, RequestError> {
        self.met &= !anew;
        self.meet()?;
        Ok(match (self.client.server(), &self.version) {
            (Server::Ours { boot }, Some(version)) => Some(ServerInfo {
                version: version.clone(),
                boot,
            }),
            _ => None,
        })
    }

    /// Asks to stop a task, and says where it is then: ABORTED, or a state that it had already
    /// reached, or ACCEPTED while it is not yet (or cannot be) stopped.
    ///
    /// # Errors
    /// As [`RequestError`] says.
    pub fn abort(&mut self, id: TaskId) -> Result<Status, RequestError> {
        self.about(Request::Abort, id, "abort command")
    }

    /// Asks the server about itself, as `tasks` or `devices`: the answer in JSON, or `None` where it
    /// does not know the question (the original knows none).
    ///
    /// # Errors
    /// As [`RequestError`] says.
    pub fn ask_server(&mut self, question: &str) -> Result<Option<String>, RequestError> {
        let said = self.ask(|client, _, body| client.ask(now(), question, body));
        match said.map_err(|unanswered| unanswered.error)? {
            Said::Answer { state, text, .. } => {
                let known = State::from_code(state) == Some(State::Completed);
                Ok(known.then_some(text))
            }
            Said::NeverStarted => Ok(None),
        }
    }

    /// Waits for a task to end, at most for `limit`, or for ever.
    ///
    /// A server that does not answer does not end the wait: the task may still run.
    ///
    /// # Errors
    /// [`WaitError`] with what was last known, when the limit has passed; at once when the server
    /// does not know the task.
    pub fn wait(&mut self, id: TaskId, limit: Option<Duration>) -> Result<Status, WaitError> {
        self.wait_held(id, limit, HELD, |_| true)
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
        seen: impl FnMut(&Result<Status, RequestError>) -> bool,
    ) -> Result<Status, WaitError> {
        self.wait_held(id, limit, HELD_FOR_PROGRESS, seen)
    }

    fn wait_held(
        &mut self,
        id: TaskId,
        limit: Option<Duration>,
        held: Duration,
        mut seen: impl FnMut(&Result<Status, RequestError>) -> bool,
    ) -> Result<Status, WaitError> {
        let start = Instant::now();
        let left = |start: Instant| limit.map(|limit| limit.saturating_sub(start.elapsed()));
        // The first question is answered at once, so that the progress is seen at once.
        let mut hold = Duration::ZERO;
        loop {
            let last = if hold.is_zero() {
                self.about(Request::Status, id, "waiting poll")
            } else {
                let payload = format!("wait {}", hold.as_millis());
                self.about(Request::Status, id, &payload)
            };
            let go_on = seen(&last);
            if let Ok(status) = &last
                && status.state.is_final()
            {
                // A server that was started anew: what became of the task nobody knows.
                if *status == unknown_to_server(id) {
                    let last = Err(RequestError::UnknownTask { id });
                    return Err(WaitError { last });
                }
                return Ok(status.clone());
            }
            let left = left(start).unwrap_or(Duration::MAX);
            if !go_on || left.is_zero() {
                return Err(WaitError { last });
            }
            let holds = last.is_ok() && matches!(self.client.server(), Server::Ours { .. });
            let longest = held.min(self.timeout / 2);
            hold = if holds {
                left.min(longest)
            } else {
                Duration::ZERO
            };
            if hold.as_millis() == 0 {
                hold = Duration::ZERO;
                std::thread::sleep(left.min(PAUSE));
            }
        }
    }

    fn open(&self) -> Result<zmq::Socket, zmq::Error> {
        let socket = self.context.socket(zmq::DEALER)?;
        socket.set_linger(0)?;
        // Nothing is queued for a server that is not there: it would act on it when it comes.
        socket.set_immediate(true)?;
        socket.set_maxmsgsize(crate::server::MAX_MESSAGE as i64)?;
        // A server that comes back is not met by all its clients in the same moment.
        socket.set_reconnect_ivl(RETRY.0)?;
        socket.set_reconnect_ivl_max(RETRY.1)?;
        if let Some((own, server)) = &self.keys {
            socket.set_curve_publickey(own.public().as_bytes())?;
            socket.set_curve_secretkey(own.secret())?;
            socket.set_curve_serverkey(server.as_bytes())?;
        }
        socket.connect(&self.endpoint)?;
        Ok(socket)
    }

    fn about(
        &mut self,
        request: Request,
        id: TaskId,
        payload: &str,
    ) -> Result<Status, RequestError> {
        let said = self.ask(|client, scope, body| {
            client.request(now(), request, scope, Some(id), payload, body)
        });
        match said.map_err(|unanswered| unanswered.error)? {
            Said::Answer { state, text, .. } => status(state, text),
            Said::NeverStarted => Err(RequestError::Unreadable {
                answer: String::new(),
            }),
        }
    }

    /// Connects, and asks a server that was not met yet who it is.
    fn meet(&mut self) -> Result<(), RequestError> {
        if self.socket.is_none() || !self.met {
            let said = self.ask(|client, _, body| client.probe(now(), body));
            if let Said::Answer { text, .. } = said.map_err(|unanswered| unanswered.error)? {
                self.version = version_of(&text);
            }
            self.met = true;
        }
        Ok(())
    }

    fn ask_outcome(&mut self) -> Result<Said, Unanswered> {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        match self.client.outcome(now(), &mut sink) {
            Some(envelope) => self.exchange(envelope, &body),
            None => Err(self.no_answer(Instant::now()).into()),
        }
    }

    /// Sends one request and waits for its answer.
    fn ask(
        &mut self,
        request: impl FnOnce(&mut Client, &str, &mut dyn Sink) -> Envelope,
    ) -> Result<Said, Unanswered> {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let envelope = request(&mut self.client, &self.scope, &mut sink);
        self.exchange(envelope, &body)
    }

    fn exchange(&mut self, envelope: Envelope, body: &[u8]) -> Result<Said, Unanswered> {
        let start = Instant::now();
        let socket = match self.socket.take() {
            Some(socket) => socket,
            None => {
                // Another connection may lead to another server.
                self.met = false;
                self.open()?
            }
        };
        let said = self.converse(&socket, start, envelope, body);
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
        socket: &zmq::Socket,
        start: Instant,
        envelope: Envelope,
        body: &[u8],
    ) -> Result<Said, Unanswered> {
        if !self.ready(socket, zmq::POLLOUT)? {
            return Err(Unanswered::from(RequestError::NotConnected {
                endpoint: self.endpoint.clone(),
                waited: start.elapsed(),
            }));
        }
        let (client, number) = envelope.frames();
        let frames: [&[u8]; 4] = [&client, &number, b"", body];
        socket.send_multipart(frames, zmq::DONTWAIT)?;
        while self.ready(socket, zmq::POLLIN)? {
            let frames = socket.recv_multipart(zmq::DONTWAIT)?;
            let [client, number, _delimiter, body] = frames.as_slice() else {
                continue;
            };
            // Anything else answers an earlier request, which has been given up.
            if let Some(envelope) = Envelope::parse(client, number)
                && let Some(heard) = self.client.handle_reply(envelope, body)
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
        match heard {
            Heard::Answer(Answer { state, id, text }) => Ok(Said::Answer {
                state,
                id,
                text: text.to_owned(),
            }),
            Heard::NeverStarted => Ok(Said::NeverStarted),
            Heard::FateUnknown => Err(self.no_answer(start).into()),
            Heard::Unreadable => Err(RequestError::Unreadable {
                answer: String::from_utf8_lossy(body).into_owned(),
            }
            .into()),
        }
    }

    fn no_answer(&self, start: Instant) -> RequestError {
        RequestError::NoAnswer {
            endpoint: self.endpoint.clone(),
            waited: start.elapsed(),
        }
    }

    /// Waits until the socket is ready, or the request's time has passed.
    fn ready(&self, socket: &zmq::Socket, events: zmq::PollEvents) -> Result<bool, zmq::Error> {
        loop {
            let deadline = self.client.poll_timeout();
            let left = deadline.map_or(Duration::ZERO, |deadline| deadline.since(now()));
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

/// What a server said.
enum Said {
    Answer { state: i64, id: i64, text: String },
    NeverStarted,
}

/// There was no answer.
struct Unanswered {
    error: RequestError,
    /// It is worth asking what became of it.
    outcome: bool,
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

impl Clone for RemoteTask {
    fn clone(&self) -> Self {
        Self {
            context: self.context.clone(),
            socket: None,
            endpoint: self.endpoint.clone(),
            scope: self.scope.clone(),
            timeout: self.timeout,
            keys: self.keys.clone(),
            client: Client::new(new_id(), self.timeout),
            met: false,
            version: None,
        }
    }
}

/// The id of a client that is new.
fn new_id() -> ClientId {
    let mut id = [0; 16];
    for (to, from) in id.iter_mut().zip(random::bytes()) {
        *to = from;
    }
    ClientId(id)
}

impl std::fmt::Debug for RemoteTask {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RemoteTask")
            .field("endpoint", &self.endpoint)
            .field("scope", &self.scope)
            .finish_non_exhaustive()
    }
}

/// What a server says of a task that it does not know.
fn unknown_to_server(id: TaskId) -> Status {
    Status {
        state: State::Rejected,
        text: format!("Invalid ID '{id}'"),
    }
}

/// The version in the answer to a probe.
fn version_of(probed: &str) -> Option<String> {
    let (_, rest) = probed.split_once("version: ")?;
    let version = rest.split([',', '}']).next()?;
    Some(version.trim_matches(['\'', '"', ' ']).to_owned())
}

pub(crate) fn encoded(handler: &str, component: &str, goal: &str) -> String {
    let spec = TaskSpec {
        handler,
        component,
        goal,
    };
    let mut payload = Vec::with_capacity(spec.encoded_len());
    spec.put(&mut |bytes: &[u8]| payload.extend_from_slice(bytes));
    // Base64 is ASCII.
    String::from_utf8_lossy(&payload).into_owned()
}

/// What the answer to an INIT says: the task, and its end where that came in its place.
fn triggered(
    state: i64,
    id: i64,
    text: String,
) -> Result<(Triggered, Option<Status>), TriggerError> {
    let Some(task) = u32::try_from(id).ok().and_then(TaskId::new) else {
        return Err(TriggerError::Refused { id, reason: text });
    };
    let ended = State::from_code(state).filter(|state| state.is_final());
    let ended = ended.map(|state| Status {
        state,
        text: text.clone(),
    });
    let task = Triggered {
        id: task,
        reply: text,
    };
    Ok((task, ended))
}

fn status(state: i64, text: String) -> Result<Status, RequestError> {
    match State::from_code(state) {
        Some(state) => Ok(Status { state, text }),
        None => Err(RequestError::Unreadable {
            answer: format!("state {state}: {text}"),
        }),
    }
}
