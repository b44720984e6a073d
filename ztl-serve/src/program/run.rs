//! The state machine of a running program, without I/O: its output, its end and the time go in, actions and the
//! outcome come out.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use ztl_std::describe::GoalValue;

use super::launch::signal_name;
use super::output::{Keep, Kept, Output};
use super::settings::{AbortBy, Program, ResultKind};
use crate::human::{human_size, human_time};
use crate::kind::{Outcome, StopReason};

/// How often to check whether a whole process group has ended.
const CHECK: Duration = Duration::from_millis(20);
/// How long a killed process group may take to end, since the system may wait for a disk.
const KILL_TIME: Duration = Duration::from_secs(1);
/// Most bytes of a reason.
const REASON: usize = 500;
/// How long a stream's program may run on after it has closed its output.
const CLOSED: Duration = Duration::from_secs(1);

/// What the program's job does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Action {
    /// Reports the task as accepted.
    Accept,
    Progress(String),
    /// Sends a signal to the whole process group.
    Signal(Signal),
    /// Starts the program that stops this one.
    RunAbort,
}

/// A running program.
#[derive(Debug)]
pub(crate) struct Run {
    program: Arc<Program>,
    /// Until when it may reject its goal.
    undecided: Option<Instant>,
    limit: Option<Instant>,
    /// When to stop it, since it has closed its output.
    closed: Option<Instant>,
    stopping: Option<Stopping>,
    out: Output,
    err: Output,
}

#[derive(Debug, Clone, Copy)]
struct Stopping {
    why: StopReason,
    /// When to kill the group.
    kill: Option<Instant>,
    /// When the group was killed.
    killed: Option<Instant>,
    /// When to check again whether the group has ended, once its first process has.
    check: Option<Instant>,
}

impl Run {
    /// The program has started.
    pub(crate) fn new(now: Instant, program: Arc<Program>, actions: &mut Vec<Action>) -> Self {
        let keep = match program.result {
            ResultKind::LastLine => Keep::Last,
            ResultKind::All | ResultKind::Json => Keep::All,
            ResultKind::Nothing | ResultKind::Stream => Keep::None,
        };
        let mut run = Self {
            undecided: None,
            limit: program.limit.and_then(|limit| now.checked_add(limit)),
            closed: None,
            stopping: None,
            out: Output::new(keep, program.output),
            err: Output::new(Keep::Last, REASON),
            program,
        };
        match run.program.rejected_by.is_empty() {
            true => actions.push(Action::Accept),
            false => run.undecided = now.checked_add(run.program.decide),
        }
        run
    }

    /// The program has written to stdout.
    pub(crate) fn handle_output(&mut self, bytes: &[u8], actions: &mut Vec<Action>) {
        let marker = self.program.marker.as_deref();
        let before = actions.len();
        self.out.push(bytes, |line| progress(line, marker, actions));
        self.decide_by_progress(before, actions);
    }

    /// The program has written to stderr. Passes each line to `log`.
    pub(crate) fn handle_error_output(&mut self, bytes: &[u8], mut log: impl FnMut(&str)) {
        self.err.push(bytes, |line| {
            log(&String::from_utf8_lossy(line));
            false
        });
    }

    /// The program of a stream has closed its output. It is usually about to end.
    pub(crate) fn on_closed_output(&mut self, now: Instant) {
        self.closed = now.checked_add(CLOSED);
    }

    /// Stops the program early.
    pub(crate) fn stop(&mut self, now: Instant, why: StopReason, actions: &mut Vec<Action>) {
        if self.stopping.is_some() {
            return;
        }
        if self.undecided.take().is_some() {
            actions.push(Action::Accept);
        }
        let abort = &self.program.abort;
        self.stopping = Some(Stopping {
            why,
            kill: now.checked_add(abort.grace),
            killed: None,
            check: None,
        });
        actions.push(match abort.by {
            AbortBy::Signal(_, signal) => Action::Signal(signal),
            AbortBy::Program(_) => Action::RunAbort,
        });
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let times = match self.stopping {
            Some(stopping) => [stopping.kill, stopping.check, None],
            None => [self.undecided, self.limit, self.closed],
        };
        times.into_iter().flatten().min()
    }

    pub(crate) fn handle_timeout(&mut self, now: Instant, actions: &mut Vec<Action>) {
        let is_due = |time: Option<Instant>| time.is_some_and(|time| time <= now);
        if is_due(self.undecided) {
            self.undecided = None;
            actions.push(Action::Accept);
        }
        if let Some(stopping) = &mut self.stopping {
            if is_due(stopping.kill) {
                stopping.kill = None;
                stopping.killed = Some(now);
                actions.push(Action::Signal(Signal::KILL));
            }
        } else if is_due(self.limit) {
            self.stop(now, StopReason::Limit, actions);
        } else if is_due(self.closed) {
            self.stop(now, StopReason::Closed, actions);
        }
    }

    /// Once the first process has ended: whether the run is over. If not, ask again at the next timeout.
    /// `is_alive` returns whether any process of the group still runs.
    pub(crate) fn is_over(&mut self, now: Instant, is_alive: impl FnOnce() -> bool) -> bool {
        let Some(stopping) = &mut self.stopping else {
            return true;
        };
        if stopping.check.is_some_and(|check| now < check) {
            return false;
        }
        let given_up = stopping
            .killed
            .is_some_and(|killed| now >= killed + KILL_TIME);
        stopping.check = now.checked_add(CHECK);
        given_up || !is_alive()
    }

