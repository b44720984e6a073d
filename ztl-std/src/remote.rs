//! The client: tasks on a server that may be ours or the original's.

mod background;
mod description;
mod error;
mod exchange;
mod guard;
mod id;
mod tasks;

use std::time::{Duration, Instant};

use tracing::info;
use ztl_core::client::{Client, Server};
use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::sink::Sink;
use ztl_core::{Request, State, TaskSpec};

use crate::keys::{KeyPair, PublicKey, can_encrypt};
use crate::random;
use crate::scope;
use crate::time::now;
pub use background::{Fate, InBackground};
pub use description::{Description, Offers};
pub use error::{RequestError, TriggerError, WaitError};
use exchange::{Said, Unanswered, Wanted};
pub use guard::TaskGuard;
pub use id::RemoteId;
pub use tasks::{ServerTask, ServerTasks};

/// Default longest time for a server to answer, as the original's.
const TIMEOUT: Duration = Duration::from_secs(2);

/// Pause between two questions about a running task, where the server does not hold the answer.
const PAUSE: Duration = Duration::from_millis(50);

/// Longest time that a server of ours is asked to hold the answer to a STATUS.
const HELD: Duration = Duration::from_millis(1000);

/// The same when somebody wants to see the progress.
const HELD_FOR_PROGRESS: Duration = Duration::from_millis(100);

/// How often it is asked what became of an INIT, each time over a new connection.
const OUTCOMES: u32 = 3;

