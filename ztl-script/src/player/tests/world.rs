//! Simulated servers, operator and clock: requests are answered after a latency, tasks last as long as their
//! goals say, and servers pause and restart when a test says so.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ztl_core::integer::Integer;
use ztl_core::{Instant, State, TaskId};

use crate::event::{
    DecidedBy, Question, RequestNumber, RunCommand, RunEvent, RunOutcome, WaitReason,
};
use crate::player::state::Phase;
use crate::player::{PlayOptions, Player, Request};
use crate::server::{Server, ServerAnswer, ServerRequest};
use crate::{Defaults, Script};
use ztl_std::RemoteId;

/// Round-trip time.
const LATENCY: Duration = Duration::from_millis(1);
/// When a request times out.
const TIMEOUT: Duration = Duration::from_secs(2);
/// How often the client asks for the outcome of an INIT.
const OUTCOMES: u32 = 3;
/// A longer run hangs.
const HANGS: Duration = Duration::from_secs(3600);

/// A server, its tasks by id.
pub(super) struct Machine {
    pub(super) ours: bool,
    boot: u32,
    next: u32,
    tasks: BTreeMap<u32, Job>,
    /// When it is silent.
    pub(super) pauses: Vec<(Instant, Instant)>,
    /// When it restarts.
    pub(super) restarts: Vec<Instant>,
    /// How many INITs it rejects, by component.
    pub(super) rejections: BTreeMap<&'static str, u32>,
    /// No server listens at its address.
    pub(super) missing: bool,
    /// It does not serve the scope.
    pub(super) scopeless: bool,
    /// The times of its probes.
    pub(super) probed: Vec<Instant>,
}

struct Job {
    begun: Instant,
    ends: Instant,
    end: State,
    said: &'static str,
    unstoppable: bool,
    aborted: Option<Instant>,
}

/// A task that began on a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Began {
    pub(super) at: Instant,
    pub(super) task: String,
    /// When it really ends.
    pub(super) until: Instant,
}

pub(super) struct World {
    pub(super) player: Player,
    pub(super) now: Instant,
    pub(super) machines: BTreeMap<String, Machine>,
    /// When an answer reaches the player.
    coming: BTreeMap<(Instant, u64), (RequestNumber, ServerAnswer)>,
    number: u64,
    pub(super) events: Vec<(Instant, RunEvent)>,
    pub(super) began: Vec<Began>,
    pub(super) statuses: usize,
}

impl Machine {
    fn paused(&self, at: Instant) -> Option<Instant> {
        let pause = self
            .pauses
            .iter()
            .find(|(from, to)| *from <= at && at < *to);
        pause.map(|(_, to)| *to)
    }

    /// Applies restarts that are due.
    fn turn(&mut self, now: Instant) {
        while let Some(restart) = self.restarts.first().copied().filter(|at| *at <= now) {
            self.restarts.remove(0);
            self.boot += 1;
            self.tasks.clear();
            if !self.ours {
                // The original counts from 1 again.
                self.next = 0;
            }
            let _ = restart;
        }
    }

    fn state(&self, id: &RemoteId, now: Instant) -> Option<(State, String)> {
        let job = self.tasks.get(&place(id))?;
        Some(match job.aborted {
            Some(at) if at <= now => (State::Aborted, "True".to_owned()),
            _ if now >= job.ends => (job.end, job.said.to_owned()),
            _ => (State::Accepted, "running".to_owned()),
        })
    }
}

/// Plays every scene.
pub(super) fn on(_: &World, question: Question) -> Option<RunCommand> {
    Some(match question {
        Question::Scene { .. } => RunCommand::Start,
        Question::End => RunCommand::Leave,
        Question::Step { .. } => RunCommand::GoOn,
        Question::Pause => RunCommand::Resume,
    })
}

pub(super) fn unattended() -> PlayOptions {
    PlayOptions {
        unattended: true,
        ..PlayOptions::default()
    }
}

/// The question about the first step of the first scene.
pub(super) const FIRST_STEP: Option<Question> = Some(Question::Step { scene: 0, step: 0 });

/// The number of events that match a pattern.
macro_rules! count {
    ($world:expr, $($pattern:tt)+) => {
        $world.events.iter().filter(|(_, event)| matches!(event, $($pattern)+)).count()
    };
}
pub(super) use count;

impl World {
    /// A script with two servers: `robot` is the original's, `lamp` one of this project.
    pub(super) fn new(script: &str, options: PlayOptions) -> Self {
        Self::with(script, options, Defaults::default())
    }

