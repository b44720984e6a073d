//! The rules of a server: requests go in; replies and actions come out.
//!
//! The dispatcher decides every case of the wire specification's table (4.3) and keeps the design's rules: a
//! final state never changes, a repeated request has no second effect, every request gets exactly one reply
//! within 2 s. It has no socket, no clock, and calls no user code.
//!
//! ```
//! use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
//! use ztl_core::{Instant, TaskId, memory::Fixed, reply::Reply};
//!
//! // One scope, four tasks with results of up to 32 bytes, two held replies; a client is a number.
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
mod inits;
mod reserved;

use core::time::Duration;

use crate::envelope::Envelope;
use crate::integer::Integer;
use crate::lifecycle::{Event, Request, State};
use crate::memory::{Awaited, Memory, Scope, Waiter};
use crate::message::Message;
use crate::reply::{Reply, ReplyId, Text};
use crate::tasks::{TaskOf, TaskRules, Tasks};
use crate::time::micros;
use crate::{Instant, TaskId, valid_start};

/// How long the reply to an INIT or ABORT is held at most: less than the 2 s timeout of the original's
/// client.
pub const HOLD: Duration = Duration::from_millis(1500);

/// How long a STATUS may ask its reply to be held, for the same reason.
pub const LONGEST_WAIT: Duration = Duration::from_millis(LONGEST_WAIT_MS);
const LONGEST_WAIT_MS: u64 = 1999;

/// Default for [`Config::early`]: about one round trip.
pub const EARLY: Duration = Duration::from_millis(3);

/// Default for [`Config::keep`].
pub const KEEP: Duration = Duration::from_secs(3600);

/// How long the reply to an INIT is kept for deduplication, from the moment it is sent.
pub const KEEP_INIT: Duration = Duration::from_secs(60);

/// The scope reserved for the protocol itself.
pub const RESERVED_SCOPE: &str = "$ztl";

/// Python's `None`: the original's text while no progress is known.
pub const NOTHING_KNOWN: &str = "None";

/// Begins the reason of a FAILED task whose end cannot be learned, such as one that was forwarded to
/// a server that was restarted: the task may still run. Clients take it for an unknown outcome
/// ([`Answer::UnknownEnd`](crate::client::Answer::UnknownEnd)).
pub const UNKNOWN_END: &str = "unknown: ";

/// What may be chosen about a dispatcher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Config {
    /// The first task id. Choose it at random (1 to 2^30), so that an id from before a restart does not name
    /// another task.
    pub first: TaskId,
    /// Changes with each start, so that clients detect a restart; reported by `$ztl`.
    pub boot: u32,
    /// How long a reply is held at most. Defaults to [`HOLD`].
    pub hold: Duration,
    /// How long the reply to an INIT waits for a final state if the client asks for it. Defaults to
    /// [`EARLY`].
    pub early: Duration,
    /// How long an ended task is kept, from its end, if [ended tasks expire](Memory::ENDS_EXPIRE). Defaults
    /// to [`KEEP`].
    pub keep: Duration,
}

impl Config {
    /// The default settings.
    #[must_use]
    #[cfg_attr(target_os = "none", inline(always))]
    pub const fn new(first: TaskId, boot: u32) -> Self {
        Self {
            first,
            boot,
            hold: HOLD,
            early: EARLY,
            keep: KEEP,
        }
    }
}

/// The body of a request, as received over ZeroMQ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Body<'a> {
    /// One frame, as every client sends it.
    One(&'a [u8]),
    /// Several frames, which is invalid (wire specification 2.4).
    Several,
}

/// An action for a scope's handler, which reports back through [`handle_event`](Dispatcher::handle_event).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Action<'a> {
    /// Start this task, or reject it.
    Start {
        /// The id assigned to it.
        id: TaskId,
        /// The scope it was sent to.
        scope: Scope,
        /// The INIT's payload, unchanged.
        payload: &'a str,
    },
    /// Abort this task, or refuse to.
    Abort {
        /// The task.
        id: TaskId,
        /// The scope it runs in.
        scope: Scope,
    },
}

