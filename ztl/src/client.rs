//! Runs a task as the original's three clients do: start it, wait for it, abort it at the time limit.
//! Reports it in the words of each client, or as JSON.

mod event;
mod json;
pub(crate) mod task;
mod text;

use std::cell::{Cell, RefCell};
use std::net::ToSocketAddrs;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::{RemoteId, RemoteTask, RequestError, State, Status, TriggerError, WaitError};

use crate::exit::Done;
use crate::signals;
use event::{ClientEvent, LastEvent, TaskOutcome};
use json::JsonReporter;
use task::{ClientTask, Target};
use text::TextReporter;

/// The end of a client's help.
pub(crate) const AFTER_HELP: &str = "\
With --exit-status: 0 completed, 1 rejected, 3 failed, 4 aborted, 5 unknown or not started.
Ctrl-C aborts the task, and a second one ends the client at once; the exit code is 130 without --exit-status.
SIGTERM aborts the task too, waits at most 2 s for the answer, and the exit code is 143.";

/// How long to wait after a rejected abort, as the original. Not after SIGTERM.
const AFTER_ABORT: Duration = Duration::from_secs(5);

/// Pause between two attempts to abort a task.
const PAUSE: Duration = Duration::from_millis(50);

impl ClientTask<'_> {
    /// Connects and runs the task.
    pub(crate) fn run(
        &self,
        identify: impl FnOnce(RemoteTask) -> Result<RemoteTask, Box<dyn std::error::Error>>,
    ) -> Done {
        signals::leave_at_the_second();
        if !self.report.json {
            text::connecting(self);
        }
        let outcome = if self.target.port > i64::from(u16::MAX) {
            self.not_connected()
        } else {
            let connected = self
                .target
                .connect()
                .map_err(|error| match self.as_original {
                    // The original ends with 1 after any exception.
                    true => error.to_string().into(),
                    false => error,
                });
            let mut remote = identify(connected?)?;
            self.play(&mut remote)
        };
        Ok(match self.report.exit_status {
            true => ExitCode::from(outcome.code()),
            false => signals::exit_code().unwrap_or(ExitCode::SUCCESS),
        })
    }

    /// Reports an impossible port as the original does: after the INIT.
    fn not_connected(&self) -> TaskOutcome {
        let mut report = self.reporter();
        report(ClientEvent::Asking);
        let port = self.target.port;
        let reason = &format!("invalid port '{port}': expected 0 to 65535; nothing was sent");
        let outcome = TaskOutcome::NotStarted;
        last(
            report,
            LastEvent::NotTriggered {
                id: None,
                reason,
                outcome,
            },
        )
    }

    fn play(&self, remote: &mut RemoteTask) -> TaskOutcome {
        let reporter = RefCell::new(self.reporter());
        let report = |event: ClientEvent<'_>| reporter.borrow_mut()(event);
        report(ClientEvent::Asking);
        let told = Cell::new(false);
        let triggered = remote.trigger_while(self.request, || {
            let stopped = signals::stopped();
            if stopped && !told.replace(true) {
                reporter.borrow_mut()(ClientEvent::Interrupted);
            }
            !stopped
        });
        let (id, reply) = match triggered {
            Ok(task) => (task.id, task.reply),
            Err(error) => return self.not_triggered(error, report),
        };
        let (id, reply) = (&id, &reply);
        report(ClientEvent::Started { id, reply });
        if signals::stopped() {
            return self.abort(remote, id, report);
        }
        let ended = remote.wait_with(id, self.wording.limit(), |answer| {
            if let Ok(status) = answer
                && !status.state.is_final()
            {
                report(ClientEvent::Progress { id, status });
            }
            !signals::stopped()
        });
        match ended {
            Ok(status) => last(
                report,
                LastEvent::Ended {
                    id,
                    status: &status,
                },
            ),
            Err(WaitError { last: Err(cause) }) if cause.was_answered() => {
                let reason = &format!("unknown: {cause}");
                let answer = event::answer(&cause);
                let lost = LastEvent::Lost { id, reason, answer };
                last(report, lost)
            }
            Err(_) => self.abort(remote, id, report),
        }
    }

    fn reporter(&self) -> Box<dyn FnMut(ClientEvent<'_>) + '_> {
        if self.report.json {
            let mut reporter = JsonReporter::new(self);
            Box::new(move |event| reporter.report(&event))
        } else {
            let mut reporter = TextReporter::new(self);
            Box::new(move |event| reporter.report(&event))
        }
    }

    fn not_triggered(
        &self,
        error: TriggerError,
        report: impl FnMut(ClientEvent<'_>),
    ) -> TaskOutcome {
        let outcome = match &error {
            TriggerError::Rejected { .. } => TaskOutcome::Rejected,
            TriggerError::NeverCame | TriggerError::GivenUp => TaskOutcome::NotStarted,
            TriggerError::Request(cause) if cause.nothing_was_sent() => TaskOutcome::NotStarted,
            _ => TaskOutcome::Unknown,
        };
        let (id, reason) = match error {
            TriggerError::Rejected { id, reason } => (Some(id), reason),
            other => (None, format!("{other}{}", self.nameless())),
        };
        let reason = &reason;
        last(
            report,
            LastEvent::NotTriggered {
                id,
                reason,
                outcome,
            },
        )
    }

    /// Why the host has no address, if so.
    fn nameless(&self) -> String {
        let Target { host, port, .. } = self.target;
        let port = u16::try_from(port).unwrap_or_default();
        match (host, port).to_socket_addrs() {
            Ok(_) => String::new(),
            Err(_) => format!("; no host '{host}' is known"),
        }
    }

    /// Aborts the task at the time limit or at a signal.
    fn abort(
        &self,
        remote: &mut RemoteTask,
        id: &RemoteId,
        mut report: impl FnMut(ClientEvent<'_>),
    ) -> TaskOutcome {
        let interrupted = signals::stopped();
        report(ClientEvent::Aborting { id, interrupted });
        let (reply, answered) = match insist(remote, id) {
            Ok(status) if status.state.is_final() => {
                match self.last_words(remote, id, status.state) {
                    Ok(words) => {
                        let (status, words) = (&status, words.as_str());
                        return last(report, LastEvent::Stopped { id, status, words });
                    }
                    Err(error) => {
                        let reason = &error.to_string();
                        return last(report, LastEvent::StopUnclear { id, reason });
                    }
                }
            }
            Ok(status) => (status.text, true),
            Err(error) if error.was_answered() => {
                let reason = &error.to_string();
                return last(report, LastEvent::StopUnclear { id, reason });
            }
            Err(error) => (error.to_string(), false),
        };
        let reply = &reply;
        let patient = || !signals::in_a_hurry();
        let waits = answered && patient();
        report(ClientEvent::NotAborted { id, reply, waits });
        let wait = || remote.wait_with(id, Some(AFTER_ABORT), |_| patient());
        let Some(waited) = waits.then(wait) else {
            return last(report, LastEvent::Left { id, reply });
        };
        let (state, text) = match waited {
            Ok(Status { state, text }) => (Some(state), text),
            Err(_) if !patient() => return last(report, LastEvent::Left { id, reply }),
            Err(WaitError {
                last: Ok(Status { state, text }),
            }) => (Some(state), text),
            Err(WaitError { last: Err(cause) }) => match event::answer(&cause) {
                Some((state, text)) if self.as_original => (state, text.to_owned()),
                _ => (None, cause.to_string()),
            },
        };
        let text = &text;
        let after = LastEvent::After {
            id,
            state,
            text,
            reply,
        };
        last(report, after)
    }

    /// The result of an aborted task, for JSON. The original's words do not have it. An error means that the task may
    /// still run, since its server does not know its outcome or does not answer.
    fn last_words(
        &self,
        remote: &mut RemoteTask,
        id: &RemoteId,
        state: State,
    ) -> Result<String, RequestError> {
        let failed = state == State::Failed;
        if !self.report.json && !failed {
            return Ok(String::new());
        }
        match remote.status(id) {
            Err(error) if failed || matches!(error, RequestError::UnknownOutcome { .. }) => {
                Err(error)
            }
            Ok(last) if last.state == state && last.text != NOTHING_KNOWN => Ok(last.text),
            _ => Ok(String::new()),
        }
    }
}

/// Sends an abort until the server answers: for 5 s, or only once after SIGTERM.
fn insist(remote: &mut RemoteTask, id: &RemoteId) -> Result<Status, RequestError> {
    let start = Instant::now();
    loop {
        match remote.send_abort(id) {
            Err(error)
                if !error.was_answered()
                    && start.elapsed() < AFTER_ABORT
                    && !signals::in_a_hurry() =>
            {
                std::thread::sleep(PAUSE);
            }
            answer => return answer,
        }
    }
}

/// Reports the last event.
fn last(mut report: impl FnMut(ClientEvent<'_>), event: LastEvent<'_>) -> TaskOutcome {
    let outcome = event.outcome();
    report(ClientEvent::Last(event));
    outcome
}
