//! All that happens while a script is played, as values: what the lines on a terminal, the live
//! view, the record of a run and its report are made from.
//!
//! The player makes [`Event`]s; the shell around it adds the times ([`Stamped`]) and hands them to
//! whoever wants to know. As JSON each is one line; `docs/record.md` is the schema.
//!
//! Scenes, steps and tasks are called by their places in the [`Outline`], counted from 0; what is
//! started, by a number of the run, counted from 1 ([`TaskNumber`], [`RequestNumber`]).

use std::fmt;
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};
use ztl_core::State;

use ztl_std::RemoteId;

/// What [`Event::RunStarted`] says of the schema. Another number means that old readers would
/// misread it; fields and events may be added without.
pub const FORMAT: u32 = 1;

/// An event, and when it happened.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stamped {
    /// Since the run started, by a clock that never jumps.
    #[serde(rename = "at_ms", with = "millis")]
    pub at: Duration,
    /// By the clock on the wall; it may jump.
    #[serde(with = "ztl_std::time::rfc3339")]
    pub wall: SystemTime,
    /// What happened.
    #[serde(flatten)]
    pub event: Event,
}

/// Number of a task in a run, from 1 in the order of starting. It has nothing to do with the ids of
/// servers, which may be the same on two of them.
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

/// What happens in a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Event {
    /// The first of each run.
    RunStarted(Box<RunStarted>),
    /// A scene is shown to the operator, before anything of it is done.
    SceneShown {
        /// Which.
        scene: usize,
    },
    /// The operator has to decide. It ends by [`Event::Decided`], or by itself when a step that
    /// waited ends or [goes on](Event::StepGoesOn).
    Asked {
        /// What about.
        question: Question,
        /// What can be answered. Whatever is not among these does nothing.
        choices: Vec<Command>,
    },
    /// The operator pressed a key, whether it meant something or not.
    Key {
        /// As it is called: `Enter`, `s`, `Ctrl-C`.
        key: String,
        /// What it meant just then; `None` where it meant nothing.
        command: Option<Command>,
    },
    /// What is done was decided, by whoever had the right to.
    Decided {
        /// What.
        command: Command,
        /// Who decided.
        by: By,
        /// In which scene.
        scene: Option<usize>,
        /// In which step, where a step was under way.
        step: Option<usize>,
    },
    /// A scene begins; its delay comes next.
    SceneStarted {
        /// Which.
        scene: usize,
        /// The how-manieth time in this run, from 1.
        take: u32,
        /// It is played again because the operator wanted the last scene again.
        replay: bool,
    },
    /// A scene is over.
    SceneEnded {
        /// Which.
        scene: usize,
        /// As its start said.
        take: u32,
        /// How.
        end: SceneEnd,
    },
    /// A scene is passed over: nothing of it is done.
    SceneSkipped {
        /// Which.
        scene: usize,
        /// Who wanted that: the operator (skip, jump), or the call (`--scene`, `--from`).
        by: By,
    },
    /// A step begins; its delay comes next.
    StepStarted {
        /// Its scene.
        scene: usize,
        /// Which.
        step: usize,
    },
    /// A step does not end although it could have: something is unknown, or has failed.
    StepWaiting {
        /// Its scene.
        scene: usize,
        /// Which.
        step: usize,
        /// Why.
        why: Why,
        /// The tasks that it is about.
        tasks: Vec<TaskNumber>,
    },
    /// What a step waited for is settled.
    StepGoesOn {
        /// Its scene.
        scene: usize,
        /// Which.
        step: usize,
    },
    /// A step is over.
    StepEnded {
        /// Its scene.
        scene: usize,
        /// Which.
        step: usize,
        /// How.
        end: StepEnd,
    },
    /// A step is passed over: nothing of it is done.
    StepSkipped {
        /// Its scene.
        scene: usize,
        /// Which.
        step: usize,
        /// Who wanted that.
        by: By,
    },
    /// From here on nothing new is started until the operator goes on.
    Paused {
        /// Its scene.
        scene: usize,
        /// The last step that was played.
        step: usize,
    },
    /// The operator goes on after a pause.
    Resumed,
    /// A task's turn has come, its delay has passed: it is sent now.
    TaskStarting {
        /// Its number from now on.
        task: TaskNumber,
        /// Its scene.
        scene: usize,
        /// Its step.
        step: usize,
        /// Its place among [`StepOutline::tasks`].
        part: usize,
        /// The task in whose place it is tried again.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        retry_of: Option<TaskNumber>,
    },
    /// A task is in another state, or says something new of its progress.
    TaskState {
        /// Which.
        task: TaskNumber,
        /// Its state now.
        state: TaskState,
        /// Its id on its server, as soon as that is known.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        id: Option<RemoteId>,
        /// Progress, result, or the reason why it was not started or is unknown.
        text: String,
    },
    /// A request leaves.
    RequestSent {
        /// Its number.
        request: RequestNumber,
        /// What is asked.
        kind: Kind,
        /// The name of the server.
        remote: String,
        /// The task that it is about.
        task: Option<TaskNumber>,
        /// Of an INIT `handler:component:goal` in plain text; else the payload.
        text: String,
    },
    /// A server has answered.
    Answered {
        /// Which request.
        request: RequestNumber,
        /// From its sending.
        #[serde(rename = "latency_ms", with = "millis")]
        latency: Duration,
        /// The state in the answer, as its number on the wire.
        state: i64,
        /// The id in the answer.
        id: RemoteId,
        /// The payload of the answer.
        text: String,
    },
    /// There was no answer that could be used.
    Unanswered {
        /// Which request.
        request: RequestNumber,
        /// How long it was waited for.
        #[serde(rename = "waited_ms", with = "millis")]
        waited: Duration,
        /// Whether it was sent at all: `false` means that nothing can have happened.
        sent: bool,
        /// What went wrong, in words.
        text: String,
    },
    /// What is known of a server has changed.
    Server {
        /// Its name.
        remote: String,
        /// How it is with it.
        state: ServerState,
    },
    /// When everything is stopped, a server lists a running task that this run has not started. It is
    /// stopped too.
    TaskFound {
        /// Its number from now on.
        task: TaskNumber,
        /// The name of the server.
        remote: String,
        /// Its id there.
        id: RemoteId,
        /// `handler:component:goal`, as the server lists it.
        text: String,
    },
    /// Tasks that may still be under way are being stopped.
    Stopping {
        /// Which tasks.
        tasks: Vec<TaskNumber>,
    },
    /// What became of stopping one task.
    StopAnswered {
        /// Which.
        task: TaskNumber,
        /// It has ended, by what its server says.
        confirmed: bool,
        /// What was said, or what went wrong.
        text: String,
    },
    /// Something that the operator should know and that nothing else here tells.
    Note {
        /// In words.
        text: String,
    },
    /// The last of each run that was not cut off.
    RunEnded {
        /// How it went.
        outcome: Outcome,
        /// Tasks that may still be under way, by the last that was heard of them.
        running: Vec<TaskNumber>,
        /// What else there is to say, such as the error that ended it.
        #[serde(default, skip_serializing_if = "String::is_empty")]
        text: String,
    },
    /// An event of a newer version, in a record that is read.
    #[serde(other)]
    Unknown,
}

