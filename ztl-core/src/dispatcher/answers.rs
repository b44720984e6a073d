//! When the held answers go out, and what they say.

use super::{Dispatcher, KEEP_INIT, NOTHING_KNOWN, RESERVED_SCOPE, prefix};
use crate::lifecycle::{Event, State};
use crate::memory::{Awaited, First, LastInit, Memory, Waiter};
use crate::reply::{Reply, ReplyText};
use crate::tasks::{TaskRules, Tasks, Text};
use crate::{Instant, TaskId};

impl<M: Memory> Dispatcher<M> {
    /// Answers the INIT of a task that was taken: at once, or where the client wishes it after a
    /// moment in which it may end.
    pub(super) fn on_accepted(
        &mut self,
        now: Instant,
        id: TaskId,
        text: ReplyText<'_>,
        kept: &str,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let early_end = self.settle(now, id, State::Accepted, Some(id), kept);
        while let Some(waiter) = self.release(id, Awaited::Decision) {
            if early_end {
                let early = Waiter {
                    awaited: Awaited::EarlyEnd,
                    deadline: now + self.config.early,
                    ..waiter
                };
                // There is room: one was just taken out.
                if let Err(waiter) = self.memory.hold(early) {
                    self.answer_task(waiter, State::Accepted, text, out);
                }
            } else {
                // Case D: ACCEPTED, even if the task has ended since.
                self.answer_task(waiter, State::Accepted, text, out);
            }
        }
        while let Some(waiter) = self.release(id, Awaited::Outcome) {
            let reply = Reply::about(RESERVED_SCOPE, id, State::Accepted, text);
            out(waiter.peer, &reply);
        }
    }

    pub(super) fn on_rejected(
        &mut self,
        now: Instant,
        id: TaskId,
        told: State,
        reason: &str,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let tasks = self.memory.tasks_mut();
        let scope = tasks.get(id).map(|task| task.extra);
        if !tasks.apply(now, id, Event::Reject, Some(reason)) {
            return;
        }
        for awaited in [Awaited::Abort, Awaited::End] {
            self.answer_waiting(id, awaited, None, out);
        }
        self.settle(now, id, told, None, reason);
        let prefix = prefix(told == State::Failed);
        let mut nobody_knows = false;
        for awaited in [Awaited::Decision, Awaited::Outcome] {
            while let Some(waiter) = self.release(id, awaited) {
                let name = match (awaited, scope) {
                    (Awaited::Decision, Some(scope)) => self.memory.scope_name(scope),
                    _ => RESERVED_SCOPE,
                };
                let mut reply = Reply::refusal(name, ReplyText::About(prefix, reason));
                reply.state = told;
                out(waiter.peer, &reply);
                nobody_knows = true;
            }
        }
        // Without a held INIT the client has the id already, and learns it by STATUS.
        if nobody_knows {
            self.memory.tasks_mut().remove(id);
        }
    }

    /// Remembers the answer to an enveloped INIT; says whether its client wishes to be told a quick
    /// end in its place.
    pub(super) fn settle(
        &mut self,
        now: Instant,
        task: TaskId,
        state: State,
        id: Option<TaskId>,
        answer: &str,
    ) -> bool {
        let Some(init) = self.memory.init_of(task) else {
            return false;
        };
        let mut text = M::Text::default();
        text.set(answer);
        init.first = First::Answered { state, id, text };
        init.until = Some(now + KEEP_INIT);
        let (client, early_end) = (init.client, init.early_end);
        self.memory.on_settled(client, task);
        early_end
    }

    /// Answers all that await something of a task: with `text` and the present state, or with its
    /// end.
    pub(super) fn answer_waiting(
        &mut self,
        id: TaskId,
        awaited: Awaited,
        text: Option<&str>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        while let Some(waiter) = self.release(id, awaited) {
            let Some(task) = self.memory.tasks().get(id) else {
                continue;
            };
            let text = match text {
                Some(text) => text,
                None if awaited == Awaited::Abort && task.state == State::Aborted => "True",
                None => task.text.as_ref(),
            };
            let scope = self.memory.scope_name(task.extra);
            let reply = Reply::about(scope, id, task.state, ReplyText::Plain(text));
            out(waiter.peer, &reply);
        }
    }

    /// Answers one whose time has passed.
    pub(super) fn answer_late(
        &mut self,
        waiter: Waiter<M::Peer>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let id = waiter.task;
        if waiter.awaited == Awaited::EarlyEnd {
            return self.answer_accepted(waiter, out);
        }
        let task = self.memory.tasks().get(id);
        let progress = task.map_or(NOTHING_KNOWN, |task| task.text.as_ref());
        let state = task.map_or(State::Initiated, |task| task.state);
        match waiter.awaited {
            Awaited::Decision | Awaited::EarlyEnd => {
                let text = ReplyText::Undecided(id);
                self.answer_task(waiter, State::Accepted, text, out);
            }
            Awaited::Abort => {
                let text = ReplyText::Plain("aborting");
                self.answer_task(waiter, State::Accepted, text, out);
            }
            Awaited::End => self.answer_task(waiter, state, ReplyText::Plain(progress), out),
            Awaited::Outcome => {
                let text = ReplyText::Undecided(id);
                let reply = Reply::about(RESERVED_SCOPE, id, State::Accepted, text);
                out(waiter.peer, &reply);
            }
        }
    }

    /// The INIT of our client has waited for a quick end in vain: it gets the answer that is kept.
    pub(super) fn answer_accepted(
        &mut self,
        waiter: Waiter<M::Peer>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let id = waiter.task;
        let mut kept = M::Text::default();
        if let Some(LastInit {
            first: First::Answered { text, .. },
            ..
        }) = self.memory.init_of(id)
        {
            core::mem::swap(&mut kept, text);
        }
        let text = ReplyText::Plain(kept.as_ref());
        self.answer_task(waiter, State::Accepted, text, out);
        if let Some(LastInit {
            first: First::Answered { text, .. },
            ..
        }) = self.memory.init_of(id)
        {
            *text = kept;
        }
    }

    pub(super) fn answer_task(
        &self,
        waiter: Waiter<M::Peer>,
        state: State,
        text: ReplyText<'_>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let scope = self.memory.tasks().get(waiter.task).map(|task| task.extra);
        let name = scope.map_or("", |scope| self.memory.scope_name(scope));
        out(waiter.peer, &Reply::about(name, waiter.task, state, text));
    }

    pub(super) fn release(&mut self, id: TaskId, awaited: Awaited) -> Option<Waiter<M::Peer>> {
        let waiting = |w: &Waiter<M::Peer>| w.task == id && w.awaited == awaited;
        let place = self.memory.held().iter().position(waiting)?;
        self.memory.release(place)
    }
}
