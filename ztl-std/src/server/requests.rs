//! One request: from its frames to its answer, or to the handler that takes its task.

use tracing::{error, warn};
use ztl_core::dispatcher::{Action, Body};
use ztl_core::envelope::Envelope;
use ztl_core::integer::Integer;
use ztl_core::memory::Memory;
use ztl_core::message::Message;
use ztl_core::reply::{RefusalOf, Reply};
use ztl_core::tasks::Tasks;
use ztl_core::{Request, TaskId};

use super::access::Who;
use super::report::TaskReporter;
use super::{LOG, TaskServer, now};

impl TaskServer {
    /// Shows a request about a task to the witness.
    fn show(&mut self, body: Body<'_>) {
        let (Some(witness), Body::One(body)) = (&mut self.witness, body) else {
            return;
        };
        let Ok(message) = Message::parse(body) else {
            return;
        };
        let value = |integer: Result<Integer<'_>, _>| integer.ok().and_then(Integer::value);
        let request = value(message.code()).and_then(Request::from_code);
        let id = value(message.number()).and_then(|id| u32::try_from(id).ok());
        if let (Some(request), Some(id)) = (request, id.and_then(TaskId::new))
            && request != Request::Init
            && let Some(task) = self.dispatcher.memory().tasks().get(id)
            && self.dispatcher.memory().scope_name(task.extra) == message.scope
        {
            witness(request, id, message.payload);
        }
    }

    /// Answers a message, or hands its task to the scope's handler.
    pub(super) fn serve(&mut self, mut frames: Vec<zmq::Message>, who: Who) {
        // Identity, any envelope, an empty frame, and then the body. Without the empty frame it
        // is no request: a REP socket drops it too.
        let Some(delimiter) = frames.iter().position(|frame| frame.is_empty()) else {
            return self.dropped.tell(now(), "without a delimiter");
        };
        let content = (frames.len() == delimiter + 2).then(|| frames.pop());
        frames.truncate(delimiter + 1);
        let body = match &content {
            Some(Some(content)) => Body::One(content),
            _ => Body::Several,
        };
        self.show(body);
        let router = &self.router;
        let envelope = match frames.as_slice() {
            // A proxy on the way puts its own frames before these two.
            [_identity, .., client, number, _delimiter] => Envelope::parse(client, number),
            _ => None,
        };
        let mut out = |peer, reply: &Reply<'_>| {
            log_refusal(reply, body);
            router.answer(peer, reply);
        };
        if let Who::Client(_) = who {
            let door = &self.door;
            let hidden = |scope: &str| !door.lets_use(who, scope);
            self.dispatcher.memory_mut().hide(hidden);
        }
        let action = self
            .dispatcher
            .handle_request(now(), frames, envelope, body, &mut out);
        self.dispatcher.memory_mut().hide(|_| false);
        if self.dispatcher.next_id().is_none() && !self.said_used_up {
            self.said_used_up = true;
            error!(target: LOG, "All task ids are used up: every further task is refused. Restart the server, without its journal if it has one.");
        }
        if let Some(envelope) = envelope
            && !matches!(action, Some(Action::Start { .. }))
        {
            self.touch.on_heard(now(), envelope.client);
        }
        match action {
            Some(Action::Start { id, scope, payload }) => {
                let heap = self.dispatcher.memory_mut();
                heap.note_payload(id, payload, now());
                let client = envelope.map(|envelope| envelope.client);
                let task = TaskReporter::new(id, self.mailbox.clone(), client);
                match self.handlers.get_mut(usize::from(scope.0)) {
                    Some(handler) => {
                        handler.start(task, payload);
                        self.started = true;
                    }
                    None => task.rejected("the server is stopping"),
                }
            }
            Some(Action::Abort { id, scope }) => {
                if let Some(handler) = self.handlers.get_mut(usize::from(scope.0)) {
                    handler.abort(id);
                }
            }
            None => {}
        }
    }
}

/// Logs what the original logs of a request that it cannot use (wire specification 7.1).
fn log_refusal(reply: &Reply<'_>, body: Body<'_>) {
    match reply.refusal_of() {
        Some(RefusalOf::Scope) => {
            warn!(target: LOG, "No controller for scope '{}', ignoring.", reply.scope());
        }
        Some(RefusalOf::Protocol) => {
            let bytes = match body {
                Body::One(bytes) => bytes.get(..200).unwrap_or(bytes),
                Body::Several => b"",
            };
            let bytes = bytes.escape_ascii();
            warn!(target: LOG, "Unknown command received 'b'{bytes}'', ignoring.");
        }
        None => {}
    }
}
