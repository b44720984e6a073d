//! The dispatcher's memory on the heap: task table, INITs and held answers.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::memory::{LastInit, Memory, Scope, Waiter};
use ztl_core::sink::Sink;
use ztl_core::{Instant, TaskId};

use super::clock::now;
use super::handler::Answers;
use super::incoming::ReturnPath;
use super::limits::Limits;
use super::reserved_ids::ReservedIds;
use super::task_table::{HeapText, TaskTable};
use crate::describe::{Descriptions, MAX_LENGTH, PART};
use crate::offers::quoted;
use crate::task_list::TaskList;

/// What a scope's handler says about itself.
pub(super) struct ScopeInfo {
    /// What it offers, as a mapping in YAML flow style.
    pub(super) describe: Box<dyn Fn() -> String + Send>,
    /// What its components say of themselves, for the question `describe`.
    pub(super) components: Descriptions,
    /// Answers further questions.
    pub(super) answer: Answers,
    /// Whether the answer about an unknown id names the id.
    pub(super) names_unknown_ids: bool,
}

/// The dispatcher's memory on the heap, bounded by the server's limits.
pub(super) struct ServerMemory {
    limits: Limits,
    /// Names and descriptions, by [`Scope`].
    scopes: Vec<(String, ScopeInfo)>,
    /// The answer to the last question.
    answer: Option<String>,
    scope_numbers: HashMap<String, Scope>,
    tasks: TaskTable,
    /// Limits which ids are given.
    ids: Option<Arc<ReservedIds>>,
    held: Vec<Waiter<ReturnPath>>,
    inits: HashMap<ClientId, LastInit<HeapText>>,
    /// The client whose last INIT started a task.
    clients: HashMap<TaskId, ClientId>,
    /// When each answered INIT may be dropped.
    expiry: BTreeSet<(Instant, ClientId)>,
    /// Until then, an INIT that found no room may be resent.
    full_until: Instant,
}

impl ServerMemory {
    pub(super) fn new(limits: Limits) -> Self {
        Self {
            limits,
            scopes: Vec::new(),
            answer: None,
            scope_numbers: HashMap::new(),
            tasks: TaskTable::new(limits),
            ids: None,
            held: Vec::new(),
            inits: HashMap::new(),
            clients: HashMap::new(),
            expiry: BTreeSet::new(),
            full_until: Instant::ZERO,
        }
    }

    /// The present limits.
    #[cfg(feature = "publish")]
    pub(super) const fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Changes the limits for future requests.
    pub(super) fn set_limits(&mut self, limits: Limits) {
        self.limits = limits;
        self.tasks.set_limits(limits);
    }

    /// Gives only ids that are reserved there.
    pub(super) fn set_ids(&mut self, ids: Arc<ReservedIds>) {
        self.ids = Some(ids);
    }

    /// This id is given.
    pub(super) fn give(&self, id: TaskId) {
        if let Some(ids) = &self.ids {
            ids.give(id);
        }
    }

    /// Adds a scope, or replaces its description.
    pub(super) fn register(&mut self, name: &str, about: ScopeInfo) -> Scope {
        if let Some(scope) = self.scope_numbers.get(name).copied() {
            if let Some((_, known)) = self.scopes.get_mut(usize::from(scope.0)) {
                *known = about;
            }
            return scope;
        }
        // Beyond 65,536 scopes the last number is shared.
        let scope = Scope(u16::try_from(self.scopes.len()).unwrap_or(u16::MAX));
        self.scopes.push((name.to_owned(), about));
        self.scope_numbers.insert(name.to_owned(), scope);
        scope
    }

    /// Hides scopes from the request that is served next, as if they did not exist.
    pub(super) fn hide(&mut self, hidden: impl Fn(&str) -> bool) {
        if self.tasks.hides_any() || self.scopes.iter().any(|(name, _)| hidden(name)) {
            let scopes = self.scopes.iter().zip(0..);
            let scopes = scopes.filter(|((name, _), _)| hidden(name));
            self.tasks
                .hide(scopes.map(|(_, number)| Scope(number)).collect());
        }
    }

    /// The scopes that the client being served may use.
    fn visible(&self) -> impl Iterator<Item = &(String, ScopeInfo)> {
        let shown = |(_, number): &(_, u16)| !self.tasks.hides(Scope(*number));
        let scopes = self.scopes.iter().zip(0..).filter(shown);
        scopes.map(|(scope, _)| scope)
    }

    /// Keeps what a task was asked for, to be shown.
    /// Counts a running task's bytes again: its text may be another one.
    pub(super) fn recount(&mut self, id: TaskId) {
        self.tasks.recount(id);
    }

    pub(super) fn note_payload(&mut self, id: TaskId, payload: &str, now: Instant) {
        self.tasks.note_payload(id, payload, now);
    }

