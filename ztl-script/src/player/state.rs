//! The state of a run.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use ztl_core::Instant;
use ztl_std::RemoteId;

use crate::event::{
    Question, RequestNumber, RunEvent, ServerState, TaskNumber, TaskState, WaitReason,
};
use crate::script::Script;
use crate::server::ServerRequest;

/// Pause between two STATUS requests about a task where the server does not hold the answer, as in the
/// original.
pub(super) const POLL: Duration = Duration::from_millis(100);

/// How long an unattended run waits for a server that does not answer.
pub(super) const PATIENCE: Duration = Duration::from_secs(60);

/// What is played of a script, and how.
#[derive(Debug, Clone, Default)]
pub struct PlayOptions {
    /// No operator: each scene is played, and a decision that needs a person aborts the tasks of
    /// this run and ends it.
    pub unattended: bool,
    /// Play only this scene.
    pub scene: Option<usize>,
    /// Start with this step, by scene and step.
    pub from: Option<(usize, usize)>,
    /// Somebody watches the progress: ask the original's servers about tasks in the background too. Servers
    /// of this project are always asked.
    pub watch: bool,
    /// Names of the configured servers. A task for another server is not started.
    pub remotes: BTreeSet<String>,
}

/// A numbered request to one server. The runner sends it and returns the answer with the number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Request {
    /// Its number.
    pub(crate) number: RequestNumber,
    /// Name of the server.
    pub(crate) remote: String,
    /// The request.
    pub(crate) body: ServerRequest,
}

/// Decides what a script does next, without I/O: time, answers and commands come in; requests, events and
/// the next wake-up time go out.
///
/// Inputs: `begin` once, then `handle_command`, `handle_answer`, and `handle_time` at `poll_timeout`. After
/// each input, take everything from `poll_request` and `poll_event`. An input costs at most work linear in
/// the running tasks and in the steps that end by it.
#[derive(Debug)]
pub(crate) struct Player {
    pub(super) script: Arc<Script>,
    pub(super) options: PlayOptions,
    pub(super) phase: Phase,
    /// The open question to the operator.
    pub(super) question: Option<Question>,
    /// Every task that was started.
    pub(super) tasks: BTreeMap<TaskNumber, RunTask>,
    /// The tasks that may still run.
    pub(super) live: BTreeSet<TaskNumber>,
    pub(super) next_task: u32,
    pub(super) under_way: BTreeMap<RequestNumber, Pending>,
    pub(super) next_request: u64,
    pub(super) requests: VecDeque<Request>,
    pub(super) events: VecDeque<RunEvent>,
    pub(super) servers: BTreeMap<String, ServerState>,
    /// When each server is probed next; `None` while a probe is under way.
    pub(super) probes: BTreeMap<String, Option<Instant>>,
    /// The scene that was played last.
    pub(super) last: Option<usize>,
    /// What failed in it: step, part, task.
    pub(super) failed: Vec<(usize, usize, TaskNumber)>,
    /// How many times each scene was played.
    pub(super) takes: BTreeMap<usize, u32>,
    /// Tasks that failed or are unknown, and were not repeated successfully.
    pub(super) unresolved: BTreeSet<TaskNumber>,
}

#[derive(Debug)]
pub(super) enum Phase {
    /// Before the start, or while the operator is asked about a scene or the end.
    Idle,
    Playing(Box<Play>),
    /// Waiting for the last answers about tasks in the background.
    Settling(BTreeSet<RequestNumber>),
    Stopping(Stopping),
    Over,
}

/// A request without an answer yet.
#[derive(Debug)]
pub(super) struct Pending {
    pub(super) task: Option<TaskNumber>,
    pub(super) remote: String,
    pub(super) body: ServerRequest,
    pub(super) at: Instant,
}

