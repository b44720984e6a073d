//! The reserved scope `$ztl`: who this server is, and what became of an INIT.

use super::{Asker, Dispatcher, KEEP_INIT, RESERVED_SCOPE, first_answer};
use crate::envelope::Envelope;
use crate::integer::Integer;
use crate::lifecycle::{Request, State};
use crate::memory::{Awaited, First, LastInit, Memory};
use crate::message::Message;
use crate::reply::{Put, Reply, ReplyText};
use crate::repr::put_yaml;
use crate::sink::{Sink, put_decimal};
use crate::tasks::Tasks;
use crate::{Instant, VERSION};

impl<M: Memory> Dispatcher<M> {
    pub(super) fn on_reserved(
        &mut self,
        now: Instant,
        asker: Asker<M::Peer>,
        message: Message<'_>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let invalid = "Invalid request: $ztl takes STATUS with the payload 'probe' or 'outcome N'";
        let code = message.code().ok().and_then(Integer::value);
        let status = code.and_then(Request::from_code) == Some(Request::Status);
        match (status, message.payload, asker.envelope) {
            (true, "probe", _) => {
                let probe = Probe(self);
                let text = ReplyText::Probe(&probe);
                out(asker.peer, &Reply::reserved(State::Completed, text));
            }
            (true, payload, envelope) => match (asked_outcome(payload), envelope) {
                (Some(number), Some(envelope)) => {
                    self.on_outcome(now, asker.peer, envelope, number, out);
                }
                _ => match self.memory.answer(payload) {
                    Some(text) => {
                        let text = ReplyText::Plain(text.as_ref());
                        out(asker.peer, &Reply::reserved(State::Completed, text));
                    }
                    None => out(asker.peer, &refusal(invalid)),
                },
            },
            _ => out(asker.peer, &refusal(invalid)),
        }
    }

    /// Tells what the INIT of this number was answered; if it never came, it is refused from now on
    /// for as long as an answer would be kept.
    fn on_outcome(
        &mut self,
        now: Instant,
        peer: M::Peer,
        asker: Envelope,
        number: u64,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let client = asker.client;
        if let Some(known) = self.memory.last_init(client)
            && known.number >= number
        {
            if known.number > number {
                return out(peer, &refusal("settled by a later INIT"));
            }
            match &known.first {
                First::Pending(task) => {
                    let task = *task;
                    let waiter = self.waiter(now, peer, task, Awaited::Outcome);
                    if let Err(waiter) = self.memory.hold(waiter) {
                        self.answer_late(waiter, out);
                    }
                    return;
                }
                First::Answered { state, id, text } => {
                    return out(
                        peer,
                        &first_answer(RESERVED_SCOPE, *state, *id, text.as_ref()),
                    );
                }
                First::Void => {}
            }
        }
        let void = LastInit {
            client,
            number,
            early_end: false,
            first: First::<M::Text>::Void,
            until: Some(now + KEEP_INIT),
        };
        let boot = self.config.boot;
        let reply = if self.memory.remember(void) {
            Reply::reserved(State::Rejected, ReplyText::NeverSeen { boot })
        } else {
            refusal("too many clients at a time, try again in a minute")
        };
        out(peer, &reply);
    }
}

fn refusal(reason: &str) -> Reply<'_> {
    Reply::reserved(State::Rejected, ReplyText::Plain(reason))
}

fn asked_outcome(payload: &str) -> Option<u64> {
    let number = Integer::parse(payload.strip_prefix("outcome ")?).ok()?;
    u64::try_from(number.value()?).ok()
}

/// What `probe` is answered: a mapping in YAML's flow style.
struct Probe<'a, M>(&'a Dispatcher<M>);

impl<M: Memory> Put for Probe<'_, M> {
    fn put(&self, sink: &mut dyn Sink) {
        let Self(dispatcher) = self;
        sink.put(b"{ztl: 1, version: '");
        sink.put(VERSION.as_bytes());
        sink.put(b"', boot: ");
        put_decimal(sink, dispatcher.config.boot);
        sink.put(b", scopes: ");
        dispatcher.memory.put_scopes(sink);
        sink.put(b", running: {");
        let mut first = true;
        dispatcher.memory.tasks().for_each(&mut |id, task| {
            if task.state.is_final() {
                return;
            }
            if !core::mem::take(&mut first) {
                sink.put(b", ");
            }
            put_decimal(sink, id.get());
            sink.put(b": ");
            put_yaml(dispatcher.memory.scope_name(task.extra), sink);
        });
        sink.put(b"}}");
    }
}
