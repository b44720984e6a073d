//! When the held answers go out, and what they say.

use super::{Dispatcher, RESERVED_SCOPE};
use crate::lifecycle::State;
use crate::memory::{Awaited, First, Memory, Waiter};
use crate::reply::{Reply, ReplyId, Text};
use crate::tasks::Tasks;
use crate::{Instant, TaskId};

/// Whose wait is over.
struct Over {
    /// Of those who wait for this task, ...
    task: Option<TaskId>,
    /// ... these, a bit for each [`kind`].
    kinds: u8,
    /// And until when those of them wait at most who would be told a quick end.
    early: Instant,
    /// Of all, whose time ends before this.
    late: Instant,
}

const fn kind(awaited: Awaited) -> u8 {
    1 << awaited as u8
}

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
        let mut over = Over {
            task: Some(id),
            kinds: 0,
            early: Instant::NEVER,
            late: Instant::ZERO,
        };
        if kept {
            over.early = self.now.after(self.early);
        }
        if decided {
            over.kinds = kind(Awaited::Decision) | kind(Awaited::Outcome);
        }
        // Otherwise nobody keeps the text for a moment.
        if ended || decided && !kept {
            over.kinds |= kind(Awaited::EarlyEnd);
        }
        if ended || abort_refused {
            over.kinds |= kind(Awaited::Abort);
        }
        if ended {
            over.kinds |= kind(Awaited::End);
        }
        // Without a held INIT the client has the id already, and learns it by STATUS.
        if self.answer_over(&over, Some((told, text)), out) && told != State::Accepted {
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
        let over = Over {
            task: settled,
            kinds: kind(Awaited::EarlyEnd),
            early: Instant::NEVER,
            late: self.now.after(1),
        };
        self.answer_over(&over, None, out);
    }

    /// Answers those whose wait is over; says whether one of them did not know yet that its task is decided.
    // Apart in firmware, since it is needed in two places.
    #[cfg_attr(target_os = "none", inline(never))]
    fn answer_over(
        &mut self,
        over: &Over,
        said: Option<(State, &str)>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> bool {
        let is_over = |waiter: &mut Waiter<M::Peer>| {
            let its = Some(waiter.task) == over.task;
            if its && waiter.awaited == Awaited::EarlyEnd {
                waiter.deadline = waiter.deadline.min(over.early);
            }
            its && over.kinds & kind(waiter.awaited) != 0 || waiter.deadline < over.late
        };
        let mut nobody_knew = false;
        while let Some(waiter) = self.memory.release(is_over) {
            nobody_knew |= !matches!(waiter.awaited, Awaited::Abort | Awaited::End);
            self.answer(waiter, said, out);
        }
        nobody_knew
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
