//! Everything that happens while a script is played, as values. The lines on a terminal, the live view,
//! the record of a run and its report are made from them.
//!
//! The player emits [`RunEvent`]s; the runner adds the time ([`StampedEvent`]). In JSON each is one line;
//! `docs/record.md` is the schema.
//!
//! Scenes, steps and tasks of the [`Outline`] are named by index, from 0. Tasks and requests of the run
//! are numbered from 1 ([`TaskNumber`], [`RequestNumber`]).

mod command;
mod outline;
mod state;

use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};
use ztl_std::RemoteId;

use crate::millis;
pub use command::{DecidedBy, Question, RunCommand};
pub use outline::{Outline, RemoteOutline, RunStarted, SceneOutline, StepOutline, TaskOutline};
pub use state::{Ending, RequestKind, RunOutcome, ServerState, TaskState, WaitReason};

/// Version of the schema. It changes when old readers would misread new records; new fields and events
/// do not change it.
pub const FORMAT: u32 = 1;

/// An event and its time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StampedEvent {
    /// Time since the run started, by the monotonic clock.
    #[serde(rename = "at_ms", with = "millis")]
    pub at: Duration,
    /// Time by the wall clock, which may jump.
    #[serde(with = "ztl_std::time::rfc3339")]
    pub wall: SystemTime,
    /// What happened.
    #[serde(flatten)]
    pub event: RunEvent,
}

/// Number of a task in a run, from 1 in the order of starting. It is unrelated to the ids of servers,
/// which may be the same on two of them.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct TaskNumber(pub u32);

/// Number of a request in a run, from 1 in the order of sending.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct RequestNumber(pub u64);

