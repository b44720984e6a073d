//! The engine that plays a script, without I/O: the time, answers and the operator's commands come
//! in; requests, events and the next wake-up time go out.
//!
//! Its rules: no step starts before every task that the last one waited for has ended by the word of
//! its server. What is unknown is never taken for done: while a server is silent or has forgotten a
//! task, the step waits, says so, and the operator decides. An INIT is never sent again by itself.

mod answer;
mod commands;
mod ends;
mod probe;
mod send;
mod steps;
mod stop;
mod tasks;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use ztl_core::{Instant, State};

use super::event::{By, Event, Outcome, Question, RequestNumber, ServerState, TaskNumber};
use super::model::Script;
use steps::Play;
use stop::Stopping;
use tasks::Live;
use ztl_std::RemoteId;

/// Pause between two questions about a task where the server does not hold the answer, as the
/// original's.
pub(super) const POLL: Duration = Duration::from_millis(100);

/// How long an unattended run waits for a server that does not answer.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// What is played of a script, and how.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// Nobody is asked: each scene is played, and what nobody can decide stops everything.
    pub unattended: bool,
    /// Only this scene.
    pub scene: Option<usize>,
    /// From this step on, by scene and step.
    pub from: Option<(usize, usize)>,
    /// Somebody looks at the progress: tasks in the background are asked about too, where the server is
    /// the original's. Servers of ours always are.
    pub watch: bool,
    /// Names of the servers that there are. A task for another is not started.
    pub remotes: BTreeSet<String>,
}

/// Something to ask a server. The shell sends it and hands back what came of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Its number.
    pub number: RequestNumber,
    /// The task that it is about, where it is about one.
    pub task: Option<TaskNumber>,
    /// The name of the server.
    pub remote: String,
    /// What is asked.
    pub ask: Ask,
}

/// What is asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ask {
    /// To start a task.
    Init {
        /// Whose.
        handler: String,
        /// Which part of it.
        component: String,
        /// What it is to do.
        goal: String,
    },
    /// How a task is.
    Status {
        /// Which.
        id: RemoteId,
        /// The payload for a server that does not hold answers.
        text: String,
        /// Longest time for a server of ours to hold the answer until the task's end; zero: at once.
        hold: Duration,
    },
    /// To stop a task.
    Abort {
        /// Which.
        id: RemoteId,
    },
    /// Whether the server is there and serves the scope. Starts nothing.
    Probe,
    /// Which tasks run in the scope.
    Tasks,
}

/// What came of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// To an INIT: the task was taken.
    Started {
        /// Its id there.
        id: RemoteId,
        /// What the server says.
        text: String,
        /// Who the server is.
        server: Server,
    },
    /// To an INIT: it was not.
    Refused {
        /// The id in the answer.
        id: RemoteId,
        /// Why.
        text: String,
    },
    /// To an INIT: it cannot have been acted on, and never will be.
    NotStarted {
        /// How that is known.
        text: String,
    },
    /// To a STATUS or an ABORT.
    Task {
        /// Where the task is in its life.
        state: State,
        /// Progress, result or reason.
        text: String,
    },
    /// The server does not know the task.
    TaskUnknown {
        /// Which start of the server says so, where it is one of ours.
        boot: Option<u32>,
        /// In words.
        text: String,
    },
    /// To a probe: the server is there.
    There {
        /// Who it is.
        server: Server,
    },
    /// To a probe: it is there, but does not serve the scope.
    NoScope {
        /// In words.
        text: String,
    },
    /// To [`Ask::Tasks`].
    Tasks {
        /// Which start of the server lists them, and those that run or may run in the scope: id and
        /// `handler:component:goal`. `None`: the server does not list its tasks, as the original's.
        listed: Option<(u32, Vec<(RemoteId, String)>)>,
        /// Reasons why others may run.
        gaps: Vec<String>,
    },
    /// The server answered, but that it did not reach the task. It may tell more later.
    NotTold {
        /// In words.
        text: String,
    },
    /// The server answered, and the outcome is unknown: the server could not learn it, or its answer is
    /// about another task, has an undefined state, or is not a ZTL message. To ask again would not
    /// help. To an INIT: the task may have been started.
    Unclear {
        /// In words.
        text: String,
    },
    /// There was no answer.
    Nothing {
        /// Whether the request was sent at all.
        sent: bool,
        /// In words.
        text: String,
    },
}

/// Who a server is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Server {
    /// The original's, or another's.
    Original,
    /// Ours: it holds answers to STATUS.
    Ours {
        /// Its version.
        version: String,
        /// Differs from start to start.
        boot: u32,
    },
}