/// Longest answer that is taken, in bytes: the original's client takes any, but memory has an end.
const LONGEST_ANSWER: usize = 64 << 20;

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
    /// Longest answer that is taken, in bytes.
    takes: usize,
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
    pub id: RemoteId,
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
    /// [`RequestError::Transport`] when the endpoint is not a ZeroMQ address, and
    /// [`RequestError::Scope`] when the scope contains `;`.
    pub fn connect(endpoint: &str, scope: &str) -> Result<Self, RequestError> {
        Self::connect_in(zmq::Context::new(), endpoint, scope)
    }

    /// The same with ZeroMQ's threads, which several clients may share.
    ///
    /// # Errors
    /// Those of [`connect`](Self::connect).
    pub fn connect_in(
        context: zmq::Context,
        endpoint: &str,
        scope: &str,
    ) -> Result<Self, RequestError> {
        if let Some(mistake) = scope::cannot_be_asked(scope) {
            return Err(RequestError::Scope(mistake));
        }
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
            takes: LONGEST_ANSWER,
        };
        remote.socket = Some(remote.open()?);
        info!(target: LOG, "Remote task interface initialised at '{endpoint}'.");
        Ok(remote)
    }

    /// Where its server is.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// The scope that it asks.
    #[must_use]
    pub fn scope(&self) -> &str {
        &self.scope
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
        let (task, _) = self.init(None, payload, |client, scope, body| {
            client.request(now(), Request::Init, scope, None, payload, body)
        })?;
        Ok(task)
    }

    /// The same for as long as it is `wanted`, which is asked while there is no answer, several times
    /// a second. When it is not wanted any more, a server of ours is asked at once what became of it,
    /// so that the task can be aborted: it is taken, refused, or will never be. The answer of the
    /// original's server is waited for, since nothing else tells the task's id.
    ///
    /// # Errors
    /// As [`trigger`](Self::trigger); [`TriggerError::GivenUp`] when it was not wanted before it was
    /// sent.
    pub fn trigger_while(
        &mut self,
        payload: &str,
        wanted: impl Fn() -> bool,
    ) -> Result<Triggered, TriggerError> {
        let (task, _) = self.init(Some(&wanted), payload, |client, scope, body| {
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
        let (task, ended) = self.init(None, &payload, |client, scope, body| {
            client.init_to_end(now(), scope, &payload, body)
        })?;
        Ok(match ended {
            Some(status) => Ok(status),
            None => self.wait(task.id, limit),
        })
    }

    /// Asks for a task, and for what became of that where no answer comes.
    fn init(
        &mut self,
        wanted: Wanted<'_>,
        payload: &str,
        request: impl FnOnce(&mut Client, &str, &mut dyn Sink) -> Envelope,
    ) -> Result<(Triggered, Option<Status>), TriggerError> {
        let length = self.init_length(payload);
        let met = self
            .meet(wanted)
            .and_then(|()| self.make_room(wanted, length));
        if let Some(wanted) = wanted
            && !wanted()
        {
            return Err(TriggerError::GivenUp);
        }
        met.map_err(|error| match error {
            // The task was not asked for yet.
            RequestError::NoAnswer { endpoint, waited } => {
                RequestError::NotConnected { endpoint, waited }
            }
            error => error,
        })
        .map_err(TriggerError::Request)?;
        let mut said = self.ask_while(wanted, request);
        if matches!(said, Err(Unanswered { outcome: true, .. })) {
            // Only an answer settles what became of the INIT. A question that could not be sent, because the
            // server hangs or is gone, says nothing about it: the INIT was sent.
            let answer = (0..OUTCOMES).find_map(|_| self.ask_outcome().ok());
            said = answer.map_or(said, Ok);
        }
        match said.map_err(|unanswered| TriggerError::Request(unanswered.error))? {
            Said::NeverStarted => Err(TriggerError::NeverCame),
            Said::Accepted { id, ended, text } => {
                let status = ended.map(|state| Status {
                    state,
                    text: text.clone(),
                });
                Ok((Triggered { id, reply: text }, status))
            }
            Said::Refused { id, text } => Err(TriggerError::Refused { id, reason: text }),
            Said::Unclear(error) => Err(TriggerError::Request(error)),
            Said::Task(Status { text, .. }) | Said::UnknownTask { text } => {
                Err(TriggerError::Request(no_answer_to_this(text)))
            }
        }
    }

    /// Asks where a task is.
    ///
    /// # Errors
    /// As [`RequestError`] says: also when the server answers, but does not say where the task is.
    pub fn status(&mut self, id: impl Into<RemoteId>) -> Result<Status, RequestError> {
        self.about(Request::Status, &id.into(), "status update")
    }

    /// The same with a payload of one's own; to a server of ours, `wait MS` has it hold the answer until the task
    /// ends, at most so many milliseconds (below 2000).
    ///
    /// # Errors
    /// As [`status`](Self::status).
    pub fn status_with(
        &mut self,
        id: impl Into<RemoteId>,
        payload: &str,
    ) -> Result<Status, RequestError> {
        self.about(Request::Status, &id.into(), payload)
    }

    /// Asks the server who it is, unless this connection knows that; `None` when it is not one of ours. A server
    /// that was started anew has another `boot`; `anew`: asks in any case.
    ///
    /// # Errors
    /// As [`RequestError`] says.
    pub fn server_info(&mut self, anew: bool) -> Result<Option<ServerInfo>, RequestError> {
        self.met &= !anew;
        self.meet(None)?;
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
    /// The answer to an ABORT does not tell the result of a task that has ended, so a STATUS asks for it. If
    /// its answer does not tell it, the text is `None`; if it says that the task runs, that counts.
    ///
    /// # Errors
    /// As [`status`](Self::status).
    pub fn abort(&mut self, id: impl Into<RemoteId>) -> Result<Status, RequestError> {
        let id = id.into();
        let answer = self.send_abort(&id)?;
        if !answer.state.is_final() {
            return Ok(answer);
        }
        match self.status(id) {
            // Only a STATUS tells whether a failed task may still run.
            Err(error)
                if answer.state == State::Failed
                    || matches!(error, RequestError::UnknownEnd { .. }) =>
            {
                Err(error)
            }
            Ok(told) if told.state == answer.state || !told.state.is_final() => Ok(told),
            _ => Ok(Status {
                state: answer.state,
                text: NOTHING_KNOWN.to_owned(),
            }),
        }
    }

    /// Sends an ABORT, as [`abort`](Self::abort), and returns the answer as it came. Its text says whether the
    /// ABORT stopped the task (`True` or `False`), and not what the result is.
    ///
    /// # Errors
    /// As [`status`](Self::status).
    pub fn send_abort(&mut self, id: impl Into<RemoteId>) -> Result<Status, RequestError> {
        self.about(Request::Abort, &id.into(), "abort command")
    }

    /// Asks the server about itself, as `tasks` or `devices`: the answer in JSON, or `None` where it
    /// does not know the question (the original knows none).
    ///
    /// # Errors
    /// As [`RequestError`] says.
    pub fn ask_server(&mut self, question: &str) -> Result<Option<String>, RequestError> {
        let said = self.ask(|client, _, body| client.ask(now(), question, body));
        match said.map_err(|unanswered| unanswered.error)? {
            Said::Task(Status {
                state: State::Completed,
                text,
            }) => Ok(Some(text)),
            Said::Unclear(error @ RequestError::Unreadable { .. }) => Err(error),
            _ => Ok(None),
        }
    }

    #[cfg(feature = "config")]
    /// Asks the server what it offers; `None` when it is not one of ours.
    ///
    /// # Errors
    /// As [`RequestError`] says.
    pub fn describe(&mut self) -> Result<Option<Description>, RequestError> {
        let Some(answer) = self.ask_server("probe")? else {
            return Ok(None);
        };
        let told = Description::parse(&answer);
        told.map(Some).ok_or(RequestError::Undescribed { answer })
    }

    /// Waits for a task to end, at most for `limit`, or for ever.
    ///
    /// A server that does not answer does not end the wait: the task may still run.
    ///
    /// # Errors
    /// [`WaitError`] with what was last known, when the limit has passed; at once when the server
    /// answers, but does not say where the task is.
    pub fn wait(
        &mut self,
        id: impl Into<RemoteId>,
        limit: Option<Duration>,
    ) -> Result<Status, WaitError> {
        self.wait_held(&id.into(), limit, HELD, |_| true)
    }

    /// As [`wait`](Self::wait); each answer, or its absence, is shown to `seen`, which ends the wait
    /// with `false`.
    ///
    /// # Errors
    /// As [`wait`](Self::wait), also when `seen` ended it.
    pub fn wait_with(
        &mut self,
        id: impl Into<RemoteId>,
        limit: Option<Duration>,
        seen: impl FnMut(&Result<Status, RequestError>) -> bool,
    ) -> Result<Status, WaitError> {
        self.wait_held(&id.into(), limit, HELD_FOR_PROGRESS, seen)
    }

    fn wait_held(
        &mut self,
        id: &RemoteId,
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
            let ends = match &last {
                Ok(status) if status.state.is_final() => return Ok(status.clone()),
                Ok(_) => false,
                Err(error) => error.was_answered(),
            };
            let left = left(start).unwrap_or(Duration::MAX);
            if ends || !go_on || left.is_zero() {
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

    fn about(
        &mut self,
        request: Request,
        id: &RemoteId,
        payload: &str,
    ) -> Result<Status, RequestError> {
        let said = self.ask(|client, scope, body| {
            client.request(now(), request, scope, id.integer(), payload, body)
        });
        match said.map_err(|unanswered| unanswered.error)? {
            Said::Task(status) => Ok(status),
            Said::UnknownTask { text } => Err(RequestError::UnknownTask {
                id: id.clone(),
                text,
            }),
            Said::Unclear(error) => Err(error),
            Said::Accepted { text, .. } | Said::Refused { text, .. } => {
                Err(no_answer_to_this(text))
            }
            Said::NeverStarted => Err(no_answer_to_this(String::new())),
        }
    }
}

/// What would answer another request; [`ztl_core::client`] does not let it happen.
const fn no_answer_to_this(answer: String) -> RequestError {
    RequestError::Unreadable { answer }
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
            takes: self.takes,
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

/// The version in the answer to a probe.
fn version_of(probed: &str) -> Option<String> {
    let (_, rest) = probed.split_once("version: ")?;
    let version = rest.split([',', '}']).next()?;
    Some(version.trim_matches(['\'', '"', ' ']).to_owned())
}

/// The payload of an INIT: the specification in base64.
#[must_use]
pub fn encoded(handler: &str, component: &str, goal: &str) -> String {
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