/// The scene being played.
#[derive(Debug)]
pub(super) struct Play {
    pub(super) scene: usize,
    pub(super) take: u32,
    /// Steps to come, with the parts to play: all, or those that are repeated.
    pub(super) steps: VecDeque<(usize, Option<Vec<Todo>>)>,
    /// The scene shown before (past the last: the end), which is shown again when this one is stopped.
    pub(super) before: usize,
    /// The scene shown afterwards.
    pub(super) then: usize,
    pub(super) stage: Stage,
    /// The current step.
    pub(super) step: Option<StepPlay>,
    pub(super) failures: bool,
    /// Pause after this step.
    pub(super) pause: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stage {
    /// Waiting until then.
    Delay(Instant),
    Step,
    Paused,
}

/// The step being played.
#[derive(Debug)]
pub(super) struct StepPlay {
    pub(super) step: usize,
    /// What is still to be started.
    pub(super) todo: VecDeque<Todo>,
    /// What was started and not repeated.
    pub(super) tasks: Vec<TaskNumber>,
    /// The wait that the operator was shown.
    pub(super) told: Option<ToldWait>,
    /// The operator was asked about this step: nothing of it is retried without a decision.
    pub(super) asked: bool,
    pub(super) retries: u32,
    pub(super) begun: bool,
}

/// Why a step waits, as shown to the operator.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct ToldWait {
    pub(super) why: WaitReason,
    pub(super) tasks: Vec<TaskNumber>,
    /// Whether something could be retried.
    pub(super) can_retry: bool,
}

/// A task of a step that is to be started.
#[derive(Debug, Clone, Copy)]
pub(super) struct Todo {
    pub(super) part: usize,
    pub(super) at: Option<Instant>,
    pub(super) retry_of: Option<TaskNumber>,
}

/// What is being stopped.
#[derive(Debug)]
pub(super) struct Stopping {
    pub(super) tasks: BTreeSet<TaskNumber>,
    /// Requests for the tasks that others started.
    pub(super) listings: BTreeSet<RequestNumber>,
    /// Everything is being stopped, not only a scene.
    pub(super) all: bool,
    /// The scene shown afterwards (past the last: the end); `None`: the run ends.
    pub(super) then: Option<usize>,
}

/// A task of this run, or one that another client started and this run stops.
#[derive(Debug)]
pub(super) struct RunTask {
    /// Scene, step and part; `None` for a task of a cue, or that another client started.
    pub(super) place: Option<(usize, usize, usize)>,
    /// Cue and part.
    pub(super) cue: Option<(usize, usize)>,
    pub(super) remote: String,
    /// Its step waits for it.
    pub(super) awaited: bool,
    pub(super) state: TaskState,
    pub(super) text: String,
    pub(super) id: Option<RemoteId>,
    /// Its server is one of this project and holds answers.
    pub(super) ours: bool,
    /// Boot id of the server that accepted it.
    pub(super) boot: Option<u32>,
    /// Payload of its STATUS where the server does not hold answers, after its id.
    pub(super) status_text: String,
    /// The STATUS that is under way.
    pub(super) asked: Option<RequestNumber>,
    /// When the next STATUS or ABORT may be sent.
    pub(super) next: Instant,
    /// When its time limit passes.
    pub(super) deadline: Option<Instant>,
    /// Its time limit has passed.
    pub(super) late: bool,
    /// Why its state is unknown, and since when.
    pub(super) unknown: Option<(WaitReason, Instant)>,
    /// The operator decided to continue without it.
    pub(super) excused: bool,
    /// ABORTs sent.
    pub(super) aborts: u32,
    /// An ABORT is under way.
    pub(super) aborting: bool,
    /// The last ABORT was not answered.
    pub(super) abort_lost: bool,
    /// It was not started because its server is not there.
    pub(super) absent: bool,
    /// The operator was shown the result of stopping it.
    pub(super) stop_told: bool,
}

impl Stage {
    pub(super) const fn is_paused(self) -> bool {
        matches!(self, Self::Paused)
    }
}