/// What is known when a run starts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunStarted {
    /// [`FORMAT`].
    pub format: u32,
    /// The file, as it was called.
    pub script: String,
    /// SHA-256 of its bytes, in hex ([`sha256`]).
    pub sha256: String,
    /// The configuration that was read, where there is one.
    pub config: Option<String>,
    /// Options that change what is played, as words of a command line.
    pub options: Vec<String>,
    /// Programs and their versions, such as `("ztl", "0.1.0")`.
    pub versions: Vec<(String, String)>,
    /// The servers that the script uses.
    pub remotes: Vec<RemoteOutline>,
    /// What the script says.
    pub outline: Outline,
}

/// A server that a script uses.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RemoteOutline {
    /// Its name in the configuration.
    pub name: String,
    /// Its ZeroMQ address; `None` where the configuration has none.
    pub endpoint: Option<String>,
    /// Its scope.
    pub scope: String,
}

/// What a script says is to be done, without what it says on how.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Outline {
    /// In the order of the file.
    pub scenes: Vec<SceneOutline>,
}

/// A scene as it is planned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneOutline {
    /// Without its parameters.
    pub name: String,
    /// Time before its first step.
    #[serde(rename = "delay_ms", with = "millis")]
    pub delay: Duration,
    /// In the order of the file.
    pub steps: Vec<StepOutline>,
}

