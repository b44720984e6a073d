//! A server's rules: a request comes in, an answer or something to do comes out.
//!
//! The dispatcher decides every case of the wire specification's table (4.3) and keeps the five
//! rules of the design: a final state never changes, every request is answered exactly once and in
//! bounded time. It has no socket and no clock, and calls no user code.
//!
//! ```
//! use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
//! use ztl_core::{Instant, TaskId, store::Fixed};
//!
//! // One scope, four tasks with results of 32 bytes, two answers held; clients are numbers here.
//! let store = Fixed::<u8, 1, 4, 32, 2>::new(["/lab"]);
//! let mut dispatcher = Dispatcher::new(store, TaskId::new(1).unwrap(), Config::default());
//!
//! let mut answers = Vec::new();
//! let mut out = |client: u8, reply: ztl_core::dispatcher::Reply<'_>| {
//!     let mut text = Vec::new();
//!     reply.put(&mut |bytes: &[u8]| text.extend_from_slice(bytes));
//!     answers.push((client, String::from_utf8(text).unwrap()));
//! };
//! let now = Instant::ZERO;
//! let action = dispatcher.handle_request(now, 9, Body::One(b"/lab;1;-1;open"), &mut out);
//! let Some(Action::Start { id, payload, .. }) = action else { panic!() };
//! assert_eq!(payload, "open");
//! dispatcher.handle_event(now, id, TaskEvent::Accepted { reply: "opening" }, &mut out);
//! dispatcher.handle_event(now, id, TaskEvent::Completed { result: "open" }, &mut out);
//! dispatcher.handle_request(now, 9, Body::One(b"/lab;2;1;"), &mut out);
//! assert_eq!(answers, [(9, "/lab;1;1;opening".into()), (9, "/lab;5;1;open".into())]);
//! ```

use core::time::Duration;

use crate::integer::Integer;
use crate::lifecycle::{Event, Request, State};
use crate::message::Message;
use crate::sink::{Sink, put_decimal};
use crate::store::{Awaited, Full, Scope, Store, Task, Text, Waiter};
use crate::time::earliest;
use crate::{Instant, TaskId};

/// Longest time that the answer to an INIT or an ABORT is held; below the 2 s after which the
/// original's client gives up.
pub const HOLD: Duration = Duration::from_millis(1500);

/// Python's `None`, with which the original fills a text that is not known yet.
pub const NOTHING_KNOWN: &str = "None";

/// What may be chosen about a dispatcher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Config {
    /// Longest time that an answer is held. Default [`HOLD`].
    pub hold: Duration,
    /// How long an ended task is remembered, counted from its end. Default one hour.
    pub keep: Duration,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            hold: HOLD,
            keep: Duration::from_secs(3600),
        }
    }
}

/// The body of a request, as it came over ZeroMQ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Body<'a> {
    /// One frame, as every client sends it.
    One(&'a [u8]),
    /// Several frames, which no client may send (wire specification 2.4).
    Several,
}

/// Something for the handler of a scope to do. The dispatcher expects the outcome in
/// [`handle_event`](Dispatcher::handle_event).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action<'a> {
    /// Start this task, or refuse it.
    Start {
        /// The id it has been given.
        id: TaskId,
        /// Under which scope.
        scope: Scope,
        /// The INIT's payload, as it came.
        payload: &'a str,
    },
    /// Stop this task, or refuse to.
    Abort {
        /// Which.
        id: TaskId,
        /// Under which scope.
        scope: Scope,
    },
}

/// What a handler reports about a task. What no longer changes anything (a second end, progress
/// after the end) is ignored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskEvent<'a> {
    /// The task is taken; `reply` is the INIT's answer.
    Accepted {
        /// Text for the client.
        reply: &'a str,
    },
    /// The task is refused and nothing was done.
    Rejected {
        /// What was wrong, and what would be right.
        reason: &'a str,
    },
    /// The task is refused in the form in which the original reports an exception of its
    /// controller (case H): state 3 and `Controller threw exception: …`.
    Threw {
        /// The exception's message.
        message: &'a str,
    },
    /// Where the task is now; the latest wins.
    Progress {
        /// Text for the client.
        text: &'a str,
    },
    /// The goal is reached.
    Completed {
        /// What came of it.
        result: &'a str,
    },
    /// The goal will not be reached.
    Failed {
        /// Why.
        reason: &'a str,
    },
    /// Stopped as asked.
    Aborted {
        /// Where it stopped, or why.
        result: &'a str,
    },
    /// The task cannot be stopped, and goes on.
    AbortRefused,
}

