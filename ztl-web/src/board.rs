//! What is known of all robots: the watchers and goals write it, every socket shows it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Instant;

use serde::Serialize;
use serde_json::{Value, json};
use ztl_std::describe::{CheckGoal as _, ScopeDescriptions, find};
use ztl_std::{Offers, RemoteId, State};

use crate::aborts::AbortRequest;
use crate::clients::Clients;
use crate::devices::Devices;
use crate::goal::Goal;
use crate::lock::locked;
use crate::operator::{Client, Operator};
use crate::past::Past;
use crate::robots::{self, ConfiguredScope, Server, Target};
use crate::show::handle::ShowHandle;
use crate::stop::Stops;
use crate::streams::Streams;
use crate::task::Task;
use crate::topics::{Topic, Topics};

/// Most tasks of one server that are shown.
const SHOWN: usize = 200;
/// Most goals whose final state cannot be learnt that are remembered.
const LOST: usize = 100;
/// Most aborts that wait for the thread of a server.
const WAITING: usize = 1000;

/// What the components of a server say of themselves, by scope.
pub(crate) type Described = Arc<BTreeMap<String, ScopeDescriptions>>;

pub(crate) struct Board {
    pub(crate) servers: Vec<Server>,
    pub(crate) topics: Topics,
    pub(crate) operator: Operator,
    pub(crate) streams: Arc<Streams>,
    pub(crate) past: Past,
    seen: Mutex<Vec<Seen>>,
    /// What the components of each server say of themselves.
    described: Mutex<Vec<Described>>,
    goals: Mutex<Goals>,
    /// How many sockets are open.
    pub(crate) sockets: AtomicUsize,
    pub(crate) stops: Stops,
    pub(crate) clients: Clients,
    show: OnceLock<ShowHandle>,
    /// What the thread of each server is to do.
    posts: Vec<Post>,
    /// Held while a topic is written, so that an older value never replaces a newer one.
    publishing: Mutex<()>,
}

/// What the thread of a server is to do besides looking.
struct Post {
    wake: SyncSender<()>,
    aborts: Mutex<Vec<AbortRequest>>,
}

/// The goals of this console that have not ended.
#[derive(Default)]
struct Goals {
    next: u64,
    open: BTreeMap<u64, Arc<Goal>>,
    /// Those whose final state cannot be learnt. They may run, and a list need not tell it.
    lost: VecDeque<Arc<Goal>>,
    /// For each server, those that got no answer to their INIT. They may run, and no ABORT reaches them.
    without_id: BTreeMap<usize, WithoutId>,
}

struct WithoutId {
    count: usize,
    /// When the last one was lost, or a complete list was answered after that.
    at: Instant,
    is_listed: bool,
}

/// What a watcher knows of its server.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) health: Health,
    /// Wall clock in ms: since when the health is so.
    pub(crate) since_ms: u64,
    /// The version, or why the server is missing.
    pub(crate) text: String,
    pub(crate) scopes: BTreeMap<String, Offers>,
    /// Changes with what its components say of themselves; 0 if that is nothing, `None` until the server was asked.
    pub(crate) described: Option<u64>,
    /// The devices of a gateway.
    pub(crate) devices: Arc<Devices>,
    /// Whether the server lists its tasks.
    pub(crate) lists: bool,
    pub(crate) tasks: Vec<Task>,
    /// Why more tasks than these may run.
    pub(crate) gaps: Vec<String>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Health {
    /// Not asked yet.
    #[default]
    Unknown,
    There,
    Missing,
}

impl Board {
    /// The board, and for each server what wakes its thread.
    pub(crate) fn new(servers: Vec<Server>, streams: Streams) -> (Self, Vec<Receiver<()>>) {
        // A thread that is woken twice looks once.
        let (wakes, woken): (Vec<_>, Vec<_>) = servers.iter().map(|_| sync_channel(1)).unzip();
        let post = |wake| Post {
            wake,
            aborts: Mutex::default(),
        };
        let board = Self {
            seen: Mutex::new(vec![Seen::default(); servers.len()]),
            described: Mutex::new(vec![Described::default(); servers.len()]),
            stops: Stops::new(servers.iter().map(|server| server.name.clone())),
            posts: wakes.into_iter().map(post).collect(),
            servers,
            topics: Topics::default(),
            operator: Operator::new(),
            past: Past::default(),
            streams: Arc::new(streams),
            goals: Mutex::default(),
            sockets: AtomicUsize::new(0),
            clients: Clients::default(),
            show: OnceLock::new(),
            publishing: Mutex::default(),
        };
        board.publish();
        (board, woken)
    }

    /// Whether somebody looks.
    pub(crate) fn is_watched(&self) -> bool {
        self.sockets.load(Ordering::Relaxed) > 0
    }