/// A step as it is planned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepOutline {
    /// Without its parameters.
    pub name: String,
    /// Time before its first task's delay begins.
    #[serde(rename = "delay_ms", with = "millis")]
    pub delay: Duration,
    /// The next step waits for the end of this one; else its tasks run in the background.
    pub wait: bool,
    /// The tasks' delays are counted from the step's begin, and not one after the other.
    pub parallel: bool,
    /// In the order of the file.
    pub tasks: Vec<TaskOutline>,
}

/// A task as it is planned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskOutline {
    /// The handler, as it is sent.
    pub handler: String,
    /// The component, as it is sent.
    pub component: String,
    /// The goal, as it is sent.
    pub goal: String,
    /// The name of its server.
    pub remote: String,
    /// Time before it is sent.
    #[serde(rename = "delay_ms", with = "millis")]
    pub delay: Duration,
    /// Its step waits for its end (if the step itself is waited for).
    pub wait: bool,
    /// Longest time that it may take.
    #[serde(rename = "limit_ms", with = "optional_millis", default)]
    pub limit: Option<Duration>,
}

/// What the operator is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "about", rename_all = "snake_case")]
pub enum Question {
    /// Whether to play this scene.
    Scene {
        /// Which.
        scene: usize,
    },
    /// What is to come after the last scene.
    End,
    /// What to do with a step that [waits](Event::StepWaiting).
    Step {
        /// Its scene.
        scene: usize,
        /// Which.
        step: usize,
    },
    /// When to go on after a pause.
    Pause,
}

/// What an operator can want. The player says which of them it would take ([`Event::Asked`]), and
/// while a scene runs those of [`Command::WHILE_RUNNING`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub enum Command {
    /// Play the scene that is shown.
    Start,
    /// Pass over the scene that is shown.
    Skip,
    /// Play the last scene again.
    Replay,
    /// Show this scene next.
    Jump {
        /// Which.
        scene: usize,
    },
    /// Begin again with the first scene.
    Restart,
    /// Start nothing more when this step is over.
    Pause,
    /// Go on after a pause, or take a pause back.
    Resume,
    /// Start again what failed.
    Retry,
    /// Go on although something failed or is unknown.
    GoOn,
    /// Stop the tasks of the scene that is played, and return to the scene that was shown before it.
    StopScene,
    /// Stop all tasks that this run has started, and all others that run in the scopes of its servers;
    /// the run goes on as after [`StopScene`](Self::StopScene).
    StopAll,
    /// Stop all tasks that this run has started, on all servers, and end.
    Stop,
    /// End now, without waiting for anything.
    Leave,
}

impl Command {
    /// What can be wanted while a step runs and nothing is asked.
    pub const WHILE_RUNNING: [Self; 5] = [
        Self::Pause,
        Self::Resume,
        Self::StopScene,
        Self::StopAll,
        Self::Stop,
    ];
}

/// Who decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum By {
    /// The person at the keyboard.
    Operator,
    /// The script's own rule for this case.
    Script,
    /// How the command was called: `--yes`, `--scene`, `--from`.
    Options,
    /// A signal to the process.
    Signal,
}

/// How a scene ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SceneEnd {
    /// All its steps were played to their end, and nothing that they waited for failed.
    Completed,
    /// It was played, and something failed or stayed unknown.
    Failures,
    /// It was left before its end.
    Stopped,
}

/// How a step ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StepEnd {
    /// All that it waited for is completed. Of a step in the background: all was started.
    Completed,
    /// Something failed, and it went on all the same.
    Failures,
    /// It was left before its end.
    Stopped,
}

/// Why a step waits.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "because", rename_all = "snake_case")]
pub enum Why {
    /// A server does not answer: what its tasks do is unknown.
    ServerSilent {
        /// Its name.
        remote: String,
    },
    /// A server was started anew: what became of its tasks is unknown.
    ServerRestarted {
        /// Its name.
        remote: String,
    },
    /// A server does not know a task that it had taken.
    TaskUnknown,
    /// A server answers, but does not say how its tasks are: it has not their scope (yet), or its
    /// controller raises an exception.
    NotTold {
        /// Its name.
        remote: String,
    },
    /// A server's answer does not tell how a task is, and to ask again would not help: it could not learn the end,
    /// or answered about another task or what ZTL does not define.
    AnswerUnclear {
        /// Its name.
        remote: String,
    },
    /// A task was sent and there was no answer: whether it runs is unknown.
    StartUnknown,
    /// A task failed, was aborted by somebody else, or was not started.
    Failed,
    /// A task takes longer than its limit.
    TooLong,
}

