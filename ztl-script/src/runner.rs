//! Plays a script on real servers: a [`Player`] with a clock, connections and an operator.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::time::{Duration, SystemTime};

use ztl_core::Instant;
use ztl_std::RemoteId;
use ztl_std::time::now;

use crate::event::{DecidedBy, Question, RequestNumber, RunCommand, RunEvent, StampedEvent};
use crate::player::{PlayOptions, Player, Request};
use crate::script::Script;
use crate::server::{Connected, Connection, ServerAnswer, ServerRequest};

/// A [`RunnerHandle::stop_all`] so soon after another, while nothing runs, is the same.
const SAME_PRESS: Duration = Duration::from_millis(200);

/// Most tasks that a connection is known to have started.
const STARTED: usize = 256;

/// Opens a connection to the server with this name: one for each request that is under way at the same time.
pub type Connect = Box<dyn FnMut(&str) -> Connected + Send>;

/// Plays a script on real servers. Call [`begin`](Self::begin), then take events from
/// [`next`](Self::next) until the run has ended.
pub struct Runner {
    player: Player,
    start: Instant,
    inbox: Receiver<Input>,
    handle: RunnerHandle,
    /// The [`RunnerHandle::stop_all`]s that the player has carried out.
    obeyed: SeenStops,
    /// When the player carried out the last of them.
    stopped_at: Option<Instant>,
    connect: Connect,
    /// Workers without a request, by server.
    idle: BTreeMap<String, Vec<Worker>>,
    /// The INITs under way, and whether each is withdrawn, so that it is not sent any more.
    inits: BTreeMap<RequestNumber, Arc<AtomicBool>>,
    events: VecDeque<StampedEvent>,
}

/// Reaches a [`Runner`] from any thread.
#[derive(Debug, Clone)]
pub struct RunnerHandle {
    inputs: Sender<Input>,
    /// How often everything was to be stopped.
    stops: Arc<AtomicU32>,
}

/// What a person who decided had seen: how often everything was to be stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SeenStops(u32);

#[derive(Debug)]
enum Input {
    Command(RunCommand, DecidedBy),
    Answer(RequestNumber, ServerAnswer, Worker),
    StopAll,
    Wake,
}

impl RunnerHandle {
    /// Passes a command to the player, which ignores one that does not apply.
    pub fn command(&self, command: RunCommand, by: DecidedBy) {
        // Fails only when the runner is gone.
        let _ = self.inputs.send(Input::Command(command, by));
    }

    /// Stops everything, as [`RunCommand::StopAll`] does. When this returns, no task is sent any more that was decided
    /// before, whatever the runner does at the moment.
    pub fn stop_all(&self) {
        self.stops.fetch_add(1, Ordering::SeqCst);
        // As above.
        let _ = self.inputs.send(Input::StopAll);
    }

    /// What somebody who decides now has seen ([`Runner::has_obeyed`]).
    #[must_use]
    pub fn seen(&self) -> SeenStops {
        SeenStops(self.stops.load(Ordering::SeqCst))
    }

    /// Makes [`Runner::next`] return at once.
    pub fn wake(&self) {
        let _ = self.inputs.send(Input::Wake);
    }
}

impl Runner {
    /// A runner for this script. It connects to a server on the first request to it.
    #[must_use]
    pub fn new(script: Arc<Script>, options: PlayOptions, connect: Connect) -> Self {
        let (sender, inbox) = mpsc::channel();
        Self {
            player: Player::new(script, options),
            start: now(),
            inbox,
            handle: RunnerHandle {
                inputs: sender,
                stops: Arc::default(),
            },
            obeyed: SeenStops(0),
            stopped_at: None,
            connect,
            idle: BTreeMap::new(),
            inits: BTreeMap::new(),
            events: VecDeque::new(),
        }
    }

    /// A handle for other threads.
    #[must_use]
    pub fn handle(&self) -> RunnerHandle {
        self.handle.clone()
    }

    /// Begins. To be called once.
    pub fn begin(&mut self) {
        self.player.begin(now());
        self.pump();
    }

    /// Adds an event that the player does not know: the start of the run, a key, a note.
    pub fn tell(&mut self, event: RunEvent) {
        let (at, wall) = (now().since(self.start), SystemTime::now());
        self.events.push_back(StampedEvent { at, wall, event });
    }

    /// Carries out a command of the operator, who saw `seen` as the open question; returns whether it was
    /// carried out. An answer to a question that has closed meanwhile is ignored.
    pub fn decide(&mut self, command: RunCommand, seen: Option<Question>) -> bool {
        let of_no_question = matches!(
            command,
            RunCommand::StopScene
                | RunCommand::StopAll
                | RunCommand::Stop
                | RunCommand::Leave
                | RunCommand::Pause
        );
        if !of_no_question && seen != self.player.question() {
            return false;
        }
        let by = DecidedBy::Operator;
        let done = self.player.handle_command(now(), command, by);
        self.pump();
        done
    }