/// Plays one script once.
///
/// *Inputs*: [`begin`](Self::begin) once, then [`handle_command`](Self::handle_command),
/// [`handle_answer`](Self::handle_answer), [`handle_time`](Self::handle_time) when
/// [`poll_timeout`](Self::poll_timeout) has come. After each, take all of
/// [`poll_request`](Self::poll_request) and [`poll_event`](Self::poll_event). Each input costs at most
/// work linear in the tasks that run and in the steps that end by it.
#[derive(Debug)]
pub struct Player {
    script: Arc<Script>,
    options: Options,
    phase: Phase,
    /// What the operator is asked.
    question: Option<Question>,
    /// All that were started, by number.
    tasks: BTreeMap<TaskNumber, Live>,
    /// Those that may still be under way, as far as is known.
    live: BTreeSet<TaskNumber>,
    next_task: u32,
    /// Requests under way: whose, what, and since when.
    under_way: BTreeMap<RequestNumber, Sent>,
    next_request: u64,
    requests: VecDeque<Request>,
    events: VecDeque<Event>,
    servers: BTreeMap<String, ServerState>,
    /// When each server is probed the next time; `None` while a probe is under way.
    probes: BTreeMap<String, Option<Instant>>,
    /// The last scene that was played.
    last: Option<usize>,
    /// What failed in it, by step and part.
    failed: Vec<(usize, usize, TaskNumber)>,
    takes: BTreeMap<usize, u32>,
    /// What failed or is unknown and was not made good.
    unresolved: BTreeSet<TaskNumber>,
}

#[derive(Debug)]
enum Phase {
    /// Nothing has begun, or an operator is asked about a scene or the end.
    Idle,
    Playing(Box<Play>),
    /// The last answers about tasks in the background are waited for.
    Settling(BTreeSet<RequestNumber>),
    Stopping(Stopping),
    Over(Outcome),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum What {
    Init,
    Status { held: bool },
    Abort,
    Probe,
    Tasks,
}

#[derive(Debug)]
struct Sent {
    task: Option<TaskNumber>,
    remote: String,
    what: What,
    at: Instant,
}

impl Player {
    /// A player of this script.
    #[must_use]
    pub fn new(script: Arc<Script>, options: Options) -> Self {
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

    /// Shows the first scene. To be called once, before anything else.
    pub fn begin(&mut self, now: Instant) {
        let first = self.first();
        for scene in 0..first {
            self.events.push_back(Event::SceneSkipped {
                scene,
                by: By::Options,
            });
        }
        self.show(first);
        if self.options.watch {
            let remotes = self.options.remotes.iter();
            self.probes = remotes.map(|name| (name.clone(), Some(now))).collect();
        }
        self.advance(now);
    }

    /// The time has come to which [`poll_timeout`](Self::poll_timeout) pointed.
    pub fn handle_time(&mut self, now: Instant) {
        self.probe(now);
        self.watch(now);
        self.advance(now);
    }

    /// The next request to send.
    pub fn poll_request(&mut self) -> Option<Request> {
        self.requests.pop_front()
    }

    /// The next thing that has happened.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// When [`handle_time`](Self::handle_time) is to be called, if nothing else comes.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        if matches!(self.phase, Phase::Over(_)) {
            return None;
        }
        let step = match &self.phase {
            Phase::Playing(play) => play.wake(),
            _ => None,
        };
        let tasks = self
            .live
            .iter()
            .filter_map(|number| self.task_wake(*number));
        tasks.chain(step).chain(self.probe_wake()).min()
    }

    /// How the run ended, if it has.
    #[must_use]
    pub const fn outcome(&self) -> Option<Outcome> {
        match self.phase {
            Phase::Over(outcome) => Some(outcome),
            _ => None,
        }
    }

    /// What the operator is asked just now.
    #[must_use]
    pub const fn question(&self) -> Option<Question> {
        self.question
    }

    /// The script.
    #[must_use]
    pub const fn script(&self) -> &Arc<Script> {
        &self.script
    }

    /// The scene that was played last, which can be replayed.
    #[must_use]
    pub const fn last(&self) -> Option<usize> {
        self.last
    }

    /// The first scene to show.
    fn first(&self) -> usize {
        let from = self.options.from.map(|(scene, _)| scene);
        self.options.scene.or(from).unwrap_or(0)
    }

    /// Shows a scene, or asks what comes after the last.
    fn show(&mut self, scene: usize) {
        self.phase = Phase::Idle;
        if scene < self.script.scenes.len() {
            self.events.push_back(Event::SceneShown { scene });
            self.ask(Question::Scene { scene });
        } else {
            self.ask(Question::End);
        }
    }

    fn ask(&mut self, question: Question) {
        self.question = Some(question);
        let choices = self.choices();
        self.events.push_back(Event::Asked { question, choices });
    }

    fn over(&mut self, outcome: Outcome) {
        let running = self.live.iter().copied().collect();
        self.question = None;
        self.requests.clear();
        self.phase = Phase::Over(outcome);
        let text = String::new();
        self.events.push_back(Event::RunEnded {
            outcome,
            running,
            text,
        });
    }

    /// How it went, if it ends now by itself.
    fn fate(&self) -> Outcome {
        match self.unresolved.is_empty() {
            true => Outcome::Completed,
            false => Outcome::Failures,
        }
    }
}

#[cfg(test)]
mod tests;
