//! Tasks on one scope of one server.

use std::time::{Duration, Instant};

use tracing::info;
use ztl_core::Request;
use ztl_core::client::{Client, Server};
use ztl_core::envelope::Envelope;
use ztl_core::sink::Sink;

use super::connection::{
    ABORT, ClientReply, Connection, Open, Question, STATUS, Unanswered, Wanted, server_answer,
};
use super::error::{RequestError, RunError, TriggerError, WaitError};
use super::reply_status::{after_abort, status_of, unexpected};
use super::status::{ServerInfo, Status, Triggered};
use crate::keys::{KeyPair, PublicKey};
use crate::log_targets::TASKS;
use crate::remote_id::RemoteId;
use crate::scope;
use crate::task_request::encoded;
use crate::time::now;
use crate::transport::Transport;

/// Pause between two STATUS requests for a running task, if the server does not hold the answer.
const PAUSE: Duration = Duration::from_millis(50);

/// Longest time for which a server is asked to hold the answer to a STATUS.
const HELD: Duration = Duration::from_millis(1000);

/// The same if the caller wants to see the progress.
const HELD_FOR_PROGRESS: Duration = Duration::from_millis(100);

/// How often the outcome of an INIT is asked for, each time over a new connection.
const OUTCOMES: u32 = 3;

/// Tasks on one scope of one server.
///
/// Follows the rules of [`ztl_core::client`]: a late answer is never taken for the next one, nothing is sent to
/// a server that is not connected, and an INIT is never sent twice. If the answer to an INIT does not arrive, a
/// server of this project is asked for its outcome; otherwise the outcome is *unknown*, which is an error of
/// its own and never a state.
///
/// A value is for one thread at a time; a [`clone`](Clone::clone) is another client of the same server, which
/// connects when it is first used.
pub struct RemoteTask {
    pub(super) connection: Connection,
    scope: String,
}

impl RemoteTask {
    /// A client of `scope` at the server `endpoint`, such as `tcp://localhost:12345`. The server need not
    /// be there yet.
    ///
    /// # Errors
    /// [`RequestError::Endpoint`] if the endpoint is not a ZeroMQ address, and [`RequestError::Scope`] if the
    /// scope contains `;`.
    pub fn connect(endpoint: &str, scope: &str) -> Result<Self, RequestError> {
        if let Some(mistake) = scope::cannot_be_asked(scope) {
            return Err(RequestError::Scope(mistake));
        }
        let connection = Connection::new(endpoint)?;
        info!(target: TASKS, "Remote task interface initialised at '{endpoint}'.");
        Ok(Self {
            connection,
            scope: scope.to_owned(),
        })
    }

