//! Where a dispatcher remembers tasks and the clients that wait for an answer.
//!
//! The rules are the dispatcher's; a store only keeps. [`Fixed`] needs no heap and is for a
//! microcontroller; `ztl-std` has one that grows.

use crate::lifecycle::State;
use crate::{Instant, TaskId};

/// Which of the registered scopes, by its place in the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Scope(pub u16);

/// A task as a server remembers it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Task<T> {
    /// Under which scope it was asked for; other scopes do not know it.
    pub scope: Scope,
    /// Where it is in its life.
    pub state: State,
    /// Progress while it runs, the result or the reason once it has ended; `None` in words
    /// (Python's `None`) until something is known.
    pub text: T,
    /// When it ended; what is remembered longest is given up first, counted from here.
    pub ended: Option<Instant>,
}

/// A text that a store keeps: progress, result, reason.
pub trait Text: Default + AsRef<str> {
    /// Replaces the text; what does not fit is cut at a character's boundary.
    fn set(&mut self, text: &str);
}

impl<const N: usize> Text for heapless::String<N> {
    fn set(&mut self, text: &str) {
        self.clear();
        let fitting = text.floor_char_boundary(N);
        // Cannot fail: it was cut to fit.
        let _ = self.push_str(text.get(..fitting).unwrap_or_default());
    }
}

/// What a held answer waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Awaited {
    /// The handler's decision on an INIT.
    Decision,
    /// The end of a task that is being aborted.
    End,
}

/// A client whose answer is held back until something happens, or until a moment has passed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Waiter<P> {
    /// How the transport finds the client.
    pub peer: P,
    /// The task in question.
    pub task: TaskId,
    /// What must happen to it.
    pub awaited: Awaited,
    /// When it is answered in any case.
    pub deadline: Instant,
}

/// There is no room; what was to be stored comes back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Full<T>(pub T);

/// What a dispatcher needs to remember.
pub trait Store {
    /// How the transport finds a client: a ZeroMQ envelope, a connection's number.
    type Peer;
    /// How results are kept.
    type Text: Text;

    /// The scope of this name, compared byte for byte.
    fn scope(&self, name: &str) -> Option<Scope>;
    /// The name of a scope; empty for one that was never registered.
    fn scope_name(&self, scope: Scope) -> &str;

    /// The task with this id.
    fn task(&self, id: TaskId) -> Option<&Task<Self::Text>>;
    /// The task with this id, to be changed.
    fn task_mut(&mut self, id: TaskId) -> Option<&mut Task<Self::Text>>;
    /// Adds a task.
    ///
    /// # Errors
    /// [`Full`] when no more fit; the dispatcher then gives up the oldest end, or refuses.
    fn insert(&mut self, id: TaskId, task: Task<Self::Text>) -> Result<(), Full<()>>;
    /// Forgets a task.
    fn remove(&mut self, id: TaskId);
    /// Told once when a task has ended, so that a store can keep the order of the ends.
    fn on_ended(&mut self, id: TaskId);
    /// The task that ended first, of those still remembered.
    fn oldest_end(&self) -> Option<(TaskId, Instant)>;
    /// How many tasks are remembered.
    fn tasks(&self) -> usize;

    /// Adds a held answer.
    ///
    /// # Errors
    /// [`Full`] with the waiter when no more fit.
    fn hold(&mut self, waiter: Waiter<Self::Peer>) -> Result<(), Full<Waiter<Self::Peer>>>;
    /// Every held answer.
    fn held(&self) -> &[Waiter<Self::Peer>];
    /// Takes out the held answer at this place of [`held`](Self::held); the last one moves there.
    fn release(&mut self, place: usize) -> Option<Waiter<Self::Peer>>;
}

/// A store without a heap: `SCOPES` scopes, `TASKS` tasks with texts of at most `TEXT` bytes, and
/// `HELD` answers held at a time.
#[derive(Debug)]
pub struct Fixed<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize> {
    scopes: [&'static str; SCOPES],
    tasks: heapless::Vec<(TaskId, Task<heapless::String<TEXT>>), TASKS>,
    held: heapless::Vec<Waiter<P>, HELD>,
}

impl<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize>
    Fixed<P, SCOPES, TASKS, TEXT, HELD>
{
    /// An empty store that knows these scopes.
    #[must_use]
    pub const fn new(scopes: [&'static str; SCOPES]) -> Self {
        Self {
            scopes,
            tasks: heapless::Vec::new(),
            held: heapless::Vec::new(),
        }
    }
}

impl<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize> Store
    for Fixed<P, SCOPES, TASKS, TEXT, HELD>
{
    type Peer = P;
    type Text = heapless::String<TEXT>;

    fn scope(&self, name: &str) -> Option<Scope> {
        let place = self.scopes.iter().position(|scope| *scope == name)?;
        u16::try_from(place).ok().map(Scope)
    }

    fn scope_name(&self, scope: Scope) -> &str {
        self.scopes
            .get(usize::from(scope.0))
            .copied()
            .unwrap_or_default()
    }

    fn task(&self, id: TaskId) -> Option<&Task<Self::Text>> {
        let (_, task) = self.tasks.iter().find(|(known, _)| *known == id)?;
        Some(task)
    }

    fn task_mut(&mut self, id: TaskId) -> Option<&mut Task<Self::Text>> {
        let (_, task) = self.tasks.iter_mut().find(|(known, _)| *known == id)?;
        Some(task)
    }

    fn insert(&mut self, id: TaskId, task: Task<Self::Text>) -> Result<(), Full<()>> {
        self.tasks.push((id, task)).map_err(|_| Full(()))
    }

    fn remove(&mut self, id: TaskId) {
        self.tasks.retain(|(known, _)| *known != id);
    }

    fn on_ended(&mut self, _id: TaskId) {}

    fn oldest_end(&self) -> Option<(TaskId, Instant)> {
        self.tasks
            .iter()
            .filter_map(|(id, task)| Some((*id, task.ended?)))
            .min_by_key(|(id, ended)| (*ended, *id))
    }

    fn tasks(&self) -> usize {
        self.tasks.len()
    }

    fn hold(&mut self, waiter: Waiter<P>) -> Result<(), Full<Waiter<P>>> {
        self.held.push(waiter).map_err(Full)
    }

    fn held(&self) -> &[Waiter<P>] {
        &self.held
    }

    fn release(&mut self, place: usize) -> Option<Waiter<P>> {
        (place < self.held.len()).then(|| self.held.swap_remove(place))
    }
}
