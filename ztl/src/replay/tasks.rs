//! The tasks of a recording, sent to robots again. Only tasks that a person has agreed to are sent, and no INIT is sent
//! twice.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::io::{IsTerminal as _, stdin};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread::Scope;
use std::time::Duration;

use ztl_record::{Content, Reader, Source, TaskEvent};
use ztl_std::remotes::Remote;
use ztl_std::{RemoteTask, State, TaskSpec};

use crate::chosen_publisher::configuration;
use crate::connect_options::ConnectOptions;
use crate::exit::Misuse;
use crate::keyboard;
use crate::signals;
use crate::terminal::{error_line, flat, line, part};

/// How often the question looks for a signal.
const TURN: Duration = Duration::from_millis(20);
/// Most tasks that run at a time; each has a thread and a connection.
const RUNNING: usize = 256;

#[derive(Debug, clap::Args)]
pub(super) struct TaskOptions {
    /// Send the recorded tasks to the robots, each once, after asking
    #[arg(long)]
    pub(super) tasks: bool,

    /// Agree to the list of robots: they move at once
    #[arg(long, requires = "tasks")]
    yes: bool,

    /// Send tasks to this server of the configuration file only (repeatable) [default: those with the tasks' scopes]
    #[arg(long, value_name = "NAME", requires = "tasks")]
    remote: Vec<String>,

    /// The configuration file [default: zmq-remotes.yaml in $XDG_CONFIG_HOME or ~/.config]
    #[arg(short, long, value_name = "FILE", requires = "tasks")]
    config: Option<PathBuf>,
}

/// The robots that a person has agreed to, by scope.
type Robots = BTreeMap<String, Robot>;

/// Identifies a task of a recording: its scope, its id and the time of the event.
type TaskKey = (String, String, u64);

/// What a person has agreed to.
pub(super) struct Agreed {
    /// Messages in the file when it was read for the question. Later ones are not played.
    pub(super) messages: usize,
    robots: Robots,
    /// The name and the payload of each task.
    tasks: BTreeMap<TaskKey, (String, String)>,
}

struct Robot {
    name: String,
    connection: RemoteTask,
}

impl TaskOptions {
    /// Shows the robots and their tasks, and asks. An error if the answer is not yes.
    pub(super) fn agreed(
        &self,
        mut reader: Reader,
        is_chosen: impl Fn(&str) -> bool,
    ) -> Result<Agreed, Box<dyn std::error::Error>> {
        let mut messages = 0;
        let mut asked = BTreeMap::new();
        let mut tasks: BTreeMap<String, BTreeMap<(Source, String), usize>> = BTreeMap::new();
        for read in reader.by_ref() {
            messages += 1;
            let Content::Task(event, _) = read.content else {
                continue;
            };
            if !is_chosen(&read.topic) {
                continue;
            }
            let Some(request) = request(&event) else {
                continue;
            };
            let key = (event.scope.clone(), event.id, read.publish_time);
            match asked.entry(key) {
                Entry::Vacant(entry) => {
                    let count = tasks.entry(event.scope).or_default();
                    *count
                        .entry(((*read.source).clone(), request.0.clone()))
                        .or_default() += 1;
                    entry.insert((request, read.source));
                }
                Entry::Occupied(known) if known.get().0 == request => {}
                Entry::Occupied(known) => {
                    let (scope, id, _) = known.key();
                    return Err(Misuse(format!(
                        "{} and {} tell of task {} of {} differently; leave it out with --topics; nothing was sent",
                        teller(&known.get().1),
                        teller(&read.source),
                        flat(id),
                        flat(scope)
                    ))
                    .into());
                }
            }
        }
        let asked = asked.into_iter().map(|(key, (request, _))| (key, request));
        let asked = asked.collect();
        if tasks.is_empty() {
            return Err("no tasks in this recording".into());
        }
        if reader.damage().is_any() {
            error_line(format_args!(
                "ztl: warning: the recording {}",
                reader.damage()
            ));
        }
        let mut robots = Robots::new();
        line("These tasks will be sent to robots, which will move:");
        for (scope, names) in tasks {
            let (name, remote) = self.robot(&scope)?;
            line(format_args!(
                "  {} ({}, {}): {} tasks",
                flat(&name),
                flat(&remote.endpoint()),
                flat(&scope),
                names.values().sum::<usize>()
            ));
            let mut told_by = None;
            for ((source, task), count) in names {
                if told_by.as_ref() != Some(&source) {
                    line(format_args!("    told by {}", teller(&source)));
                }
                line(format_args!("      {count} x '{}'", flat(&task)));
                told_by = Some(source);
            }
            let connection = RemoteTask::connect(&remote.endpoint(), &scope)?;
            let connection = ConnectOptions::default().apply(connection, remote.keys.as_ref())?;
            robots.insert(scope, Robot { name, connection });
        }
        match self.yes || is_agreed()? {
            true => Ok(Agreed {
                messages,
                robots,
                tasks: asked,
            }),
            false => Err(Misuse("not agreed; nothing was sent".to_owned()).into()),
        }
    }