/// A handler's report about a task. The dispatcher ignores reports that can no longer change anything: a
/// second final state, progress after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum TaskEvent<'a> {
    /// The task is accepted; `reply` answers the INIT.
    Accepted {
        /// Text for the client.
        reply: &'a str,
    },
    /// The task is rejected; nothing was done.
    Rejected {
        /// What is wrong, and what would be right.
        reason: &'a str,
    },
    /// The task is rejected in the form in which the original reports an exception of its controller (case
    /// H): state 3 and `Controller threw exception: …`.
    Threw {
        /// The exception's message.
        message: &'a str,
    },
    /// Progress; a later one replaces it.
    Progress {
        /// Text for the client.
        text: &'a str,
    },
    /// The goal is reached.
    Completed {
        /// The result.
        result: &'a str,
    },
    /// The goal will not be reached.
    Failed {
        /// The cause.
        reason: &'a str,
    },
    /// The task has stopped as requested.
    Aborted {
        /// Where or why it stopped.
        result: &'a str,
    },
    /// The task cannot be aborted and continues.
    AbortRefused,
}

/// The rules of a server, over any [`Memory`].
///
/// *Inputs*: [`handle_request`](Self::handle_request), [`handle_event`](Self::handle_event),
/// [`handle_timeout`](Self::handle_timeout). *Outputs*: replies through the `out` argument, immediately or
/// later, and an [`Action`] for the handler. *Next wake-up*: [`poll_timeout`](Self::poll_timeout); ask again
/// after each input.
///
/// For each reply that it sends and each task that it drops, a call searches the held replies, the tasks and
/// the stored INITs. `probe` and other questions write what the memory holds. So the memory's capacities
/// bound the work; a memory with indexes makes the searches short.
// This order of fields gives the shortest code on a Cortex-M0.
#[derive(Debug)]
#[repr(C)]
pub struct Dispatcher<M> {
    /// Time of the current input.
    now: Instant,
    /// The durations of [`Config`] in microseconds, converted once.
    hold: u64,
    early: u64,
    keep: u64,
    boot: u32,
    next: Option<TaskId>,
    memory: M,
}

/// A request in progress: its reply is a rejection until a rule replaces it.
///
/// The rules fill in one shared value, because returning values costs flash on a Cortex-M0.
struct Asked<'r, 'a> {
    envelope: Option<&'r Envelope>,
    /// Number from which on an INIT of this client is new, if the client has no record.
    new_from: u64,
    /// The reply, unless the request waits.
    reply: Reply<'r>,
    /// The reply waits for this event of this task, until `deadline`.
    wait: Option<(TaskId, Awaited)>,
    deadline: Instant,
    action: Option<Action<'a>>,
}

impl<M: Memory> Dispatcher<M> {
    /// Creates a dispatcher over `memory`.
    pub const fn new(memory: M, config: Config) -> Self {
        Self {
            memory,
            next: Some(config.first),
            boot: config.boot,
            now: Instant::ZERO,
            hold: micros(config.hold),
            early: micros(config.early),
            keep: micros(config.keep),
        }
    }

    /// Handles a request of `peer`, with its envelope if the client uses ours. The reply goes through `out`:
    /// now, on a later event, or at its deadline.
    pub fn handle_request<'a>(
        &mut self,
        now: Instant,
        peer: M::Peer,
        envelope: Option<Envelope>,
        body: Body<'a>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> Option<Action<'a>> {
        let (text, whole) = match body {
            Body::One(bytes) => {
                let text = valid_start(bytes);
                (text, text.len() == bytes.len())
            }
            Body::Several => ("", true),
        };
        self.handle_text(now, peer, envelope, (text, whole), out)
    }