    /// Whether processes that the program left behind may continue.
    pub(crate) fn leaves_behind(&self) -> bool {
        self.stopping.is_none() && !self.program.kills_left_behind
    }

    /// The run is over, and all output was handled. `status` is `None` if another part of this process has reaped the
    /// program.
    pub(crate) fn end(mut self, status: Option<ExitStatus>, actions: &mut Vec<Action>) -> Outcome {
        let marker = self.program.marker.as_deref();
        let before = actions.len();
        self.out.end(|line| progress(line, marker, actions));
        self.err.end(|_| false);
        self.decide_by_progress(before, actions);
        let code = status.and_then(|status| status.code());
        let rejected = code.and_then(|code| u8::try_from(code).ok());
        let rejected = rejected.is_some_and(|code| self.program.rejected_by.contains(&code));
        let undecided = self.undecided.take().is_some();
        if undecided && rejected {
            let why = self.last_line();
            let code = code.unwrap_or_default();
            return Outcome::Rejected(
                why.unwrap_or_else(|| format!("rejected (exit code {code})")),
            );
        }
        if undecided {
            actions.push(Action::Accept);
        }
        match self.stopping {
            Some(stopping) => self.outcome_of_stopped(stopping),
            None => self.outcome_by_itself(status),
        }
    }

    /// Progress accepts the task.
    fn decide_by_progress(&mut self, before: usize, actions: &mut Vec<Action>) {
        if actions.len() > before && self.undecided.take().is_some() {
            actions.insert(before, Action::Accept);
        }
    }

    fn outcome_of_stopped(&self, stopping: Stopping) -> Outcome {
        let abort = &self.program.abort;
        let mut text = match stopping.why {
            StopReason::Client => {
                let last = Some(self.out.kept().text).filter(|text| !text.trim().is_empty());
                last.unwrap_or_else(|| "aborted".to_owned())
            }
            why @ (StopReason::Replaced(_) | StopReason::Server) => why.to_string(),
            StopReason::Closed => "it closed its output, ran on and was stopped".to_owned(),
            StopReason::Limit => format!(
                "not done within {}",
                human_time(self.program.limit.unwrap_or_default())
            ),
        };
        if stopping.killed.is_some() {
            let grace = human_time(abort.grace);
            let asked = match &abort.by {
                AbortBy::Signal(name, _) => format!("SIG{name}"),
                AbortBy::Program(_) => "its abort program".to_owned(),
            };
            text.push_str(&format!(" (killed: not ended within {grace} of {asked})"));
        }
        match stopping.why {
            StopReason::Limit | StopReason::Closed => Outcome::Failed(text),
            _ => Outcome::Aborted(text),
        }
    }

    fn outcome_by_itself(&self, status: Option<ExitStatus>) -> Outcome {
        let Some(status) = status else {
            return Outcome::Unknown("its exit status was lost".to_owned());
        };
        let how = match (status.code(), status.signal()) {
            (Some(0), _) => return self.result(),
            (Some(code), _) => format!("exit code {code}"),
            (None, Some(number)) => format!("ended by {}", signal_name(number)),
            (None, None) => format!("ended with {status}"),
        };
        Outcome::Failed(match self.last_line() {
            Some(words) => format!("{how}: {words}"),
            None => how,
        })
    }

    fn result(&self) -> Outcome {
        let Kept { text, cut } = self.out.kept();
        let most = human_size(self.program.output);
        match self.program.result {
            ResultKind::Nothing | ResultKind::Stream => Outcome::Completed("None".to_owned()),
            ResultKind::Json if cut => Outcome::Failed(format!("its JSON output exceeds {most}")),
            ResultKind::Json => json(&text),
            ResultKind::LastLine | ResultKind::All if cut => {
                Outcome::Completed(format!("{text} … (cut at {most})"))
            }
            ResultKind::LastLine | ResultKind::All => Outcome::Completed(text),
        }
    }

    /// The last line of stderr, or of stdout.
    fn last_line(&self) -> Option<String> {
        let errors = self.err.kept().text;
        let said = match errors.trim() {
            "" => self.out.kept().text,
            _ => errors,
        };
        let last = said
            .lines()
            .rev()
            .find(|line| !line.trim().is_empty())?
            .trim();
        Some(last.get(..last.floor_char_boundary(REASON))?.to_owned())
    }
}

/// Whether a line is progress. Adds the action then.
fn progress(line: &[u8], marker: Option<&str>, actions: &mut Vec<Action>) -> bool {
    let Some(text) = marker.and_then(|marker| line.strip_prefix(marker.as_bytes())) else {
        return false;
    };
    // Only the latest is reported.
    if let Some(Action::Progress(_)) = actions.last() {
        actions.pop();
    }
    actions.push(Action::Progress(String::from_utf8_lossy(text).into_owned()));
    true
}

/// JSON, of the whole output or its last line, as the original writes values.
fn json(text: &str) -> Outcome {
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    let value = serde_json::from_str::<GoalValue>(text)
        .or_else(|error| serde_json::from_str(last.unwrap_or_default()).map_err(|_| error));
    match value.map(|value| value.to_text()) {
        Ok(Ok(text)) => Outcome::Completed(text),
        Ok(Err(error)) => Outcome::Failed(format!("its result cannot be sent: {error}")),
        Err(error) => Outcome::Failed(format!("its output is not JSON: {error}")),
    }
}

#[cfg(test)]
mod tests;
