//! Plays a script on real servers: a [`Player`] with a clock, connections and an operator.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::time::{Duration, SystemTime};

use ztl_core::Instant;
use ztl_std::time::now;

use crate::event::{DecidedBy, Question, RequestNumber, RunCommand, RunEvent, StampedEvent};
use crate::player::{PlayOptions, Player, Request};
use crate::script::Script;
use crate::server::{Connected, Connection, ServerAnswer};

/// Opens a connection to the server with this name: one for each request that is under way at the same time.
pub type Connect = Box<dyn FnMut(&str) -> Connected>;

/// Plays a script on real servers. Call [`begin`](Self::begin), then take events from
/// [`next`](Self::next) until the run has ended.
pub struct Runner {
    player: Player,
    start: Instant,
    inbox: Receiver<Input>,
    handle: RunnerHandle,
    connect: Connect,
    /// Workers without a request, by server.
    idle: BTreeMap<String, Vec<Worker>>,
    events: VecDeque<StampedEvent>,
}

/// Reaches a [`Runner`] from any thread.
#[derive(Debug, Clone)]
pub struct RunnerHandle(Sender<Input>);

#[derive(Debug)]
enum Input {
    Command(RunCommand, DecidedBy),
    Answer(RequestNumber, ServerAnswer, Worker),
    Wake,
}

impl RunnerHandle {
    /// Passes a command to the player, which ignores one that does not apply.
    pub fn command(&self, command: RunCommand, by: DecidedBy) {
        // Fails only when the runner is gone.
        let _ = self.0.send(Input::Command(command, by));
    }

    /// Makes [`Runner::next`] return at once.
    pub fn wake(&self) {
        let _ = self.0.send(Input::Wake);
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
            handle: RunnerHandle(sender),
            connect,
            idle: BTreeMap::new(),
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
                Ok(Input::Answer(request, answer, worker)) => {
                    let idle = self.idle.entry(worker.remote.clone()).or_default();
                    idle.push(worker);
                    self.player.handle_answer(now(), request, answer);
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
        let worker = match self.idle.get_mut(remote).and_then(Vec::pop) {
            Some(worker) => worker,
            None => Worker::start(remote, (self.connect)(remote)?, self.handle.clone())?,
        };
        // The worker travels with the request and returns with the answer. Nobody else holds the sending
        // end of its channel, so its thread ends when the runner is dropped.
        let requests = worker.requests.clone();
        requests
            .send((request, worker))
            .map_err(|_| "its thread has ended".to_owned())
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
    requests: Sender<(Request, Worker)>,
}

impl Worker {
    fn start(
        remote: &str,
        mut connection: Box<dyn Connection>,
        runner: RunnerHandle,
    ) -> Result<Self, String> {
        let (requests, inbox) = mpsc::channel::<(Request, Self)>();
        std::thread::Builder::new()
            .name(format!("ztl-{remote}"))
            .spawn(move || {
                for (request, worker) in inbox {
                    let answer = connection.request(&request.body);
                    let answer = Input::Answer(request.number, answer, worker);
                    if runner.0.send(answer).is_err() {
                        return;
                    }
                }
            })
            .map_err(|error| format!("no thread for it: {error}"))?;
        Ok(Self {
            remote: remote.to_owned(),
            requests,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Defaults;

    #[test]
    fn a_decision_answers_only_the_question_that_the_operator_saw() {
        let file = b"one: {a(on_failure=ask): {nobody: {x: 1}}}\ntwo: {b: {nobody: {x: 1}}}";
        let script = Script::read("f", file, Defaults::default()).unwrap();
        let mut runner = Runner::new(
            script.into(),
            PlayOptions::default(),
            Box::new(|_| Err("nobody is there".to_owned())),
        );
        runner.begin();
        let scene = Some(Question::Scene { scene: 0 });
        assert!(runner.decide(RunCommand::Start, scene));
        // It could not be started, and the operator has not seen that yet.
        let step = Some(Question::Step { scene: 0, step: 0 });
        assert_eq!(runner.player.question(), step);
        assert!(!runner.decide(RunCommand::Skip, scene));
        assert_eq!(runner.player.question(), step);
        assert!(runner.decide(RunCommand::Skip, step));
        assert_eq!(runner.player.question(), Some(Question::Scene { scene: 1 }));
        assert!(runner.decide(RunCommand::Stop, step), "at any time");
    }
}
