//! The thread of a server asks what the server offers and which tasks run, and sends ABORTs. All requests go out at the same
//! time over one connection, so that an ABORT never waits for another answer. A server that hangs delays no other server.

mod seldom;
mod stopping;

use std::collections::HashMap;
use std::hash::DefaultHasher;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::thread;
use std::time::{Duration, Instant};

use ztl_std::{
    DescribeQuestions, Description, ParallelRequests, RemoteId, RequestError, ServerTask,
    ServerTasks, State, Status, server_answer,
};

use crate::aborts::{Aborts, Key};
use crate::board::{Board, Described, Health, Seen};
use crate::clock::now_ms;
use crate::cut;
use crate::robots::Server;
use crate::task::Task;
use stopping::Stopping;

/// Pause between two questions to a server: during a Stop, while a page is open, and while none is.
const STOPPING: Duration = Duration::from_millis(20);
const WATCHED: Duration = Duration::from_millis(50);
const UNWATCHED: Duration = Duration::from_millis(250);
/// The same for a server of the original, which logs each question as a mistake.
const ORIGINAL: Duration = Duration::from_secs(2);
/// Between two attempts to make a client.
const NO_CLIENT: Duration = Duration::from_millis(500);
/// Limit for an answer. A server that comes back is noticed after this time.
const PATIENCE: Duration = Duration::from_millis(900);
/// The same while an ABORT is under way: a device may answer nothing else for 1.5 s.
const PATIENCE_FOR_ABORTS: Duration = Duration::from_millis(1700);
/// How long an answer is waited for until the next look at what has to be sent.
const TURN: Duration = Duration::from_millis(10);
/// Ended tasks that are kept for each server.
const ENDED: usize = 20;
/// Most tasks that a message names.
const NAMED: usize = 5;

/// Starts the thread of a server. It looks for work when it is woken.
pub(crate) fn spawn(board: &Arc<Board>, index: usize, woken: Receiver<()>) -> io::Result<()> {
    let board = Arc::clone(board);
    let thread = thread::Builder::new().name("ztl-web-server".to_owned());
    let run = move || {
        if let Some(of) = board.servers.get(index) {
            let mut server = ServerThread::new(&board, index, of);
            loop {
                server.turn(&woken);
            }
        }
    };
    thread.spawn(run).map(drop)
}

/// What was asked.
#[derive(Debug)]
enum Asked {
    Probe,
    Tasks,
    /// What its components say of themselves.
    Describe,
    Devices,
    Abort(Key),
}

type Answer = Result<Status, RequestError>;

/// The questions to a server that are under way.
struct Look {
    /// When they were asked.
    at: Instant,
    /// Whether every goal sent to this server had been answered by then, so that the list has all their tasks.
    settled: bool,
    probe: Option<Answer>,
    tasks: Option<Answer>,
}

struct ServerThread<'b> {
    board: &'b Board,
    index: usize,
    of: &'b Server,
    requests: Option<ParallelRequests<Asked>>,
    look: Option<Look>,
    next_look: Instant,
    /// The questions what its components say of themselves, while they are under way, and the hash of the answers.
    describing: Option<(DescribeQuestions, DefaultHasher)>,
    next_describe: Instant,
    /// When it was asked for its devices, while there is no answer, and when the last answer was asked for.
    asks_devices: Option<Instant>,
    devices_at: Option<Instant>,
    next_devices: Instant,
    /// Whether it does not list its tasks, as a server of the original.
    is_original: bool,
    boot: Option<u32>,
    /// Every task that runs, as far as it is known, with its name.
    running: Vec<(Key, String)>,
    aborts: Aborts,
    stop: Option<Stopping>,
}

impl<'b> ServerThread<'b> {
    fn new(board: &'b Board, index: usize, of: &'b Server) -> Self {
        Self {
            board,
            index,
            of,
            requests: None,
            look: None,
            next_look: Instant::now(),
            describing: None,
            next_describe: Instant::now(),
            asks_devices: None,
            devices_at: None,
            next_devices: Instant::now(),
            is_original: false,
            boot: None,
            running: Vec::new(),
            aborts: Aborts::default(),
            stop: None,
        }
    }

    fn turn(&mut self, woken: &Receiver<()>) {
        if self
            .requests
            .as_ref()
            .is_none_or(ParallelRequests::is_empty)
        {
            let wait = self.next_work().saturating_duration_since(Instant::now());
            // Fails if there is nothing but the time.
            let _ = woken.recv_timeout(wait);
        }
        for request in self.board.take_aborts(self.index) {
            self.aborts.add(request, Instant::now());
        }
        self.begin_stop();
        self.send();
        self.receive();
        self.end_stop();
    }

    fn next_work(&self) -> Instant {
        // Without a client, ABORTs wait for the next attempt, too.
        let aborts = self.requests.as_ref().and(self.aborts.next_due());
        let limit = self.stop.as_ref().map(Stopping::limit);
        let others = aborts.into_iter().chain(limit);
        others.fold(self.next_look, Instant::min)
    }