    pub(super) fn with(script: &str, mut options: PlayOptions, defaults: Defaults) -> Self {
        let script = Script::read("test.yaml", script.as_bytes(), defaults).expect("a script");
        let machines = [("robot", false), ("lamp", true)].map(|(name, ours)| {
            let machine = Machine {
                ours,
                boot: 1,
                next: 0,
                tasks: BTreeMap::new(),
                pauses: Vec::new(),
                restarts: Vec::new(),
                rejections: BTreeMap::new(),
                missing: false,
                scopeless: false,
                probed: Vec::new(),
            };
            (name.to_owned(), machine)
        });
        options
            .remotes
            .extend(["robot".to_owned(), "lamp".to_owned()]);
        Self {
            player: Player::new(Arc::new(script), options),
            now: Instant::ZERO,
            machines: machines.into_iter().collect(),
            coming: BTreeMap::new(),
            number: 0,
            events: Vec::new(),
            began: Vec::new(),
            statuses: 0,
        }
    }

    /// Plays the whole script unattended.
    pub(super) fn played_unattended(script: &str) -> Self {
        let mut world = Self::new(script, unattended());
        world.begin();
        world.run(on);
        world
    }

    /// Starts the first scene.
    pub(super) fn started(script: &str) -> Self {
        Self::started_with(script, |_| {})
    }

    /// The same with servers that `prepare` changes first.
    pub(super) fn started_with(script: &str, prepare: impl FnOnce(&mut Self)) -> Self {
        let mut world = Self::new(script, PlayOptions::default());
        prepare(&mut world);
        world.begin();
        world.command(RunCommand::Start);
        world
    }

    /// A signal stops the run; returns whether the player accepts it.
    pub(super) fn stop_by_signal(&mut self) -> bool {
        let command = RunCommand::Stop;
        let done = self
            .player
            .handle_command(self.now, command, DecidedBy::Signal);
        self.pump();
        done
    }

    /// How the run ended, if it has.
    pub(super) fn outcome(&self) -> Option<RunOutcome> {
        if !matches!(self.player.phase, Phase::Over) {
            return None;
        }
        let mut events = self.events.iter().rev();
        events.find_map(|(_, event)| match event {
            RunEvent::RunEnded { outcome, .. } => Some(*outcome),
            _ => None,
        })
    }

    /// Silences a server between these milliseconds.
    pub(super) fn pause(&mut self, name: &str, from: u64, to: u64) {
        let pause = (Instant::from_millis(from), Instant::from_millis(to));
        self.machine(name).pauses.push(pause);
    }

    pub(super) fn machine(&mut self, name: &str) -> &mut Machine {
        self.machines.get_mut(name).expect("there is one")
    }

    pub(super) fn begin(&mut self) {
        self.player.begin(self.now);
        self.pump();
    }

    #[track_caller]
    pub(super) fn command(&mut self, command: RunCommand) {
        let done = self
            .player
            .handle_command(self.now, command, DecidedBy::Operator);
        assert!(done, "{command:?} of {:?}", self.player.choices());
        self.pump();
    }