    /// Like [`handle_request`](Self::handle_request), for firmware that has already validated the body, which
    /// saves a table of 0.5 KiB: the longest valid UTF-8 prefix, and whether that is the whole body. A body
    /// of several frames is an empty text.
    // Not inlined in firmware, so that its stack is free when a task starts.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn handle_text<'a>(
        &mut self,
        now: Instant,
        peer: M::Peer,
        envelope: Option<Envelope>,
        body: (&'a str, bool),
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> Option<Action<'a>> {
        self.now = now;
        let mut asked = Asked {
            envelope: envelope.as_ref(),
            new_from: 0,
            reply: Reply::refusal(self.boot),
            wait: None,
            deadline: now.after(self.hold),
            action: None,
        };
        self.decide(&peer, body, &mut asked, out);
        let Some((task, awaited)) = asked.wait else {
            out(peer, &asked.reply);
            return None;
        };
        let action = asked.action;
        let waiter = Waiter {
            peer,
            task,
            awaited,
            deadline: asked.deadline,
        };
        // Without room to hold it, reply as if the deadline had passed.
        if let Err(waiter) = self.memory.hold(waiter) {
            self.answer(waiter, None, out);
        }
        action
    }

    /// Handles a handler's report about a task.
    pub fn handle_event(
        &mut self,
        now: Instant,
        id: TaskId,
        event: TaskEvent<'_>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let (told, step, text) = match event {
            TaskEvent::Accepted { reply } => (State::Accepted, Some(Event::Accept), reply),
            TaskEvent::Rejected { reason } => (State::Rejected, Some(Event::Reject), reason),
            TaskEvent::Threw { message } => (State::Failed, Some(Event::Reject), message),
            TaskEvent::Completed { result } => (State::Accepted, Some(Event::Complete), result),
            TaskEvent::Failed { reason } => (State::Accepted, Some(Event::Fail), reason),
            TaskEvent::Aborted { result } => (State::Accepted, Some(Event::Abort), result),
            TaskEvent::AbortRefused => (State::Accepted, None, ""),
            TaskEvent::Progress { text } => {
                self.memory.tasks_mut().progress(id, text);
                return;
            }
        };
        self.handle_step(now, id, told, step, text, out);
    }

    /// Like [`handle_event`](Self::handle_event), for firmware that uses lifecycle events. A held INIT is
    /// answered with the state `told`: a rejected task is REJECTED or FAILED. `None` for `step` means that
    /// the task cannot be aborted and continues. Progress goes to the task table directly.
    pub fn handle_step(
        &mut self,
        now: Instant,
        id: TaskId,
        told: State,
        step: Option<Event>,
        text: &str,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        self.now = now;
        let tasks = self.memory.tasks_mut();
        if let Some(step) = step {
            // A handler that reports a final state has implicitly accepted the task.
            let taken = told == State::Accepted && tasks.apply(now, id, Event::Accept, None);
            if !tasks.apply(now, id, step, Some(text)) && !taken {
                return;
            }
        }
        self.on_change(id, (told, text), step.is_none(), out);
    }

    /// Sends held replies whose deadline has passed, and drops what has expired.
    pub fn handle_timeout(&mut self, now: Instant, out: &mut impl FnMut(M::Peer, &Reply<'_>)) {
        self.now = now;
        self.answer_late(None, out);
        if M::ENDS_EXPIRE
            && let Some(end) = now.before(self.keep)
        {
            self.memory.tasks_mut().forget_until(end);
        }
        self.memory.forget_inits(now);
    }

    /// When to call [`handle_timeout`](Self::handle_timeout); `None` while nothing is held and nothing can
    /// expire.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let mut wake = self.memory.next_answer();
        if M::ENDS_EXPIRE
            && let Some((_, end)) = self.memory.tasks().oldest_end()
        {
            wake = wake.min(end.after(self.keep));
        }
        let wake = wake.min(self.memory.next_forgetting());
        (wake != Instant::NEVER).then_some(wake)
    }

    /// Restores a task from before a restart and skips all ids up to its own. Returns whether there was room.
    /// Call it before the first request.
    pub fn restore(&mut self, id: TaskId, task: TaskOf<M::Tasks>) -> bool {
        self.skip_to(id);
        let ended = task.ended != Instant::NEVER;
        let tasks = self.memory.tasks_mut();
        let fits = tasks.insert(id, task).is_some();
        if fits && ended {
            tasks.on_ended(id);
        }
        fits
    }

    /// Skips all ids up to `last`.
    pub fn skip_to(&mut self, last: TaskId) {
        if self.next.is_some_and(|next| next <= last) {
            self.next = last.next();
        }
    }

    /// Changes how long an ended task is remembered, also for those that have ended.
    pub const fn set_keep(&mut self, keep: Duration) {
        self.keep = micros(keep);
    }

    /// The id of the next task; `None` when all are used up.
    pub const fn next_id(&self) -> Option<TaskId> {
        self.next
    }

    /// What is remembered.
    pub fn memory(&self) -> &M {
        &self.memory
    }

    /// The memory, mutable, for example to register scopes.
    pub fn memory_mut(&mut self) -> &mut M {
        &mut self.memory
    }

    /// The reply table of `docs/protocol.md`, 4.1, row by row.
    fn decide<'r, 'a: 'r>(
        &'r mut self,
        peer: &M::Peer,
        (text, whole): (&'a str, bool),
        asked: &mut Asked<'r, 'a>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let reply = &mut asked.reply;
        let message = match Message::parse_text(text, whole) {
            Ok(message) => message,
            Err(error) => {
                reply.scope = error.scope();
                return;
            }
        };
        reply.scope = message.scope;
        let code = message.code();
        let request = code.map_or(None, |code| Request::from_code(code.natural() as i64));
        if let Some(envelope) = asked.envelope {
            let is_init = request == Some(Request::Init);
            asked.new_from = self.memory.on_heard(self.now, peer, envelope, is_init);
        }
        if message.scope == RESERVED_SCOPE {
            return self.on_reserved(request, message.payload, asked, out);
        }
        reply.text = Text::UnknownScope;
        let Some(scope) = self.memory.scope(message.scope) else {
            return;
        };
        reply.text = Text::Invalid;
        let (Ok(_), Ok(id)) = (code, message.number()) else {
            return;
        };
        if request == Some(Request::Init) {
            return self.on_init(scope, message.payload, asked, out);
        }
        reply.id = ReplyId::Asked(id);
        let Some(request) = request else {
            return;
        };
        reply.text = match self.memory.names_unknown_ids(scope) {
            true => Text::UnknownId,
            false => Text::UnknownIdAlone,
        };
        let number = u32::try_from(id.natural()).ok();
        let Some(id) = number.and_then(TaskId::new) else {
            return;
        };
        // A client that names the task has received the reply to its INIT.
        if let Some(envelope) = asked.envelope
            && self.memory.on_asked_about(&envelope.client, id)
        {
            self.answer_late(Some(id), out);
        }
        let task = self.memory.tasks().get(id);
        let Some(task) = task.filter(|task| task.extra == scope) else {
            return;
        };
        reply.id = ReplyId::Task(id);
        reply.state = task.state;
        reply.say(task.text.as_ref());
        let ended = task.state.is_final();
        if request == Request::Abort {
            // A final state never changes; `False` is how the original says "not aborted".
            reply.text = Text::False;
            if !ended {
                asked.wait = Some((id, Awaited::Abort));
                asked.action = Some(Action::Abort { id, scope });
            }
        } else if !ended
            && asked.envelope.is_some()
            && let Some(wait) = argument(message.payload, "wait ")
        {
            asked.wait = Some((id, Awaited::End));
            let wait = wait.min(LONGEST_WAIT_MS) as u32;
            asked.deadline = self.now.after(u64::from(wait * 1000));
        }
    }
}

/// The number after `word` in a payload.
fn argument(payload: &str, word: &str) -> Option<u64> {
    let number = Integer::parse(payload.strip_prefix(word)?).ok()?.natural();
    (number != u64::MAX).then_some(number)
}

#[cfg(test)]
mod tests;
