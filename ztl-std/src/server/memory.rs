//! A dispatcher's memory on the heap: the same rules, as many tasks as are allowed.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::hash::{BuildHasherDefault, Hasher};

use super::listing::{Asked, ListedTask, Listing, told};
use super::{Answers, Limits, now};
use crate::time::millis;

use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::memory::{LastInit, Memory, Scope, Waiter};
use ztl_core::sink::Sink;
use ztl_core::tasks::{Task, Tasks, Text};
use ztl_core::{Instant, TaskId};

/// The way back to a client: its ROUTER identity, its envelope, the empty delimiter.
pub(super) type Peer = Vec<zmq::Message>;

/// What a scope's handler tells of itself.
pub(super) struct About {
    /// What it offers, as a mapping in YAML's flow style.
    pub(super) describe: Box<dyn Fn() -> String + Send>,
    /// Answers to further questions.
    pub(super) answer: Answers,
    /// Whether the answer about an unknown id names it.
    pub(super) names_unknown_ids: bool,
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

/// Something for each of some tasks. The ids are given by the server one after the other, so nobody can
/// choose some that meet in one place.
pub(crate) type ById<T> = HashMap<TaskId, T, BuildHasherDefault<IdHasher>>;

/// Numbers that follow each other lie side by side, where the newest are still in the cache.
#[derive(Debug, Default)]
pub(crate) struct IdHasher(u64);

impl Hasher for IdHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.write_u32((*byte).into()));
    }

    fn write_u32(&mut self, number: u32) {
        // The map takes the place from the low bits, and tells neighbours apart by the seven highest.
        let number = u64::from(number) ^ self.0.rotate_left(8);
        self.0 = number ^ number << 57;
    }
}

/// A task, and what it was asked for, to be shown.
#[derive(Debug)]
struct Kept {
    task: Task<Scope, Grown>,
    asked: Option<Asked>,
    /// Bytes that it counts for: its goal while it runs, its result afterwards.
    bytes: usize,
}

/// Tasks by their id, and the ends in their order.
#[derive(Debug)]
pub(super) struct HeapTasks {
    limits: Limits,
    tasks: ById<Kept>,
    /// Sorted. A new end is the latest, or nearly so.
    ends: VecDeque<(Instant, TaskId)>,
    /// Bytes of the goals of tasks that run.
    goals: usize,
    /// Bytes of the results of those that have ended.
    results: usize,
    /// Bytes of the answers to INITs, which cannot be forgotten either.
    answers: usize,
    /// Scopes that the client whose request is served may not use.
    hidden: Vec<Scope>,
}

impl HeapTasks {
    /// Forgets the oldest ends until all bytes fit, but never this one, which nobody has been told yet.
    fn forget_surplus(&mut self, last: TaskId) {
        while self.goals + self.results + self.answers > self.limits.memory
            && let Some((_, oldest)) = self.ends.front().copied()
            && oldest != last
        {
            self.remove(oldest);
        }
    }
}

impl Tasks for HeapTasks {
    type Id = TaskId;
    type Extra = Scope;
    type Text = Grown;

    fn get(&self, id: TaskId) -> Option<&Task<Scope, Grown>> {
        self.tasks.get(&id).map(|kept| &kept.task)
    }

    fn get_mut(&mut self, id: TaskId) -> Option<&mut Task<Scope, Grown>> {
        self.tasks.get_mut(&id).map(|kept| &mut kept.task)
    }

    fn may_run(&self) -> bool {
        // Half of the memory is for results, so that clients hear them.
        self.tasks.len().saturating_sub(self.ends.len()) < self.limits.running
            && self.goals + self.answers < self.limits.memory / 2
    }

    fn make_room(&mut self) -> bool {
        if self.tasks.len() >= self.limits.remembered {
            let Some((_, oldest)) = self.ends.front().copied() else {
                return false;
            };
            self.remove(oldest);
        }
        true
    }

    fn insert(&mut self, id: TaskId, task: Task<Scope, Grown>) -> Option<&mut Task<Scope, Grown>> {
        let kept = Kept {
            task,
            asked: None,
            bytes: 0,
        };
        let place = self.tasks.entry(id).insert_entry(kept);
        Some(&mut place.into_mut().task)
    }

    fn remove(&mut self, id: TaskId) {
        let Some(kept) = self.tasks.remove(&id) else {
            return;
        };
        match kept.task.ended {
            Instant::NEVER => self.goals -= kept.bytes,
            _ => self.results -= kept.bytes,
        }
        let end = (kept.task.ended, id);
        // Mostly the oldest makes room.
        if self.ends.front() == Some(&end) {
            self.ends.pop_front();
        } else if let Ok(place) = self.ends.binary_search(&end) {
            self.ends.remove(place);
        }
    }

