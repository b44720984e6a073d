//! The settings of a program.

use std::sync::Arc;
use std::time::Duration;

use rustix::process::Signal;

use super::launch::Invocation;

/// A program that does the tasks of a component.
#[derive(Debug, Clone)]
pub(crate) struct Program {
    pub(crate) run: Arc<Invocation>,
    /// Lines of stdout that begin with this are progress.
    pub(crate) marker: Option<String>,
    pub(crate) result: ResultKind,
    /// Most bytes of output that are kept.
    pub(crate) output: usize,
    /// Exit codes that reject the goal.
    pub(crate) rejected_by: Vec<u8>,
    /// How long the program may take to reject the goal before the task is accepted.
    pub(crate) decide: Duration,
    pub(crate) limit: Option<Duration>,
    pub(crate) abort: Abort,
    /// Whether processes that the program leaves behind are killed when it ends by itself.
    pub(crate) kills_left_behind: bool,
}

/// How the program is stopped early.
#[derive(Debug, Clone)]
pub(crate) struct Abort {
    /// Whether clients may abort.
    pub(crate) allowed: bool,
    pub(crate) by: AbortBy,
    /// How long its whole process group has to end before it is killed.
    pub(crate) grace: Duration,
}

#[derive(Debug, Clone)]
pub(crate) enum AbortBy {
    /// A signal to the whole process group, with its name.
    Signal(&'static str, Signal),
    Program(Arc<Invocation>),
}

/// What becomes the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ResultKind {
    LastLine,
    All,
    Json,
    Nothing,
    /// Nothing: the output is a stream.
    Stream,
}