    /// A device started this task, not a client.
    pub(super) fn note_by_device(&mut self, id: TaskId) {
        self.tasks.note_by_device(id);
    }

    /// The answer to `describe`, with what follows that word: `[SCOPE][;FROM]`.
    fn describe(&self, of: &str) -> Option<String> {
        let (scope, from) = of.split_once(';').unwrap_or((of, "0"));
        let from: usize = from.parse().ok()?;
        let scopes = self
            .visible()
            .filter(|(name, _)| scope.is_empty() || name == scope);
        let scopes: Vec<_> = scopes
            .map(|(name, about)| (name, (about.components)()))
            .collect();
        let all = scopes.iter().flat_map(|(scope, handlers)| {
            handlers.iter().flat_map(move |(handler, components)| {
                let components = components.iter();
                components.map(move |(component, is)| ([*scope, handler, component], is))
            })
        });
        let mut json = "{\"components\": [".to_owned();
        let mut first = true;
        for (number, (names, is)) in all.enumerate().skip(from) {
            let description = is.json().to_string();
            if description.len() > MAX_LENGTH {
                // No client would read it.
                continue;
            }
            let [scope, handler, component] =
                names.map(|name| serde_json::Value::from(name.as_str()).to_string());
            let one = format!(
                "{{\"scope\": {scope}, \"handler\": {handler}, \"component\": {component}, \"is\": {description}}}"
            );
            if !first && json.len() + one.len() > PART {
                return Some(format!("{json}], \"next\": {number}}}"));
            }
            if !first {
                json.push_str(", ");
            }
            first = false;
            json.push_str(&one);
        }
        Some(json + "]}")
    }

    /// The answers of the handlers, by scope.
    fn ask_handlers(&self, question: &str) -> Option<String> {
        let answers = self.visible().filter_map(|(name, about)| {
            let answer = serde_json::from_str((about.answer)(question)?.as_str()).ok()?;
            Some((name.clone(), answer))
        });
        let answers: serde_json::Map<String, serde_json::Value> = answers.collect();
        (!answers.is_empty()).then(|| serde_json::Value::Object(answers).to_string())
    }

    /// Removes a client's INIT from the indexes.
    fn unlink(&mut self, client: ClientId) {
        if let Some(init) = self.inits.get(&client) {
            if let Some(task) = init.task {
                self.clients.remove(&task);
            }
            self.expiry.remove(&(init.until, client));
            self.tasks.forget_answer(init.text.as_ref().len());
        }
    }
}

impl Memory for ServerMemory {
    type Peer = ReturnPath;
    type Text = HeapText;
    type Tasks = TaskTable;

    fn tasks(&self) -> &TaskTable {
        &self.tasks
    }

    fn tasks_mut(&mut self) -> &mut TaskTable {
        &mut self.tasks
    }

    fn scope(&self, name: &str) -> Option<Scope> {
        let scope = self.scope_numbers.get(name).copied();
        scope.filter(|scope| !self.tasks.hides(*scope))
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
        u32::try_from(self.limits.longest_message()).ok()
    }

    fn answer(&mut self, question: &str) -> Option<&str> {
        self.answer = match question {
            "tasks" => {
                let tasks = self.tasks.list(now(), |scope| self.scope_name(scope));
                TaskList::of(tasks.collect(), self.tasks.running_elsewhere()).into_json()
            }
            "describe" => self.describe(""),
            other => match other.strip_prefix("describe ") {
                Some(of) => self.describe(of),
                None => self.ask_handlers(other),
            },
        };
        self.answer.as_deref()
    }

    fn last_id(&self) -> Option<TaskId> {
        self.ids.as_ref()?.last()
    }

    fn can_hold(&self) -> bool {
        self.held.len() < self.limits.held
    }

    fn hold(&mut self, waiter: Waiter<ReturnPath>) -> Result<(), Waiter<ReturnPath>> {
        if !self.can_hold() {
            return Err(waiter);
        }
        self.held.push(waiter);
        Ok(())
    }

    fn release(
        &mut self,
        wanted: impl Fn(&mut Waiter<ReturnPath>) -> bool,
    ) -> Option<Waiter<ReturnPath>> {
        let index = self.held.iter_mut().position(wanted)?;
        Some(self.held.swap_remove(index))
    }

    fn next_answer(&self) -> Instant {
        let deadlines = self.held.iter().map(|waiter| waiter.deadline);
        deadlines.min().unwrap_or(Instant::NEVER)
    }

    fn last_init(&self, client: &ClientId) -> Option<&LastInit<HeapText>> {
        self.inits.get(client)
    }