    /// Stop is pressed: aborts everything on every server. Returns the number of this press.
    pub(crate) fn press_stop(&self, by: &str) -> u64 {
        let press = self.stops.press(by);
        // What was not sent yet is never sent.
        if let Some(show) = self.show() {
            show.stop_all();
        }
        for goal in self.goals() {
            goal.give_up();
        }
        for post in &self.posts {
            post.wake();
        }
        self.publish_stop();
        press
    }

    /// The show, if there is one.
    pub(crate) fn show(&self) -> Option<&ShowHandle> {
        self.show.get()
    }

    pub(crate) fn set_show(&self, handle: ShowHandle) {
        // A console has one show.
        let _ = self.show.set(handle);
    }

    pub(crate) fn publish_show(&self, value: &Value) {
        self.topics.set(Topic::Show, value);
    }

    /// The server of a robot, and its scope there.
    pub(crate) fn locate(&self, robot: &str) -> Option<(usize, String)> {
        let mut servers = self.servers.iter().enumerate();
        servers.find_map(|(index, server)| Some((index, server.scope_of(robot)?.to_owned())))
    }

    pub(crate) fn publish_stop(&self) {
        let _publishing = locked(&self.publishing);
        self.topics.set(Topic::Stop, &self.stops.shown());
    }

    /// Aborts a task.
    ///
    /// # Errors
    /// If too many aborts wait.
    pub(crate) fn abort(&self, server: usize, request: AbortRequest) -> Result<(), String> {
        let post = self.posts.get(server).ok_or("no such server")?;
        let mut aborts = locked(&post.aborts);
        if aborts.len() >= WAITING {
            return Err(format!("{WAITING} aborts wait: try again"));
        }
        aborts.push(request);
        drop(aborts);
        post.wake();
        Ok(())
    }

    /// What the thread of a server is to abort.
    pub(crate) fn take_aborts(&self, server: usize) -> Vec<AbortRequest> {
        let post = self.posts.get(server);
        post.map_or_else(Vec::new, |post| std::mem::take(&mut *locked(&post.aborts)))
    }

    /// What is known of a server.
    pub(crate) fn seen(&self, server: usize) -> Seen {
        locked(&self.seen).get(server).cloned().unwrap_or_default()
    }

    /// What a scope of a server offers, if the server has told that.
    fn offers(&self, server: usize, scope: &str) -> Option<Offers> {
        let seen = locked(&self.seen);
        seen.get(server)?.scopes.get(scope).cloned()
    }

    /// Replaces what is known of a server.
    pub(crate) fn set_seen(&self, server: usize, now: Seen) {
        self.past.on_listed(&now.tasks);
        let mut seen = locked(&self.seen);
        let known = seen.get_mut(server).filter(|known| **known != now);
        if let Some(known) = known {
            if let Some(of) = self.servers.get(server) {
                match (known.health, now.health) {
                    (Health::Unknown | Health::There, Health::Missing) => {
                        tracing::warn!("robot '{}' is missing: {}", of.name, now.text);
                    }
                    (Health::Missing, Health::There) => {
                        tracing::warn!("robot '{}' is there again", of.name);
                    }
                    _ => {}
                }
            }
            *known = now;
            drop(seen);
            self.publish();
        }
    }

    /// Replaces what the components of a server say of themselves, and the number that changes with it.
    pub(crate) fn set_described(&self, server: usize, number: u64, described: Described) {
        if let Some(known) = locked(&self.described).get_mut(server) {
            *known = described;
        }
        let mut seen = self.seen(server);
        seen.described = Some(number);
        self.set_seen(server, seen);
    }

    /// What a component says of itself, as JSON; `null` if it says nothing.
    ///
    /// # Errors
    /// What is wrong with the name of its action.
    pub(crate) fn describe(&self, args: &Value) -> Result<Value, String> {
        let action = args.get("action").and_then(Value::as_str);
        let action = action.ok_or("expected {\"action\": SCOPE/handler/component}")?;
        let target = self.find(action)?;
        let described = self.described(target.server);
        let scope = described.get(&target.scope);
        let is = scope.and_then(|scope| find(scope, &target.handler, &target.component));
        let is = is.map(|is| serde_json::from_str::<Value>(&is.json().to_string()));
        let is = is.transpose().map_err(|error| error.to_string())?;
        Ok(json!({ "is": is }))
    }

    /// Checks a goal against what its component says of itself.
    ///
    /// # Errors
    /// What is wrong, and what the goal should be.
    pub(crate) fn check(&self, goal: &Goal) -> Result<(), String> {
        let Goal { target, goal, .. } = goal;
        let described = self.described(target.server);
        let scope = described.get(&target.scope);
        match scope.and_then(|scope| find(scope, &target.handler, &target.component)) {
            Some(is) => is.goal.check(goal, false).map(drop),
            None => Ok(()),
        }
    }