/// Something that happens in a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[non_exhaustive]
pub enum RunEvent {
    /// The first event of each run.
    RunStarted(Box<RunStarted>),
    /// A scene is shown to the operator, before anything of it is done.
    SceneShown {
        /// Index of the scene.
        scene: usize,
    },
    /// The operator has to decide. The question closes with [`Decided`](Self::Decided), or without a
    /// decision when a waiting step ends or [continues](Self::StepGoesOn).
    Asked {
        /// The question.
        question: Question,
        /// The possible answers; other commands do nothing.
        choices: Vec<RunCommand>,
    },
    /// The operator pressed a key.
    Key {
        /// Name of the key: `Enter`, `s`, `Ctrl-C`.
        key: String,
        /// What it meant at that moment; `None` if nothing.
        command: Option<RunCommand>,
    },
    /// A command is carried out.
    Decided {
        /// The command.
        command: RunCommand,
        /// Who decided.
        by: DecidedBy,
        /// The scene shown or playing.
        scene: Option<usize>,
        /// The step playing.
        step: Option<usize>,
    },
    /// A scene starts; its delay comes next.
    SceneStarted {
        /// Index of the scene.
        scene: usize,
        /// How many times it has started in this run, from 1.
        take: u32,
        /// Whether the operator asked to play the last scene again.
        replay: bool,
    },
    /// A scene is over.
    SceneEnded {
        /// Index of the scene.
        scene: usize,
        /// As in its start.
        take: u32,
        /// How it ended.
        end: Ending,
    },
    /// A scene is skipped: nothing of it is done.
    SceneSkipped {
        /// Index of the scene.
        scene: usize,
        /// Who decided.
        by: DecidedBy,
    },
    /// A step starts; its delay comes next.
    StepStarted {
        /// Index of the scene.
        scene: usize,
        /// Index of the step.
        step: usize,
    },
    /// A step cannot end: something failed or is unknown.
    StepWaiting {
        /// Index of the scene.
        scene: usize,
        /// Index of the step.
        step: usize,
        /// Why it waits.
        why: WaitReason,
        /// The tasks concerned.
        tasks: Vec<TaskNumber>,
    },
    /// The reason why a step waited is settled.
    StepGoesOn {
        /// Index of the scene.
        scene: usize,
        /// Index of the step.
        step: usize,
    },
    /// A step is over.
    StepEnded {
        /// Index of the scene.
        scene: usize,
        /// Index of the step.
        step: usize,
        /// How it ended.
        end: Ending,
    },
    /// A step is skipped: nothing of it is done.
    StepSkipped {
        /// Index of the scene.
        scene: usize,
        /// Index of the step.
        step: usize,
        /// Who decided.
        by: DecidedBy,
    },
    /// Nothing new starts until the operator continues.
    Paused {
        /// Index of the scene.
        scene: usize,
        /// The last step played.
        step: usize,
    },
    /// The operator continues after a pause.
    Resumed,
    /// The delay of a task has passed: it is sent now.
    TaskStarting {
        /// Its number from now on.
        task: TaskNumber,
        /// Index of the scene.
        scene: usize,
        /// Index of the step.
        step: usize,
        /// Its index in [`StepOutline::tasks`].
        part: usize,
        /// The failed task that it repeats.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        retry_of: Option<TaskNumber>,
    },
    /// A task of a cue is sent now.
    CueStarting {
        /// Its number from now on.
        task: TaskNumber,
        /// Index of the cue.
        cue: usize,
        /// Its index in the cue's tasks.
        part: usize,
    },
    /// The state of a task changed, or it reports progress.
    TaskState {
        /// The task.
        task: TaskNumber,
        /// Its new state.
        state: TaskState,
        /// Its id on its server, once known.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        id: Option<RemoteId>,
        /// Progress, result, or why it was not started or is unknown.
        text: String,
        /// Whether it was not started because the configuration has no server for it.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        no_server: bool,
    },
    /// A request about a task is sent.
    RequestSent {
        /// Its number.
        request: RequestNumber,
        /// Its kind.
        kind: RequestKind,
        /// Name of the server.
        remote: String,
        /// The task concerned.
        task: Option<TaskNumber>,
        /// INIT: `handler:component:goal` in plain text; otherwise the payload.
        text: String,
        /// How long the server may hold its answer to a STATUS.
        #[serde(
            rename = "hold_ms",
            with = "millis::optional",
            default,
            skip_serializing_if = "Option::is_none"
        )]
        hold: Option<Duration>,
    },
    /// A server answered.
    Answered {
        /// The request.
        request: RequestNumber,
        /// Time since it was sent.
        #[serde(rename = "latency_ms", with = "millis")]
        latency: Duration,
        /// The state in the answer, as its number in the protocol.
        state: i64,
        /// The id in the answer.
        id: RemoteId,
        /// The payload of the answer.
        text: String,
    },
    /// No usable answer came.
    Unanswered {
        /// The request.
        request: RequestNumber,
        /// How long the run waited for it.
        #[serde(rename = "waited_ms", with = "millis")]
        waited: Duration,
        /// Whether it was sent at all; if not, nothing can have happened.
        sent: bool,
        /// What went wrong.
        text: String,
    },
    /// The state of a server changed.
    Server {
        /// Name of the server.
        remote: String,
        /// Its new state.
        state: ServerState,
    },
    /// While everything is being stopped, a server lists a running task that this run did not start. It
    /// is stopped too.
    TaskFound {
        /// Its number from now on.
        task: TaskNumber,
        /// Name of the server.
        remote: String,
        /// Its id there.
        id: RemoteId,
        /// `handler:component:goal`, as the server lists it.
        text: String,
    },
    /// Tasks that may still run are being stopped.
    Stopping {
        /// The tasks.
        tasks: Vec<TaskNumber>,
        /// Servers that are asked for the tasks that others started.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        remotes: Vec<String>,
    },
    /// While everything is being stopped, a server was asked for the tasks that others started. The found
    /// ones are told before.
    TasksListed {
        /// Name of the server.
        remote: String,
        /// Why other tasks may still run there. Empty if the list is complete.
        gaps: Vec<String>,
    },
    /// The result of stopping one task.
    StopAnswered {
        /// The task.
        task: TaskNumber,
        /// Whether its server confirmed that it ended.
        confirmed: bool,
        /// The server's text, or what went wrong.
        text: String,
    },
    /// Something for the operator that no other event says.
    Note {
        /// The message.
        text: String,
    },
    /// The last event of a run that was not cut off.
    RunEnded {
        /// How it ended.
        outcome: RunOutcome,
        /// Tasks that may still run.
        running: Vec<TaskNumber>,
        /// More about it, such as the error that ended it.
        #[serde(default, skip_serializing_if = "String::is_empty")]
        text: String,
    },
    /// An event of a newer version, in a record that is read.
    #[serde(other)]
    Unknown,
}

#[cfg(test)]
mod tests;
