//! Reports events in the original's words, and progress in one line of a terminal.

use std::time::Instant;

use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::{RemoteId, State, Status};

use super::event::{Answer, ClientEvent, LastEvent};
use super::task::{ClientTask, Target, Wording};
use crate::terminal::{flat, is_live, line, line_with_state, rewrite};

/// Reports the server, except as `remote-task`.
pub(super) fn connecting(task: &ClientTask<'_>) {
    let Target { host, port, scope } = task.target;
    if !matches!(task.wording, Wording::RemoteTask(_)) {
        line(format_args!(
            "Connecting to host '{host}:{port}' at scope '{scope}'..."
        ));
    }
}

/// Reports events to a person.
pub(super) struct TextReporter<'a> {
    request: &'a str,
    wording: Wording,
    as_original: bool,
    start: Instant,
    /// Whether the progress line is shown.
    shown: bool,
}

impl<'a> TextReporter<'a> {
    pub(super) fn new(task: &ClientTask<'a>) -> Self {
        Self {
            request: task.request,
            wording: task.wording,
            as_original: task.as_original,
            start: Instant::now(),
            shown: false,
        }
    }

    pub(super) fn report(&mut self, event: &ClientEvent<'_>) {
        if let ClientEvent::Progress { status, .. } = event {
            return self.progress(status);
        }
        if std::mem::take(&mut self.shown) {
            rewrite("", "");
        }
        let request = self.request;
        match event {
            ClientEvent::Asking => {
                line(format_args!("Triggering task with request '{request}'..."))
            }
            ClientEvent::Interrupted => {
                line("Interrupted, asking the server what became of the request...");
            }
            ClientEvent::Started { id, reply } => self.started(id, reply),
            ClientEvent::Progress { .. } => {}
            ClientEvent::Aborting { id, .. } => {
                line(format_args!("Aborting task with ID '{id}'..."))
            }
            ClientEvent::NotAborted { id, reply, waits } => {
                let waits = if *waits {
                    ", waiting for completion"
                } else {
                    ""
                };
                line(format_args!(
                    "Could not abort Task with ID '{id}'{waits}. Reply is '{reply}'."
                ));
            }
            ClientEvent::Last(last) => self.last(last),
        }
    }

    fn started(&mut self, id: &RemoteId, reply: &str) {
        self.start = Instant::now();
        match self.wording {
            Wording::TaskClient(seconds) | Wording::RemoteTask(seconds) => line(format_args!(
                "Initialised task with ID '{id}' for {seconds}s. Reply is '{reply}'."
            )),
            Wording::Simple => {
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
        self.finished(id, state, &rest);
    }

    fn last(&self, last: &LastEvent<'_>) {
        match last {
            LastEvent::NotTriggered { id, reason, .. } => {
                let id = id.as_ref().map_or("-1", RemoteId::as_str);
                let which = match self.wording {
                    Wording::TaskClient(_) => format!(" '{id}'"),
                    Wording::RemoteTask(_) => String::new(),
                    Wording::Simple => format!(" '{}'", self.request),
                };
                line(format_args!(
                    "Task{which} could not be triggered: '{reason}'."
                ));
            }
            LastEvent::Ended { id, status } => self.ended(id, Some(status.state), &status.text),
            LastEvent::Lost {
                id,
                answer: Some(answer),
                ..
            } if self.as_original && !answer.is_negative => {
                self.ended(id, answer.state, answer.text);
            }
            LastEvent::Lost {
                id,
                answer: Some(Answer { text, .. }),
                ..
            } if self.as_original => line(format_args!(
                "Could not wait for task with ID '{id}'. Reply is '{text}'."
            )),
            LastEvent::StopUnclear {
                id,
                answer:
                    Some(Answer {
                        state: Some(State::Aborted),
                        text,
                        ..
                    }),
                ..
            } if self.as_original => aborted(id, text),
            LastEvent::StopUnclear { .. } if self.as_original => {}
            LastEvent::StopUnclear { id, reason, .. } => line(format_args!(
                "Could not abort Task with ID '{id}'. Reply is '{reason}'."
            )),
            LastEvent::Lost { id, reason, .. } => line(format_args!(
                "Could not wait for task with ID '{id}'. Reply is '{reason}'."
            )),
            LastEvent::Stopped { id, status, .. } if status.state == State::Aborted => {
                aborted(id, &status.text);
            }
            // The original prints nothing.
            LastEvent::Stopped { .. } if self.as_original => {}
            LastEvent::Stopped { id, status, words } => {
                let told = match *words {
                    // Only the answer to the abort is known.
                    "" => format!("Reply is '{}'", status.text),
                    words => format!("Result is '{words}'"),
                };
                self.finished(
                    id,
                    Some(status.state),
                    &format!("after abort signal. {told}."),
                );
            }
            LastEvent::After {
                id, state, text, ..
            } if !self.as_original && !state.is_some_and(State::is_final) => line(format_args!(
                "Task with ID '{id}' may still run after unsuccessful abort signal. Reply is '{text}'."
            )),
            LastEvent::After {
                id,
                state,
                text,
                reply,
            } => {
                let text = match self.wording {
                    Wording::TaskClient(_) | Wording::RemoteTask(_) => text,
                    // The original prints the answer to the abort again.
                    Wording::Simple => reply,
                };
                let rest = format!("after unsuccessful abort signal. Reply is '{text}'.");
                self.finished(id, *state, &rest);
            }
            LastEvent::Left { id, .. } => line(format_args!("Task with ID '{id}' may still run.")),
        }
    }

    /// Prints that a task has finished.
    fn finished(&self, id: &RemoteId, state: Option<State>, rest: &str) {
        let task = format!("Task with ID '{id}' finished");
        match (self.wording, state) {
            (Wording::Simple, _) => line(format_args!("{task} {rest}")),
            (_, Some(state)) => {
                line_with_state(&format!("{task} in state '"), state, &format!("' {rest}"));
            }
            (_, None) => line(format_args!("{task} in state 'None' {rest}")),
        }
    }
}

fn aborted(id: &RemoteId, reply: &str) {
    line(format_args!(
        "Task with ID '{id}' aborted. Reply is '{reply}'."
    ));
}
