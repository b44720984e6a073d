//! Stop: aborts every task on every server, and tells for each robot whether it has confirmed that nothing runs.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use serde::Serialize;
use serde_json::{Value, json};
use ztl_std::{RemoteId, ServerTask};

use crate::board::{Board, locked, set, wall_clock_ms};
use crate::robots::{Connect, Server};
use crate::watcher::PATIENCE;

/// How long a robot may take to stop its tasks until it counts as not confirmed.
const LIMIT: Duration = Duration::from_secs(4);
/// Between two looks at the tasks of a server.
const LOOK_AGAIN: Duration = Duration::from_millis(20);
/// Most Stops at a time.
const MOST: usize = 8;
/// How long an ABORT may take to be answered until it is sent again. A server holds the answer for up to 1.5 s.
const ABORT: Duration = Duration::from_secs(2);
/// Most ABORTs to a server at a time; each has a thread.
const MOST_ABORTS: usize = 128;
/// Most tasks that a message names.
const NAMED: usize = 5;

/// Whether a robot has confirmed that nothing runs.
#[derive(Debug, Clone, Serialize)]
struct Confirmation {
    robot: String,
    /// `null` until it is decided.
    confirmed: Option<bool>,
    text: String,
}

/// Stops everything. Returns, and publishes on the way, what each robot has confirmed.
///
/// # Errors
/// If too many Stops are under way, which stop everything already.
pub(crate) fn all(board: &Arc<Board>, by: &str) -> Result<Value, String> {
    let others = board.stops.fetch_add(1, Ordering::SeqCst);
    let told = match others < MOST {
        true => Ok(stop(board, by)),
        false => Err(format!("{MOST} Stops are under way")),
    };
    board.stops.fetch_sub(1, Ordering::SeqCst);
    told
}

fn stop(board: &Arc<Board>, by: &str) -> Value {
    // What was not sent yet is never sent.
    for goal in board.goals() {
        goal.give_up();
    }
    let waiting = |server: &Server| Confirmation {
        robot: server.name.clone(),
        confirmed: None,
        text: "no answer yet".to_owned(),
    };
    let all: Vec<Confirmation> = board.servers.iter().map(waiting).collect();
    let (at, all) = (wall_clock_ms(), Mutex::new(all));
    let publish = || {
        let told = json!({ "by": by, "at_ms": at, "robots": &*locked(&all) });
        set(&board.topics.stop, &told);
        told
    };
    publish();
    thread::scope(|scope| {
        for (index, server) in board.servers.iter().enumerate() {
            let (all, publish) = (&all, &publish);
            let spawned = thread::Builder::new().spawn_scoped(scope, move || {
                let told = server_stops(board, index, server);
                decide(all, index, told);
                publish();
            });
            if let Err(error) = spawned {
                decide(all, index, Err(format!("no thread: {error}")));
            }
        }
    });
    publish()
}

fn decide(all: &Mutex<Vec<Confirmation>>, index: usize, told: Result<String, String>) {
    if let Some(robot) = locked(all).get_mut(index) {
        robot.confirmed = Some(told.is_ok());
        robot.text = told.unwrap_or_else(|why| why);
    }
}

