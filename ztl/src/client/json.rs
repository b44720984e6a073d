//! Reports events as JSON, one object a line. Programs rely on the names, which `docs/tools.md` lists.

use serde::Serialize;
use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::{RemoteId, Status};

use super::event::{ClientEvent, LastEvent, TaskOutcome};
use super::task::{ClientTask, Target};
use crate::terminal::line;

/// A line.
#[derive(Debug, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
enum Line<'a> {
    Asking {
        host: &'a str,
        port: i64,
        scope: &'a str,
        request: &'a str,
    },
    Interrupted,
    Started {
        id: &'a RemoteId,
        reply: &'a str,
    },
    Progress {
        id: &'a RemoteId,
        state: &'static str,
        /// The task's own progress.
        text: Option<&'a str>,
    },
    Aborting {
        id: &'a RemoteId,
        interrupted: bool,
    },
    NotAborted {
        id: &'a RemoteId,
        reply: &'a str,
    },
    Over {
        /// `None` if no task is known to have started.
        id: Option<&'a RemoteId>,
        outcome: &'static str,
        /// The exit code with `--exit-status`.
        exit_status: u8,
        /// Result or reason.
        text: &'a str,
    },
}

/// Reports events to a program.
pub(super) struct JsonReporter<'a> {
    target: Target<'a>,
    request: &'a str,
    /// The latest progress.
    last: Option<Status>,
}

impl<'a> JsonReporter<'a> {
    pub(super) fn new(task: &ClientTask<'a>) -> Self {
        Self {
            target: task.target,
            request: task.request,
            last: None,
        }
    }

    pub(super) fn report(&mut self, event: &ClientEvent<'_>) {
        let Target { host, port, scope } = self.target;
        let told = match event {
            ClientEvent::Asking => Line::Asking {
                host,
                port,
                scope,
                request: self.request,
            },
            ClientEvent::Interrupted => Line::Interrupted,
            ClientEvent::Started { id, reply } => Line::Started { id, reply },
            // Only changes are reported.
            ClientEvent::Progress { status, .. } if self.last.as_ref() == Some(status) => return,
            ClientEvent::Progress { id, status } => {
                self.last = Some((*status).clone());
                Line::Progress {
                    id,
                    state: status.state.name(),
                    text: Some(status.text.as_str()).filter(|text| *text != NOTHING_KNOWN),
                }
            }
            ClientEvent::Aborting { id, interrupted } => Line::Aborting {
                id,
                interrupted: *interrupted,
            },
            ClientEvent::NotAborted { id, reply, .. } => Line::NotAborted { id, reply },
            ClientEvent::Last(last) => end(last),
        };
        // Cannot fail: there are no maps and no floating-point numbers.
        line(serde_json::to_string(&told).unwrap_or_default());
    }
}

fn end<'a>(last: &'a LastEvent<'a>) -> Line<'a> {
    let (id, text): (Option<&RemoteId>, &str) = match last {
        LastEvent::NotTriggered { reason, .. } => (None, reason),
        LastEvent::Ended { id, status } => (Some(*id), &status.text),
        // The reply to an ABORT is not the result.
        LastEvent::Stopped { id, words, .. } => (Some(*id), words),
        LastEvent::Lost { id, reason, .. } | LastEvent::StopUnclear { id, reason, .. } => {
            (Some(*id), reason)
        }
        LastEvent::After { id, text, .. } => (Some(*id), text),
        LastEvent::Left { id, reply } => (Some(*id), reply),
    };
    let outcome = last.outcome();
    Line::Over {
        id,
        outcome: name(outcome),
        exit_status: outcome.code(),
        text,
    }
}

const fn name(outcome: TaskOutcome) -> &'static str {
    match outcome {
        TaskOutcome::Completed => "completed",
        TaskOutcome::Rejected => "rejected",
        TaskOutcome::Failed => "failed",
        TaskOutcome::Aborted => "aborted",
        TaskOutcome::Unknown => "unknown",
        TaskOutcome::NotStarted => "not_started",
    }
}
