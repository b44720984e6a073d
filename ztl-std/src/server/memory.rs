//! A dispatcher's memory on the heap: the same rules, as many tasks as are allowed.

use std::collections::{BTreeSet, HashMap};

use super::Answers;
use super::listing::{Asked, ListedTask, Listing, millis, told};
use super::now;

use ztl_core::envelope::ClientId;
use ztl_core::memory::{LastInit, Memory, Scope, Waiter};
use ztl_core::sink::Sink;
use ztl_core::tasks::{Task, Tasks, Text};
use ztl_core::{Instant, TaskId};

/// How many tasks are remembered, running and ended together.
const MAX_TASKS: usize = 10_000;
/// How many answers are held at a time.
const MAX_HELD: usize = 10_000;
/// How many clients' last INIT is remembered.
const MAX_CLIENTS: usize = 10_000;

/// The way back to a client: its ROUTER identity, its envelope, the empty delimiter.
pub(super) type Peer = Vec<Vec<u8>>;

/// What a scope's handler tells of itself.
pub(super) struct About {
    /// What it offers, as a mapping in YAML's flow style.
    pub(super) describe: Box<dyn Fn() -> String + Send>,
    /// Answers to further questions.
    pub(super) answer: Answers,
}

/// Longest text that is kept, in bytes: an answer must fit a message that a client of ours takes.
const MAX_TEXT: usize = super::MAX_MESSAGE - 1024;

/// A text that grows as needed, up to what a message can carry.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Grown(String);

impl AsRef<str> for Grown {
    fn as_ref(&self) -> &str {
        &self.0
    }
}

impl Text for Grown {
    fn set(&mut self, text: &str) {
        self.0.clear();
        if text.len() <= MAX_TEXT {
            self.0.push_str(text);
        } else {
            let fitting = text.floor_char_boundary(MAX_TEXT);
            self.0.push_str(text.get(..fitting).unwrap_or_default());
            self.0.push('…');
        }
    }
}

/// Tasks by their id, and the ends in their order.
#[derive(Debug, Default)]
pub(super) struct HeapTasks {
    tasks: HashMap<TaskId, Task<Scope, Grown>>,
    ends: BTreeSet<(Instant, TaskId)>,
    /// What each was asked for, to be shown.
    asked: HashMap<TaskId, Asked>,
    /// Scopes that the client whose request is served may not use.
    hidden: Vec<Scope>,
}

impl Tasks for HeapTasks {
    type Id = TaskId;
    type Extra = Scope;
    type Text = Grown;

    fn get(&self, id: TaskId) -> Option<&Task<Scope, Grown>> {
        self.tasks.get(&id)
    }

    fn get_mut(&mut self, id: TaskId) -> Option<&mut Task<Scope, Grown>> {
        self.tasks.get_mut(&id)
    }

    fn insert(&mut self, id: TaskId, task: Task<Scope, Grown>) -> bool {
        if self.tasks.len() >= MAX_TASKS {
            return false;
        }
        self.tasks.insert(id, task);
        true
    }

    fn remove(&mut self, id: TaskId) {
        self.asked.remove(&id);
        if let Some(ended) = self.tasks.remove(&id).and_then(|task| task.ended) {
            self.ends.remove(&(ended, id));
        }
    }

    fn on_ended(&mut self, id: TaskId) {
        if let Some(ended) = self.tasks.get(&id).and_then(|task| task.ended) {
            self.ends.insert((ended, id));
        }
    }

    fn oldest_end(&self) -> Option<(TaskId, Instant)> {
        // No end here needs an acknowledgement.
        self.ends.first().map(|(ended, id)| (*id, *ended))
    }

    fn for_each(&self, each: &mut dyn FnMut(TaskId, &Task<Scope, Grown>)) {
        for (id, task) in &self.tasks {
            if !self.hidden.contains(&task.extra) {
                each(*id, task);
            }
        }
    }
}

#[derive(Default)]
pub(super) struct Heap {
    /// Names and descriptions, by scope.
    scopes: Vec<(String, About)>,
    places: HashMap<String, Scope>,
    tasks: HeapTasks,
    held: Vec<Waiter<Peer>>,
    inits: HashMap<ClientId, LastInit<Grown>>,
    /// Which client's last INIT led to a task.
    clients: HashMap<TaskId, ClientId>,
    /// When an answered INIT may be forgotten. One that was replaced since stands here in vain.
    until: BTreeSet<(Instant, ClientId)>,
}

impl Heap {
    /// Makes a scope known, or describes it anew, and says its place.
    pub(super) fn register(&mut self, name: &str, about: About) -> Scope {
        if let Some(scope) = self.places.get(name).copied() {
            if let Some((_, known)) = self.scopes.get_mut(usize::from(scope.0)) {
                *known = about;
            }
            return scope;
        }
        // More scopes than 65,536 would need as many calls; the last place is then shared.
        let scope = Scope(u16::try_from(self.scopes.len()).unwrap_or(u16::MAX));
        self.scopes.push((name.to_owned(), about));
        self.places.insert(name.to_owned(), scope);
        scope
    }

    /// Hides scopes from the request that is served next: to its client they do not exist. To be
    /// shown again afterwards.
    pub(super) fn hide(&mut self, hidden: impl Fn(&str) -> bool) {
        if self.tasks.hidden.is_empty() && !self.scopes.iter().any(|(name, _)| hidden(name)) {
            return;
        }
        let places = self.scopes.iter().zip(0..);
        let hidden = places.filter(|((name, _), _)| hidden(name));
        self.tasks.hidden = hidden.map(|(_, place)| Scope(place)).collect();
    }