    fn on_ended(&mut self, id: TaskId) {
        if let Some(kept) = self.tasks.get_mut(&id) {
            let result = kept.task.text.as_ref().len();
            self.goals -= std::mem::replace(&mut kept.bytes, result);
            self.results += result;
            let end = (kept.task.ended, id);
            let later = self.ends.iter().rev().take_while(|other| **other > end);
            self.ends.insert(self.ends.len() - later.count(), end);
            self.forget_surplus(id);
        }
    }

    fn oldest_end(&self) -> Option<(TaskId, Instant)> {
        self.ends.front().map(|(ended, id)| (*id, *ended))
    }

    fn iter(&self) -> impl Iterator<Item = (TaskId, &Task<Scope, Grown>)> {
        let tasks = self.tasks.iter().map(|(id, kept)| (*id, &kept.task));
        tasks.filter(|(_, task)| !self.hidden.contains(&task.extra))
    }
}

pub(super) struct Heap {
    limits: Limits,
    /// Names and descriptions, by scope.
    scopes: Vec<(String, About)>,
    /// What the last question was answered, to be told.
    answer: Option<String>,
    places: HashMap<String, Scope>,
    tasks: HeapTasks,
    held: Vec<Waiter<Peer>>,
    inits: HashMap<ClientId, LastInit<Grown>>,
    /// Which client's last INIT led to a task.
    clients: ById<ClientId>,
    /// When an answered INIT may be forgotten.
    until: BTreeSet<(Instant, ClientId)>,
    /// Until when an INIT that found no room may come again.
    full: Instant,
}

impl Heap {
    pub(super) fn new(limits: Limits) -> Self {
        Self {
            limits,
            scopes: Vec::new(),
            answer: None,
            places: HashMap::new(),
            tasks: HeapTasks {
                limits,
                tasks: ById::default(),
                ends: VecDeque::new(),
                goals: 0,
                results: 0,
                answers: 0,
                hidden: Vec::new(),
            },
            held: Vec::new(),
            inits: HashMap::new(),
            clients: ById::default(),
            until: BTreeSet::new(),
            full: Instant::ZERO,
        }
    }

    /// Other limits, which hold for what comes from now on.
    pub(super) fn set_limits(&mut self, limits: Limits) {
        self.limits = limits;
        self.tasks.limits = limits;
    }

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

    /// Keeps what a task was asked for, to be shown. While the task runs its handler keeps all of it.
    pub(super) fn note_payload(&mut self, id: TaskId, payload: &str, now: Instant) {
        if let Some(kept) = self.tasks.tasks.get_mut(&id) {
            kept.asked = Some(Asked::new(payload, now));
            if !kept.task.state.is_final() {
                kept.bytes = payload.len();
                self.tasks.goals += payload.len();
            }
        }
    }