    fn described(&self, server: usize) -> Described {
        let described = locked(&self.described);
        described.get(server).cloned().unwrap_or_default()
    }

    /// The component that an action names.
    ///
    /// # Errors
    /// What is wrong with the name.
    pub(crate) fn find(&self, action: &str) -> Result<Target, String> {
        let offers = |server, scope: &str| self.offers(server, scope);
        robots::find(&self.servers, offers, action)
    }

    /// Lets a client operate if nobody does.
    ///
    /// # Errors
    /// Why it may not start tasks.
    pub(crate) fn begins_to_operate(&self, client: &Client) -> Result<(), String> {
        if self.operator.begin(client)? {
            self.publish();
        }
        Ok(())
    }

    /// Lets a client operate instead of another, which `args` may name.
    ///
    /// # Errors
    /// Why it does not.
    pub(crate) fn take_over(&self, client: &Client, args: &Value) -> Result<Value, String> {
        let from = match args.get("from") {
            None => None,
            Some(from) => Some(from.as_u64().ok_or("expected {\"from\": NUMBER} or {}")?),
        };
        self.operator.take_over(client, from)?;
        self.publish();
        Ok(json!({ "operator": self.operator.now() }))
    }

    /// A client is gone: nobody operates if it did.
    pub(crate) fn client_left(&self, client: &Client) {
        if self.operator.leave(client) {
            self.publish();
        }
    }

    /// Adds a goal; `None` if `most` are open.
    pub(crate) fn add_goal(&self, goal: &Arc<Goal>, most: usize) -> Option<u64> {
        let mut goals = locked(&self.goals);
        if goals.open.len() >= most {
            return None;
        }
        goals.next += 1;
        let number = goals.next;
        goals.open.insert(number, Arc::clone(goal));
        Some(number)
    }

    pub(crate) fn remove_goal(&self, number: u64) {
        let mut goals = locked(&self.goals);
        let goal = goals.open.remove(&number);
        if let Some(goal) = goal.as_ref().filter(|goal| goal.is_lost()) {
            if goals.lost.len() >= LOST {
                goals.lost.pop_front();
            }
            goals.lost.push_back(Arc::clone(goal));
        }
        drop(goals);
        if let Some(goal) = goal
            && let (Some(server), Some(id)) = (self.servers.get(goal.target.server), goal.id())
        {
            let key = (server.name.clone(), goal.target.scope.clone(), id.clone());
            self.past.on_goal(key, &goal.by);
        }
        self.publish();
    }

    /// The task with this id has ended, its server does not know it, or another task has the id now.
    pub(crate) fn forget_lost(&self, server: usize, scope: &str, id: &RemoteId) {
        let is_it = |goal: &Arc<Goal>| {
            let of = &goal.target;
            of.server == server && of.scope == scope && goal.id() == Some(id)
        };
        let mut goals = locked(&self.goals);
        let before = goals.lost.len();
        goals.lost.retain(|goal| !is_it(goal));
        let is_forgotten = goals.lost.len() < before;
        drop(goals);
        if is_forgotten {
            self.publish();
        }
    }

    /// A goal got no answer to its INIT, so that its task has no id.
    pub(crate) fn lose_without_id(&self, server: usize) {
        let mut goals = locked(&self.goals);
        let count = goals.without_id.get(&server).map_or(0, |lost| lost.count);
        let lost = WithoutId {
            count: count + 1,
            at: Instant::now(),
            is_listed: false,
        };
        goals.without_id.insert(server, lost);
    }

    /// A server has sent a complete list of its tasks; `asked_at` is when the console asked for it. Goals without an id are
    /// forgotten at the second list after they were lost: by then, a server that hung has read their INITs.
    pub(crate) fn forget_without_id(&self, server: usize, asked_at: Instant) {
        let mut goals = locked(&self.goals);
        let Some(lost) = goals.without_id.get_mut(&server) else {
            return;
        };
        if asked_at <= lost.at {
            return;
        }
        lost.at = Instant::now();
        if std::mem::replace(&mut lost.is_listed, true) {
            goals.without_id.remove(&server);
            drop(goals);
            self.publish();
        }
    }

    /// How many goals of a server got no answer to their INIT.
    pub(crate) fn lost_without_id(&self, server: usize) -> usize {
        let goals = locked(&self.goals);
        goals.without_id.get(&server).map_or(0, |lost| lost.count)
    }

    /// The goals of a server whose final state cannot be learnt.
    pub(crate) fn lost_at(&self, server: usize) -> Vec<Arc<Goal>> {
        let goals = locked(&self.goals);
        let own = goals
            .lost
            .iter()
            .filter(|goal| goal.target.server == server);
        own.cloned().collect()
    }