    /// The scopes that the present client may use, with their places.
    fn visible(&self) -> impl Iterator<Item = &(String, About)> {
        let shown = |(_, place): &(_, u16)| !self.tasks.hidden.contains(&Scope(*place));
        self.scopes
            .iter()
            .zip(0..)
            .filter(shown)
            .map(|(scope, _)| scope)
    }

    /// Keeps what a task was asked for, to be shown.
    pub(super) fn note_payload(&mut self, id: TaskId, payload: &str, now: Instant) {
        self.tasks.asked.insert(id, Asked::new(payload, now));
    }

    fn listing(&self) -> Listing {
        let now = now();
        let shown = |(_, task): &(_, &Task<Scope, Grown>)| !self.tasks.hidden.contains(&task.extra);
        let tasks = self.tasks.tasks.iter().filter(shown).map(|(id, task)| {
            let asked = self.tasks.asked.get(id);
            ListedTask {
                id: id.get(),
                scope: self.scope_name(task.extra).to_owned(),
                task: asked.map(Asked::task).unwrap_or_default(),
                state: task.state.code(),
                text: told(task.text.as_ref()),
                age_ms: asked.map_or(0, |asked| millis(asked.age(now))),
                ended_ms: task.ended.map(|ended| millis(now.since(ended))),
            }
        });
        Listing {
            tasks: tasks.collect(),
            more: 0,
        }
    }

    /// What the handlers answer, by scope.
    fn ask_handlers(&self, question: &str) -> Option<String> {
        let answers = self.visible().filter_map(|(name, about)| {
            let answer = serde_json::from_str((about.answer)(question)?.as_str()).ok()?;
            Some((name.clone(), answer))
        });
        let answers: serde_json::Map<String, serde_json::Value> = answers.collect();
        (!answers.is_empty()).then(|| serde_json::Value::Object(answers).to_string())
    }

    /// Takes an INIT out of the indexes.
    fn unlink(&mut self, client: ClientId) {
        if let Some(init) = self.inits.get(&client) {
            if let Some(task) = init.first.task() {
                self.clients.remove(&task);
            }
            if let Some(until) = init.until {
                self.until.remove(&(until, client));
            }
        }
    }
}

impl Memory for Heap {
    type Peer = Peer;
    type Text = Grown;
    type Tasks = HeapTasks;

    fn tasks(&self) -> &HeapTasks {
        &self.tasks
    }

    fn tasks_mut(&mut self) -> &mut HeapTasks {
        &mut self.tasks
    }

    fn scope(&self, name: &str) -> Option<Scope> {
        let place = self.places.get(name).copied();
        place.filter(|place| !self.tasks.hidden.contains(place))
    }

    fn scope_name(&self, scope: Scope) -> &str {
        self.scopes
            .get(usize::from(scope.0))
            .map_or("", |(name, _)| name)
    }

    fn put_scopes(&self, sink: &mut dyn Sink) {
        let scopes: Vec<String> = self
            .visible()
            .map(|(name, about)| format!("{}: {}", quoted(name), (about.describe)()))
            .collect();
        sink.put(format!("{{{}}}", scopes.join(", ")).as_bytes());
    }

    fn answer(&self, question: &str) -> Option<impl AsRef<str>> {
        match question {
            "tasks" => self.listing().into_json(),
            other => self.ask_handlers(other),
        }
    }

    fn hold(&mut self, waiter: Waiter<Peer>) -> Result<(), Waiter<Peer>> {
        if self.held.len() >= MAX_HELD {
            return Err(waiter);
        }
        self.held.push(waiter);
        Ok(())
    }

    fn held(&self) -> &[Waiter<Peer>] {
        &self.held
    }

    fn release(&mut self, place: usize) -> Option<Waiter<Peer>> {
        (place < self.held.len()).then(|| self.held.swap_remove(place))
    }

    fn last_init(&mut self, client: ClientId) -> Option<&mut LastInit<Grown>> {
        self.inits.get_mut(&client)
    }

    fn init_of(&mut self, task: TaskId) -> Option<&mut LastInit<Grown>> {
        let client = self.clients.get(&task)?;
        self.inits.get_mut(client)
    }

    fn remember(&mut self, init: LastInit<Grown>) -> bool {
        if self.inits.len() >= MAX_CLIENTS && !self.inits.contains_key(&init.client) {
            return false;
        }
        self.unlink(init.client);
        if let Some(task) = init.first.task() {
            self.clients.insert(task, init.client);
        }
        if let Some(until) = init.until {
            self.until.insert((until, init.client));
        }
        self.inits.insert(init.client, init);
        true
    }

    fn on_settled(&mut self, client: ClientId, task: TaskId) {
        let Some(init) = self.inits.get(&client) else {
            return;
        };
        if init.first.task().is_none() {
            self.clients.remove(&task);
        }
        if let Some(until) = init.until {
            self.until.insert((until, client));
        }
    }

    fn forget_inits(&mut self, now: Instant) {
        while let Some((until, client)) = self.until.first().copied() {
            if now < until {
                break;
            }
            self.unlink(client);
            self.until.remove(&(until, client));
            self.inits.remove(&client);
        }
    }

    fn next_forgetting(&self) -> Option<Instant> {
        self.until.first().map(|(until, _)| *until)
    }
}

/// A text in quotes, as YAML reads it.
pub(crate) fn quoted(text: &str) -> String {
    let mut bytes = Vec::new();
    ztl_core::repr::put_yaml(text, &mut |part: &[u8]| bytes.extend_from_slice(part));
    String::from_utf8_lossy(&bytes).into_owned()
}
