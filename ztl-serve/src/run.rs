//! The life of one program, without I/O: what it says, its exit and the time come in, and what is to be
//! done comes out.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use ztl_core::TaskId;
use ztl_core::dispatcher::UNKNOWN_END;

use super::output::{Keep, Kept, Output};
use super::program::{AbortBy, Program, ResultKind, signal_name};
use super::value::Value;

/// How often it is looked whether all of a group that was asked to end has ended.
const LOOK: Duration = Duration::from_millis(20);
/// How long a group that was killed may take to be gone: the system may wait for a disk.
pub(super) const GOING: Duration = Duration::from_secs(1);
/// Most bytes of a reason.
const REASON: usize = 500;

/// Why a task is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Why {
    /// A client asked for it.
    Client,
    /// This one takes its place.
    Replaced(TaskId),
    /// It has had its time.
    Limit,
    /// The server ends.
    Server,
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Act {
    /// The client is told that the task is taken.
    Accept,
    /// The client is told where it is.
    Progress(String),
    /// To the whole group.
    Signal(Signal),
    /// The program that aborts this one is started.
    RunAbort,
}

/// How a task ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum End {
    Completed(String),
    Failed(String),
    Aborted(String),
    Rejected(String),
}

/// A program that runs.
#[derive(Debug)]
pub(super) struct Run {
    program: Arc<Program>,
    /// Until when it may refuse.
    undecided: Option<Instant>,
    limit: Option<Instant>,
    stopping: Option<Stopping>,
    out: Output,
    err: Output,
}

#[derive(Debug, Clone, Copy)]
struct Stopping {
    why: Why,
    /// When it is killed.
    kill: Option<Instant>,
    /// When that was.
    killed: Option<Instant>,
    /// When it is looked again, once the first process has ended.
    look: Option<Instant>,
}

impl Run {
    /// The program has been started.
    pub(super) fn new(now: Instant, program: Arc<Program>, acts: &mut Vec<Act>) -> Self {
        let keep = match program.result {
            ResultKind::Last => Keep::Last,
            ResultKind::All | ResultKind::Json => Keep::All,
            ResultKind::Nothing => Keep::None,
        };
        let mut run = Self {
            undecided: None,
            limit: program.limit.and_then(|limit| now.checked_add(limit)),
            stopping: None,
            out: Output::new(keep, program.output),
            err: Output::new(Keep::Last, REASON),
            program,
        };
        match run.program.refused_by.is_empty() {
            true => acts.push(Act::Accept),
            false => run.undecided = now.checked_add(run.program.decide),
        }
        run
    }

    /// It has written to stdout.
    pub(super) fn handle_output(&mut self, bytes: &[u8], acts: &mut Vec<Act>) {
        let marker = self.program.marker.as_deref();
        let before = acts.len();
        self.out.take(bytes, |line| progress(line, marker, acts));
        self.decide_by_progress(before, acts);
    }

    /// It has written to stderr; each line is shown to `log`.
    pub(super) fn handle_error_output(&mut self, bytes: &[u8], mut log: impl FnMut(&str)) {
        self.err.take(bytes, |line| {
            log(&String::from_utf8_lossy(line));
            false
        });
    }

    /// It is to end before its time.
    pub(super) fn stop(&mut self, now: Instant, why: Why, acts: &mut Vec<Act>) {
        if self.stopping.is_some() {
            return;
        }
        if self.undecided.take().is_some() {
            acts.push(Act::Accept);
        }
        let abort = &self.program.abort;
        self.stopping = Some(Stopping {
            why,
            kill: now.checked_add(abort.grace),
            killed: None,
            look: None,
        });
        acts.push(match abort.by {
            AbortBy::Signal(_, signal) => Act::Signal(signal),
            AbortBy::Program(_) => Act::RunAbort,
        });
    }