    fn send(&mut self) {
        let now = Instant::now();
        if self.requests.is_none() {
            if now < self.next_look {
                return;
            }
            match self.of.remote("$ztl") {
                Ok(remote) => self.requests = Some(remote.into_parallel()),
                Err(why) => {
                    self.next_look = now + NO_CLIENT;
                    self.set_missing(why);
                }
            }
        }
        let Some(requests) = &mut self.requests else {
            return;
        };
        for key in self.aborts.take_due(now) {
            let (scope, id) = &key;
            if let Err(error) = requests.abort(Asked::Abort(key.clone()), scope, id) {
                self.aborts.on_answer(&key, Err(error), now);
            }
        }
        // The original answers one request after the other: a question would wait for the ABORTs.
        let busy = self.is_original && self.aborts.are_under_way();
        if self.look.is_none() && now >= self.next_look && !busy {
            let goals = self.board.goals_at(self.index);
            self.look = Some(Look {
                at: now,
                settled: goals.iter().all(|goal| goal.is_settled()),
                probe: None,
                tasks: None,
            });
            requests.ask_server(Asked::Probe, "probe");
            requests.ask_server(Asked::Tasks, "tasks");
        }
    }

    fn receive(&mut self) {
        let Some(requests) = &mut self.requests else {
            return;
        };
        let mut answers = match requests.is_empty() {
            true => return,
            false => requests.wait(TURN),
        };
        let patience = match self.aborts.are_under_way() {
            true => PATIENCE_FOR_ABORTS,
            false => PATIENCE,
        };
        if answers.is_empty()
            && self
                .look
                .as_ref()
                .is_some_and(|look| look.at.elapsed() > patience)
        {
            answers = requests.give_up();
        }
        for (asked, answer) in answers {
            match asked {
                Asked::Abort(key) => self.on_abort(&key, answer),
                Asked::Describe => self.on_described(answer),
                Asked::Devices => self.on_devices(answer),
                Asked::Probe => self.on_look(|look| look.probe = Some(answer)),
                Asked::Tasks => self.on_look(|look| look.tasks = Some(answer)),
            }
        }
    }

    fn on_abort(&mut self, key: &Key, answer: Answer) {
        if match &answer {
            Ok(status) => status.state.is_final(),
            Err(error) => matches!(error, RequestError::UnknownTask { .. }),
        } {
            self.board.forget_lost(self.index, &key.0, &key.1);
        }
        if let Some(Ok(status)) = self.aborts.on_answer(key, answer, Instant::now())
            && status.state.is_final()
            && let Some(stop) = &mut self.stop
        {
            stop.note_ended(|asked| asked == key);
        }
    }

    fn on_look(&mut self, note: impl FnOnce(&mut Look)) {
        let Some(mut look) = self.look.take() else {
            return;
        };
        note(&mut look);
        match look {
            Look {
                at,
                settled,
                probe: Some(probe),
                tasks: Some(tasks),
            } => self.on_answers((at, settled), probe, tasks),
            look => self.look = Some(look),
        }
    }

    fn on_answers(&mut self, (at, settled): (Instant, bool), probe: Answer, tasks: Answer) {
        let described =
            server_answer(probe).and_then(|answer| answer.map(Description::read).transpose());
        let listed =
            ServerTasks::merged(&self.of.endpoint, described.clone(), server_answer(tasks));
        let is_older = |stop: &Stopping| !stop.counts(at);
        let pause = match &listed {
            Ok(None) if !self.stop.as_ref().is_some_and(is_older) => ORIGINAL,
            _ if self.stop.is_some() => STOPPING,
            _ if self.board.is_watched() => WATCHED,
            _ => UNWATCHED,
        };
        // A slow server gets a rest, too.
        self.next_look = (at + pause).max(Instant::now() + pause / 2);
        if let (Ok(_), Some(stop)) = (&listed, &mut self.stop) {
            stop.note_kind(at);
        }
        match listed {
            Err(error) => self.set_missing(error.to_string()),
            Ok(None) => {
                self.is_original = true;
                self.running.clear();
                let known = self.board.seen(self.index);
                if known.described != Some(0) {
                    self.board
                        .set_described(self.index, 0, Described::default());
                }
                self.board.set_seen(
                    self.index,
                    Seen {
                        since_ms: since(&known, Health::There),
                        health: Health::There,
                        text: "a server of the original: it does not tell what it offers or does"
                            .to_owned(),
                        described: Some(0),
                        gaps: vec![
                            "it does not list its tasks: others than these may run".to_owned(),
                        ],
                        ..Seen::default()
                    },
                );
            }
            Ok(Some(listed)) => {
                self.is_original = false;
                self.on_list(described.ok().flatten(), &listed);
                self.note_idle(at, settled);
            }
        }
    }

