//! A server's rules: a request comes in, an answer or something to do comes out.
//!
//! The dispatcher decides every case of the wire specification's table (4.3) and keeps the five
//! rules of the design: a final state never changes, what is repeated does not act twice, every
//! request is answered exactly once and within 2 s. It has no socket and no clock, and calls
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

/// Longest time that the answer to an INIT or an ABORT is held; below the 2 s after which the
/// original's client gives up.
pub const HOLD: Duration = Duration::from_millis(1500);

/// Longest time that a STATUS may ask to be held, for the same reason.
pub const LONGEST_WAIT: Duration = Duration::from_millis(LONGEST_WAIT_MS);
const LONGEST_WAIT_MS: u64 = 1999;

/// How long the answer to an INIT waits for a quick end where the client wishes it, if nothing else
/// is chosen: about a round trip.
pub const EARLY: Duration = Duration::from_millis(3);

/// How long an ended task is remembered if nothing else is chosen.
pub const KEEP: Duration = Duration::from_secs(3600);

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
    /// Default [`EARLY`].
    pub early: Duration,
    /// How long an ended task is remembered, counted from its end, where [ends expire](Memory::ENDS_EXPIRE).
    /// Default [`KEEP`].
    pub keep: Duration,
}

impl Config {
    /// The defaults.
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
/// to be asked again after each input.
///
/// A call goes through the held answers, the tasks and the remembered INITs again for each answer
/// that it gives and each task that it forgets; `probe` and other questions write what the memory
/// holds. So the memory's capacities bound its work; one with indexes makes the searches short.
// In this order: a Cortex-M0 reaches what comes first with shorter code.
#[derive(Debug)]
#[repr(C)]
pub struct Dispatcher<M> {
    /// The time of the input that is being handled.
    now: Instant,
    /// The times of [`Config`] in microseconds: what a `Duration` would be turned into each time.
    hold: u64,
    early: u64,
    keep: u64,
    boot: u32,
    next: Option<TaskId>,
    memory: M,
}

/// A request, and what is to be done with it: a refusal, until something better is found.
///
/// One place that is filled in by whoever finds it: a Cortex-M0 pays for each value that is handed
/// back and taken apart again.
struct Asked<'r, 'a> {
    envelope: Option<&'r Envelope>,
    /// From which number on an INIT of its client is new, if none is remembered.
    new_from: u64,
    /// What it is answered if it does not wait.
    reply: Reply<'r>,
    /// It waits for this to happen to this task, until the deadline.
    wait: Option<(TaskId, Awaited)>,
    deadline: Instant,
    action: Option<Action<'a>>,
}

impl<M: Memory> Dispatcher<M> {
    /// A dispatcher that remembers in `memory`.
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
        let (text, whole) = match body {
            Body::One(bytes) => {
                let text = valid_start(bytes);
                (text, text.len() == bytes.len())
            }
            Body::Several => ("", true),
        };
        self.handle_text(now, peer, envelope, (text, whole), out)
    }

    /// The same for firmware that has the body as a text already, since the table by which others are looked
    /// at takes 0.5 KiB: what the body begins with up to the first byte that is not UTF-8, and whether that is
    /// all. A body of several frames is an empty text.
    // Apart in firmware, so that its stack is free again when a task is started.
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
        // Without room it is answered as if its time had passed.
        if let Err(waiter) = self.memory.hold(waiter) {
            self.answer(waiter, None, out);
        }
        action
    }

    /// A handler reports what became of a task.
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

    /// The same for firmware, which has its events as those of the lifecycle already: a held INIT is answered
    /// with the state `told`, by which a task that is refused is REJECTED or FAILED. Without an event the task
    /// cannot be stopped, and goes on. Progress is that of the tasks.
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
            // A handler that reports an end has taken the task, whether it said so or not.
            let taken = told == State::Accepted && tasks.apply(now, id, Event::Accept, None);
            if !tasks.apply(now, id, step, Some(text)) && !taken {
                return;
            }
        }
        self.on_change(id, (told, text), step.is_none(), out);
    }

    /// Answers what has been held long enough, and forgets what ended long ago.
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

    /// When [`handle_timeout`](Self::handle_timeout) has something to do; `None` while nothing is
    /// held, and nothing remembered that expires.
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

    /// Takes up a task from before this start, and gives no id up to its own from now on; says
    /// whether there is room for it. To be called before the first request.
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

    /// Gives no id up to this one from now on.
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

    /// What is remembered, to register scopes.
    pub fn memory_mut(&mut self) -> &mut M {
        &mut self.memory
    }

    /// The table of what a server answers (`docs/protocol.md`, 4.1), row by row.
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
        // Whoever names the task has the answer to its INIT.
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
            // It stays what it is (rule 2); `False` is the original's word for "not aborted".
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

/// The number that follows `word` in a payload.
fn argument(payload: &str, word: &str) -> Option<u64> {
    let number = Integer::parse(payload.strip_prefix(word)?).ok()?.natural();
    (number != u64::MAX).then_some(number)
}

#[cfg(test)]
mod tests;