    /// Presses a cue.
    pub(super) fn cue(&mut self, cue: usize) -> Result<(), &'static str> {
        let started = self.player.start_cue(self.now, cue);
        self.pump();
        started
    }

    /// Lets time pass until a question or the end of the run; returns the question.
    pub(super) fn until_asked(&mut self) -> Option<Question> {
        while self.outcome().is_none() && self.player.question().is_none() {
            if !self.tick(None) {
                break;
            }
        }
        self.player.question()
    }

    /// Lets time pass.
    pub(super) fn pass(&mut self, time: Duration) {
        let until = self.now + time;
        while self.tick(Some(until)) {}
        self.now = until;
    }

    /// Runs to the end; `decide` answers questions.
    pub(super) fn run(&mut self, mut decide: impl FnMut(&Self, Question) -> Option<RunCommand>) {
        for _ in 0..100_000 {
            if self.outcome().is_some() {
                return;
            }
            let decided = self
                .player
                .question()
                .and_then(|question| decide(self, question));
            match decided {
                Some(command) => self.command(command),
                None => assert!(self.tick(None), "nothing is to come: {:#?}", self.events),
            }
        }
        panic!("it does not end: {:?}", self.events.last());
    }

    /// Processes the next input, if it comes before `until`.
    fn tick(&mut self, until: Option<Instant>) -> bool {
        let answer = self.coming.first_key_value().map(|((at, _), _)| *at);
        let wake = self.player.poll_timeout();
        let Some(next) = [answer, wake].into_iter().flatten().min() else {
            return false;
        };
        if until.is_some_and(|until| next > until) {
            return false;
        }
        assert!(
            next.since(Instant::ZERO) < HANGS,
            "it hangs: {:#?}",
            self.events.last()
        );
        self.now = self.now.max(next);
        if answer == Some(next)
            && let Some((_, (request, answer))) = self.coming.pop_first()
        {
            self.player.handle_answer(self.now, request, answer);
        } else {
            self.player.handle_time(self.now);
        }
        self.pump();
        true
    }

    fn pump(&mut self) {
        while let Some(event) = self.player.poll_event() {
            self.events.push((self.now, event));
        }
        while let Some(request) = self.player.poll_request() {
            let (at, answer) = self.serve(&request);
            self.number += 1;
            self.coming
                .insert((at, self.number), (request.number, answer));
        }
    }

    /// The answer to a request, and its time.
    fn serve(&mut self, request: &Request) -> (Instant, ServerAnswer) {
        let now = self.now;
        let machine = self.machines.get_mut(&request.remote).expect("a server");
        machine.turn(now);
        let resumes = machine.paused(now);
        // The server acts on it when it is back, and answers if the client still waits.
        let acts = resumes.unwrap_or(now) + LATENCY;
        let late = acts.since(now) >= TIMEOUT;
        if machine.missing {
            return (now + TIMEOUT, nothing(false));
        }
        if request.body == ServerRequest::Probe {
            machine.probed.push(now);
        }
        match &request.body {
            ServerRequest::Probe | ServerRequest::Tasks if late => (now + TIMEOUT, nothing(true)),
            ServerRequest::Probe if machine.scopeless => {
                let text = "no such scope".to_owned();
                (acts, ServerAnswer::NoScope { text })
            }
            ServerRequest::Probe => {
                let server = machine.who();
                (acts, ServerAnswer::There { server })
            }
            ServerRequest::Tasks => {
                let runs = |job: &Job| now < job.ends && job.aborted.is_none();
                let tasks = machine.tasks.iter().filter(|(_, job)| runs(job));
                let tasks = tasks
                    .filter_map(|(id, _)| Some((TaskId::new(*id)?.into(), format!("job:{id}"))))
                    .collect();
                let listed = machine.ours.then_some((machine.boot, tasks));
                (
                    acts,
                    ServerAnswer::Tasks {
                        listed,
                        gaps: Vec::new(),
                    },
                )
            }
            ServerRequest::Init {
                handler,
                component,
                goal,
            } => {
                let task = format!("{handler}:{component}:{goal}");
                let patience = TIMEOUT * (OUTCOMES + 1);
                if machine.ours && resumes.is_some() && late {
                    // The client asks for its outcome: it never arrived, and never will.
                    return match acts.since(now) < patience {
                        true => (
                            acts,
                            ServerAnswer::NotStarted {
                                text: "never came".to_owned(),
                            },
                        ),
                        false => (now + patience, nothing(true)),
                    };
                }
                let answer = machine.init(acts, component, goal);
                if let ServerAnswer::Started { id, .. } = &answer
                    && let Some(job) = machine.tasks.get(&place(id))
                {
                    self.began.push(Began {
                        at: acts,
                        task,
                        until: job.ends,
                    });
                }
                match late {
                    true => (now + TIMEOUT, nothing(true)),
                    false => (acts, answer),
                }
            }
            ServerRequest::Status { .. } | ServerRequest::Abort { .. } if late => {
                (now + TIMEOUT, nothing(true))
            }
            ServerRequest::Status { id, hold, .. } => {
                self.statuses += 1;
                let ends = machine.tasks.get(&place(id)).map(|job| job.ends);
                let held = match ends {
                    Some(ends) if ends > acts => (*hold).min(ends.since(acts)),
                    _ => Duration::ZERO,
                };
                // A server that restarts or falls silent loses the answer that it holds.
                let gone = machine
                    .restarts
                    .iter()
                    .chain(machine.pauses.iter().map(|(from, _)| from));
                if gone.into_iter().any(|at| *at > acts && *at <= acts + held) {
                    return (now + TIMEOUT, nothing(true));
                }
                let at = acts + held;
                (at, machine.tell(id, at))
            }
            ServerRequest::Abort { id } => {
                if let Some(job) = machine.tasks.get_mut(&place(id))
                    && acts < job.ends
                    && job.aborted.is_none()
                    && !job.unstoppable
                {
                    job.aborted = Some(acts);
                    let begun = job.begun;
                    // Another client's task is not in the list.
                    let began = self.began.iter_mut().find(|began| began.at == begun);
                    if let Some(began) = began {
                        began.until = acts;
                    }
                }
                let answer = match machine.tasks.get(&place(id)) {
                    Some(job) if job.unstoppable && acts < job.ends => match job.end {
                        State::Aborted => ServerAnswer::Task {
                            state: State::Accepted,
                            text: "True".to_owned(),
                        },
                        _ => ServerAnswer::CannotStop {
                            state: State::Accepted,
                            text: "False".to_owned(),
                        },
                    },
                    _ => machine.tell(id, acts),
                };
                (acts, answer)
            }
        }
    }

    /// The events that match.
    pub(super) fn seen(&self, is: impl Fn(&RunEvent) -> bool) -> Vec<&RunEvent> {
        self.events
            .iter()
            .map(|(_, event)| event)
            .filter(|event| is(event))
            .collect()
    }

    /// The last reason why a step waited.
    pub(super) fn why(&self) -> Option<&WaitReason> {
        self.events.iter().rev().find_map(|(_, event)| match event {
            RunEvent::StepWaiting { why, .. } => Some(why),
            _ => None,
        })
    }

    /// When each task began, in milliseconds.
    pub(super) fn timeline(&self) -> Vec<(u64, &str)> {
        self.began
            .iter()
            .map(|began| (began.at.as_millis(), began.task.as_str()))
            .collect()
    }
}

