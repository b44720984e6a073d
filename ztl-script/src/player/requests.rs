//! Requests to servers.

use ztl_core::Instant;

use super::state::{Pending, Player, Request};
use crate::event::{RequestKind, RequestNumber, RunEvent, TaskNumber};
use crate::server::ServerRequest;

impl Player {
    /// Sends a request about a task.
    pub(super) fn send(
        &mut self,
        now: Instant,
        task: TaskNumber,
        body: ServerRequest,
    ) -> Option<RequestNumber> {
        let remote = self.tasks.get(&task)?.remote.clone();
        Some(self.send_to(now, remote, Some(task), body))
    }

    /// Sends a request. One about a task is recorded as an event.
    pub(super) fn send_to(
        &mut self,
        now: Instant,
        remote: String,
        task: Option<TaskNumber>,
        body: ServerRequest,
    ) -> RequestNumber {
        let request = RequestNumber(self.next_request);
        self.next_request += 1;
        if let Some((kind, text)) = about_task(&body) {
            let hold = match &body {
                ServerRequest::Status { hold, .. } if !hold.is_zero() => Some(*hold),
                _ => None,
            };
            self.emit(RunEvent::RequestSent {
                request,
                kind,
                remote: remote.clone(),
                task,
                text,
                hold,
            });
        }
        let pending = Pending {
            task,
            remote: remote.clone(),
            body: body.clone(),
            at: now,
        };
        self.under_way.insert(request, pending);
        self.requests.push_back(Request {
            number: request,
            remote,
            body,
        });
        request
    }
}

/// The kind and the recorded text of a request about a task.
fn about_task(body: &ServerRequest) -> Option<(RequestKind, String)> {
    match body {
        ServerRequest::Init {
            handler,
            component,
            goal,
        } => Some((RequestKind::Init, format!("{handler}:{component}:{goal}"))),
        ServerRequest::Status { text, hold, .. } => Some((
            RequestKind::Status,
            ServerRequest::status_payload(text, *hold),
        )),
        ServerRequest::Abort { .. } => Some((RequestKind::Abort, "abort command".to_owned())),
        ServerRequest::Probe | ServerRequest::Tasks => None,
    }
}