    /// The server for a scope.
    fn robot(&self, scope: &str) -> Result<(String, Remote), Misuse> {
        let remotes = configuration(self.config.as_deref())?;
        let names: Vec<String> = match self.remote.is_empty() {
            true => remotes.task_names().map(str::to_owned).collect(),
            false => self.remote.clone(),
        };
        let mut found = Vec::new();
        for name in names {
            match remotes.task(&name) {
                Ok(remote) if remote.scope == scope => found.push((name, remote.clone())),
                Ok(_) => {}
                Err(error) => return Err(Misuse(error.to_string())),
            }
        }
        let file = remotes.name();
        match (found.pop(), found.is_empty()) {
            (Some(robot), true) => Ok(robot),
            (Some(_), false) => Err(Misuse(format!(
                "several servers in {file} have the scope {scope}; choose one with --remote; nothing was sent"
            ))),
            (None, _) => Err(Misuse(format!(
                "no server in {file} has the scope {scope}; leave its tasks out with --topics; nothing was sent"
            ))),
        }
    }
}

/// Who told of a task, and how sure that is.
fn teller(source: &Source) -> String {
    let Source {
        name,
        endpoint,
        key,
    } = source;
    let name = if name.is_empty() {
        "an unnamed publisher"
    } else {
        name
    };
    let endpoint = match endpoint.is_empty() {
        true => "address unknown",
        false => endpoint,
    };
    let sure = match key.is_empty() {
        true => "not authenticated".to_owned(),
        false => format!("authenticated by its key {}", flat(key)),
    };
    match name == endpoint {
        true => format!("{} ({sure})", flat(name)),
        false => format!("{} ({}, {sure})", flat(name), flat(endpoint)),
    }
}

/// Asks on the terminal. Only a clear yes that is typed after the question is one; a signal is a no.
fn is_agreed() -> Result<bool, Box<dyn std::error::Error>> {
    if !stdin().is_terminal() {
        let mistake = "--tasks asks on a terminal, but stdin is not a terminal; agree with --yes; nothing was sent";
        return Err(Misuse(mistake.to_owned()).into());
    }
    keyboard::drop_input();
    part("Send them? [y/N] ");
    let (sender, typed) = mpsc::channel();
    // A signal does not interrupt a read.
    std::thread::Builder::new()
        .name("ztl-answer".to_owned())
        .spawn(move || {
            let mut answer = String::new();
            let read = stdin().read_line(&mut answer);
            sender.send(read.map(|_| answer))
        })?;
    let answer = loop {
        match typed.recv_timeout(TURN) {
            Ok(answer) => break answer?,
            Err(RecvTimeoutError::Timeout) if !signals::stopped() => {}
            Err(_) => return Ok(false),
        }
    };
    Ok(!signals::stopped() && ["y", "yes"].contains(&answer.trim().to_lowercase().as_str()))
}

/// The name of a task that was asked for, and the payload of its INIT.
fn request(event: &TaskEvent) -> Option<(String, String)> {
    if event.state() != Some(State::Initiated) {
        return None;
    }
    if let Some(payload) = &event.payload {
        return Some((payload.clone(), payload.clone()));
    }
    let [handler, component, goal] = event.request.as_ref()?;
    if handler.contains(':') || component.contains(':') {
        return None;
    }
    let spec = TaskSpec {
        handler,
        component,
        goal,
    };
    let mut payload = vec![0; spec.encoded_len()];
    let payload = spec.encode_into(&mut payload).ok()?.to_owned();
    Some((format!("{handler}:{component}:{goal}"), payload))
}

