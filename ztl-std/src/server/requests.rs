//! Serves one request: from its frames to the answer, or to the handler of its task.

use tracing::{error, warn};
use ztl_core::TaskId;
use ztl_core::dispatcher::{Action, Body};
use ztl_core::integer::Integer;
use ztl_core::memory::Memory;
use ztl_core::message::Message;
use ztl_core::reply::{RefusalOf, Reply};
use ztl_core::tasks::Tasks;

use super::access::Sender;
use super::clock::now;
use super::engine::{Engine, answer};
use super::incoming::Request;
use super::reporter::TaskReporter;
use crate::log_targets::TASKS;

impl Engine {
    /// Shows a request about a task to the observer.
    fn observe(&mut self, body: Body<'_>) {
        let (Some(observer), Body::One(body)) = (&mut self.observer, body) else {
            return;
        };
        let Ok(message) = Message::parse(body) else {
            return;
        };
        let value = |integer: Result<Integer<'_>, _>| integer.ok().and_then(Integer::value);
        let request = value(message.code()).and_then(ztl_core::Request::from_code);
        let id = value(message.number()).and_then(|id| u32::try_from(id).ok());
        if let (Some(request), Some(id)) = (request, id.and_then(TaskId::new))
            && request != ztl_core::Request::Init
            && let Some(task) = self.dispatcher.memory().tasks().get(id)
            && self.dispatcher.memory().scope_name(task.extra) == message.scope
        {
            observer(request, id, message.payload);
        }
    }

    /// Answers a request, or hands its task to the scope's handler.
    pub(super) fn serve(&mut self, request: Request) {
        let Request {
            path,
            envelope,
            content,
            sender,
        } = request;
        let body = match &content {
            Some(content) => Body::One(content),
            None => Body::Several,
        };
        self.observe(body);
        let hidden = |scope: &str| !self.router.access().may_use(sender, scope);
        if let Sender::Client(_) = sender {
            self.dispatcher.memory_mut().hide(hidden);
        }
        let (router, untold) = (&mut self.router, &mut self.untold);
        let refusals = &mut self.refusals;
        let mut out = |peer, reply: &Reply<'_>| {
            if reply.refusal_of().is_some() && refusals.take(now()) {
                log_refusal(reply, body);
            }
            answer(router, untold, peer, reply);
        };
        let action = self
            .dispatcher
            .handle_request(now(), path, envelope, body, &mut out);
        self.dispatcher.memory_mut().hide(|_| false);
        if self.dispatcher.next_id().is_none() && !self.logged_used_up {
            self.logged_used_up = true;
            error!(target: TASKS, "All task ids are used up: every further task is refused. Restart the server, without its journal if it has one.");
        }
        if let Some(envelope) = envelope {
            let is_init = matches!(action, Some(Action::Start { .. }));
            self.clients.on_heard(now(), envelope.client, is_init);
        }
        match action {
            Some(Action::Start { id, scope, payload }) => {
                let memory = self.dispatcher.memory_mut();
                memory.give(id);
                memory.note_payload(id, payload, now());
                let client = envelope.map(|envelope| envelope.client);
                #[cfg(feature = "publish")]
                if let Some(events) = &mut self.events {
                    let scope = self.dispatcher.memory().scope_name(scope);
                    events.on_asked(scope, id, payload, client);
                }
                let mut task = TaskReporter::new(id, self.mailbox.clone(), client);
                // Who sends no other request cannot be missed.
                task.can_be_missed = envelope.is_some_and(|envelope| envelope.number > 0);
                match self.handlers.get_mut(usize::from(scope.0)) {
                    Some(handler) => {
                        handler.start_payload(task, payload);
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

/// Logs a request that is refused; one that cannot be used in the words of the original's server.
fn log_refusal(reply: &Reply<'_>, body: Body<'_>) {
    let scope = reply.scope();
    let shown = scope.get(..scope.floor_char_boundary(200)).unwrap_or(scope);
    match reply.refusal_of() {
        Some(RefusalOf::Scope) => {
            warn!(target: TASKS, "No controller for scope '{shown}', ignoring.");
        }
        Some(RefusalOf::Protocol) => {
            let bytes = match body {
                Body::One(bytes) => bytes.get(..200).unwrap_or(bytes),
                Body::Several => b"",
            };
            let bytes = bytes.escape_ascii();
            warn!(target: TASKS, "Unknown command received 'b'{bytes}'', ignoring.");
        }
        Some(RefusalOf::Limit(reason)) => {
            warn!(target: TASKS, "A request for scope '{shown}' was refused: {reason}");
        }
        None => {}
    }
}
