//! A player in the world: the clock, connections to servers, and what the operator wants.

use std::collections::{BTreeMap, VecDeque};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::time::{Duration, SystemTime};

use ztl_core::Instant;
use ztl_core::integer::Integer;

use super::ask::serves;
use super::event::{By, Command, Event, Question, RequestNumber, Stamped};
use super::player::{Answer, Ask, Player, Request, Server};
use ztl_std::time::now;
use ztl_std::{RemoteTask, RequestError, ServerTask, Status, TriggerError};

/// Plays a script on real servers: give it [`begin`](Self::begin), then take what happens from
/// [`next`](Self::next) until the run has ended.
pub struct Show {
    player: Player,
    start: Instant,
    inbox: Receiver<Input>,
    inputs: Inputs,
    crew: Crew,
    happened: VecDeque<Stamped>,
}

/// Hands in what is wanted, from any thread.
#[derive(Debug, Clone)]
pub struct Inputs(Sender<Input>);

#[derive(Debug)]
enum Input {
    Wanted(Command, By),
    Heard(RequestNumber, Answer, Worker),
    Wake,
}

impl Inputs {
    /// Somebody wants something; what cannot be done just now does nothing.
    pub fn command(&self, command: Command, by: By) {
        // Without a show there is nothing to be done.
        let _ = self.0.send(Input::Wanted(command, by));
    }

    /// Makes [`Show::next`] return at once.
    pub fn wake(&self) {
        let _ = self.0.send(Input::Wake);
    }
}

/// Makes a client of the server with this name; says why it cannot.
pub type Connect = Box<dyn FnMut(&str) -> Result<RemoteTask, String>>;

impl Show {
    /// A show of this player, whose servers `connect` reaches: each is connected to when it is first used.
    #[must_use]
    pub fn new(player: Player, connect: Connect) -> Self {
        let (sender, inbox) = mpsc::channel();
        let inputs = Inputs(sender);
        Self {
            player,
            start: now(),
            inbox,
            crew: Crew {
                connect,
                known: BTreeMap::new(),
                inputs: inputs.clone(),
            },
            inputs,
            happened: VecDeque::new(),
        }
    }

    /// To hand in commands from other threads.
    #[must_use]
    pub fn inputs(&self) -> Inputs {
        self.inputs.clone()
    }

    /// What is played, and how it is.
    #[must_use]
    pub const fn player(&self) -> &Player {
        &self.player
    }

    /// Begins. To be called once.
    pub fn begin(&mut self) {
        self.player.begin(now());
        self.pump();
    }

    /// Adds something that the player does not know: the run's start, a key, a note.
    pub fn tell(&mut self, event: Event) {
        let (at, wall) = (now().since(self.start), SystemTime::now());
        self.happened.push_back(Stamped { at, wall, event });
    }

    /// Somebody wants something; whether it is done.
    pub fn command(&mut self, command: Command, by: By) -> bool {
        let done = self.player.handle_command(now(), command, by);
        self.pump();
        done
    }

    /// The operator has decided, when this was asked as far as was seen; whether it is done. What settled
    /// itself meanwhile is not answered, and what is asked since then neither.
    pub fn decide(&mut self, command: Command, seen: Option<Question>) -> bool {
        let of_no_question = matches!(
            command,
            Command::StopScene | Command::StopAll | Command::Stop | Command::Leave | Command::Pause
        );
        let meant = of_no_question || seen == self.player.question();
        meant && self.command(command, By::Operator)
    }

