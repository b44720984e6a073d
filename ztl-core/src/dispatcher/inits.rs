//! INITs: a new one starts a task, a repeated one does not.

use super::config::KEEP_INIT;
use super::interface::Action;
use super::state::{Asked, Dispatcher};
use crate::envelope::{ClientId, Envelope};
use crate::lifecycle::State;
use crate::memory::{Awaited, First, Memory, Scope};
use crate::reply::{NOTHING_KNOWN, Reply, ReplyText};
use crate::tasks::{StoredText, Task, TaskRules};
use crate::time::micros;
use crate::{Instant, TaskId};

/// What is known about an INIT.
pub(super) enum Known {
    /// It has not arrived, or its record has expired.
    New,
    /// It may have arrived, but the record was evicted.
    Forgotten,
    /// Its client was told that it never arrived; it must not start anything.
    Void,
    /// A later INIT of this client has arrived.
    Settled,
    /// Another INIT has the same number.
    Taken,
    /// It is the client's last one and has a task or a reply: see `tell_again`.
    Last,
}

// The inline attributes of these methods together save 116 bytes in `microbit-zmtp`.
impl<M: Memory> Dispatcher<M> {
    pub(super) fn on_init<'r, 'a: 'r>(
        &'r mut self,
        scope: Scope,
        payload: &'a str,
        asked: &mut Asked<'r, 'a>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        asked.reply.text = ReplyText::GivenUp;
        let check = check(scope, payload);
        let mut awaited = Awaited::Decision;
        if let Some(envelope) = asked.envelope {
            if envelope.early_end {
                awaited = Awaited::EarlyEnd;
            }
            match self.known(asked, envelope.number, Some(check)) {
                Known::New => self.settle_last(&envelope.client, out),
                Known::Void | Known::Settled => return,
                Known::Forgotten => {
                    asked.reply.text = ReplyText::ManyClients;
                    return;
                }
                Known::Taken => {
                    asked.reply.text = ReplyText::NumberTaken;
                    return;
                }
                Known::Last => return self.tell_again(&envelope.client, awaited, asked),
            }
        }
        let Some(id) = self.next else {
            asked.reply.text = ReplyText::NoMoreIds;
            return;
        };
        if self.memory.last_id().is_some_and(|last| id > last) {
            asked.reply.text = ReplyText::NoIdYet;
            return;
        }
        // Check everything that can reject the INIT before `admit`, which may drop an ended task.
        if let Some(Envelope { client, number, .. }) = asked.envelope
            && !self.remember(client, (*number, check), First::Pending, Some(id), "")
        {
            asked.reply.text = ReplyText::ManyClients;
            return;
        }
        let mut refused = Some(ReplyText::ManyWaiting);
        if self.memory.can_hold() {
            refused = match self.memory.tasks_mut().admit(id, Task::new(scope)) {
                Ok(task) => {
                    task.text.set(NOTHING_KNOWN);
                    None
                }
                Err(_) => Some(ReplyText::ManyTasks),
            };
        }
        if let Some(reason) = refused {
            self.settle(id, State::Rejected, reason.template());
            asked.reply.text = reason;
            return;
        }
        self.next = id.next();
        asked.wait = Some((id, awaited));
        asked.action = Some(Action::Start { id, scope, payload });
    }

    /// Looks up the client's INIT with this number. `check` is its checksum if it has just arrived.
    #[cfg_attr(target_os = "none", inline(always))]
    pub(super) fn known(&self, asked: &Asked<'_, '_>, number: u64, check: Option<u32>) -> Known {
        let last = |envelope: &Envelope| self.memory.last_init(&envelope.client);
        let Some(init) = asked.envelope.and_then(last) else {
            return match number < asked.new_from {
                true => Known::Forgotten,
                false => Known::New,
            };
        };
        match init.first {
            _ if init.number < number => Known::New,
            _ if init.number > number => Known::Settled,
            First::Void => Known::Void,
            _ if check.is_some_and(|check| check != init.check) => Known::Taken,
            First::Pending | First::Answered(_) => Known::Last,
        }
    }

    /// Records a client's last INIT; returns whether there was room.
    // Not inlined in firmware: with `start` of the ZMTP server, that saves 264 bytes of stack in `microbit-zmtp`.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn remember(
        &mut self,
        client: &ClientId,
        (number, check): (u64, u32),
        first: First,
        task: Option<TaskId>,
        text: &str,
    ) -> bool {
        let until = self.now.after(micros(KEEP_INIT));
        let Some(init) = self.memory.remember(client, until) else {
            return false;
        };
        init.number = number;
        init.check = check;
        init.first = first;
        init.received &= matches!(first, First::Answered(_));
        init.task = task;
        init.text.set(text);
        init.until = match first {
            First::Pending => Instant::NEVER,
            _ => until,
        };
        self.memory.on_remembered(client);
        true
    }

    /// Repeats the reply to a client's last INIT, or waits for it.
    pub(super) fn tell_again<'r>(
        &'r self,
        client: &ClientId,
        awaited: Awaited,
        asked: &mut Asked<'r, '_>,
    ) {
        let Some(init) = self.memory.last_init(client) else {
            return;
        };
        // An INIT without a task was rejected; its reply has no id.
        let task = init.task.unwrap_or(TaskId::MAX);
        match init.first {
            First::Answered(told) => asked.reply.decide(told, task, init.text.as_ref()),
            _ => asked.wait = Some((task, awaited)),
        }
    }

    /// A client's last INIT is about to be replaced: sends the replies that wait for an early end of its task
    /// while their text is still stored.
    #[cfg_attr(target_os = "none", inline(always))]
    pub(super) fn settle_last(
        &mut self,
        client: &ClientId,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        if let Some(last) = self.memory.last_init(client)
            && last.first != First::Pending
        {
            self.answer_late(last.task, out);
        }
    }
}

/// Checksum (FNV-1a) that detects another INIT under the same number, which only a faulty client sends.
fn check(scope: Scope, payload: &str) -> u32 {
    payload
        .bytes()
        .fold(0x811C_9DC5 ^ u32::from(scope.0), |sum, byte| {
            (sum ^ u32::from(byte)).wrapping_mul(0x0100_0193)
        })
}