    fn listing(&self) -> Listing {
        let now = now();
        let kept = self.tasks.tasks.iter();
        let shown = kept.filter(|(_, kept)| !self.tasks.hidden.contains(&kept.task.extra));
        let tasks = shown.map(|(id, Kept { task, asked, .. })| {
            let asked = asked.as_ref();
            ListedTask {
                id: (*id).into(),
                scope: self.scope_name(task.extra).to_owned(),
                task: asked.map(Asked::task).unwrap_or_default(),
                state: task.state.code(),
                text: told(task.text.as_ref()),
                age_ms: asked.map_or(0, |asked| millis(asked.age(now))),
                ended_ms: (task.ended != Instant::NEVER).then(|| millis(now.since(task.ended))),
            }
        });
        Listing {
            tasks: tasks.collect(),
            ..Listing::default()
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
            if let Some(task) = init.task {
                self.clients.remove(&task);
            }
            self.until.remove(&(init.until, client));
            self.tasks.answers -= init.text.as_ref().len();
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

    fn names_unknown_ids(&self, scope: Scope) -> bool {
        let scope = self.scopes.get(usize::from(scope.0));
        scope.is_none_or(|(_, about)| about.names_unknown_ids)
    }

    fn longest_message(&self) -> Option<u32> {
        u32::try_from(self.tasks.limits.longest_message()).ok()
    }

    fn answer(&mut self, question: &str) -> Option<&str> {
        self.answer = match question {
            "tasks" => self.listing().into_json(),
            other => self.ask_handlers(other),
        };
        self.answer.as_deref()
    }

    fn can_hold(&self) -> bool {
        self.held.len() < self.limits.held
    }

    fn hold(&mut self, waiter: Waiter<Peer>) -> Result<(), Waiter<Peer>> {
        if !self.can_hold() {
            return Err(waiter);
        }
        self.held.push(waiter);
        Ok(())
    }

    fn release(&mut self, wanted: impl Fn(&mut Waiter<Peer>) -> bool) -> Option<Waiter<Peer>> {
        let place = self.held.iter_mut().position(wanted)?;
        Some(self.held.swap_remove(place))
    }

    fn next_answer(&self) -> Instant {
        let deadlines = self.held.iter().map(|waiter| waiter.deadline);
        deadlines.min().unwrap_or(Instant::NEVER)
    }

    fn last_init(&self, client: &ClientId) -> Option<&LastInit<Grown>> {
        self.inits.get(client)
    }

    fn init_of(&self, task: TaskId) -> Option<&LastInit<Grown>> {
        let client = self.clients.get(&task)?;
        self.inits.get(client)
    }

    fn remember(&mut self, client: &ClientId, until: Instant) -> Option<&mut LastInit<Grown>> {
        if self.inits.len() >= self.limits.clients && !self.inits.contains_key(client) {
            self.full = until;
            return None;
        }
        self.unlink(*client);
        let init = self.inits.entry(*client);
        Some(init.or_insert_with(|| LastInit::new(*client)))
    }

    fn on_heard(&mut self, now: Instant, _peer: &Peer, _envelope: &Envelope, _init: bool) -> u64 {
        // Nobody is forgotten before their time; but whose INIT had no room is not known.
        if now < self.full { u64::MAX } else { 0 }
    }

    fn on_remembered(&mut self, client: &ClientId) {
        let Some(init) = self.inits.get(client) else {
            return;
        };
        self.tasks.answers += init.text.as_ref().len();
        if let Some(task) = init.task {
            self.clients.insert(task, *client);
        }
        if init.until != Instant::NEVER {
            self.until.insert((init.until, *client));
        }
    }

    fn forget_inits(&mut self, now: Instant) {
        while let Some((until, client)) = self.until.first().copied()
            && until <= now
        {
            self.unlink(client);
            self.inits.remove(&client);
        }
    }

    fn next_forgetting(&self) -> Instant {
        self.until
            .first()
            .map_or(Instant::NEVER, |(until, _)| *until)
    }
}

/// What a scope offers, in YAML's flow style: `{gripper: [finger]}`.
pub fn offered<'n, C>(handlers: impl IntoIterator<Item = (&'n str, C)>) -> String
where
    C: IntoIterator<Item = &'n str>,
{
    let handlers = handlers.into_iter().map(|(handler, components)| {
        let names: Vec<String> = components.into_iter().map(quoted).collect();
        format!("{}: [{}]", quoted(handler), names.join(", "))
    });
    format!("{{{}}}", handlers.collect::<Vec<_>>().join(", "))
}

/// A text in quotes, as YAML reads it.
fn quoted(text: &str) -> String {
    let mut bytes = Vec::new();
    ztl_core::repr::put_yaml(text, &mut |part: &[u8]| bytes.extend_from_slice(part));
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use core::time::Duration;

    use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, KEEP_INIT, TaskEvent};
    use ztl_core::reply::Reply;

    use super::*;

    #[test]
    fn an_init_that_found_no_room_never_acts_when_it_comes_again_and_there_is_some() {
        let mut heap = Heap::new(Limits {
            clients: 1,
            ..Limits::default()
        });
        let about = About {
            describe: Box::new(String::new),
            answer: Box::new(|_| None),
            names_unknown_ids: true,
        };
        heap.register("/lab", about);
        let first = TaskId::new(1).expect("not 0");
        let mut server = Dispatcher::new(heap, Config::new(first, 1));
        let start = Instant::from_micros(1);
        let mut init = |now: Instant, client: u8, number: u64| {
            let envelope = Envelope {
                client: ClientId([client; 16]),
                number,
                early_end: false,
            };
            let body = Body::One(b"/lab;1;-1;x");
            let out = &mut |_: Peer, _: &Reply<'_>| {};
            server.handle_timeout(now, out);
            let action = server.handle_request(now, Vec::new(), Some(envelope), body, out);
            let began = action.is_some();
            if let Some(Action::Start { id, .. }) = action {
                let event = TaskEvent::Rejected { reason: "busy" };
                server.handle_event(now, id, event, out);
            }
            began
        };
        assert!(init(start, 1, 2));
        let later = start + (KEEP_INIT - Duration::from_secs(1));
        assert!(!init(later, 2, 2), "there is room for one");
        let later = start + (KEEP_INIT + Duration::from_secs(1));
        assert!(!init(later, 2, 2), "it was told that there was none");
        assert!(init(later + KEEP_INIT, 3, 2));
    }
}