    /// The next thing that happens, within `limit`; `None` when nothing does, or somebody has
    /// [waken](Inputs::wake) it.
    pub fn next(&mut self, limit: Duration) -> Option<Stamped> {
        let until = now() + limit;
        loop {
            if let Some(happened) = self.happened.pop_front() {
                return Some(happened);
            }
            let wake = self
                .player
                .poll_timeout()
                .map_or(until, |wake| wake.min(until));
            match self.inbox.recv_timeout(wake.since(now())) {
                Ok(Input::Wanted(command, by)) => {
                    self.player.handle_command(now(), command, by);
                }
                Ok(Input::Heard(request, answer, worker)) => {
                    self.crew.rest(worker);
                    self.player.handle_answer(now(), request, answer);
                }
                Ok(Input::Wake) => return self.happened.pop_front(),
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

    fn pump(&mut self) {
        while let Some(event) = self.player.poll_event() {
            self.tell(event);
        }
        while let Some(request) = self.player.poll_request() {
            let number = request.number;
            if let Err(text) = self.crew.send(request) {
                let answer = Answer::Nothing { sent: false, text };
                self.player.handle_answer(now(), number, answer);
                while let Some(event) = self.player.poll_event() {
                    self.tell(event);
                }
            }
        }
    }
}

impl std::fmt::Debug for Show {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Show")
            .field("player", &self.player)
            .finish_non_exhaustive()
    }
}

/// Connections to servers, each with a thread: as many as have requests under way at once.
struct Crew {
    connect: Connect,
    known: BTreeMap<String, Known>,
    inputs: Inputs,
}

struct Known {
    template: RemoteTask,
    idle: Vec<Worker>,
}

/// A thread with a connection of its own.
#[derive(Debug)]
struct Worker {
    remote: String,
    requests: Sender<(Request, Worker)>,
}

impl Crew {
    fn send(&mut self, request: Request) -> Result<(), String> {
        let worker = match self.known.get_mut(&request.remote) {
            Some(known) => match known.idle.pop() {
                Some(worker) => worker,
                None => hire(&request.remote, known.template.clone(), &self.inputs)?,
            },
            None => {
                let first = (self.connect)(&request.remote)?;
                let known = Known {
                    template: first.clone(),
                    idle: Vec::new(),
                };
                self.known.insert(request.remote.clone(), known);
                hire(&request.remote, first, &self.inputs)?
            }
        };
        // It comes back with the answer. While it is away nobody else holds its end of the channel, so that its
        // thread ends with the show.
        let requests = worker.requests.clone();
        requests
            .send((request, worker))
            .map_err(|_| "its thread has ended".to_owned())
    }

    fn rest(&mut self, worker: Worker) {
        if let Some(known) = self.known.get_mut(&worker.remote) {
            known.idle.push(worker);
        }
    }
}

fn hire(name: &str, mut remote: RemoteTask, inputs: &Inputs) -> Result<Worker, String> {
    let (requests, orders) = mpsc::channel::<(Request, Worker)>();
    let worker = Worker {
        remote: name.to_owned(),
        requests,
    };
    let inputs = inputs.clone();
    std::thread::Builder::new()
        .name(format!("ztl-{name}"))
        .spawn(move || {
            for (request, worker) in orders {
                let answer = perform(&mut remote, &request.ask);
                let heard = Input::Heard(request.number, answer, worker);
                if inputs.0.send(heard).is_err() {
                    return;
                }
            }
        })
        .map_err(|error| format!("no thread for it: {error}"))?;
    Ok(worker)
}

/// Asks, and says what came of it.
fn perform(remote: &mut RemoteTask, ask: &Ask) -> Answer {
    match ask {
        Ask::Init {
            handler,
            component,
            goal,
        } => init(remote, handler, component, goal),
        Ask::Status { id, text, hold } => {
            let payload = match hold.is_zero() {
                true => text.clone(),
                false => format!("wait {}", hold.as_millis()),
            };
            let said = remote.status_with(id, &payload);
            about(remote, said)
        }
        Ask::Abort { id } => {
            let said = remote.abort(id);
            about(remote, said)
        }
        Ask::Probe => probe(remote),
        Ask::Tasks => tasks(remote),
    }
}

/// Whether the server is there and serves the scope: nothing is started by either question.
fn probe(remote: &mut RemoteTask) -> Answer {
    let met = who(remote).and_then(|server| Ok((server, serves(remote)?)));
    match met {
        Ok((server, true)) => Answer::There { server },
        Ok((_, false)) => Answer::NoScope {
            text: format!(
                "the server at {} has no scope '{}'",
                remote.endpoint(),
                remote.scope()
            ),
        },
        Err(error) => nothing(&error),
    }
}

/// The tasks that run or may run in the scope, whoever has started them.
fn tasks(remote: &mut RemoteTask) -> Answer {
    let known = match remote.tasks() {
        Ok(Some(known)) => known,
        Ok(None) => {
            return Answer::Tasks {
                listed: None,
                gaps: Vec::new(),
            };
        }
        Err(error) => return nothing(&error),
    };
    let here = |task: &&ServerTask| task.may_run && task.scope == remote.scope();
    let here = known.tasks.iter().filter(here);
    let here = here.map(|task| (task.id.clone(), task.task().to_owned()));
    Answer::Tasks {
        listed: known.boot.map(|boot| (boot, here.collect())),
        gaps: known.gaps,
    }
}

/// Who the server is; a connection knows it from the first answer on.
fn who(remote: &mut RemoteTask) -> Result<Server, RequestError> {
    Ok(match remote.server_info(false)? {
        Some(info) => Server::Ours {
            version: info.version,
            boot: info.boot,
        },
        None => Server::Original,
    })
}

fn init(remote: &mut RemoteTask, handler: &str, component: &str, goal: &str) -> Answer {
    // Whoever does not say who he is, is sent no INIT.
    let server = match who(remote) {
        Ok(server) => server,
        Err(error) => {
            return Answer::Nothing {
                sent: false,
                text: error.to_string(),
            };
        }
    };
    match remote.trigger(handler, component, goal) {
        Ok(task) => Answer::Started {
            id: task.id,
            text: task.reply,
            server,
        },
        Err(TriggerError::Refused { id, reason }) => Answer::Refused { id, text: reason },
        Err(error @ (TriggerError::NeverCame | TriggerError::GivenUp)) => Answer::NotStarted {
            text: error.to_string(),
        },
        // It is there, and would not take it: that is for whoever wrote the goal.
        Err(TriggerError::Request(error @ RequestError::TooLong { .. })) => Answer::Refused {
            id: Integer::MINUS_ONE.into(),
            text: error.to_string(),
        },
        Err(TriggerError::Request(error)) => nothing(&error),
    }
}

/// What comes of a request that told nothing of its task.
fn nothing(error: &RequestError) -> Answer {
    let text = error.to_string();
    match error {
        RequestError::NotTold { .. } => Answer::NotTold { text },
        error if error.was_answered() => Answer::Unclear { text },
        error => Answer::Nothing {
            sent: !error.nothing_was_sent(),
            text,
        },
    }
}

fn about(remote: &mut RemoteTask, said: Result<Status, RequestError>) -> Answer {
    match said {
        Ok(Status { state, text }) => Answer::Task { state, text },
        Err(error @ RequestError::UnknownTask { .. }) => {
            // Which start of the server says so is worth knowing; whether it answers that is not.
            let info = remote.server_info(true).ok().flatten();
            Answer::TaskUnknown {
                boot: info.map(|info| info.boot),
                text: error.to_string(),
            }
        }
        Err(error) => nothing(&error),
    }
}

#[cfg(test)]
mod tests {
    use super::super::player::Options;
    use super::super::{Defaults, Script};
    use super::*;

    #[test]
    fn a_decision_is_about_what_was_seen_and_nothing_that_came_since() {
        let file = b"one: {a(on_failure=ask): {nobody: {x: 1}}}\ntwo: {b: {nobody: {x: 1}}}";
        let script = Script::read("f", file, Defaults::default()).unwrap();
        let player = Player::new(script.into(), Options::default());
        let mut show = Show::new(player, Box::new(|_| Err("nobody is there".to_owned())));
        show.begin();
        let scene = Some(Question::Scene { scene: 0 });
        assert!(show.decide(Command::Start, scene));
        // It could not be started, and the operator has not seen that yet.
        let step = Some(Question::Step { scene: 0, step: 0 });
        assert_eq!(show.player().question(), step);
        assert!(!show.decide(Command::Skip, scene));
        assert_eq!(show.player().question(), step);
        assert!(show.decide(Command::Skip, step));
        assert_eq!(show.player().question(), Some(Question::Scene { scene: 1 }));
        assert!(show.decide(Command::Stop, step), "at any time");
    }
}
