//! When the held answers go out, and what they say.

use super::{Dispatcher, RESERVED_SCOPE};
use crate::TaskId;
use crate::lifecycle::State;
use crate::memory::{Awaited, First, Memory, Waiter};
use crate::reply::{Reply, ReplyId, Text};
use crate::tasks::Tasks;

impl<M: Memory> Dispatcher<M> {
    /// A task was decided about, or has ended, or both at once, or will not be aborted: those who
    /// waited for it are answered, INITs with `told` and `text`.
    pub(super) fn on_change(
        &mut self,
        id: TaskId,
        (told, text): (State, &str),
        abort_refused: bool,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let Some(task) = self.memory.tasks().get(id) else {
            return;
        };
        let decided = task.state != State::Initiated;
        let ended = task.state.is_final();
        let kept = decided && self.settle(id, told, text);
        let early = self.now.after(self.early);
        let is_over = |waiter: &mut Waiter<M::Peer>| {
            waiter.task == id
                && match waiter.awaited {
                    Awaited::Decision | Awaited::Outcome => decided,
                    Awaited::Abort => ended || abort_refused,
                    Awaited::End => ended,
                    Awaited::EarlyEnd if kept => {
                        waiter.deadline = waiter.deadline.min(early);
                        ended
                    }
                    // Nobody keeps the text for a moment.
                    Awaited::EarlyEnd => decided,
                }
        };
        let mut nobody_knows = false;
        while let Some(waiter) = self.memory.release(is_over) {
            nobody_knows |= !matches!(waiter.awaited, Awaited::Abort | Awaited::End);
            self.answer(waiter, Some((told, text)), out);
        }
        // Without a held INIT the client has the id already, and learns it by STATUS.
        if nobody_knows && told != State::Accepted {
            self.memory.tasks_mut().remove(id);
        }
    }

    /// Answers those who have waited long enough, and those who wait for a quick end of a task whose
    /// INIT is `settled` by another.
    pub(super) fn answer_late(
        &mut self,
        settled: Option<TaskId>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let now = self.now;
        let is_over = |waiter: &mut Waiter<M::Peer>| {
            waiter.deadline <= now
                || (Some(waiter.task) == settled && waiter.awaited == Awaited::EarlyEnd)
        };
        while let Some(waiter) = self.memory.release(is_over) {
            self.answer(waiter, None, out);
        }
    }

    /// Remembers the answer to an enveloped INIT; says whether there is such a one.
    pub(super) fn settle(&mut self, task: TaskId, told: State, answer: &str) -> bool {
        let Some(init) = self.memory.init_of(task) else {
            return false;
        };
        if init.first == First::Pending {
            let (client, number) = (init.client, (init.number, init.check));
            let first = First::Answered(told);
            let task = (told == State::Accepted).then_some(task);
            self.remember(&client, number, first, task, answer);
        }
        true
    }

    /// Answers one that was held: what it waited for has happened, or its time has passed. `said` is
    /// what the handler just said.
    pub(super) fn answer(
        &self,
        waiter: Waiter<M::Peer>,
        said: Option<(State, &str)>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let id = waiter.task;
        let mut reply = Reply::refusal(self.boot);
        reply.scope = RESERVED_SCOPE;
        reply.id = ReplyId::Task(id);
        if let Some(task) = self.memory.tasks().get(id) {
            if waiter.awaited != Awaited::Outcome {
                reply.scope = self.memory.scope_name(task.extra);
            }
            reply.state = task.state;
            reply.say(task.text.as_ref());
        }
        let ended = reply.state.is_final();
        match waiter.awaited {
            Awaited::End => {}
            Awaited::Abort => {
                if reply.state == State::Aborted {
                    reply.text = Text::True;
                } else if !ended {
                    reply.text = Text::False;
                    if said.is_none() {
                        reply.state = State::Accepted;
                        reply.text = Text::Aborting;
                    }
                }
            }
            Awaited::EarlyEnd if ended && reply.state != State::Rejected => {}
            _ => {
                reply.state = State::Accepted;
                reply.text = Text::Undecided;
                let known = || {
                    let init = self.memory.init_of(id)?;
                    match init.first {
                        First::Answered(told) => Some((told, init.text.as_ref())),
                        _ => None,
                    }
                };
                if let Some((told, text)) = said.or_else(known) {
                    reply.decide(told, id, text);
                }
            }
        }
        out(waiter.peer, &reply);
    }
}
