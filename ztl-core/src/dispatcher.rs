//! A server's rules: a request comes in, an answer or something to do comes out.
//!
//! The dispatcher decides every case of the wire specification's table (4.3) and keeps the five
//! rules of the design: a final state never changes, what is repeated does not act twice, every
//! request is answered exactly once and in bounded time. It has no socket and no clock, and calls
//! no user code.
//!
//! ```
//! use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
//! use ztl_core::{Instant, TaskId, memory::Fixed, reply::Reply};
//!
//! // One scope, four tasks with results of 32 bytes, two answers held; clients are numbers here.
//! let memory = Fixed::<u8, 1, 4, 32, 2>::new(["/lab"]);
//! let mut dispatcher = Dispatcher::new(memory, Config::new(TaskId::new(1).unwrap(), 4711));
//!
//! let mut answers = Vec::new();
//! let mut out = |client: u8, reply: &Reply<'_>| {
//!     let mut text = Vec::new();
//!     reply.put(&mut |bytes: &[u8]| text.extend_from_slice(bytes));
//!     answers.push((client, String::from_utf8(text).unwrap()));
//! };
//! let now = Instant::ZERO;
//! let action = dispatcher.handle_request(now, 9, None, Body::One(b"/lab;1;-1;open"), &mut out);
//! let Some(Action::Start { id, payload, .. }) = action else { panic!() };
//! assert_eq!(payload, "open");
//! dispatcher.handle_event(now, id, TaskEvent::Accepted { reply: "opening" }, &mut out);
//! dispatcher.handle_event(now, id, TaskEvent::Completed { result: "open" }, &mut out);
//! dispatcher.handle_request(now, 9, None, Body::One(b"/lab;2;1;"), &mut out);
//! assert_eq!(answers, [(9, "/lab;1;1;opening".into()), (9, "/lab;5;1;open".into())]);
//! ```

mod answers;
mod reserved;

use core::time::Duration;

use crate::envelope::Envelope;
use crate::integer::Integer;
use crate::lifecycle::{Event, Request, State};
use crate::memory::{Awaited, First, LastInit, Memory, Scope, Waiter};
use crate::message::Message;
use crate::reply::{NO_CONTROLLER, Reply, ReplyId, ReplyText, UNKNOWN_PROTOCOL};
use crate::tasks::{Task, TaskOf, TaskRules, Tasks, Text};
use crate::time::earliest;
use crate::{Instant, TaskId};

/// Longest time that the answer to an INIT or an ABORT is held; below the 2 s after which the
/// original's client gives up.
pub const HOLD: Duration = Duration::from_millis(1500);

/// Longest time that a STATUS may ask to be held, for the same reason.
pub const LONGEST_WAIT: Duration = Duration::from_millis(1999);

/// How long the answer to an INIT is kept for its client, counted from the answer.
pub const KEEP_INIT: Duration = Duration::from_secs(60);

/// The scope that belongs to the protocol itself.
pub const RESERVED_SCOPE: &str = "$ztl";

/// Python's `None`, with which the original fills a text that is not known yet.
pub const NOTHING_KNOWN: &str = "None";

/// What may be chosen about a dispatcher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Config {
    /// The first task id. Should be random (1 to 2^30), so that an id from before a restart is
    /// nobody else's task.
    pub first: TaskId,
    /// Told by `$ztl`: differs from start to start of the server, so that a client notices one.
    pub boot: u32,
    /// Longest time that an answer is held. Default [`HOLD`].
    pub hold: Duration,
    /// How long the answer to an INIT waits for a quick end, where the client wishes it.
    /// Default 3 ms.
    pub early: Duration,
    /// How long an ended task is remembered, counted from its end. Default one hour.
    pub keep: Duration,
}

impl Config {
    /// The defaults.
    #[must_use]
    pub const fn new(first: TaskId, boot: u32) -> Self {
        Self {
            first,
            boot,
            hold: HOLD,
            early: Duration::from_millis(3),
            keep: Duration::from_secs(3600),
        }
    }
}

/// The body of a request, as it came over ZeroMQ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Body<'a> {
    /// One frame, as every client sends it.
    One(&'a [u8]),
    /// Several frames, which no client may send (wire specification 2.4).
    Several,
}