impl Why {
    /// Whether it can end without anybody's decision: a server answers again, or a task ends.
    #[must_use]
    pub const fn may_mend(&self) -> bool {
        matches!(
            self,
            Self::ServerSilent { .. } | Self::NotTold { .. } | Self::TooLong
        )
    }
}

/// How it is with a task of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskState {
    /// Sent, and not answered yet.
    Asked,
    /// It was not started: there is no such server, it is not there, or it never got the request.
    NotStarted,
    /// Its server refused to start it.
    Refused,
    /// Its server has it, and its handler has not decided yet.
    Initiated,
    /// Under way.
    Accepted,
    /// Its handler refused it. Final.
    Rejected,
    /// Ended without reaching its goal. Final.
    Failed,
    /// Stopped on request. Final.
    Aborted,
    /// Reached its goal. Final.
    Completed,
    /// Nobody knows: no answer, or a server that was started anew. It may become known again.
    Unknown,
}

impl TaskState {
    /// Nothing more will come: it has ended, or never began.
    #[must_use]
    pub const fn is_over(self) -> bool {
        self.is_failure() || matches!(self, Self::Completed)
    }

    /// It is over, and did not reach its goal.
    #[must_use]
    pub const fn is_failure(self) -> bool {
        matches!(
            self,
            Self::NotStarted | Self::Refused | Self::Rejected | Self::Failed | Self::Aborted
        )
    }

    /// As in records: `completed`, `not_started`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Asked => "asked",
            Self::NotStarted => "not_started",
            Self::Refused => "refused",
            Self::Initiated => "initiated",
            Self::Accepted => "accepted",
            Self::Rejected => "rejected",
            Self::Failed => "failed",
            Self::Aborted => "aborted",
            Self::Completed => "completed",
            Self::Unknown => "unknown",
        }
    }
}

impl From<State> for TaskState {
    fn from(state: State) -> Self {
        match state {
            State::Initiated => Self::Initiated,
            State::Accepted => Self::Accepted,
            State::Rejected => Self::Rejected,
            State::Failed => Self::Failed,
            State::Aborted => Self::Aborted,
            State::Completed => Self::Completed,
        }
    }
}

impl fmt::Display for TaskState {
    /// As it is told to people: `completed`, `not started`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotStarted => f.write_str("not started"),
            other => f.write_str(other.name()),
        }
    }
}

/// What is asked of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Kind {
    /// To start a task.
    Init,
    /// How a task is.
    Status,
    /// To stop a task.
    Abort,
}

/// How it is with a server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "is", rename_all = "snake_case")]
pub enum ServerState {
    /// It answers.
    Answering {
        /// Its version, where it is one of ours; `None` of the original's.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        version: Option<String>,
    },
    /// It was there, and does not answer.
    Silent,
    /// It is not there, or does not serve the scope.
    Absent {
        /// How that is known.
        #[serde(default, skip_serializing_if = "String::is_empty")]
        text: String,
    },
    /// It answers, and is another than before: it has forgotten all tasks.
    Restarted,
}

/// How a run went; its exit code follows from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Nothing that was played failed.
    Completed,
    /// It came to its end, and something failed or stayed unknown.
    Failures,
    /// It was stopped, and the end of every task that it had started is known.
    Stopped,
    /// It was stopped, and at least one task may still run.
    NotConfirmed,
    /// It was left without stopping what it had started.
    Left,
    /// An error ended it.
    Error,
}