/// Aborts every task of a server until it says that none runs.
///
/// # Errors
/// Why that is not certain.
fn server_stops(board: &Board, index: usize, server: &Server) -> Result<String, String> {
    let deadline = Instant::now() + LIMIT;
    let mut aborts = Aborts {
        connect: Arc::clone(&server.connect),
        sent: HashMap::new(),
        answers: channel(),
        failed: None,
    };
    let mut remote = (server.connect)("$ztl")?.with_timeout(PATIENCE);
    loop {
        let own: Vec<_> = board.goals();
        let own: Vec<_> = own
            .iter()
            .filter(|goal| goal.target.server == index)
            .collect();
        let listed = match remote.tasks() {
            Ok(Some(listed)) => listed,
            Ok(None) => {
                for goal in &own {
                    if let Some(id) = goal.id() {
                        aborts.abort(&goal.target.scope, id);
                    }
                }
                return Err(format!(
                    "a server of the original lists no tasks; {} of this console were asked to stop",
                    aborts.sent.len()
                ));
            }
            Err(error) => return Err(error.to_string()),
        };
        let running: Vec<&ServerTask> = listed.tasks.iter().filter(|task| task.may_run).collect();
        let is_sent = own.iter().any(|goal| goal.id().is_none());
        if running.is_empty() && listed.gaps.is_empty() && !is_sent {
            return Ok(match aborts.sent.len() {
                0 => "nothing ran".to_owned(),
                1 => "1 task has ended".to_owned(),
                many => format!("{many} tasks have ended"),
            });
        }
        for task in &running {
            aborts.abort(&task.scope, &task.id);
        }
        if Instant::now() >= deadline {
            let names = running.iter().take(NAMED);
            let names: Vec<String> = names
                .map(|task| format!("{} {}", task.id, task.task()))
                .collect();
            let mut why = match running.len() {
                0 if listed.gaps.is_empty() => "a goal of this console has no answer".to_owned(),
                0 => listed.gaps.join("; "),
                many => format!("{many} may still run: {}", names.join(", ")),
            };
            if let Some(failed) = aborts.failed {
                why = format!("{why} ({failed})");
            }
            return Err(why);
        }
        thread::sleep(LOOK_AGAIN);
    }
}

type Key = (String, RemoteId);

/// Sends an ABORT to each task, each on its own thread, because a server holds the answer until the task ends.
struct Aborts {
    connect: Connect,
    sent: HashMap<Key, Abort>,
    answers: (Sender<Answer>, Receiver<Answer>),
    failed: Option<String>,
}

#[derive(PartialEq, Eq)]
enum Abort {
    UnderWay,
    Answered,
    Failed,
}

type Answer = (Key, Result<(), String>);

impl Aborts {
    /// Sends an ABORT, unless one is under way or answered.
    fn abort(&mut self, scope: &str, id: &RemoteId) {
        while let Ok((key, answer)) = self.answers.1.try_recv() {
            let state = match answer {
                Ok(()) => Abort::Answered,
                Err(why) => {
                    self.failed = Some(why);
                    Abort::Failed
                }
            };
            self.sent.insert(key, state);
        }
        let key = (scope.to_owned(), id.clone());
        let under_way = self
            .sent
            .values()
            .filter(|abort| **abort == Abort::UnderWay);
        if under_way.count() >= MOST_ABORTS
            || self
                .sent
                .get(&key)
                .is_some_and(|abort| *abort != Abort::Failed)
        {
            return;
        }
        self.sent.insert(key.clone(), Abort::UnderWay);
        let (connect, answers, of) = (
            Arc::clone(&self.connect),
            self.answers.0.clone(),
            key.clone(),
        );
        let thread = thread::Builder::new().name("ztl-web-abort".to_owned());
        let spawned = thread.spawn(move || {
            let (scope, id) = &of;
            let answer = connect(scope).and_then(|remote| {
                let answer = remote.with_timeout(ABORT).send_abort(id);
                answer.map(drop).map_err(|error| error.to_string())
            });
            // Fails if the Stop has ended.
            let _ = answers.send((of, answer));
        });
        if let Err(error) = spawned {
            self.failed = Some(format!("no thread for an ABORT: {error}"));
            self.sent.insert(key, Abort::Failed);
        }
    }
}

/// Aborts one task. Returns its state and text.
///
/// # Errors
/// Why nothing is known of it.
pub(crate) fn one(board: &Board, robot: &str, scope: &str, id: &RemoteId) -> Result<Value, String> {
    let server = board.servers.iter().find(|server| server.name == robot);
    let server = server.ok_or_else(|| format!("no robot '{robot}'"))?;
    let remote = (server.connect)(scope)?;
    let status = remote.with_timeout(PATIENCE).abort(id);
    let status = status.map_err(|error| format!("it may still run: {error}"))?;
    let text = match status.is_abort_rejected() {
        true => "its handler cannot stop it".to_owned(),
        false => status.text,
    };
    Ok(json!({ "state": status.state.name(), "text": text }))
}
