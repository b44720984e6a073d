//! What happens as JSON, one object a line. The names are for programs and stay as they are:
//! `docs/tools.md` tells them.

use serde::Serialize;
use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::{RemoteId, Status};

use super::{Conversation, Fate, News, Over, Target};
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
        /// What the task has told of itself.
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
        /// Without an id there is no task, as far as is known.
        id: Option<&'a RemoteId>,
        fate: &'static str,
        /// What `--exit-status` makes the exit code.
        exit_status: u8,
        /// Result or reason.
        text: &'a str,
    },
}

/// Tells it to a program.
pub(super) struct Teller<'a> {
    target: Target<'a>,
    request: &'a str,
    /// What was told of the progress last.
    last: Option<Status>,
}

impl<'a> Teller<'a> {
    pub(super) fn new(conversation: &Conversation<'a>) -> Self {
        Self {
            target: conversation.target,
            request: conversation.request,
            last: None,
        }
    }

    pub(super) fn tell(&mut self, news: &News<'_>) {
        let Target { host, port, scope } = self.target;
        let told = match news {
            News::Asking => Line::Asking {
                host,
                port,
                scope,
                request: self.request,
            },
            News::Interrupted => Line::Interrupted,
            News::Started { id, reply } => Line::Started { id, reply },
            // Only what is new is told.
            News::Progress { status, .. } if self.last.as_ref() == Some(status) => return,
            News::Progress { id, status } => {
                self.last = Some((*status).clone());
                Line::Progress {
                    id,
                    state: status.state.name(),
                    text: Some(status.text.as_str()).filter(|text| *text != NOTHING_KNOWN),
                }
            }
            News::Aborting { id, interrupted } => Line::Aborting {
                id,
                interrupted: *interrupted,
            },
            News::NotAborted { id, reply, .. } => Line::NotAborted { id, reply },
            News::Over(over) => end(over),
        };
        // Nothing in it that JSON has not: no maps, no numbers that are none.
        line(serde_json::to_string(&told).unwrap_or_default());
    }
}

fn end<'a>(over: &'a Over<'a>) -> Line<'a> {
    let (id, text): (Option<&RemoteId>, &str) = match over {
        Over::NotTriggered { reason, .. } => (None, reason),
        Over::Ended { id, status } => (Some(*id), &status.text),
        // The answer to an ABORT is not the result.
        Over::Stopped { id, words, .. } => (Some(*id), words),
        Over::Lost { id, reason, .. } | Over::StopUnclear { id, reason } => (Some(*id), reason),
        Over::After { id, text, .. } => (Some(*id), text),
        Over::Left { id, reply } => (Some(*id), reply),
    };
    let fate = over.fate();
    Line::Over {
        id,
        fate: name(fate),
        exit_status: fate.code(),
        text,
    }
}

const fn name(fate: Fate) -> &'static str {
    match fate {
        Fate::Completed => "completed",
        Fate::Refused => "refused",
        Fate::Failed => "failed",
        Fate::Aborted => "aborted",
        Fate::Unknown => "unknown",
        Fate::NotStarted => "not_started",
    }
}