/// SHA-256 in lower-case hex, as `sha256sum` prints it.
#[must_use]
pub fn sha256(bytes: &[u8]) -> String {
    use sha2::Digest;
    let digest = sha2::Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A time as milliseconds with their fraction, exact to the microsecond.
mod millis {
    use std::time::Duration;

    use serde::{Deserialize, Deserializer, Serializer, de};

    pub(super) fn serialize<S: Serializer>(time: &Duration, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_f64(time.as_micros() as f64 / 1000.0)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Duration, D::Error> {
        let millis = f64::deserialize(from)?;
        // Rounded, or 0.001 ms would be read as no time at all.
        let micros = (millis * 1000.0).round();
        Duration::try_from_secs_f64(micros / 1e6)
            .map(|time| Duration::from_micros(((time.as_nanos() + 500) / 1000) as u64))
            .map_err(|_| de::Error::custom(format!("{millis} ms is no length of time")))
    }
}

/// The same, or nothing.
mod optional_millis {
    use std::time::Duration;

    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    #[derive(Serialize, Deserialize)]
    #[serde(transparent)]
    struct Millis(#[serde(with = "super::millis")] Duration);

    #[expect(clippy::ref_option, reason = "serde calls it so")]
    pub(super) fn serialize<S: Serializer>(
        time: &Option<Duration>,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        time.map(Millis).serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(
        from: D,
    ) -> Result<Option<Duration>, D::Error> {
        let millis = Option::<Millis>::deserialize(from)?;
        Ok(millis.map(|Millis(time)| time))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamped(event: Event) -> Stamped {
        Stamped {
            at: Duration::from_micros(1_234_567),
            wall: SystemTime::UNIX_EPOCH + Duration::from_millis(1_763_740_800_250),
            event,
        }
    }

    #[test]
    fn an_event_is_one_line_with_both_times() {
        let line = serde_json::to_string(&stamped(Event::Key {
            key: "Enter".to_owned(),
            command: Some(Command::Jump { scene: 2 }),
        }))
        .unwrap();
        assert_eq!(
            line,
            r#"{"at_ms":1234.567,"wall":"2025-11-21T16:00:00.250000Z","event":"key","key":"Enter","command":{"do":"jump","scene":2}}"#
        );
    }

    #[test]
    fn what_is_written_is_read_back() {
        let outline = Outline {
            scenes: vec![SceneOutline {
                name: "a\n\"b\"".to_owned(),
                delay: Duration::from_micros(1),
                steps: vec![StepOutline {
                    name: "s".to_owned(),
                    delay: Duration::ZERO,
                    wait: true,
                    parallel: false,
                    tasks: vec![TaskOutline {
                        handler: "h".to_owned(),
                        component: "c".to_owned(),
                        goal: "g".to_owned(),
                        remote: "r".to_owned(),
                        delay: Duration::from_millis(1500),
                        wait: false,
                        limit: Some(Duration::from_secs(3)),
                    }],
                }],
            }],
        };
        let events = [
            Event::RunStarted(Box::new(RunStarted {
                format: FORMAT,
                script: "s.yaml".to_owned(),
                sha256: sha256(b""),
                config: None,
                options: vec!["--yes".to_owned()],
                versions: vec![("ztl".to_owned(), "0.1.0".to_owned())],
                remotes: Vec::new(),
                outline,
            })),
            Event::Resumed,
            Event::Asked {
                question: Question::Step { scene: 1, step: 2 },
                choices: vec![Command::Retry, Command::GoOn, Command::Stop],
            },
            Event::StepWaiting {
                scene: 0,
                step: 0,
                why: Why::ServerSilent {
                    remote: "robot".to_owned(),
                },
                tasks: vec![TaskNumber(7)],
            },
            Event::Answered {
                request: RequestNumber(9),
                latency: Duration::from_micros(321),
                state: 1,
                id: "-99999999999999999999".parse().unwrap(),
                text: String::new(),
            },
        ];
        for event in events {
            let line = serde_json::to_string(&stamped(event.clone())).unwrap();
            assert!(!line.contains('\n'), "{line}");
            let read: Stamped = serde_json::from_str(&line).unwrap();
            assert_eq!(read, stamped(event), "{line}");
        }
    }

    #[test]
    fn an_event_of_a_newer_version_is_passed_over() {
        let line = r#"{"at_ms":0,"wall":"2025-11-21T16:00:00Z","event":"eclipse","of":"sun"}"#;
        let read: Stamped = serde_json::from_str(line).unwrap();
        assert_eq!(read.event, Event::Unknown);
    }

    #[test]
    fn a_time_that_cannot_be_is_refused() {
        for at in ["-1", "1e300", "\"1\""] {
            let line =
                format!(r#"{{"at_ms":{at},"wall":"2025-11-21T16:00:00Z","event":"resumed"}}"#);
            assert!(serde_json::from_str::<Stamped>(&line).is_err(), "{line}");
        }
    }

    #[test]
    fn the_hash_is_that_of_sha256sum() {
        assert_eq!(
            sha256(b"abc"),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
    }
}
