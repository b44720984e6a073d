//! The original's lines, and a line that shows the progress on a terminal.

use std::time::{Duration, Instant};

use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::{RemoteId, State, Status};

use super::{Conversation, News, Over, Target};
use crate::terminal::{flat, is_live, line, line_with_state, rewrite};

/// In whose words.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Words {
    /// `task-client`'s; with the seconds that it waits, as they were given.
    TaskClient(i64),
    /// `remote-task`'s; the same.
    RemoteTask(i64),
    /// `simple-client`'s, which waits for 5 s.
    Simple,
}

impl Words {
    /// How long is waited, for ever if this is `None`.
    pub(super) fn limit(self) -> Option<Duration> {
        let seconds = match self {
            Self::TaskClient(seconds) | Self::RemoteTask(seconds) => seconds,
            Self::Simple => 5,
        };
        let seconds = u64::try_from(seconds).ok().filter(|seconds| *seconds > 0);
        seconds.map(Duration::from_secs)
    }

    /// Says that a task has finished, with its state where these words tell it.
    fn finished(self, id: &RemoteId, state: Option<State>, rest: &str) {
        let task = format!("Task with ID '{id}' finished");
        match (self, state) {
            (Self::Simple, _) => line(format_args!("{task} {rest}")),
            (_, Some(state)) => {
                line_with_state(&format!("{task} in state '"), state, &format!("' {rest}"));
            }
            (_, None) => line(format_args!("{task} in state 'None' {rest}")),
        }
    }
}

/// `remote-task` does not say this.
pub(super) fn connecting(conversation: &Conversation<'_>) {
    let Target { host, port, scope } = conversation.target;
    if !matches!(conversation.words, Words::RemoteTask(_)) {
        line(format_args!(
            "Connecting to host '{host}:{port}' at scope '{scope}'..."
        ));
    }
}

/// Tells it to a person.
pub(super) struct Teller<'a> {
    request: &'a str,
    words: Words,
    as_original: bool,
    start: Instant,
    /// Whether the line of the progress is there.
    shown: bool,
}

impl<'a> Teller<'a> {
    pub(super) fn new(conversation: &Conversation<'a>) -> Self {
        Self {
            request: conversation.request,
            words: conversation.words,
            as_original: conversation.as_original,
            start: Instant::now(),
            shown: false,
        }
    }

    pub(super) fn tell(&mut self, news: &News<'_>) {
        if let News::Progress { status, .. } = news {
            return self.progress(status);
        }
        if std::mem::take(&mut self.shown) {
            // It makes room.
            rewrite("", "");
        }
        let request = self.request;
        match news {
            News::Asking => line(format_args!("Triggering task with request '{request}'...")),
            News::Interrupted => {
                line("Interrupted, asking the server what became of the request...");
            }
            News::Started { id, reply } => self.started(id, reply),
            News::Progress { .. } => {}
            News::Aborting { id, .. } => line(format_args!("Aborting task with ID '{id}'...")),
            News::NotAborted { id, reply, waits } => {
                let waits = if *waits {
                    ", waiting for completion"
                } else {
                    ""
                };
                line(format_args!(
                    "Could not abort Task with ID '{id}'{waits}. Reply is '{reply}'."
                ));
            }
            News::Over(over) => self.over(over),
        }
    }

    fn started(&mut self, id: &RemoteId, reply: &str) {
        self.start = Instant::now();
        match self.words {
            Words::TaskClient(seconds) | Words::RemoteTask(seconds) => line(format_args!(
                "Initialised task with ID '{id}' for {seconds}s. Reply is '{reply}'."
            )),
            Words::Simple => {
                line(format_args!(
                    "Initialised task with ID '{id}'. Reply is '{reply}'."
                ));
                line("Waiting maximum 5s for the task to finish...");
            }
        }
    }

    fn progress(&mut self, Status { state, text }: &Status) {
        if !is_live() {
            return;
        }
        self.shown = true;
        let seconds = self.start.elapsed().as_secs();
        let text = match text.as_str() {
            NOTHING_KNOWN => String::new(),
            text => format!(": {}", flat(text)),
        };
        rewrite(&format!("{state} {seconds} s{text}"), "");
    }

    fn ended(&self, id: &RemoteId, state: Option<State>, text: &str) {
        let rest = format!("while waiting. Result is '{text}'.");
        self.words.finished(id, state, &rest);
    }

    fn over(&self, over: &Over<'_>) {
        match over {
            Over::NotTriggered { id, reason, .. } => {
                let id = id.as_ref().map_or("-1", RemoteId::as_str);
                let which = match self.words {
                    Words::TaskClient(_) => format!(" '{id}'"),
                    Words::RemoteTask(_) => String::new(),
                    Words::Simple => format!(" '{}'", self.request),
                };
                line(format_args!(
                    "Task{which} could not be triggered: '{reason}'."
                ));
            }
            Over::Ended { id, status } => self.ended(id, Some(status.state), &status.text),
            Over::Lost {
                id,
                answered: Some((state, text)),
                ..
            } if self.as_original => self.ended(id, *state, text),
            Over::StopUnclear { .. } if self.as_original => {}
            Over::StopUnclear { id, reason } => line(format_args!(
                "Could not abort Task with ID '{id}'. Reply is '{reason}'."
            )),
            Over::Lost { id, reason, .. } => line(format_args!(
                "Could not wait for task with ID '{id}'. Reply is '{reason}'."
            )),
            Over::Stopped { id, status, .. } if status.state == State::Aborted => line(
                format_args!("Task with ID '{id}' aborted. Reply is '{}'.", status.text),
            ),
            // Nor does the original say anything.
            Over::Stopped { .. } => {}
            Over::After {
                id, state, text, ..
            } if !self.as_original && !state.is_some_and(State::is_final) => line(format_args!(
                "Task with ID '{id}' may still run after unsuccessful abort signal. Reply is '{text}'."
            )),
            Over::After {
                id,
                state,
                text,
                reply,
            } => {
                let text = match self.words {
                    Words::TaskClient(_) | Words::RemoteTask(_) => text,
                    // The original's says once more what the abort was answered.
                    Words::Simple => reply,
                };
                let rest = format!("after unsuccessful abort signal. Reply is '{text}'.");
                self.words.finished(id, *state, &rest);
            }
            Over::Left { id, .. } => line(format_args!("Task with ID '{id}' may still run.")),
        }
    }
}