impl Machine {
    fn init(&mut self, now: Instant, component: &str, goal: &str) -> ServerAnswer {
        if let Some(times) = self.rejections.get_mut(component)
            && *times > 0
        {
            *times -= 1;
            return ServerAnswer::Rejected {
                id: Integer::MINUS_ONE.into(),
                text: "not now".to_owned(),
            };
        }
        self.next += 1;
        // `3`, `3 fail`, `3 lost`, `3 forever`; `3 stubborn` is aborted, but only after its time.
        let mut words = goal.split(' ');
        let seconds: f64 = words
            .next()
            .and_then(|word| word.parse().ok())
            .unwrap_or(0.0);
        let how = words.next();
        let job = Job {
            begun: now,
            ends: now + Duration::from_secs_f64(seconds),
            end: match how {
                Some("fail" | "lost") => State::Failed,
                Some("stubborn") => State::Aborted,
                _ => State::Completed,
            },
            said: match how {
                Some("lost") => LOST,
                _ => "done",
            },
            unstoppable: matches!(how, Some("forever" | "stubborn")),
            aborted: None,
        };
        self.tasks.insert(self.next, job);
        let id = TaskId::new(self.next).expect("above 0").into();
        ServerAnswer::Started {
            id,
            text: "initiated".to_owned(),
            server: self.who(),
        }
    }

    fn who(&self) -> Server {
        match self.ours {
            true => Server::Ours {
                version: "1".to_owned(),
                boot: self.boot,
            },
            false => Server::Original,
        }
    }

    /// Another client starts a task.
    pub(super) fn begins(&mut self, now: Instant, goal: &str) {
        self.init(now, "other", goal);
    }

    /// Number of its running tasks.
    pub(super) fn running(&self, now: Instant) -> usize {
        let runs = |job: &&Job| now < job.ends && job.aborted.is_none_or(|at| now < at);
        self.tasks.values().filter(runs).count()
    }

    fn tell(&mut self, id: &RemoteId, now: Instant) -> ServerAnswer {
        self.turn(now);
        match self.state(id, now) {
            Some((_, text)) if text == LOST => ServerAnswer::Unclear { text },
            Some((state, text)) => ServerAnswer::Task { state, text },
            None => ServerAnswer::TaskUnknown {
                boot: self.ours.then_some(self.boot),
                text: format!("does not know task {id}"),
            },
        }
    }
}

/// The text about a task whose outcome the server could not learn.
const LOST: &str = "the robot behind it was restarted";

/// The key of a task in [`Machine::tasks`].
fn place(id: &RemoteId) -> u32 {
    id.number().expect("an id of these machines").get()
}

fn nothing(sent: bool) -> ServerAnswer {
    ServerAnswer::Nothing {
        sent,
        text: "no answer".to_owned(),
    }
}
