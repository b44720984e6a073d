//! Asks a server what it offers and which tasks run, on a thread of its own, so that one that hangs delays no other.

use std::collections::HashMap;
use std::io;
use std::sync::{Arc, Weak};
use std::thread;
use std::time::{Duration, Instant};

use ztl_std::{RemoteId, RemoteTask, RequestError, ServerTask, State};

use crate::board::{Board, Health, Seen, Task, wall_clock_ms};
use crate::robots::Connect;

/// Between two questions while a page is open.
const WATCHED: Duration = Duration::from_millis(80);
/// Between two questions while nobody looks.
const UNWATCHED: Duration = Duration::from_millis(250);
/// Between two questions to a server of the original, which logs each as a mistake.
const ORIGINAL: Duration = Duration::from_secs(2);
/// How long an answer may take. Also how soon a server that returns is seen.
pub(crate) const PATIENCE: Duration = Duration::from_millis(900);
/// How often a server is asked what it offers, which changes with a reload.
const OFFERS: Duration = Duration::from_secs(3);
/// Ended tasks that are kept for each server.
const ENDED: usize = 20;

/// Starts the thread of a server.
pub(crate) fn spawn(board: &Arc<Board>, server: usize) -> io::Result<()> {
    let board = Arc::downgrade(board);
    let thread = thread::Builder::new().name("ztl-web-watch".to_owned());
    thread.spawn(move || run(&board, server)).map(drop)
}

fn run(board: &Weak<Board>, server: usize) {
    let mut watcher = Watcher::default();
    while let Some(board) = board.upgrade() {
        let Some(of) = board.servers.get(server) else {
            return;
        };
        let known = board.seen(server);
        let now = watcher.look(&of.name, &of.connect, known);
        let pause = match board.is_watched() {
            _ if now.health == Health::There && !now.lists => ORIGINAL,
            true => WATCHED,
            false => UNWATCHED,
        };
        board.set_seen(server, now);
        drop(board);
        thread::sleep(pause);
    }
}

#[derive(Default)]
struct Watcher {
    remote: Option<RemoteTask>,
    boot: Option<u32>,
    described: Option<Instant>,
}

impl Watcher {
    /// Asks once. What is not answered stays as it was known.
    fn look(&mut self, robot: &str, connect: &Connect, known: Seen) -> Seen {
        match self.ask(robot, connect, &known) {
            Ok(seen) => seen,
            Err(why) => {
                self.described = None;
                Seen {
                    since_ms: since(&known, Health::Missing),
                    health: Health::Missing,
                    text: why,
                    ..known
                }
            }
        }
    }

    fn ask(&mut self, robot: &str, connect: &Connect, known: &Seen) -> Result<Seen, String> {
        let remote = match &mut self.remote {
            Some(remote) => remote,
            none => none.insert(connect("$ztl")?.with_timeout(PATIENCE)),
        };
        let words = |error: RequestError| error.to_string();
        let mut seen = Seen {
            since_ms: since(known, Health::There),
            health: Health::There,
            ..Seen::default()
        };
        let Some(listed) = remote.tasks().map_err(words)? else {
            seen.text = "a server of the original: it does not tell what it offers or does".into();
            seen.gaps = vec!["it does not list its tasks: others than these may run".to_owned()];
            return Ok(seen);
        };
        let due = self.described.is_none_or(|at| at.elapsed() >= OFFERS);
        let started = match listed.boot == self.boot {
            true => starts(known),
            false => HashMap::new(),
        };
        if due || listed.boot != self.boot {
            let told = remote.describe().map_err(words)?;
            seen.scopes = told
                .as_ref()
                .map(|told| told.scopes.clone())
                .unwrap_or_default();
            seen.text = told.map_or_else(String::new, |told| format!("ztl {}", told.version));
            self.described = Some(Instant::now());
            self.boot = listed.boot;
        } else {
            seen.scopes.clone_from(&known.scopes);
            seen.text.clone_from(&known.text);
        }
        seen.lists = true;
        seen.gaps = listed.gaps;
        let ended = listed.tasks.iter().filter(|task| !task.may_run).take(ENDED);
        let running = listed.tasks.iter().filter(|task| task.may_run);
        let now = wall_clock_ms();
        seen.tasks = running
            .chain(ended)
            .map(|task| shown(robot, task, now, &started))
            .collect();
        Ok(seen)
    }
}

/// Since when the health is so.
fn since(known: &Seen, health: Health) -> u64 {
    match known.health == health {
        true => known.since_ms,
        false => wall_clock_ms(),
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

fn shown(robot: &str, task: &ServerTask, now: u64, started: &Starts<'_>) -> Task {
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
        task: task.task().to_owned(),
        state: state.unwrap_or_default(),
        text: listed.map_or_else(String::new, |listed| listed.text.clone()),
        runs: task.may_run,
        started_ms: known.or(computed),
        by: None,
    }
}