    fn init_of(&self, task: TaskId) -> Option<&LastInit<HeapText>> {
        let client = self.clients.get(&task)?;
        self.inits.get(client)
    }

    fn remember(&mut self, client: &ClientId, until: Instant) -> Option<&mut LastInit<HeapText>> {
        if self.inits.len() >= self.limits.clients && !self.inits.contains_key(client) {
            self.full_until = until;
            return None;
        }
        self.unlink(*client);
        let init = self.inits.entry(*client);
        Some(init.or_insert_with(|| LastInit::new(*client)))
    }

    fn on_heard(
        &mut self,
        now: Instant,
        _peer: &ReturnPath,
        _envelope: &Envelope,
        _init: bool,
    ) -> u64 {
        // INITs are not dropped early. An INIT rejected for lack of space may come from any client.
        if now < self.full_until { u64::MAX } else { 0 }
    }

    fn on_remembered(&mut self, client: &ClientId) {
        let Some(init) = self.inits.get(client) else {
            return;
        };
        self.tasks.count_answer(init.text.as_ref().len());
        if let Some(task) = init.task {
            self.clients.insert(task, *client);
        }
        if init.until != Instant::NEVER {
            self.expiry.insert((init.until, *client));
        }
    }

    fn forget_inits(&mut self, now: Instant) {
        while let Some((until, client)) = self.expiry.first().copied()
            && until <= now
        {
            self.unlink(client);
            self.inits.remove(&client);
        }
    }

    fn next_forgetting(&self) -> Instant {
        self.expiry
            .first()
            .map_or(Instant::NEVER, |(until, _)| *until)
    }
}

#[cfg(test)]
mod tests {
    use core::time::Duration;
    use std::sync::Arc;

    use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, KEEP_INIT, TaskEvent};
    use ztl_core::reply::Reply;

    use super::*;
    use crate::describe::{ComponentDescription, GoalRule, ScopeDescriptions, described};
    use crate::native::peers::PeerId;

    #[test]
    fn a_resent_init_that_was_rejected_for_space_is_not_started() {
        let mut heap = ServerMemory::new(Limits {
            clients: 1,
            ..Limits::default()
        });
        let about = ScopeInfo {
            components: Box::new(Arc::default),
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
            let out = &mut |_: ReturnPath, _: &Reply<'_>| {};
            server.handle_timeout(now, out);
            let action = server.handle_request(
                now,
                ReturnPath::Native(PeerId::default(), Box::default()),
                Some(envelope),
                body,
                out,
            );
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
        assert!(!init(later, 2, 2), "it was rejected before");
        assert!(init(later + KEEP_INIT, 3, 2));
    }

    #[test]
    fn descriptions_come_in_parts_and_only_from_scopes_that_the_client_may_use() {
        let mut heap = ServerMemory::new(Limits::default());
        for scope in ["/lab", "/secret"] {
            let component = |number: u32| {
                // Component 3 is too long to be sent.
                let length = if number == 3 { MAX_LENGTH } else { 30 << 10 };
                let is = ComponentDescription {
                    about: Some("x".repeat(length).into()),
                    ..described(GoalRule::Any)
                };
                (number.to_string(), is)
            };
            let components = (0..6).map(component).collect();
            let all = Arc::new(ScopeDescriptions::from([("arm".to_owned(), components)]));
            let about = ScopeInfo {
                components: Box::new(move || Arc::clone(&all)),
                describe: Box::new(String::new),
                answer: Box::new(|_| None),
                names_unknown_ids: true,
            };
            heap.register(scope, about);
        }
        let ask = |heap: &mut ServerMemory, scope: &str| {
            let (mut from, mut names, mut parts) = (0, Vec::new(), 0);
            loop {
                let question = format!("describe {scope};{from}");
                let answer = heap.answer(&question).expect("known");
                assert!(answer.len() < PART + 100);
                let answer: serde_json::Value = serde_json::from_str(answer).expect("JSON");
                let listed = answer["components"].as_array().expect("a list");
                names.extend(
                    listed
                        .iter()
                        .map(|it| format!("{}{}", it["scope"], it["component"])),
                );
                parts += 1;
                match answer["next"].as_u64() {
                    Some(next) => from = next,
                    None => return (parts, names.len(), names.concat().contains("secret")),
                }
            }
        };
        assert_eq!(ask(&mut heap, ""), (5, 10, true));
        assert_eq!(ask(&mut heap, "/lab"), (3, 5, false));
        assert_eq!(ask(&mut heap, "/other"), (1, 0, false));
        heap.hide(|scope| scope == "/secret");
        assert_eq!(ask(&mut heap, ""), (3, 5, false));
        assert_eq!(ask(&mut heap, "/secret"), (1, 0, false));
        assert!(heap.answer("describe ;x").is_none());
    }
}