/// An answer, as a view; [`put`](Self::put) writes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply<'a> {
    scope: &'a str,
    state: State,
    id: ReplyId<'a>,
    text: ReplyText<'a>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ReplyId<'a> {
    Asked(Integer<'a>),
    Task(TaskId),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ReplyText<'a> {
    Plain(&'a str),
    /// A fixed beginning, then what it is about.
    About(&'static str, &'a str),
    InvalidId(Integer<'a>),
    Undecided(TaskId),
}

impl<'a> Reply<'a> {
    fn refusal(scope: &'a str, text: ReplyText<'a>) -> Self {
        Self {
            scope,
            state: State::Rejected,
            id: ReplyId::Asked(Integer::MINUS_ONE),
            text,
        }
    }

    /// The state it tells.
    #[must_use]
    pub fn state(&self) -> State {
        self.state
    }

    /// Writes the message.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        sink.put(self.scope.as_bytes());
        sink.put(b";");
        put_decimal(sink, u32::from(self.state.code()));
        sink.put(b";");
        match self.id {
            ReplyId::Asked(id) => id.put(sink),
            ReplyId::Task(id) => put_decimal(sink, id.get()),
        }
        sink.put(b";");
        match self.text {
            ReplyText::Plain(text) => sink.put(text.as_bytes()),
            ReplyText::About(beginning, about) => {
                sink.put(beginning.as_bytes());
                sink.put(about.as_bytes());
            }
            ReplyText::InvalidId(id) => {
                sink.put(b"Invalid ID '");
                id.put(sink);
                sink.put(b"'");
            }
            ReplyText::Undecided(id) => {
                sink.put(b"Initiated task '");
                put_decimal(sink, id.get());
                sink.put(b"', nobody has taken it yet");
            }
        }
    }
}

/// The rules of a server, over any [`Store`].
///
/// *Inputs*: [`handle_request`](Self::handle_request), [`handle_event`](Self::handle_event),
/// [`handle_timeout`](Self::handle_timeout). *Outputs*: answers through the `out` argument, at once
/// or later; an [`Action`] for the handler. *Next wake-up*: [`poll_timeout`](Self::poll_timeout),
/// to be asked again after each input. A call's work is bounded by the number of held answers.
#[derive(Debug)]
pub struct Dispatcher<S> {
    store: S,
    next: Option<TaskId>,
    config: Config,
}

impl<S: Store> Dispatcher<S> {
    /// A dispatcher that gives ids from `first` on. The start should be random (1 to 2^30), so that
    /// an id from before a restart is nobody else's task.
    pub fn new(store: S, first: TaskId, config: Config) -> Self {
        Self {
            store,
            next: Some(first),
            config,
        }
    }

    /// A request of `peer` has arrived. It is answered through `out` now, or later by an event or
    /// when its time has passed.
    pub fn handle_request<'a>(
        &mut self,
        now: Instant,
        peer: S::Peer,
        body: Body<'a>,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) -> Option<Action<'a>> {
        let bytes = match body {
            Body::One(bytes) => bytes,
            Body::Several => b"",
        };
        let message = match Message::parse(bytes) {
            Ok(message) => message,
            Err(error) => {
                // Case A, and 4.4 for what silenced the original for good.
                let text = ReplyText::Plain("Unknown protocol");
                out(peer, Reply::refusal(error.scope(), text));
                return None;
            }
        };
        let Some(scope) = self.store.scope(message.scope) else {
            let text = ReplyText::About("No controller for scope: ", message.scope);
            out(peer, Reply::refusal(message.scope, text));
            return None;
        };
        let invalid = ReplyText::Plain("Invalid request");
        let (Ok(code), Ok(asked)) = (message.code(), message.number()) else {
            out(peer, Reply::refusal(message.scope, invalid));
            return None;
        };
        match code.value().and_then(Request::from_code) {
            Some(Request::Init) => self.on_init(now, peer, message, scope, out),
            Some(Request::Status) => {
                out(peer, self.status(message.scope, scope, asked));
                None
            }
            Some(Request::Abort) => self.on_abort(now, peer, message.scope, scope, asked, out),
            None => {
                let mut reply = Reply::refusal(message.scope, invalid);
                reply.id = ReplyId::Asked(asked);
                out(peer, reply);
                None
            }
        }
    }

    /// A handler reports what became of a task.
    pub fn handle_event(
        &mut self,
        now: Instant,
        id: TaskId,
        event: TaskEvent<'_>,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) {
        let (event, text) = match event {
            TaskEvent::Accepted { reply } => {
                if self.apply(now, id, Event::Accept, None) {
                    self.answer_decision(id, ReplyText::Plain(reply), out);
                }
                return;
            }
            TaskEvent::Rejected { reason } => {
                self.on_rejected(now, id, State::Rejected, "", reason, out);
                return;
            }
            TaskEvent::Threw { message } => {
                let prefix = "Controller threw exception: ";
                self.on_rejected(now, id, State::Failed, prefix, message, out);
                return;
            }
            TaskEvent::Progress { text } => {
                if let Some(task) = self.store.task_mut(id)
                    && !task.state.is_final()
                {
                    task.text.set(text);
                }
                return;
            }
            TaskEvent::AbortRefused => {
                self.answer_aborts(id, Some("False"), out);
                return;
            }
            TaskEvent::Completed { result } => (Event::Complete, result),
            TaskEvent::Failed { reason } => (Event::Fail, reason),
            TaskEvent::Aborted { result } => (Event::Abort, result),
        };
        if self.apply(now, id, event, Some(text)) {
            self.answer_decision(id, ReplyText::Undecided(id), out);
            self.answer_aborts(id, None, out);
        }
    }

    /// Answers what has been held long enough, and forgets what ended long ago.
    pub fn handle_timeout(&mut self, now: Instant, out: &mut impl FnMut(S::Peer, Reply<'_>)) {
        while let Some(place) = self.store.held().iter().position(|w| w.deadline <= now) {
            let Some(waiter) = self.store.release(place) else {
                break;
            };
            match waiter.awaited {
                Awaited::Decision => {
                    let text = ReplyText::Undecided(waiter.task);
                    self.answer_task(waiter, State::Accepted, text, out);
                }
                Awaited::End => {
                    let text = ReplyText::Plain("aborting");
                    self.answer_task(waiter, State::Accepted, text, out);
                }
            }
        }
        while let Some((id, ended)) = self.store.oldest_end() {
            if now < ended + self.config.keep {
                break;
            }
            self.store.remove(id);
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do; `None` while nothing is
    /// held or remembered.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let answer = self.store.held().iter().map(|w| w.deadline).min();
        let forget = self
            .store
            .oldest_end()
            .map(|(_, end)| end + self.config.keep);
        earliest(answer, forget)
    }

    /// What is remembered.
    pub fn store(&self) -> &S {
        &self.store
    }

    /// What is remembered, to register scopes.
    pub fn store_mut(&mut self) -> &mut S {
        &mut self.store
    }

    fn on_init<'a>(
        &mut self,
        now: Instant,
        peer: S::Peer,
        message: Message<'a>,
        scope: Scope,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) -> Option<Action<'a>> {
        let mut refuse = |peer, text| {
            out(peer, Reply::refusal(message.scope, ReplyText::Plain(text)));
            None
        };
        let Some(id) = self.next else {
            return refuse(peer, "all task ids are used up, restart the server");
        };
        if self.admit(id, scope).is_err() {
            return refuse(peer, "too many tasks are running, wait for one to end");
        }
        let waiter = Waiter {
            peer,
            task: id,
            awaited: Awaited::Decision,
            deadline: now + self.config.hold,
        };
        if let Err(Full(waiter)) = self.store.hold(waiter) {
            self.store.remove(id);
            return refuse(waiter.peer, "too many requests are waiting, try again");
        }
        self.next = id.next();
        Some(Action::Start {
            id,
            scope,
            payload: message.payload,
        })
    }

    /// Makes room for a task and adds it; the oldest end goes first, a running task never.
    fn admit(&mut self, id: TaskId, scope: Scope) -> Result<(), Full<()>> {
        let task = || {
            let mut text = S::Text::default();
            text.set(NOTHING_KNOWN);
            Task {
                scope,
                state: State::Initiated,
                text,
                ended: None,
            }
        };
        self.store.insert(id, task()).or_else(|full| {
            let (oldest, _) = self.store.oldest_end().ok_or(full)?;
            self.store.remove(oldest);
            self.store.insert(id, task())
        })
    }

    fn status<'a>(&'a self, name: &'a str, scope: Scope, asked: Integer<'a>) -> Reply<'a> {
        match self.find(scope, asked) {
            Some((id, task)) => Reply {
                scope: name,
                state: task.state,
                id: ReplyId::Task(id),
                text: ReplyText::Plain(task.text.as_ref()),
            },
            None => unknown_id(name, asked),
        }
    }

    fn on_abort(
        &mut self,
        now: Instant,
        peer: S::Peer,
        name: &str,
        scope: Scope,
        asked: Integer<'_>,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) -> Option<Action<'static>> {
        let Some((id, task)) = self.find(scope, asked) else {
            out(peer, unknown_id(name, asked));
            return None;
        };
        let reply = |state, text| Reply {
            scope: name,
            state,
            id: ReplyId::Task(id),
            text: ReplyText::Plain(text),
        };
        if task.state.is_final() {
            // It stays what it is (rule 2); `False` is the original's word for "not aborted".
            out(peer, reply(task.state, "False"));
            return None;
        }
        let waiter = Waiter {
            peer,
            task: id,
            awaited: Awaited::End,
            deadline: now + self.config.hold,
        };
        if let Err(Full(waiter)) = self.store.hold(waiter) {
            out(waiter.peer, reply(State::Accepted, "aborting"));
        }
        Some(Action::Abort { id, scope })
    }

    fn find(&self, scope: Scope, asked: Integer<'_>) -> Option<(TaskId, &Task<S::Text>)> {
        let number = u32::try_from(asked.value()?).ok()?;
        let id = TaskId::new(number)?;
        let task = self.store.task(id)?;
        (task.scope == scope).then_some((id, task))
    }

    /// Moves the task on, and says whether that changed anything.
    fn apply(&mut self, now: Instant, id: TaskId, event: Event, text: Option<&str>) -> bool {
        let Some(task) = self.store.task_mut(id) else {
            return false;
        };
        // A handler that reports an end has taken the task, whether it said so or not.
        if event == Event::Complete && task.state == State::Initiated {
            task.state = State::Accepted;
        }
        let Some(state) = task.state.after(event) else {
            return false;
        };
        task.state = state;
        if let Some(text) = text {
            task.text.set(text);
        }
        if state.is_final() {
            task.ended = Some(now);
            self.store.on_ended(id);
        }
        true
    }

    fn on_rejected(
        &mut self,
        now: Instant,
        id: TaskId,
        told: State,
        prefix: &'static str,
        reason: &str,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) {
        if !self.apply(now, id, Event::Reject, Some(reason)) {
            return;
        }
        self.answer_aborts(id, None, out);
        let Some(waiter) = self.release(id, Awaited::Decision) else {
            // The client has the id already, and learns it by STATUS.
            return;
        };
        let scope = self.store.task(id).map(|task| task.scope);
        let mut reply = Reply::refusal(
            scope.map_or("", |scope| self.store.scope_name(scope)),
            ReplyText::About(prefix, reason),
        );
        reply.state = told;
        out(waiter.peer, reply);
        // Nobody was told the id, so nobody can ask for it.
        self.store.remove(id);
    }

    /// Answers the INIT of a task that was taken.
    fn answer_decision(
        &mut self,
        id: TaskId,
        text: ReplyText<'_>,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) {
        if let Some(waiter) = self.release(id, Awaited::Decision) {
            // Case D: ACCEPTED, even if the task has ended since.
            self.answer_task(waiter, State::Accepted, text, out);
        }
    }

    /// Answers every ABORT of a task: with `text` and the present state, or with its end.
    fn answer_aborts(
        &mut self,
        id: TaskId,
        text: Option<&str>,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) {
        while let Some(waiter) = self.release(id, Awaited::End) {
            let Some(task) = self.store.task(id) else {
                continue;
            };
            let state = task.state;
            let text = match text {
                Some(text) => text,
                None if state == State::Aborted => "True",
                None => task.text.as_ref(),
            };
            let reply = Reply {
                scope: self.store.scope_name(task.scope),
                state,
                id: ReplyId::Task(id),
                text: ReplyText::Plain(text),
            };
            out(waiter.peer, reply);
        }
    }

    fn answer_task(
        &self,
        waiter: Waiter<S::Peer>,
        state: State,
        text: ReplyText<'_>,
        out: &mut impl FnMut(S::Peer, Reply<'_>),
    ) {
        let scope = self.store.task(waiter.task).map(|task| task.scope);
        let reply = Reply {
            scope: scope.map_or("", |scope| self.store.scope_name(scope)),
            state,
            id: ReplyId::Task(waiter.task),
            text,
        };
        out(waiter.peer, reply);
    }

    fn release(&mut self, id: TaskId, awaited: Awaited) -> Option<Waiter<S::Peer>> {
        let waiting = |w: &Waiter<S::Peer>| w.task == id && w.awaited == awaited;
        let place = self.store.held().iter().position(waiting)?;
        self.store.release(place)
    }
}

fn unknown_id<'a>(scope: &'a str, asked: Integer<'a>) -> Reply<'a> {
    Reply {
        scope,
        state: State::Rejected,
        id: ReplyId::Asked(asked),
        text: ReplyText::InvalidId(asked),
    }
}

#[cfg(test)]
mod tests;