    /// The server's endpoint.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        self.connection.endpoint()
    }

    /// The scope of its tasks.
    #[must_use]
    pub fn scope(&self) -> &str {
        &self.scope
    }

    /// Sets the time limit for each answer. Default: 2 s, as in the original.
    #[must_use]
    pub fn with_timeout(mut self, timeout: Duration) -> Self {
        self.connection.set_timeout(timeout);
        self
    }

    /// Sets the longest accepted answer in bytes. A server that sends a longer one loses the connection. Default: 64 MiB.
    ///
    /// # Errors
    /// If the system has no more files.
    pub fn with_longest_answer(mut self, bytes: usize) -> Result<Self, RequestError> {
        self.connection.set_longest_answer(bytes)?;
        Ok(self)
    }

    /// Sets how to speak to the server. Default: [`Transport::Native`].
    ///
    /// # Errors
    /// If the system has no more files.
    pub fn with_transport(mut self, transport: Transport) -> Result<Self, RequestError> {
        self.connection.set_transport(transport)?;
        Ok(self)
    }

    /// Encrypts with the client's own keys; only the server with this key is accepted.
    ///
    /// # Errors
    /// [`RequestError::NoCurve`] if the transport is libzmq, and it cannot encrypt.
    pub fn with_keys(mut self, own: KeyPair, server: PublicKey) -> Result<Self, RequestError> {
        if !self.connection.transport().can_encrypt() {
            return Err(RequestError::NoCurve);
        }
        self.connection.set_keys(own, server)?;
        Ok(self)
    }

    /// Starts a task.
    ///
    /// # Errors
    /// [`TriggerError`]. After [`RequestError::NoAnswer`] the task may run.
    pub fn trigger(
        &mut self,
        handler: &str,
        component: &str,
        goal: &str,
    ) -> Result<Triggered, TriggerError> {
        self.trigger_payload(&encoded(handler, component, goal))
    }

    /// Starts a task with a payload of any form.
    ///
    /// # Errors
    /// Those of [`trigger`](Self::trigger).
    pub fn trigger_payload(&mut self, payload: &str) -> Result<Triggered, TriggerError> {
        self.trigger_with(None, payload)
    }

    /// Starts a task while it is `wanted`, which is called several times a second until there is an answer. When the
    /// task is no longer wanted, a server of this project is asked for the outcome at once, so that the task can be
    /// aborted. For the original, this waits for the reply, because nothing else contains the task's id.
    ///
    /// # Errors
    /// Those of [`trigger`](Self::trigger); [`TriggerError::GivenUp`] if the task was no longer wanted before
    /// it was sent.
    pub fn trigger_while(
        &mut self,
        payload: &str,
        wanted: impl Fn() -> bool,
    ) -> Result<Triggered, TriggerError> {
        self.trigger_with(Some((&wanted, &wanted)), payload)
    }

    /// As [`trigger_while`](Self::trigger_while), but the INIT is sent only while it `may_be_sent`, which is called
    /// immediately before.
    ///
    /// # Errors
    /// Those of [`trigger_while`](Self::trigger_while).
    pub fn trigger_before(
        &mut self,
        payload: &str,
        may_be_sent: impl Fn() -> bool,
        wanted: impl Fn() -> bool,
    ) -> Result<Triggered, TriggerError> {
        self.trigger_with(Some((&may_be_sent, &wanted)), payload)
    }

    /// Asks again what became of the last INIT, after [`trigger`](Self::trigger) or a relative of it has got no answer.
    /// `None` if that cannot be learnt: 50 s after the INIT, from a server of the original, or from one that was restarted.
    ///
    /// # Errors
    /// Those of [`trigger`](Self::trigger). After [`RequestError::NoAnswer`], ask again.
    pub fn ask_outcome(&mut self) -> Option<Result<Triggered, TriggerError>> {
        let start = Instant::now();
        let answer = self.connection.ask_outcome()?;
        // Whatever happened to the question: the INIT was sent.
        let answer = answer.map_err(|_| TriggerError::Request(self.connection.no_answer(start)));
        Some(answer.and_then(started).map(|(task, _)| task))
    }

    fn trigger_with(
        &mut self,
        wanted: Wanted<'_>,
        payload: &str,
    ) -> Result<Triggered, TriggerError> {
        let (task, _) = self.init(wanted, payload, |client, scope, body| {
            client.request(now(), Request::Init, scope, None, payload, body)
        })?;
        Ok(task)
    }

    /// Starts a task and waits for its end, as [`trigger`](Self::trigger) and [`wait`](Self::wait) do. A quick
    /// task needs a single round trip.
    ///
    /// # Errors
    /// [`RunError`] with the error of either.
    pub fn run(
        &mut self,
        handler: &str,
        component: &str,
        goal: &str,
        limit: Option<Duration>,
    ) -> Result<Status, RunError> {
        let payload = encoded(handler, component, goal);
        let started = self.init(None, &payload, |client, scope, body| {
            client.init_to_end(now(), scope, &payload, body)
        });
        match started.map_err(RunError::NotStarted)? {
            (_, Some(status)) => Ok(status),
            (task, None) => self.wait(task.id, limit).map_err(RunError::NotEnded),
        }
    }

    /// Sends an INIT; asks for its outcome if it is not answered.
    fn init(
        &mut self,
        wanted: Wanted<'_>,
        payload: &str,
        request: impl FnOnce(&mut Client, &str, &mut dyn Sink) -> Envelope,
    ) -> Result<(Triggered, Option<Status>), TriggerError> {
        let length = self.init_length(payload);
        let connection = &mut self.connection;
        let before = wanted.map(|(may_be_sent, _)| (may_be_sent, may_be_sent));
        let prepared = connection
            .probe(before)
            .and_then(|()| connection.make_room(before, length));
        if let Some((may_be_sent, _)) = wanted
            && !may_be_sent()
        {
            return Err(TriggerError::GivenUp);
        }
        prepared
            .map_err(|error| match error {
                // The INIT was not sent yet.
                RequestError::NoAnswer { endpoint, waited } => RequestError::NotConnected {
                    endpoint,
                    waited,
                    obstacle: None,
                },
                error => error,
            })
            .map_err(TriggerError::Request)?;
        let scope = &self.scope;
        // The original sends a task's id only in this reply, so leaving would lose the task.
        let only_here = connection.server() == Server::Original;
        let wanted =
            wanted.map(|(may_be_sent, wanted)| (may_be_sent, move || only_here || wanted()));
        let wanted = wanted
            .as_ref()
            .map(|(may_be_sent, wanted)| (*may_be_sent, wanted as &dyn Fn() -> bool));
        connection.discard_unsent(true);
        let mut answer = connection.ask_while(wanted, |client, body| request(client, scope, body));
        connection.discard_unsent(false);
        if let Err(unanswered) = &answer
            && unanswered.can_ask_outcome
        {
            // Only an answer settles the outcome. If the question cannot be sent, because the server hangs or is
            // gone, the outcome stays unknown: the INIT was sent.
            let outcome = (0..OUTCOMES).find_map(|_| connection.ask_outcome()?.ok());
            answer = outcome.map_or(answer, Ok);
        }
        match answer {
            Ok(reply) => started(reply),
            Err(Unanswered {
                unwanted: true,
                error: RequestError::NotConnected { .. },
                ..
            }) => Err(TriggerError::GivenUp),
            Err(unanswered) => Err(TriggerError::Request(unanswered.error)),
        }
    }

    /// Asks for a task's status.
    ///
    /// # Errors
    /// [`RequestError`], also if the server answers without telling the task's state.
    pub fn status(&mut self, id: impl Into<RemoteId>) -> Result<Status, RequestError> {
        self.about(Request::Status, &id.into(), STATUS)
    }

    /// Asks for a task's status with a payload. With `wait MS`, a server of this project holds the answer until the
    /// task ends, at most so many milliseconds (below 2000).
    ///
    /// # Errors
    /// Those of [`status`](Self::status).
    pub fn status_with(
        &mut self,
        id: impl Into<RemoteId>,
        payload: &str,
    ) -> Result<Status, RequestError> {
        self.about(Request::Status, &id.into(), payload)
    }

    /// Identifies a server of this project; `None` for any other. A restarted server has another `boot`. `again`
    /// asks even if this connection already knows the server.
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn server_info(&mut self, again: bool) -> Result<Option<ServerInfo>, RequestError> {
        self.connection.server_info(again)
    }

    /// Asks to stop a task, and returns its status: ABORTED, a final state that it had already reached, or
    /// ACCEPTED while it is not stopped yet or cannot be stopped.
    ///
    /// The answer to an ABORT does not contain the result of an ended task, so a STATUS asks for it. If that fails,
    /// the text is `None`. If the STATUS says that the task runs, that counts.
    ///
    /// # Errors
    /// Those of [`status`](Self::status).
    pub fn abort(&mut self, id: impl Into<RemoteId>) -> Result<Status, RequestError> {
        let id = id.into();
        let answer = self.send_abort(&id)?;
        if !answer.state.is_final() {
            return Ok(answer);
        }
        after_abort(answer, self.status(id))
    }

    /// Aborts tasks of the server, in any scope, at the same time: sends all ABORTs, up to 1,000, before it waits for an
    /// answer, over one connection. Calls `told` with the position of each task and what [`abort`](Self::abort) returns, as
    /// soon as that is known. The original's server and a device that serves ZeroMQ answer an ABORT before they take the
    /// next one, so the time limit counts from the last answer.
    pub fn abort_all(
        &mut self,
        tasks: &[(String, RemoteId)],
        mut told: impl FnMut(usize, Result<Status, RequestError>),
    ) {
        let mut open = Open::new();
        for (at, (scope, id)) in tasks.iter().enumerate() {
            match scope::cannot_be_asked(scope) {
                Some(mistake) => told(at, Err(RequestError::Scope(mistake))),
                None => {
                    let (scope, id) = (scope.clone(), id.clone());
                    open.ask(at, Question::Abort { scope, id });
                }
            }
        }
        while !open.is_empty() {
            let answers = self.connection.converse_together(&mut open, Duration::MAX);
            for (at, outcome) in answers {
                told(at, outcome);
            }
        }
    }

    /// Sends an ABORT and returns its answer. The text says whether the ABORT stopped the task (`True` or
    /// `False`).
    ///
    /// # Errors
    /// Those of [`status`](Self::status).
    pub fn send_abort(&mut self, id: impl Into<RemoteId>) -> Result<Status, RequestError> {
        self.about(Request::Abort, &id.into(), ABORT)
    }

    /// Asks the server about itself, for example `tasks` or `devices`. Returns the answer in JSON, or `None` if the
    /// server does not know the question (the original knows none).
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn ask_server(&mut self, question: &str) -> Result<Option<String>, RequestError> {
        let connection = &mut self.connection;
        let answer = connection.ask(|client, body| client.ask(now(), question, body));
        let answer = answer.map_err(|unanswered| unanswered.error);
        server_answer(answer.and_then(|reply| status_of(reply, &RemoteId::from(0_i64))))
    }

    /// Checks whether the server would accept the INIT of this payload, as far as it told its longest message.
    ///
    /// # Errors
    /// [`RequestError::TooLong`].
    pub fn check_length(&self, payload: &str) -> Result<(), RequestError> {
        self.connection.check_length(self.init_length(payload))
    }

    const fn init_length(&self, payload: &str) -> usize {
        self.scope.len() + ";1;-1;".len() + payload.len()
    }

    /// Waits for a task's end, at most for `limit`, or forever.
    ///
    /// A server that does not answer does not end the wait, since the task may still run.
    ///
    /// # Errors
    /// [`WaitError`] with the last known status after `limit`; at once if the server answers without telling the
    /// task's state.
    pub fn wait(
        &mut self,
        id: impl Into<RemoteId>,
        limit: Option<Duration>,
    ) -> Result<Status, WaitError> {
        self.wait_held(&id.into(), limit, (HELD, None), |_| true)
    }

    /// As [`wait`](Self::wait); calls `seen` with each answer, or with the error if there is none. If it returns
    /// `false`, the wait ends.
    ///
    /// # Errors
    /// Those of [`wait`](Self::wait), also if `seen` ended it.
    pub fn wait_with(
        &mut self,
        id: impl Into<RemoteId>,
        limit: Option<Duration>,
        seen: impl FnMut(&Result<Status, RequestError>) -> bool,
    ) -> Result<Status, WaitError> {
        self.wait_held(&id.into(), limit, (HELD_FOR_PROGRESS, None), seen)
    }

    /// As [`wait_with`](Self::wait_with) while the end is `wanted`, which is called several times a second. The wait then
    /// ends at once, also if the server does not answer, and over the same connection the next request leaves at once, such as an
    /// ABORT.
    ///
    /// # Errors
    /// Those of [`wait`](Self::wait), also if the end is no longer wanted.
    pub fn wait_while(
        &mut self,
        id: impl Into<RemoteId>,
        limit: Option<Duration>,
        wanted: impl Fn() -> bool,
        mut seen: impl FnMut(&Result<Status, RequestError>),
    ) -> Result<Status, WaitError> {
        let held = (HELD_FOR_PROGRESS, Some((&wanted as _, &wanted as _)));
        self.wait_held(&id.into(), limit, held, |answer| {
            seen(answer);
            wanted()
        })
    }

    fn wait_held(
        &mut self,
        id: &RemoteId,
        limit: Option<Duration>,
        (held, wanted): (Duration, Wanted<'_>),
        mut seen: impl FnMut(&Result<Status, RequestError>) -> bool,
    ) -> Result<Status, WaitError> {
        let start = Instant::now();
        let left = |start: Instant| limit.map(|limit| limit.saturating_sub(start.elapsed()));
        // The first STATUS is answered at once, so that the progress is seen at once.
        let mut hold = Duration::ZERO;
        loop {
            let last = if hold.is_zero() {
                self.about_while(wanted, Request::Status, id, "waiting poll")
            } else {
                let payload = format!("wait {}", hold.as_millis());
                self.about_while(wanted, Request::Status, id, &payload)
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
            let holds = last.is_ok() && matches!(self.connection.server(), Server::Ours { .. });
            let longest = held.min(self.connection.timeout() / 2);
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
        self.about_while(None, request, id, payload)
    }

    fn about_while(
        &mut self,
        wanted: Wanted<'_>,
        request: Request,
        id: &RemoteId,
        payload: &str,
    ) -> Result<Status, RequestError> {
        let (connection, scope) = (&mut self.connection, &self.scope);
        let answer = connection.ask_while(wanted, |client, body| {
            client.request(now(), request, scope, id.integer(), payload, body)
        });
        status_of(answer.map_err(|unanswered| unanswered.error)?, id)
    }
}

/// The task in the reply to an INIT, and its status if it has ended.
fn started(reply: ClientReply) -> Result<(Triggered, Option<Status>), TriggerError> {
    match reply {
        ClientReply::NeverStarted => Err(TriggerError::NeverCame),
        ClientReply::Accepted { id, ended, text } => {
            let status = ended.map(|state| Status {
                state,
                text: text.clone(),
            });
            Ok((Triggered { id, reply: text }, status))
        }
        ClientReply::Rejected { id, text } => Err(TriggerError::Rejected { id, reason: text }),
        ClientReply::Unclear(error) => Err(TriggerError::Request(error)),
        ClientReply::Task(Status { text, .. }) | ClientReply::UnknownTask { text } => {
            Err(TriggerError::Request(unexpected(text)))
        }
    }
}

impl Clone for RemoteTask {
    fn clone(&self) -> Self {
        Self {
            connection: self.connection.another(),
            scope: self.scope.clone(),
        }
    }
}

impl std::fmt::Debug for RemoteTask {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RemoteTask")
            .field("endpoint", &self.endpoint())
            .field("scope", &self.scope)
            .finish_non_exhaustive()
    }
}
