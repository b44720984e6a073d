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

use crate::exit::{Done, Misuse};
use crate::signals;
use event::{Answer, ClientEvent, LastEvent, TaskOutcome};
use json::JsonReporter;
use task::{ClientTask, Target};
use text::TextReporter;

/// The end of a client's help.
pub(crate) const AFTER_HELP: &str = "\
With --exit-status: 0 completed, 1 rejected, 3 failed, 4 aborted, 5 unknown or not started.
Ctrl-C aborts the task, and a second one ends the client at once; the exit code is 130 without --exit-status.
SIGTERM aborts the task too, waits at most 2 s for the answer, and the exit code is 143.";

/// How long to wait after a rejected abort, as the original. Not after SIGTERM.
pub(crate) const AFTER_ABORT: Duration = Duration::from_secs(5);

/// Pause between two attempts to abort a task, or to get an answer about it.
const PAUSE: Duration = Duration::from_millis(50);

impl ClientTask<'_> {
    /// Connects and runs the task.
    pub(crate) fn run(
        &self,
        identify: impl FnOnce(RemoteTask) -> Result<RemoteTask, Box<dyn std::error::Error>>,
    ) -> Done {
        let caught = signals::catch();
        signals::leave_at_the_second();
        if !self.report.json {
            text::connecting(self);
        }
        let port = self.target.port;
        let outcome = if port > i64::from(u16::MAX) {
            self.not_started(&format!("invalid port '{port}': expected 0 to 65535"))
        } else {
            let connected = caught.map_err(Into::into);
            let connected = connected.and_then(|()| identify(self.target.connect()?));
            match connected {
                Ok(mut remote) => self.play(&mut remote),
                Err(mistake) if self.as_original || mistake.is::<Misuse>() => return Err(mistake),
                Err(error) => self.not_started(&error.to_string()),
            }
        };
        Ok(match self.report.exit_status {
            true => ExitCode::from(outcome.code()),
            false => signals::exit_code().unwrap_or(ExitCode::SUCCESS),
        })
    }

    /// Reports why there is no client, as the original reports an impossible port: after the INIT.
    fn not_started(&self, why: &str) -> TaskOutcome {
        let mut report = self.reporter();
        report(ClientEvent::Asking);
        let reason = &format!("{why}; nothing was sent");
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
        let wanted = || !signals::stopped();
        let ended = self.wait(remote, id, self.wording.limit(), &wanted, |answer| {
            if let Ok(status) = answer
                && !status.state.is_final()
            {
                report(ClientEvent::Progress { id, status });
            }
        });
        match ended {
            Ok(status) => last(
                report,
                LastEvent::Ended {
                    id,
                    status: &status,
                },
            ),
            Err(WaitError { last: Err(cause) })
                if cause.was_answered()
                    && (!self.takes_for_running(&cause)
                        || is_negative(&cause) && !signals::stopped()) =>
            {
                let reason = &format!("unknown: {cause}");
                let answer = Answer::of(&cause);
                let lost = LastEvent::Lost { id, reason, answer };
                last(report, lost)
            }
            Err(_) => self.abort(remote, id, report),
        }
    }

    /// Waits for the end of the task while it is `wanted`. The original waits on after answers that end the wait of our
    /// clients.
    fn wait(
        &self,
        remote: &mut RemoteTask,
        id: &RemoteId,
        limit: Option<Duration>,
        wanted: &dyn Fn() -> bool,
        mut seen: impl FnMut(&Result<Status, RequestError>),
    ) -> Result<Status, WaitError> {
        let start = Instant::now();
        loop {
            let left = limit.map(|limit| limit.saturating_sub(start.elapsed()));
            let ended = remote.wait_while(id, left, wanted, &mut seen);
            match &ended {
                Err(WaitError { last: Err(cause) })
                    if wanted()
                        && left.is_none_or(|left| !left.is_zero())
                        && self.takes_for_running(cause) =>
                {
                    std::thread::sleep(PAUSE);
                }
                _ => return ended,
            }
        }
    }

    /// Whether the client acts as the original, which takes this answer for one about a running task.
    fn takes_for_running(&self, cause: &RequestError) -> bool {
        self.as_original && Answer::of(cause).is_some_and(|answer| answer.runs())
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
                        let answer = None;
                        return last(report, LastEvent::StopUnclear { id, reason, answer });
                    }
                }
            }
            Ok(status) => (status.text, true),
            Err(error) if error.was_answered() => match Answer::of(&error) {
                Some(answer) if self.as_original && answer.runs() => (answer.text.to_owned(), true),
                answer => {
                    let reason = &error.to_string();
                    return last(report, LastEvent::StopUnclear { id, reason, answer });
                }
            },
            Err(error) => (error.to_string(), false),
        };
        let reply = &reply;
        let patient = || !signals::in_a_hurry();
        let waits = answered && patient();
        report(ClientEvent::NotAborted { id, reply, waits });
        let wait = || self.wait(remote, id, Some(AFTER_ABORT), &patient, |_| {});
        let Some(waited) = waits.then(wait) else {
            return last(report, LastEvent::Left { id, reply });
        };
        let (state, text) = match waited {
            Ok(Status { state, text }) => (Some(state), text),
            Err(_) if !patient() => return last(report, LastEvent::Left { id, reply }),
            Err(WaitError {
                last: Ok(Status { state, text }),
            }) => (Some(state), text),
            Err(WaitError { last: Err(cause) }) => match Answer::of(&cause) {
                Some(answer) if self.as_original => (answer.state, answer.text.to_owned()),
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

    /// The result of a task with this final state after an abort, empty if it is not reported or not known. The
    /// original never reports it, and text only if the task was not aborted. An error means that the task may still
    /// run, since its server does not know its outcome or does not answer.
    fn last_words(
        &self,
        remote: &mut RemoteTask,
        id: &RemoteId,
        state: State,
    ) -> Result<String, RequestError> {
        let failed = state == State::Failed;
        let is_reported = self.report.json || !self.as_original && state != State::Aborted;
        if !is_reported && !failed {
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

fn is_negative(cause: &RequestError) -> bool {
    Answer::of(cause).is_some_and(|answer| answer.is_negative)
}

/// Sends an abort until the server answers: for 5 s, or only once after SIGTERM.
pub(crate) fn insist(remote: &mut RemoteTask, id: &RemoteId) -> Result<Status, RequestError> {
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
