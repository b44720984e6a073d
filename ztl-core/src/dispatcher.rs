//! The rules of a server: requests go in; replies and actions come out.
//!
//! The dispatcher decides every row of the table in `docs/protocol.md` [4.1] and keeps the server's rules: a
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
mod config;
mod inits;
mod interface;
mod reserved;
mod state;

pub use config::{Config, EARLY, HOLD, KEEP, KEEP_INIT, LONGEST_WAIT};
pub use interface::{Action, Body, TaskEvent};
pub use state::Dispatcher;

use core::time::Duration;

use crate::envelope::Envelope;
use crate::lifecycle::{Event, Request, State};
use crate::memory::{Awaited, Memory, Waiter};
use crate::message::Message;
pub use crate::reply::{NEVER_SEEN, NOTHING_KNOWN, UNKNOWN_OUTCOME};
use crate::reply::{RESERVED_SCOPE, Reply, ReplyId, ReplyText};
use crate::tasks::{TaskOf, TaskRules, Tasks};
use crate::text::valid_start;
use crate::time::micros;
use crate::{Instant, TaskId};
use config::LONGEST_WAIT_MS;
use state::{Asked, argument};

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

    /// Handles a request of `peer`. `envelope` is `None` for clients that send none. The reply goes through `out`:
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
    // Not inlined in firmware, so that its stack space is free when a task starts.
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
            TaskEvent::AbortRejected => (State::Accepted, None, ""),
            TaskEvent::Progress { text } => {
                self.memory.tasks_mut().progress(id, text);
                return;
            }
        };
        self.handle_step(now, id, told, step, text, out);
    }

    /// Like [`handle_event`](Self::handle_event), for firmware that uses lifecycle events. `told` is the
    /// state sent in the answer to a held INIT; it may differ from the stored state. `None` for `step`
    /// means that the task cannot be aborted and continues. Progress goes to the task table directly.
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

    /// Continues with the id after `last`, also if that is lower than the configured one. Call it before the first request.
    pub fn continue_after(&mut self, last: TaskId) {
        self.next = last.next();
    }

    /// Changes how long an ended task is kept, also for tasks that have already ended.
    pub const fn set_keep(&mut self, keep: Duration) {
        self.keep = micros(keep);
    }

    /// The id of the next task; `None` when all are used up.
    pub const fn next_id(&self) -> Option<TaskId> {
        self.next
    }

    /// The stored tasks, held replies and INITs.
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
        reply.text = ReplyText::UnknownScope;
        let Some(scope) = self.memory.scope(message.scope) else {
            return;
        };
        reply.text = ReplyText::Invalid;
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
            true => ReplyText::UnknownId,
            false => ReplyText::UnknownIdAlone,
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
            reply.text = ReplyText::False;
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

#[cfg(test)]
mod tests;