    /// Starts the tasks of a cue, by its index in the script, beside the scene that plays.
    ///
    /// # Errors
    /// Why nothing was started. A cue whose tasks still run is not started again.
    pub fn cue(&mut self, cue: usize) -> Result<(), &'static str> {
        let started = self.player.start_cue(now(), cue);
        self.pump();
        started
    }

    /// Whether everything that was stopped is being stopped, and was when a person decided who had `seen` this. If not,
    /// the decision came before a [`RunnerHandle::stop_all`], and must not start anything.
    #[must_use]
    pub fn has_obeyed(&self, seen: SeenStops) -> bool {
        seen == self.obeyed && self.handle.seen() == self.obeyed
    }

    /// The next event. `None` after `limit`, or when [woken](RunnerHandle::wake).
    pub fn next(&mut self, limit: Duration) -> Option<StampedEvent> {
        let until = now() + limit;
        loop {
            if let Some(event) = self.events.pop_front() {
                return Some(event);
            }
            let wake = self
                .player
                .poll_timeout()
                .map_or(until, |wake| wake.min(until));
            match self.inbox.recv_timeout(wake.since(now())) {
                Ok(Input::Command(command, by)) => {
                    self.player.handle_command(now(), command, by);
                }
                Ok(Input::Answer(request, answer, mut worker)) => {
                    worker.note(&answer);
                    self.inits.remove(&request);
                    let idle = self.idle.entry(worker.remote.clone()).or_default();
                    idle.push(worker);
                    self.player.handle_answer(now(), request, answer);
                }
                Ok(Input::StopAll) => {
                    let (now, by) = (now(), DecidedBy::Operator);
                    let again = self.stopped_at.is_some_and(|at| now.since(at) < SAME_PRESS);
                    // A flood of presses must not fill the record.
                    if !(again && self.player.is_idle()) {
                        self.player.handle_command(now, RunCommand::StopAll, by);
                        self.stopped_at = Some(now);
                    }
                    self.obeyed.0 = self.obeyed.0.wrapping_add(1);
                }
                Ok(Input::Wake) => return self.events.pop_front(),
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                    let now = now();
                    if self.player.poll_timeout().is_some_and(|wake| wake <= now) {
                        self.player.handle_time(now);
                    } else if now >= until {
                        return None;
                    }
                }
            }
            self.pump();
        }
    }

    /// Hands the player's requests to workers, and collects its events.
    fn pump(&mut self) {
        self.collect_events();
        for (request, withdrawn) in &self.inits {
            if self.player.is_about_stopping(*request) {
                withdrawn.store(true, Ordering::SeqCst);
            }
        }
        while let Some(request) = self.player.poll_request() {
            let number = request.number;
            if let Err(text) = self.send(request) {
                let answer = ServerAnswer::Nothing { sent: false, text };
                self.player.handle_answer(now(), number, answer);
                self.collect_events();
            }
        }
    }

    fn collect_events(&mut self) {
        while let Some(event) = self.player.poll_event() {
            self.tell(event);
        }
    }

    fn send(&mut self, request: Request) -> Result<(), String> {
        let remote = &request.remote;
        let idle = self.idle.get_mut(remote).and_then(|idle| {
            // Who has started a task asks for it: to a server with `needs-client`, a connection that falls silent is a
            // client that is gone.
            let starter = idle.iter().position(|it| it.has_started(&request.body));
            starter
                .map(|index| idle.swap_remove(index))
                .or_else(|| idle.pop())
        });
        let worker = match idle {
            Some(worker) => worker,
            None => Worker::start(remote, (self.connect)(remote)?, self.handle.clone())?,
        };
        // The worker travels with the request and returns with the answer. Nobody else holds the sending
        // end of its channel, so its thread ends when the runner is dropped.
        let requests = worker.requests.clone();
        let withdrawn = Arc::new(AtomicBool::new(
            self.player.is_about_stopping(request.number),
        ));
        let number = request.number;
        let init = matches!(request.body, ServerRequest::Init { .. });
        let init = init.then(|| Arc::clone(&withdrawn));
        let job = Job {
            request,
            decided: self.obeyed,
            withdrawn,
        };
        requests
            .send((job, worker))
            .map_err(|_| "its thread has ended".to_owned())?;
        self.inits.extend(init.map(|withdrawn| (number, withdrawn)));
        Ok(())
    }
}

impl std::fmt::Debug for Runner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Runner")
            .field("player", &self.player)
            .finish_non_exhaustive()
    }
}

/// A thread with a connection of its own.
#[derive(Debug)]
struct Worker {
    remote: String,
    /// The last tasks that it has started, newest last.
    started: VecDeque<RemoteId>,
    requests: Sender<(Job, Worker)>,
}

/// What a worker sends.
#[derive(Debug)]
struct Job {
    request: Request,
    /// The stops that were carried out before it was decided.
    decided: SeenStops,
    /// Whether its task is stopped meanwhile.
    withdrawn: Arc<AtomicBool>,
}

impl Worker {
    fn start(
        remote: &str,
        mut connection: Box<dyn Connection>,
        runner: RunnerHandle,
    ) -> Result<Self, String> {
        let (requests, inbox) = mpsc::channel::<(Job, Self)>();
        std::thread::Builder::new()
            .name(format!("ztl-{remote}"))
            .spawn(move || {
                for (job, worker) in inbox {
                    let request = job.request;
                    let may_start =
                        || runner.seen() == job.decided && !job.withdrawn.load(Ordering::SeqCst);
                    let answer = connection.request(&request.body, &may_start);
                    let answer = Input::Answer(request.number, answer, worker);
                    if runner.inputs.send(answer).is_err() {
                        return;
                    }
                }
            })
            .map_err(|error| format!("no thread for it: {error}"))?;
        Ok(Self {
            remote: remote.to_owned(),
            started: VecDeque::new(),
            requests,
        })
    }

    fn note(&mut self, answer: &ServerAnswer) {
        if let ServerAnswer::Started { id, .. } = answer {
            self.started.push_back(id.clone());
            if self.started.len() > STARTED {
                self.started.pop_front();
            }
        }
    }

    /// Whether the request is about a task that it has started.
    fn has_started(&self, request: &ServerRequest) -> bool {
        match request {
            ServerRequest::Status { id, .. } | ServerRequest::Abort { id } => {
                self.started.contains(id)
            }
            ServerRequest::Init { .. } | ServerRequest::Probe | ServerRequest::Tasks => false,
        }
    }
}

#[cfg(test)]
mod tests;
