//! What a dispatcher remembers besides its tasks: held answers, and the last INIT of each client.
//!
//! The rules are the dispatcher's; a memory only keeps. [`Fixed`] needs no heap and is for a
//! microcontroller; `ztl-std` has one that grows.

use crate::envelope::ClientId;
use crate::lifecycle::State;
use crate::repr::put_yaml;
use crate::sink::Sink;
use crate::tasks::{TaskTable, Tasks, Text, swap_with_last};
use crate::{Instant, TaskId};

/// Which of the registered scopes, by its place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Scope(pub u16);

/// What a held answer waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Awaited {
    /// The handler's decision on an INIT.
    Decision,
    /// The decision too, asked for by `outcome`.
    Outcome,
    /// For a moment the end of a task that was just accepted, to tell both at once.
    EarlyEnd,
    /// The end of a task that is being aborted.
    Abort,
    /// The end of a task, asked for by a STATUS that waits.
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

/// What became of a client's last INIT.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum First<T> {
    /// Nothing yet: this task is undecided.
    Pending(TaskId),
    /// It was answered so.
    Answered {
        /// The answer's state.
        state: State,
        /// The answer's id; `None` is -1.
        id: Option<TaskId>,
        /// The answer's payload.
        text: T,
    },
    /// The client was told that it was never seen; it is refused if it still comes.
    Void,
}

impl<T> First<T> {
    /// The task that the INIT led to.
    #[must_use]
    pub const fn task(&self) -> Option<TaskId> {
        match self {
            Self::Pending(task) => Some(*task),
            Self::Answered { id, .. } => *id,
            Self::Void => None,
        }
    }
}

/// The last INIT of a client, so that it never acts twice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LastInit<T> {
    /// Whose.
    pub client: ClientId,
    /// Number of the request.
    pub number: u64,
    /// Whether a quick end is to be told in place of the reply.
    pub early_end: bool,
    /// What became of it.
    pub first: First<T>,
    /// Until when it is remembered; `None` while it is pending.
    pub until: Option<Instant>,
}

/// What a dispatcher needs to remember.
pub trait Memory {
    /// How the transport finds a client: a ZeroMQ envelope, a connection's number.
    type Peer;
    /// How texts are kept.
    type Text: Text;
    /// The tasks.
    type Tasks: Tasks<Id = TaskId, Extra = Scope, Text = Self::Text>;

    /// The tasks.
    fn tasks(&self) -> &Self::Tasks;
    /// The tasks, to be changed.
    fn tasks_mut(&mut self) -> &mut Self::Tasks;

    /// The scope of this name, compared byte for byte.
    fn scope(&self, name: &str) -> Option<Scope>;
    /// The name of a scope; empty for one that was never registered.
    fn scope_name(&self, scope: Scope) -> &str;
    /// Writes what the scopes offer, for `$ztl`: a mapping in YAML's flow style.
    fn put_scopes(&self, sink: &mut dyn Sink);

    /// What the reserved scope answers to a question that is not the protocol's own, or `None`
    /// where it is not known. Default: no question is known.
    fn answer(&self, _question: &str) -> Option<impl AsRef<str>> {
        None::<&str>
    }

    /// Adds a held answer; gives it back when no more fit.
    ///
    /// # Errors
    /// The waiter, when there is no room for it.
    fn hold(&mut self, waiter: Waiter<Self::Peer>) -> Result<(), Waiter<Self::Peer>>;
    /// Every held answer.
    fn held(&self) -> &[Waiter<Self::Peer>];
    /// Takes out the held answer at this place of [`held`](Self::held); the last one moves there.
    fn release(&mut self, place: usize) -> Option<Waiter<Self::Peer>>;

