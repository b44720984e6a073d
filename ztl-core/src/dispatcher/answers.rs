//! When held replies are sent, and what they say.

use super::state::Dispatcher;
use crate::lifecycle::State;
use crate::memory::{Awaited, First, Memory, Waiter};
use crate::reply::{RESERVED_SCOPE, Reply, ReplyId, ReplyText};
use crate::tasks::Tasks;
use crate::{Instant, TaskId};

/// Selects the held replies to send now.
struct Due {
    /// The task whose replies are due, ...
    task: Option<TaskId>,
    /// ... if they wait for one of these events, a bit for each [`kind`].
    kinds: u8,
    /// New deadline for replies that wait for an early end of this task.
    early: Instant,
    /// Replies with a deadline before this are due, even if what they wait for has not happened.
    late: Instant,
}

const fn kind(awaited: Awaited) -> u8 {
    1 << awaited as u8
}

impl<M: Memory> Dispatcher<M> {
    /// Answers the requests that waited for this change: the task was decided, has ended, or will not be
    /// aborted. INITs are answered with `told` and `text`.
    pub(super) fn on_change(
        &mut self,
        id: TaskId,
        (told, text): (State, &str),
        abort_rejected: bool,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let Some(task) = self.memory.tasks().get(id) else {
            return;
        };
        let decided = task.state != State::Initiated;
        let ended = task.state.is_final();
        let kept = decided && self.settle(id, told, text);
        let mut due = Due {
            task: Some(id),
            kinds: 0,
            early: Instant::NEVER,
            late: Instant::ZERO,
        };
        if kept {
            due.early = self.now.after(self.early);
        }
        if decided {
            due.kinds = kind(Awaited::Decision) | kind(Awaited::Outcome);
        }
        // If no record keeps the text, the reply cannot wait for an early end.
        if ended || decided && !kept {
            due.kinds |= kind(Awaited::EarlyEnd);
        }
        if ended || abort_rejected {
            due.kinds |= kind(Awaited::Abort);
        }
        if ended {
            due.kinds |= kind(Awaited::End);
        }
        // Without a held INIT the client already has the id, and reads the state by STATUS.
        if self.answer_due(&due, Some((told, text)), out) && told != State::Accepted {
            self.memory.tasks_mut().remove(id);
        }
    }

    /// Sends the replies whose deadline has passed, and those that wait for an early end of the task
    /// `settled`, whose record is about to be replaced.
    pub(super) fn answer_late(
        &mut self,
        settled: Option<TaskId>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let due = Due {
            task: settled,
            kinds: kind(Awaited::EarlyEnd),
            early: Instant::NEVER,
            late: self.now.after(1),
        };
        self.answer_due(&due, None, out);
    }

    /// Sends the replies that are due. Returns whether one of them is the first to send its client the
    /// decision.
    fn answer_due(
        &mut self,
        due: &Due,
        said: Option<(State, &str)>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) -> bool {
        let is_due = |waiter: &mut Waiter<M::Peer>| {
            let its = Some(waiter.task) == due.task;
            if its && waiter.awaited == Awaited::EarlyEnd {
                waiter.deadline = waiter.deadline.min(due.early);
            }
            its && due.kinds & kind(waiter.awaited) != 0 || waiter.deadline < due.late
        };
        let mut nobody_knew = false;
        while let Some(waiter) = self.memory.release(is_due) {
            nobody_knew |= !matches!(waiter.awaited, Awaited::Abort | Awaited::End);
            self.answer(waiter, said, out);
        }
        nobody_knew
    }

    /// Stores the reply to the INIT of `task`; returns whether there is a record of it.
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

    /// Sends a held reply, because its event happened or its deadline passed. `said` is what the handler just
    /// reported.
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
                    reply.text = ReplyText::True;
                } else if !ended {
                    reply.text = ReplyText::False;
                    if said.is_none() {
                        reply.state = State::Accepted;
                        reply.text = ReplyText::Aborting;
                    }
                }
            }
            Awaited::EarlyEnd if ended && reply.state != State::Rejected => {}
            _ => {
                reply.state = State::Accepted;
                reply.text = ReplyText::Undecided;
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
