//! Requests that leave.

use ztl_core::Instant;

use super::super::event::{Event, Kind, RequestNumber, TaskNumber};
use super::{Ask, Player, Request, Sent, What};

impl Player {
    /// Sends a request about a task.
    pub(super) fn send(
        &mut self,
        now: Instant,
        task: TaskNumber,
        ask: Ask,
    ) -> Option<RequestNumber> {
        let remote = self.tasks.get(&task)?.remote.clone();
        Some(self.send_to(now, &remote, Some(task), ask))
    }

    /// Sends a request. Those about a task are events too.
    pub(super) fn send_to(
        &mut self,
        now: Instant,
        remote: &str,
        task: Option<TaskNumber>,
        ask: Ask,
    ) -> RequestNumber {
        let number = RequestNumber(self.next_request);
        self.next_request += 1;
        let (what, told) = match &ask {
            Ask::Init {
                handler,
                component,
                goal,
            } => (
                What::Init,
                Some((Kind::Init, format!("{handler}:{component}:{goal}"))),
            ),
            Ask::Status { text, hold, .. } => {
                let held = !hold.is_zero();
                let text = match held {
                    true => format!("wait {}", hold.as_millis()),
                    false => text.clone(),
                };
                (What::Status { held }, Some((Kind::Status, text)))
            }
            Ask::Abort { .. } => (What::Abort, Some((Kind::Abort, "abort command".to_owned()))),
            Ask::Probe => (What::Probe, None),
            Ask::Tasks => (What::Tasks, None),
        };
        let remote = remote.to_owned();
        let sent = Sent {
            task,
            remote: remote.clone(),
            what,
            at: now,
        };
        self.under_way.insert(number, sent);
        if let Some((kind, text)) = told {
            self.events.push_back(Event::RequestSent {
                request: number,
                kind,
                remote: remote.clone(),
                task,
                text,
            });
        }
        self.requests.push_back(Request {
            number,
            task,
            remote,
            ask,
        });
        number
    }
}
