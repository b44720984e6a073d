//! A dispatcher's memory on the heap: the same rules, as many tasks as are allowed.

use std::collections::{BTreeSet, HashMap};

use ztl_core::store::{Full, Scope, Store, Task, Text, Waiter};
use ztl_core::{Instant, TaskId};

/// How many tasks are remembered, running and ended together.
pub(super) const MAX_TASKS: usize = 10_000;
/// How many answers are held at a time.
pub(super) const MAX_HELD: usize = 10_000;

/// The way back to a client: its ROUTER identity, its envelope, the empty delimiter.
pub(super) type Peer = Vec<Vec<u8>>;

/// A text that grows as needed.
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
        self.0.push_str(text);
    }
}

#[derive(Debug, Default)]
pub(super) struct Heap {
    names: Vec<String>,
    scopes: HashMap<String, Scope>,
    tasks: HashMap<TaskId, Task<Grown>>,
    /// The ended tasks, oldest end first.
    ends: BTreeSet<(Instant, TaskId)>,
    held: Vec<Waiter<Peer>>,
}

impl Heap {
    /// Makes a scope known, and says its place.
    pub(super) fn register(&mut self, name: &str) -> Scope {
        if let Some(scope) = self.scopes.get(name) {
            return *scope;
        }
        // More scopes than 65,536 would need as many calls; the last place is then shared.
        let scope = Scope(u16::try_from(self.names.len()).unwrap_or(u16::MAX));
        self.names.push(name.to_owned());
        self.scopes.insert(name.to_owned(), scope);
        scope
    }
}

impl Store for Heap {
    type Peer = Peer;
    type Text = Grown;

    fn scope(&self, name: &str) -> Option<Scope> {
        self.scopes.get(name).copied()
    }

    fn scope_name(&self, scope: Scope) -> &str {
        self.names
            .get(usize::from(scope.0))
            .map_or("", String::as_str)
    }

    fn task(&self, id: TaskId) -> Option<&Task<Grown>> {
        self.tasks.get(&id)
    }

    fn task_mut(&mut self, id: TaskId) -> Option<&mut Task<Grown>> {
        self.tasks.get_mut(&id)
    }

    fn insert(&mut self, id: TaskId, task: Task<Grown>) -> Result<(), Full<()>> {
        if self.tasks.len() >= MAX_TASKS {
            return Err(Full(()));
        }
        self.tasks.insert(id, task);
        Ok(())
    }

    fn remove(&mut self, id: TaskId) {
        if let Some(Task {
            ended: Some(ended), ..
        }) = self.tasks.remove(&id)
        {
            self.ends.remove(&(ended, id));
        }
    }

    fn on_ended(&mut self, id: TaskId) {
        if let Some(ended) = self.tasks.get(&id).and_then(|task| task.ended) {
            self.ends.insert((ended, id));
        }
    }

    fn oldest_end(&self) -> Option<(TaskId, Instant)> {
        self.ends.first().map(|(ended, id)| (*id, *ended))
    }

    fn tasks(&self) -> usize {
        self.tasks.len()
    }

    fn hold(&mut self, waiter: Waiter<Peer>) -> Result<(), Full<Waiter<Peer>>> {
        if self.held.len() >= MAX_HELD {
            return Err(Full(waiter));
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
}