    /// The last INIT of a client.
    fn last_init(&mut self, client: ClientId) -> Option<&mut LastInit<Self::Text>>;
    /// The last INIT of a client that led to this task, if it is still its last.
    fn init_of(&mut self, task: TaskId) -> Option<&mut LastInit<Self::Text>>;
    /// Adds a client's last INIT, or replaces the one before; `false` when no more clients fit.
    fn remember(&mut self, init: LastInit<Self::Text>) -> bool;
    /// Told when a client's last INIT, which asked for this task, has been answered and its time is
    /// known, so that a memory can keep an order.
    fn on_settled(&mut self, client: ClientId, task: TaskId);
    /// Forgets those whose time has passed.
    fn forget_inits(&mut self, now: Instant);
    /// The first time at which one may be forgotten.
    fn next_forgetting(&self) -> Option<Instant>;
}

/// A memory without a heap: `SCOPES` scopes, `TASKS` tasks with texts of at most `TEXT` bytes, and
/// `HELD` answers held at a time; the last INIT of as many clients.
#[derive(Debug)]
pub struct Fixed<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize> {
    scopes: [&'static str; SCOPES],
    tasks: TaskTable<TaskId, Scope, TASKS, TEXT>,
    held: heapless::Vec<Waiter<P>, HELD>,
    inits: heapless::Vec<LastInit<heapless::String<TEXT>>, HELD>,
}

impl<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize>
    Fixed<P, SCOPES, TASKS, TEXT, HELD>
{
    /// An empty memory that knows these scopes.
    #[must_use]
    pub const fn new(scopes: [&'static str; SCOPES]) -> Self {
        Self {
            scopes,
            tasks: TaskTable::new(),
            held: heapless::Vec::new(),
            inits: heapless::Vec::new(),
        }
    }
}

impl<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize> Memory
    for Fixed<P, SCOPES, TASKS, TEXT, HELD>
{
    type Peer = P;
    type Text = heapless::String<TEXT>;
    type Tasks = TaskTable<TaskId, Scope, TASKS, TEXT>;

    fn tasks(&self) -> &Self::Tasks {
        &self.tasks
    }

    fn tasks_mut(&mut self) -> &mut Self::Tasks {
        &mut self.tasks
    }

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

    fn put_scopes(&self, sink: &mut dyn Sink) {
        sink.put(b"{");
        for (place, scope) in self.scopes.iter().enumerate() {
            if place > 0 {
                sink.put(b", ");
            }
            put_yaml(scope, sink);
            sink.put(b": {}");
        }
        sink.put(b"}");
    }

    fn hold(&mut self, waiter: Waiter<P>) -> Result<(), Waiter<P>> {
        self.held.push(waiter)
    }

    fn held(&self) -> &[Waiter<P>] {
        &self.held
    }

    fn release(&mut self, place: usize) -> Option<Waiter<P>> {
        if place >= self.held.len() {
            return None;
        }
        swap_with_last(&mut self.held, place);
        self.held.pop()
    }

    fn last_init(&mut self, client: ClientId) -> Option<&mut LastInit<Self::Text>> {
        self.inits.iter_mut().find(|init| init.client == client)
    }

    fn init_of(&mut self, task: TaskId) -> Option<&mut LastInit<Self::Text>> {
        self.inits
            .iter_mut()
            .find(|init| init.first.task() == Some(task))
    }

    fn remember(&mut self, init: LastInit<Self::Text>) -> bool {
        match self
            .inits
            .iter_mut()
            .find(|known| known.client == init.client)
        {
            Some(known) => {
                *known = init;
                true
            }
            None => self.inits.push(init).is_ok(),
        }
    }

    fn on_settled(&mut self, _client: ClientId, _task: TaskId) {}

    fn forget_inits(&mut self, now: Instant) {
        let over = |init: &LastInit<_>| init.until.is_some_and(|until| until <= now);
        while let Some(place) = self.inits.iter().position(over) {
            swap_with_last(&mut self.inits, place);
            self.inits.pop();
        }
    }

    fn next_forgetting(&self) -> Option<Instant> {
        self.inits.iter().filter_map(|init| init.until).min()
    }
}
