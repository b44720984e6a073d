//! The reserved scope `$ztl`: information about this server, and the outcome of an INIT.

use super::inits::Known;
use super::state::{Asked, Dispatcher, argument};
use crate::integer::Integer;
use crate::lifecycle::{Request, State};
use crate::memory::{Awaited, First, Memory};
use crate::reply::{Put, Reply, ReplyId, ReplyText, Words};
use crate::sink::{Sink, put_decimal};
use crate::tasks::Tasks;

impl<M: Memory> Dispatcher<M> {
    pub(super) fn on_reserved<'r, 'a: 'r>(
        &'r mut self,
        request: Option<Request>,
        payload: &str,
        asked: &mut Asked<'r, 'a>,
        out: &mut impl FnMut(M::Peer, &Reply<'_>),
    ) {
        let reply = &mut asked.reply;
        reply.id = ReplyId::Asked(Integer::ZERO);
        reply.text = ReplyText::InvalidReserved;
        if request != Some(Request::Status) {
            return;
        }
        if payload == "probe" {
            reply.state = State::Completed;
            reply.text = ReplyText::Probed;
            reply.words = Words::Put(self);
            return;
        }
        let (Some(envelope), Some(number)) = (asked.envelope, argument(payload, "outcome ")) else {
            if let Some(text) = self.memory.answer(payload) {
                reply.state = State::Completed;
                reply.text = ReplyText::Words;
                reply.words = Words::Said(text);
            }
            return;
        };
        let client = &envelope.client;
        match self.known(asked, number, None) {
            Known::Forgotten => asked.reply.text = ReplyText::ManyClients,
            Known::Settled => asked.reply.text = ReplyText::Settled,
            Known::Last => self.tell_again(client, Awaited::Outcome, asked),
            // From now on the INIT is rejected, for as long as a reply would be kept.
            Known::New | Known::Void | Known::Taken => {
                self.settle_last(client, out);
                let number = (number, 0);
                let first = First::Void;
                asked.reply.text = if self.remember(client, number, first, None, "") {
                    ReplyText::NeverSeen
                } else {
                    ReplyText::ManyClients
                };
            }
        }
    }
}

/// The part of the reply to `probe` after the boot id: a YAML flow mapping, opened and closed by
/// [`ReplyText::Probed`].
impl<M: Memory> Put for Dispatcher<M> {
    fn put(&self, sink: &mut dyn Sink) {
        if let Some(most) = self.memory.longest_message() {
            sink.put(b", message: ");
            put_decimal(sink, most);
        }
        sink.put(b", scopes: ");
        self.memory.put_scopes(sink);
        sink.put(b", running: {");
        let mut separator = "";
        for (id, task) in self.memory.tasks().iter() {
            if !task.state.is_final() {
                sink.put(separator.as_bytes());
                separator = ", ";
                put_decimal(sink, id.get());
                sink.put(b": ");
                self.memory.put_scope(task.extra, sink);
            }
        }
    }
}