    /// Notes which tasks of a Stop the list shows as ended, and forgets lost goals that it does.
    fn note_ended(&mut self, listed: &ServerTasks) {
        let has_ended = |scope: &str, id: &RemoteId| {
            let mut tasks = listed.tasks.iter();
            tasks.any(|task| !task.may_run && task.scope == scope && task.id == *id)
        };
        for goal in self.board.lost_at(self.index) {
            let scope = &goal.target.scope;
            if let Some(id) = goal.id().filter(|id| has_ended(scope, id)) {
                self.board.forget_lost(self.index, scope, id);
            }
        }
        if let Some(stop) = &mut self.stop {
            stop.note_ended(|(scope, id)| has_ended(scope, id));
        }
    }

    fn set_missing(&mut self, why: String) {
        let known = self.board.seen(self.index);
        self.board.set_seen(
            self.index,
            Seen {
                since_ms: since(&known, Health::Missing),
                health: Health::Missing,
                text: cut::text(&why, 2 * cut::LINE),
                ..known
            },
        );
    }

    /// The server has told what it offers and which tasks run.
    fn on_list(&mut self, described: Option<Description>, listed: &ServerTasks) {
        let known = self.board.seen(self.index);
        let same_boot = listed.boot == self.boot;
        let started = match same_boot {
            true => starts(&known),
            false => HashMap::new(),
        };
        self.boot = listed.boot;
        let mut seen = Seen {
            since_ms: since(&known, Health::There),
            health: Health::There,
            text: known.text.clone(),
            scopes: known.scopes.clone(),
            described: known.described,
            devices: Arc::clone(&known.devices),
            lists: true,
            tasks: Vec::new(),
            gaps: listed.gaps.clone(),
        };
        if let Some(described) = described {
            seen.text = cut::text(&format!("ztl {}", described.version), cut::LINE);
            let missing = self.of.scopes.iter().map(|of| &of.scope);
            let missing = missing.filter(|scope| !described.scopes.contains_key(*scope));
            seen.gaps.extend(missing.map(|scope| {
                format!("it does not serve {scope}, or this console may not use it: its tasks cannot be seen")
            }));
            let scopes = described.scopes.into_iter();
            let ours =
                scopes.filter(|(scope, _)| self.of.scopes.iter().any(|of| of.scope == *scope));
            seen.scopes = ours
                .map(|(scope, offers)| (scope, cut::offers(offers)))
                .collect();
        }
        let running = || listed.tasks.iter().filter(|task| task.may_run);
        self.running = running()
            .map(|task| {
                (
                    (task.scope.clone(), task.id.clone()),
                    cut::text(task.task(), cut::LINE),
                )
            })
            .collect();
        let shown = |task: &&ServerTask| {
            task.scope.len() <= cut::NAME && task.id.as_str().len() <= cut::NAME
        };
        let hidden = running().filter(|task| !shown(task)).count();
        if hidden > 0 {
            seen.gaps.push(format!(
                "{hidden} run whose scope or id is too long to be shown"
            ));
        }
        let ended = listed.tasks.iter().filter(|task| !task.may_run).take(ENDED);
        let now = now_ms();
        seen.tasks = running()
            .chain(ended)
            .filter(shown)
            .map(|task| shown_task(&self.of.name, task, now, &started))
            .collect();
        seen.gaps.truncate(NAMED);
        for gap in &mut seen.gaps {
            *gap = cut::text(gap, cut::LINE);
        }
        drop(started);
        if !same_boot || seen.scopes != known.scopes || Instant::now() >= self.next_describe {
            self.describe();
        }
        if !same_boot || Instant::now() >= self.next_devices {
            self.ask_devices();
        }
        self.board.set_seen(self.index, seen);
        self.note_ended(listed);
        self.stop_running();
    }
}

/// Since when the health is so.
fn since(known: &Seen, health: Health) -> u64 {
    match known.health == health {
        true => known.since_ms,
        false => now_ms(),
    }
}

type Starts<'a> = HashMap<(&'a str, &'a RemoteId), u64>;

/// When the known tasks started: computed once for each, because the age in each answer differs by its travel time.
fn starts(known: &Seen) -> Starts<'_> {
    let tasks = known.tasks.iter();
    tasks
        .filter_map(|task| Some(((task.scope.as_str(), &task.id), task.started_ms?)))
        .collect()
}

fn shown_task(robot: &str, task: &ServerTask, now: u64, started: &Starts<'_>) -> Task {
    let listed = task.listed.as_ref();
    let state = listed.map(|listed| match State::from_code(i64::from(listed.state)) {
        _ if task.may_run && listed.ended_ms.is_some() => "MAY RUN".to_owned(),
        Some(state) => state.name().to_owned(),
        None => listed.state.to_string(),
    });
    let computed = listed.map(|listed| now.saturating_sub(listed.age_ms));
    let known = started.get(&(task.scope.as_str(), &task.id)).copied();
    Task {
        robot: robot.to_owned(),
        scope: task.scope.clone(),
        id: task.id.clone(),
        task: cut::text(task.task(), cut::LINE),
        state: state.unwrap_or_default(),
        text: listed.map_or_else(String::new, |listed| cut::text(&listed.text, cut::LINE)),
        runs: task.may_run,
        started_ms: known.or(computed),
        by: None,
    }
}