/// Something for the handler of a scope to do. The dispatcher expects the outcome in
/// [`handle_event`](Dispatcher::handle_event).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
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
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
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

/// The rules of a server, over any [`Memory`].
///
/// *Inputs*: [`handle_request`](Self::handle_request), [`handle_event`](Self::handle_event),
/// [`handle_timeout`](Self::handle_timeout). *Outputs*: answers through the `out` argument, at once
/// or later; an [`Action`] for the handler. *Next wake-up*: [`poll_timeout`](Self::poll_timeout),
/// to be asked again after each input. A call's work is bounded by the number of held answers.
#[derive(Debug)]
pub struct Dispatcher<M> {
    memory: M,
    next: Option<TaskId>,
    config: Config,
}

/// Where a request came from, and how its client named it.
struct Asker<P> {
    peer: P,
    envelope: Option<Envelope>,
}

impl<M: Memory> Dispatcher<M> {
    /// A dispatcher that remembers in `memory`.
    pub fn new(memory: M, config: Config) -> Self {
        Self {
            memory,
            next: Some(config.first),
            config,
        }
    }

    /// A request of `peer` has arrived, in this envelope if the client uses ours. It is answered
    /// through `out` now, or later by an event or when its time has passed.
    pub fn handle_request<'a>(
        &mut self,
        now: Instant,
        peer: M::Peer,
        envelope: Option<Envelope>,
        body: Body<'a>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> Option<Action<'a>> {
        let bytes = match body {
            Body::One(bytes) => bytes,
            Body::Several => b"",
        };
        let message = match Message::parse(bytes) {
            Ok(message) => message,
            Err(error) => {
                // Case A, and 4.4 for what silenced the original for good.
                let text = ReplyText::Plain(UNKNOWN_PROTOCOL);
                out(peer, &Reply::refusal(error.scope(), text));
                return None;
            }
        };
        let asker = Asker { peer, envelope };
        if message.scope == RESERVED_SCOPE {
            self.on_reserved(now, asker, message, out);
            return None;
        }
        let Some(scope) = self.memory.scope(message.scope) else {
            let text = ReplyText::About(NO_CONTROLLER, message.scope);
            out(asker.peer, &Reply::refusal(message.scope, text));
            return None;
        };
        let invalid = ReplyText::Plain("Invalid request");
        let (Ok(code), Ok(asked)) = (message.code(), message.number()) else {
            out(asker.peer, &Reply::refusal(message.scope, invalid));
            return None;
        };
        match code.value().and_then(Request::from_code) {
            Some(Request::Init) => self.on_init(now, asker, message, scope, out),
            Some(Request::Status) => {
                self.on_status(now, asker, message, scope, asked, out);
                None
            }
            Some(Request::Abort) => {
                self.on_abort(now, asker.peer, message.scope, scope, asked, out)
            }
            None => {
                let mut reply = Reply::refusal(message.scope, invalid);
                reply.id = ReplyId::Asked(asked);
                out(asker.peer, &reply);
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
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let (event, text) = match event {
            TaskEvent::Accepted { reply } => {
                if self.memory.tasks_mut().apply(now, id, Event::Accept, None) {
                    self.on_accepted(now, id, ReplyText::Plain(reply), reply, out);
                }
                return;
            }
            TaskEvent::Rejected { reason } => {
                return self.on_rejected(now, id, State::Rejected, reason, out);
            }
            TaskEvent::Threw { message } => {
                return self.on_rejected(now, id, State::Failed, message, out);
            }
            TaskEvent::Progress { text } => {
                self.memory.tasks_mut().progress(id, text);
                return;
            }
            TaskEvent::AbortRefused => {
                return self.answer_waiting(id, Awaited::Abort, Some("False"), out);
            }
            TaskEvent::Completed { result } => (Event::Complete, result),
            TaskEvent::Failed { reason } => (Event::Fail, reason),
            TaskEvent::Aborted { result } => (Event::Abort, result),
        };
        let tasks = self.memory.tasks_mut();
        // A handler that reports an end has taken the task, whether it said so or not.
        let taken = tasks.apply(now, id, Event::Accept, None);
        if tasks.apply(now, id, event, Some(text)) {
            if taken {
                self.on_accepted(now, id, ReplyText::Undecided(id), text, out);
            }
            for awaited in [Awaited::EarlyEnd, Awaited::Abort, Awaited::End] {
                self.answer_waiting(id, awaited, None, out);
            }
        }
    }

    /// Answers what has been held long enough, and forgets what ended long ago.
    pub fn handle_timeout(&mut self, now: Instant, out: &mut impl FnMut(M::Peer, &Reply<'_>)) {
        while let Some(place) = self.memory.held().iter().position(|w| w.deadline <= now) {
            let Some(waiter) = self.memory.release(place) else {
                break;
            };
            self.answer_late(waiter, out);
        }
        if let Some(end) = now.before(self.config.keep) {
            self.memory.tasks_mut().forget_until(end);
        }
        self.memory.forget_inits(now);
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do; `None` while nothing is
    /// held or remembered.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let answer = self.memory.held().iter().map(|w| w.deadline).min();
        let end = self.memory.tasks().oldest_end();
        let forget = end.map(|(_, end)| end + self.config.keep);
        earliest(earliest(answer, forget), self.memory.next_forgetting())
    }

    /// Takes up a task from before this start, and gives no id up to its own from now on; says
    /// whether there is room for it. To be called before the first request.
    pub fn restore(&mut self, id: TaskId, task: TaskOf<M::Tasks>) -> bool {
        self.skip_to(id);
        let ended = task.ended.is_some();
        let tasks = self.memory.tasks_mut();
        let fits = tasks.insert(id, task);
        if fits && ended {
            tasks.on_ended(id);
        }
        fits
    }

    /// Gives no id up to this one from now on.
    pub fn skip_to(&mut self, last: TaskId) {
        if self.next.is_some_and(|next| next <= last) {
            self.next = last.next();
        }
    }

    /// What is remembered.
    pub fn memory(&self) -> &M {
        &self.memory
    }

    /// What is remembered, to register scopes.
    pub fn memory_mut(&mut self) -> &mut M {
        &mut self.memory
    }

    fn on_init<'a>(
        &mut self,
        now: Instant,
        asker: Asker<M::Peer>,
        message: Message<'a>,
        scope: Scope,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> Option<Action<'a>> {
        let asker = self.repeated(now, asker, message.scope, out)?;
        let mut refuse = |peer, text| {
            out(peer, &Reply::refusal(message.scope, ReplyText::Plain(text)));
            None
        };
        let Some(id) = self.next else {
            return refuse(asker.peer, "all task ids are used up, restart the server");
        };
        if let Some(envelope) = asker.envelope {
            let first = First::Pending(id);
            let until = None;
            if !self.memory.remember(LastInit {
                client: envelope.client,
                number: envelope.number,
                early_end: envelope.early_end,
                first,
                until,
            }) {
                return refuse(
                    asker.peer,
                    "too many clients at a time, try again in a minute",
                );
            }
        }
        let task = || {
            let mut task = Task::<_, M::Text>::new(scope);
            task.text.set(NOTHING_KNOWN);
            task
        };
        let refusal = match self.memory.tasks_mut().admit(id, task) {
            Err(_) => Some((
                asker.peer,
                "too many tasks are running, wait for one to end",
            )),
            Ok(()) => {
                let waiter = self.waiter(now, asker.peer, id, Awaited::Decision);
                let held = self.memory.hold(waiter);
                held.err()
                    .map(|waiter| (waiter.peer, "too many requests are waiting, try again"))
            }
        };
        if let Some((peer, text)) = refusal {
            self.memory.tasks_mut().remove(id);
            self.settle(now, id, State::Rejected, None, text);
            return refuse(peer, text);
        }
        self.next = id.next();
        Some(Action::Start {
            id,
            scope,
            payload: message.payload,
        })
    }

    fn waiter(
        &self,
        now: Instant,
        peer: M::Peer,
        task: TaskId,
        awaited: Awaited,
    ) -> Waiter<M::Peer> {
        Waiter {
            peer,
            task,
            awaited,
            deadline: now + self.config.hold,
        }
    }

    /// Answers an INIT that has come before; gives back one that has not.
    fn repeated(
        &mut self,
        now: Instant,
        asker: Asker<M::Peer>,
        scope: &str,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> Option<Asker<M::Peer>> {
        let Some(envelope) = asker.envelope else {
            return Some(asker);
        };
        let known = match self.memory.last_init(envelope.client) {
            Some(known) if known.number >= envelope.number => known,
            _ => return Some(asker),
        };
        let given_up = ReplyText::Plain("this INIT was given up by its client");
        match &known.first {
            First::Pending(task) if known.number == envelope.number => {
                let task = *task;
                let waiter = self.waiter(now, asker.peer, task, Awaited::Decision);
                if let Err(waiter) = self.memory.hold(waiter) {
                    self.answer_late(waiter, out);
                }
            }
            First::Answered { state, id, text } if known.number == envelope.number => {
                out(asker.peer, &first_answer(scope, *state, *id, text.as_ref()));
            }
            // Given up, or older than one that has come since.
            _ => out(asker.peer, &Reply::refusal(scope, given_up)),
        }
        None
    }

    fn on_status(
        &mut self,
        now: Instant,
        asker: Asker<M::Peer>,
        message: Message<'_>,
        scope: Scope,
        asked: Integer<'_>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let Some((id, state)) = self.find(scope, asked) else {
            return out(asker.peer, &unknown_id(message.scope, asked));
        };
        let wait = asker.envelope.and(held_for(message.payload));
        let mut peer = asker.peer;
        if let Some(wait) = wait
            && !state.is_final()
        {
            let mut waiter = self.waiter(now, peer, id, Awaited::End);
            waiter.deadline = now + wait;
            match self.memory.hold(waiter) {
                Ok(()) => return,
                // Not held, then: it is answered now.
                Err(waiter) => peer = waiter.peer,
            }
        }
        if let Some(task) = self.memory.tasks().get(id) {
            let text = ReplyText::Plain(task.text.as_ref());
            out(peer, &Reply::about(message.scope, id, state, text));
        }
    }

    fn on_abort(
        &mut self,
        now: Instant,
        peer: M::Peer,
        name: &str,
        scope: Scope,
        asked: Integer<'_>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> Option<Action<'static>> {
        let Some((id, state)) = self.find(scope, asked) else {
            out(peer, &unknown_id(name, asked));
            return None;
        };
        let reply = |state, text| Reply::about(name, id, state, ReplyText::Plain(text));
        if state.is_final() {
            // It stays what it is (rule 2); `False` is the original's word for "not aborted".
            out(peer, &reply(state, "False"));
            return None;
        }
        let waiter = self.waiter(now, peer, id, Awaited::Abort);
        if let Err(waiter) = self.memory.hold(waiter) {
            out(waiter.peer, &reply(State::Accepted, "aborting"));
        }
        Some(Action::Abort { id, scope })
    }

    fn find(&self, scope: Scope, asked: Integer<'_>) -> Option<(TaskId, State)> {
        let number = u32::try_from(asked.value()?).ok()?;
        let id = TaskId::new(number)?;
        let task = self.memory.tasks().get(id)?;
        (task.extra == scope).then_some((id, task.state))
    }
}

fn unknown_id<'a>(scope: &'a str, asked: Integer<'a>) -> Reply<'a> {
    let mut reply = Reply::refusal(scope, ReplyText::InvalidId(asked));
    reply.id = ReplyId::Asked(asked);
    reply
}

/// What stands before the reason of a refusal.
const fn prefix(threw: bool) -> &'static str {
    if threw {
        "Controller threw exception: "
    } else {
        ""
    }
}

/// The answer to an INIT, told again.
fn first_answer<'a>(scope: &'a str, state: State, id: Option<TaskId>, text: &'a str) -> Reply<'a> {
    match id {
        Some(id) => Reply::about(scope, id, state, ReplyText::Plain(text)),
        None => {
            let threw = state == State::Failed;
            let mut reply = Reply::refusal(scope, ReplyText::About(prefix(threw), text));
            reply.state = state;
            reply
        }
    }
}

/// How long a STATUS with this payload asks to be held: `wait MS`.
fn held_for(payload: &str) -> Option<Duration> {
    let millis = Integer::parse(payload.strip_prefix("wait ")?).ok()?;
    let millis = u64::try_from(millis.value()?).ok()?;
    // Bounded first: a division in u64 costs a Cortex-M0 0.9 KiB.
    let longest = LONGEST_WAIT.subsec_millis() + 1000 * LONGEST_WAIT.as_secs() as u32;
    Some(Duration::from_millis(millis.min(u64::from(longest))))
}

#[cfg(test)]
mod tests;