    /// When it wants to be called next.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let times = match self.stopping {
            Some(stopping) => [stopping.kill, stopping.look],
            None => [self.undecided, self.limit],
        };
        times.into_iter().flatten().min()
    }

    /// Time has passed.
    pub(super) fn handle_timeout(&mut self, now: Instant, acts: &mut Vec<Act>) {
        let is_due = |time: Option<Instant>| time.is_some_and(|time| time <= now);
        if is_due(self.undecided) {
            self.undecided = None;
            acts.push(Act::Accept);
        }
        if let Some(stopping) = &mut self.stopping {
            if is_due(stopping.kill) {
                stopping.kill = None;
                stopping.killed = Some(now);
                acts.push(Act::Signal(Signal::KILL));
            }
        } else if is_due(self.limit) {
            self.stop(now, Why::Limit, acts);
        }
    }

    /// Its first process has ended: whether all is over. If not, ask again at the next timeout;
    /// `is_alive` says whether any of its processes still runs.
    pub(super) fn is_over(&mut self, now: Instant, is_alive: impl FnOnce() -> bool) -> bool {
        let Some(stopping) = &mut self.stopping else {
            return true;
        };
        if stopping.look.is_some_and(|look| now < look) {
            return false;
        }
        let given_up = stopping.killed.is_some_and(|killed| now >= killed + GOING);
        stopping.look = now.checked_add(LOOK);
        given_up || !is_alive()
    }

    /// What it left behind when it ends by itself is not killed.
    pub(super) fn leaves_behind(&self) -> bool {
        self.stopping.is_none() && !self.program.tidy
    }

    /// It is over, and all that it said has come. `status`: `None` when somebody else has reaped it.
    pub(super) fn end(mut self, status: Option<ExitStatus>, acts: &mut Vec<Act>) -> End {
        let marker = self.program.marker.as_deref();
        let before = acts.len();
        self.out.end(|line| progress(line, marker, acts));
        self.err.end(|_| false);
        self.decide_by_progress(before, acts);
        let code = status.and_then(|status| status.code());
        let refused = code.and_then(|code| u8::try_from(code).ok());
        let refused = refused.is_some_and(|code| self.program.refused_by.contains(&code));
        let undecided = self.undecided.take().is_some();
        if undecided && refused {
            let why = self.last_words();
            let code = code.unwrap_or_default();
            return End::Rejected(why.unwrap_or_else(|| format!("refused (exit code {code})")));
        }
        if undecided {
            acts.push(Act::Accept);
        }
        match self.stopping {
            Some(stopping) => self.end_stopped(stopping),
            None => self.end_itself(status),
        }
    }

    /// A line of progress says that the goal is taken.
    fn decide_by_progress(&mut self, before: usize, acts: &mut Vec<Act>) {
        if acts.len() > before && self.undecided.take().is_some() {
            acts.insert(before, Act::Accept);
        }
    }

    fn end_stopped(&self, stopping: Stopping) -> End {
        let abort = &self.program.abort;
        let mut text = match stopping.why {
            Why::Client => {
                let last = Some(self.out.kept().text).filter(|text| !text.trim().is_empty());
                last.unwrap_or_else(|| "aborted".to_owned())
            }
            Why::Replaced(by) => format!("replaced by task {by}"),
            Why::Server => "the server was stopped".to_owned(),
            Why::Limit => format!(
                "not done within {}",
                time(self.program.limit.unwrap_or_default())
            ),
        };
        if stopping.killed.is_some() {
            let grace = time(abort.grace);
            let asked = match &abort.by {
                AbortBy::Signal(name, _) => format!("SIG{name}"),
                AbortBy::Program(_) => "its abort program".to_owned(),
            };
            text.push_str(&format!(" (killed: not ended within {grace} of {asked})"));
        }
        match stopping.why {
            Why::Limit => End::Failed(text),
            _ => End::Aborted(text),
        }
    }

    fn end_itself(&self, status: Option<ExitStatus>) -> End {
        let Some(status) = status else {
            return End::Failed(format!("{UNKNOWN_END}nobody can tell how it ended"));
        };
        let how = match (status.code(), status.signal()) {
            (Some(0), _) => return self.result(),
            (Some(code), _) => format!("exit code {code}"),
            (None, Some(number)) => format!("ended by {}", signal_name(number)),
            (None, None) => format!("ended with {status}"),
        };
        End::Failed(match self.last_words() {
            Some(words) => format!("{how}: {words}"),
            None => how,
        })
    }

    fn result(&self) -> End {
        let Kept { text, cut } = self.out.kept();
        let most = size(self.program.output);
        match self.program.result {
            ResultKind::Nothing => End::Completed("None".to_owned()),
            ResultKind::Json if cut => End::Failed(format!(
                "its result is longer than {most}, and cut JSON is none"
            )),
            ResultKind::Json => json(&text),
            ResultKind::Last | ResultKind::All if cut => {
                End::Completed(format!("{text} … (cut at {most})"))
            }
            ResultKind::Last | ResultKind::All => End::Completed(text),
        }
    }

    /// The last that it said, of what was wrong if it said that.
    fn last_words(&self) -> Option<String> {
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

/// Whether a line is progress, which is then told.
fn progress(line: &[u8], marker: Option<&str>, acts: &mut Vec<Act>) -> bool {
    let Some(text) = marker.and_then(|marker| line.strip_prefix(marker.as_bytes())) else {
        return false;
    };
    // The latest wins.
    if let Some(Act::Progress(_)) = acts.last() {
        acts.pop();
    }
    acts.push(Act::Progress(String::from_utf8_lossy(text).into_owned()));
    true
}

/// JSON as the original would write it: the whole output, or its last line.
fn json(text: &str) -> End {
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    let value = serde_json::from_str::<Value>(text)
        .or_else(|error| serde_json::from_str(last.unwrap_or_default()).map_err(|_| error));
    match value.map(|value| value.to_text()) {
        Ok(Ok(text)) => End::Completed(text),
        Ok(Err(error)) => End::Failed(format!("its result cannot be told: {error}")),
        Err(error) => End::Failed(format!("its output is no JSON: {error}")),
    }
}

/// A time, for people.
pub(super) fn time(time: Duration) -> String {
    match time.as_millis() {
        millis if millis % 1000 == 0 => format!("{} s", millis / 1000),
        millis => format!("{millis} ms"),
    }
}

/// A size, for people.
pub(super) fn size(bytes: usize) -> String {
    match bytes {
        bytes if bytes % 1024 == 0 => format!("{} KiB", bytes / 1024),
        bytes => format!("{bytes} bytes"),
    }
}

#[cfg(test)]
mod tests;