impl Play {
    /// When it continues by itself.
    pub(super) fn wake(&self) -> Option<Instant> {
        match self.stage {
            Stage::Delay(until) => Some(until),
            Stage::Paused => None,
            Stage::Step => {
                let todo = self.step.as_ref()?.todo.iter();
                todo.filter_map(|todo| todo.at).min()
            }
        }
    }
}

impl RunTask {
    /// A task that is about to be sent.
    pub(super) const fn new(now: Instant, remote: String) -> Self {
        Self {
            place: None,
            cue: None,
            remote,
            awaited: false,
            state: TaskState::Asked,
            text: String::new(),
            id: None,
            ours: false,
            boot: None,
            status_text: String::new(),
            asked: None,
            next: now,
            deadline: None,
            late: false,
            unknown: None,
            excused: false,
            aborts: 0,
            aborting: false,
            absent: false,
            abort_lost: false,
            stop_told: false,
        }
    }

    /// Whether a STATUS may tell its state.
    pub(super) const fn can_be_asked(&self) -> bool {
        let hopeless = matches!(
            self.unknown,
            Some((
                WaitReason::ServerRestarted { .. }
                    | WaitReason::TaskUnknown
                    | WaitReason::AnswerUnclear { .. }
                    | WaitReason::StartUnknown,
                _
            ))
        );
        self.id.is_some() && !hopeless
    }

    /// Whether it failed and its step cares. How a task in the background ends does not matter to its step.
    pub(super) const fn is_failure(&self) -> bool {
        let never_began = matches!(self.state, TaskState::NotStarted | TaskState::Refused);
        never_began || (self.awaited && self.state.is_failure())
    }

    /// Whether, as far as is known, an earlier start of its server than this one accepted it.
    pub(super) fn is_of_an_earlier(&self, boot: Option<u32>) -> bool {
        let silent = matches!(
            self.unknown,
            Some((
                WaitReason::ServerSilent { .. } | WaitReason::NotTold { .. },
                _
            ))
        );
        silent || matches!((self.boot, boot), (Some(own), Some(boot)) if own != boot)
    }

    /// Whether its step still waits for it.
    pub(super) const fn is_open(&self) -> bool {
        self.awaited && !self.state.is_over() && !self.excused
    }
}

impl Player {
    /// A player of this script.
    pub(crate) fn new(script: Arc<Script>, options: PlayOptions) -> Self {
        Self {
            script,
            options,
            phase: Phase::Idle,
            question: None,
            tasks: BTreeMap::new(),
            live: BTreeSet::new(),
            next_task: 1,
            under_way: BTreeMap::new(),
            next_request: 1,
            requests: VecDeque::new(),
            events: VecDeque::new(),
            servers: BTreeMap::new(),
            probes: BTreeMap::new(),
            last: None,
            failed: Vec::new(),
            takes: BTreeMap::new(),
            unresolved: BTreeSet::new(),
        }
    }

    /// Whether nothing plays, and no task that it started may run.
    pub(crate) fn is_idle(&self) -> bool {
        matches!(self.phase, Phase::Idle) && self.live.is_empty()
    }

    pub(super) fn emit(&mut self, event: RunEvent) {
        self.events.push_back(event);
    }

    /// The number of a task that is about to be sent or stopped.
    pub(super) fn number_task(&mut self) -> TaskNumber {
        let number = TaskNumber(self.next_task);
        self.next_task += 1;
        number
    }

    /// The scene being played, if there is one.
    pub(super) fn play_mut(&mut self) -> Option<&mut Play> {
        match &mut self.phase {
            Phase::Playing(play) => Some(play.as_mut()),
            _ => None,
        }
    }

    /// The scene being played, with the index of its current step.
    pub(super) fn step_mut(&mut self) -> Option<(usize, &mut StepPlay)> {
        let play = self.play_mut()?;
        Some((play.scene, play.step.as_mut()?))
    }
}
