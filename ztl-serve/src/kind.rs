//! What a kind of handler implements, such as a program or another server.
//!
//! The life cycle is the supervisor's and the same for all kinds: it checks the goal, admits or queues the task,
//! starts it, passes on progress and aborts, and reports the outcome. A [`Kind`] starts [`Job`]s; a job answers
//! calls with [`Effect`]s.

use std::any::Any;
use std::fmt;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ztl_core::TaskId;
use ztl_std::describe::GoalRule;
use ztl_std::server::TaskReporter;

use crate::call::Call;
use crate::mailbox::Mailbox;
use crate::program::processes::{Process, ProcessRegistry};
use crate::{naoqi, ros1};

/// How long an abort may take on a thread or in another server once this server stops.
pub(crate) const STOP_TIME: Duration = Duration::from_millis(1500);

/// The reason of a kind whose tasks clients cannot abort.
pub(crate) const CANNOT_ABORT: &str = "it cannot be aborted";

/// One kind of handler, with the settings of one component.
pub(crate) trait Kind: Any + fmt::Debug + Send + Sync {
    /// The rule for goals where the file has none.
    fn goal_rule(&self) -> GoalRule {
        GoalRule::Any
    }

    /// How many tasks run at once where the file does not say it.
    fn at_once(&self) -> usize {
        16
    }

    /// Whether tasks use parts of their goals, as `{goal.x}` does.
    fn needs_fields(&self) -> bool {
        false
    }

    /// Whether clients may abort tasks.
    fn can_abort(&self) -> bool {
        true
    }

    /// How long tasks may take to end once the server stops.
    fn stop_time(&self) -> Duration {
        STOP_TIME
    }

    /// Returns, without starting anything, whether [`start`](Self::start) would reject the task.
    fn check(&self, _call: &Call) -> Result<(), String> {
        Ok(())
    }

    /// Connects to what tasks need. Called once, before the first task; must not block for long.
    fn prepare(&self) {}

    /// Starts a task. Must not block.
    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, services: &Services) -> Start;
}

/// How a task has started.
pub(crate) enum Start {
    Running(Box<dyn Job>),
    /// It was rejected, or had nothing to wait for.
    Ended(Outcome),
}

/// A task in progress. All calls come from the supervisor's thread and must not block.
pub(crate) trait Job: Send {
    /// Ends the task early. Sooner or later the job pushes [`Effect::End`].
    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>);

    /// Something that the job waits for has happened.
    fn handle_event(&mut self, _now: Instant, _event: JobEvent, _effects: &mut Vec<Effect>) {}

    /// When to call [`handle_timeout`](Self::handle_timeout) next.
    fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    /// Called in each turn of the loop, also before the timeout.
    fn handle_timeout(&mut self, _now: Instant, _effects: &mut Vec<Effect>) {}

    /// Pipes to wait for.
    fn pipes(&self) -> Vec<BorrowedFd<'_>> {
        Vec::new()
    }

    /// Reads the pipes.
    fn read_pipes(&mut self, _effects: &mut Vec<Effect>) {}

    /// Whether the job has a child process.
    fn has_process(&self) -> bool {
        false
    }

    /// A child of this server may have ended.
    fn check_process(&mut self) {}

    /// One turn of the loop. `check`: a child of this server may have ended.
    fn turn(&mut self, now: Instant, check: bool, effects: &mut Vec<Effect>) {
        if check {
            self.check_process();
        }
        self.handle_timeout(now, effects);
    }
}

/// What the supervisor does for a job.
pub(crate) enum Effect {
    /// Reports the task as accepted, unless that was done before.
    Accept,
    Progress(String),
    /// The program of a stream has written this.
    Output(Vec<u8>),
    /// Answers an abort: the task continues. The reason is for the log.
    RejectAbort(String),
    /// Runs another job, which may outlive the task.
    Background(Box<dyn Job>),
    End(Outcome),
    /// Ends the task with an unknown outcome.
    Leave,
}

/// A final state with its result or reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Outcome {
    Completed(String),
    Failed(String),
    /// Reported as FAILED with a reason that says so: nobody can tell the final state.
    Unknown(String),
    Aborted(String),
    Rejected(String),
}

/// Why a task ends early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StopReason {
    /// A client has sent an abort.
    Client,
    /// The client has started this task in its place.
    Replaced(TaskId),
    /// The task has reached its time limit.
    Limit,
    /// The program has closed its output and runs on, so that a stream gets nothing more.
    Closed,
    /// The server stops.
    Server,
}

impl StopReason {
    /// The outcome of a task that is stopped before it has started.
    pub(crate) fn before_start(self) -> Outcome {
        Outcome::Aborted(format!("{self} before it began"))
    }
}

impl fmt::Display for StopReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Server => f.write_str("the server was stopped"),
            Self::Replaced(by) => write!(f, "replaced by task {by}"),
            Self::Client | Self::Limit | Self::Closed => f.write_str("aborted"),
        }
    }
}

/// What a job waits for.
pub(crate) enum JobEvent {
    /// The watchdog knows of the job's program.
    Confirmed,
    /// The program has been started, or could not be.
    Started(Result<Process, String>),
    /// The program that aborts the job's could not be started.
    AbortNotStarted(String),
    /// The node of ROS 1 reports this.
    Ros1(ros1::Event),
    /// The client of NAOqi reports this.
    Naoqi(naoqi::Event),
}

/// Messages to the supervisor, or to the thread of all streams, which gets neither `Start` nor `Abort`.
pub(crate) enum Message {
    /// A client starts a task of the component with this index.
    Start {
        task: TaskReporter,
        component_index: usize,
        handler: String,
        component: String,
        goal: String,
    },
    Abort(TaskId),
    Event(TaskId, JobEvent),
    Effect(TaskId, Effect),
    /// Stop all tasks and reject new ones.
    Stop,
}

/// What all tasks share.
pub(crate) struct Services {
    pub(crate) processes: ProcessRegistry,
}

/// The way from any thread to the supervisor of a job.
#[derive(Clone)]
pub(crate) struct JobContext {
    pub(crate) id: TaskId,
    pub(crate) mailbox: Mailbox<Message>,
}

impl JobContext {
    /// Has the supervisor do this.
    pub(crate) fn effect(&self, effect: Effect) {
        self.mailbox.send(Message::Effect(self.id, effect));
    }

    /// Has the supervisor pass this to the task's job.
    pub(crate) fn event(&self, event: JobEvent) {
        self.mailbox.send(Message::Event(self.id, event));
    }
}