    pub(crate) fn goals(&self) -> Vec<Arc<Goal>> {
        locked(&self.goals).open.values().cloned().collect()
    }

    /// The open goals of a server.
    pub(crate) fn goals_at(&self, server: usize) -> Vec<Arc<Goal>> {
        let goals = locked(&self.goals);
        let own = goals
            .open
            .values()
            .filter(|goal| goal.target.server == server);
        own.cloned().collect()
    }

    /// Writes the topics anew; a topic that has not changed wakes nobody.
    pub(crate) fn publish(&self) {
        let _publishing = locked(&self.publishing);
        let seen = locked(&self.seen).clone();
        let mut goals = self.goals();
        goals.extend(locked(&self.goals).lost.iter().cloned());
        self.topics.set(Topic::Robots, &self.robots(&seen));
        self.topics.set(Topic::Tasks, &self.tasks(&seen, &goals));
    }

    fn robots(&self, seen: &[Seen]) -> Value {
        let robot = |(server, seen): (&Server, &Seen)| {
            let scope = |configured: &ConfiguredScope| {
                json!({
                    "scope": configured.scope,
                    "action": configured.prefix,
                    "handlers": seen.scopes.get(&configured.scope),
                })
            };
            json!({
                "name": server.name,
                "endpoint": server.endpoint,
                "health": seen.health,
                "since_ms": seen.since_ms,
                "text": seen.text,
                "lists_tasks": seen.lists,
                "described": seen.described,
                "devices": seen.devices.shown,
                "devices_text": seen.devices.text,
                "scopes": server.scopes.iter().map(scope).collect::<Vec<_>>(),
            })
        };
        let robots: Vec<Value> = self.servers.iter().zip(seen).map(robot).collect();
        json!({
            "robots": robots,
            "operator": self.operator.now(),
            "publishers": self.streams.names(),
        })
    }

    fn tasks(&self, seen: &[Seen], goals: &[Arc<Goal>]) -> Value {
        let mut tasks = Vec::new();
        let mut gaps = Vec::new();
        for (index, (server, seen)) in self.servers.iter().zip(seen).enumerate() {
            let mut own: Vec<&Arc<Goal>> = goals
                .iter()
                .filter(|goal| goal.target.server == index && goal.id().is_some())
                .collect();
            for task in seen.tasks.iter().take(SHOWN) {
                let mut task = task.clone();
                let of_it = |goal: &&Arc<Goal>| {
                    goal.target.scope == task.scope && goal.id() == Some(&task.id)
                };
                if let Some(at) = own.iter().position(of_it) {
                    let goal = own.swap_remove(at);
                    task.by = task.runs.then(|| goal.by.clone());
                }
                tasks.push(task);
            }
            // A server of the original lists nothing: there, the goals of this console are all that is known.
            let unlisted = own.into_iter().filter(|_| !seen.lists);
            tasks.extend(unlisted.filter_map(|goal| unlisted_task(goal, &server.name)));
            let more = seen.tasks.len().saturating_sub(SHOWN);
            let mut why = seen.gaps.clone();
            why.extend(without_id(self.lost_without_id(index)));
            if more > 0 {
                why.push(format!("{more} more tasks are not shown"));
            }
            gaps.extend(
                why.into_iter()
                    .map(|text| json!({ "robot": server.name, "text": text })),
            );
        }
        json!({ "tasks": tasks, "gaps": gaps })
    }
}

/// What is told of goals that got no answer to their INIT, if there are some.
pub(crate) fn without_id(count: usize) -> Option<String> {
    match count {
        0 => None,
        1 => Some("1 goal got no answer: it may run and cannot be aborted".to_owned()),
        _ => Some(format!(
            "{count} goals got no answer: they may run and cannot be aborted"
        )),
    }
}

/// A goal of this console as a task, for a server that lists none.
fn unlisted_task(goal: &Goal, robot: &str) -> Option<Task> {
    let target = &goal.target;
    let (state, text) = match goal.has_ended() {
        true => ("UNKNOWN", "its robot does not tell its state: it may run"),
        false => (State::Accepted.name(), ""),
    };
    Some(Task {
        robot: robot.to_owned(),
        scope: target.scope.clone(),
        id: goal.id()?.clone(),
        task: format!("{}:{}:{}", target.handler, target.component, goal.goal),
        state: state.to_owned(),
        text: text.to_owned(),
        runs: true,
        started_ms: None,
        by: Some(goal.by.clone()),
    })
}

impl Post {
    fn wake(&self) {
        // Fails if it is woken already.
        let _ = self.wake.try_send(());
    }
}