/// The tasks that were sent.
pub(super) struct RunningTasks<'scope, 'env> {
    scope: &'scope Scope<'scope, 'env>,
    robots: Robots,
    /// The tasks that were agreed to and are not sent yet.
    unsent: BTreeMap<TaskKey, (String, String)>,
    running: Arc<AtomicUsize>,
    incomplete: Arc<AtomicBool>,
    threads: Vec<std::thread::ScopedJoinHandle<'scope, ()>>,
}

impl<'scope, 'env> RunningTasks<'scope, 'env> {
    pub(super) fn new(scope: &'scope Scope<'scope, 'env>, agreed: Agreed) -> Self {
        Self {
            scope,
            robots: agreed.robots,
            unsent: agreed.tasks,
            running: Arc::default(),
            incomplete: Arc::default(),
            threads: Vec::new(),
        }
    }

    /// Sends the task that a client asked for, as it was agreed to, once.
    pub(super) fn on_event(&mut self, event: &TaskEvent, time: u64) {
        // Its other events may have the same time.
        if request(event).is_none() {
            return;
        }
        let key = (event.scope.clone(), event.id.clone(), time);
        let Some((task, payload)) = self.unsent.remove(&key) else {
            return;
        };
        let Some(robot) = self.robots.get(&event.scope) else {
            return;
        };
        let name = format!("{} {}", flat(&robot.name), flat(&task));
        if self.running.fetch_add(1, Ordering::AcqRel) >= RUNNING {
            self.running.fetch_sub(1, Ordering::AcqRel);
            return self.not_sent(&name, "too many tasks run");
        }
        let remote = robot.connection.clone();
        let (running, incomplete) = (Arc::clone(&self.running), Arc::clone(&self.incomplete));
        let of_task = name.clone();
        let spawned = std::thread::Builder::new().spawn_scoped(self.scope, move || {
            if !is_completed(remote, &of_task, &payload) {
                incomplete.store(true, Ordering::Release);
            }
            running.fetch_sub(1, Ordering::AcqRel);
        });
        match spawned {
            Ok(thread) => {
                self.threads.retain(|thread| !thread.is_finished());
                self.threads.push(thread);
            }
            Err(error) => {
                self.running.fetch_sub(1, Ordering::AcqRel);
                self.not_sent(&name, error);
            }
        }
    }

    fn not_sent(&self, name: &str, why: impl std::fmt::Display) {
        self.incomplete.store(true, Ordering::Release);
        error_line(format_args!("ztl: {name} was not sent: {why}"));
    }

    /// Waits for all tasks. Returns whether all completed.
    pub(super) fn wait(self) -> bool {
        for thread in self.threads {
            if thread.join().is_err() {
                self.incomplete.store(true, Ordering::Release);
            }
        }
        !self.incomplete.load(Ordering::Acquire)
    }
}

/// Sends a task and waits for its end; aborts it after a signal. Returns whether it completed.
fn is_completed(mut remote: RemoteTask, name: &str, payload: &str) -> bool {
    let triggered = match remote.trigger_while(payload, || !signals::stopped()) {
        Ok(triggered) => triggered,
        Err(error) => {
            error_line(format_args!("ztl: {name}: {error}"));
            return false;
        }
    };
    let ended = remote.wait_while(&triggered.id, None, || !signals::stopped(), |_| {});
    let ended = match ended {
        Ok(status) => Ok(status),
        Err(_) if signals::stopped() => remote
            .abort(&triggered.id)
            .map_err(|error| error.to_string()),
        Err(error) => Err(error.to_string()),
    };
    match ended {
        Ok(status) => {
            line(format_args!(
                "{name} {} {}",
                status.state.name(),
                flat(&status.text)
            ));
            status.state == State::Completed
        }
        Err(error) => {
            error_line(format_args!("ztl: {name}: its end is unknown: {error}"));
            false
        }
    }
}
