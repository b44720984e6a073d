//! What a dispatcher remembers besides its tasks: held answers, and the last INIT of each client.
//!
//! The rules are the dispatcher's; a memory only keeps. [`Fixed`] needs no heap and is for a
//! microcontroller; `ztl-std` has one that grows.

use crate::envelope::ClientId;
use crate::lifecycle::State;
use crate::repr::put_yaml;
use crate::sink::Sink;
use crate::tasks::{TaskTable, Tasks, Text, take_out};
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
    /// The same, and for a moment after it the end, to tell both at once.
    EarlyEnd,
    /// The decision too, asked for by `outcome`.
    Outcome,
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
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum First {
    /// Nothing yet: its task is undecided.
    Pending,
    /// It was answered with this state and a text that is kept.
    Answered(State),
    /// The client was told that it was never seen; it is refused if it still comes.
    Void,
}

/// The last INIT of a client, so that it never acts twice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LastInit<T> {
    /// Whose.
    pub client: ClientId,
    /// Number of the request.
    pub number: u64,
    /// Tells it from another INIT with this number: a check sum of its scope and payload.
    pub check: u32,
    /// What became of it.
    pub first: First,
    /// Its task, if it has one.
    pub task: Option<TaskId>,
    /// The answer's text.
    pub text: T,
    /// Until when it is remembered; [`Instant::NEVER`] while it is pending.
    pub until: Instant,
}

impl<T: Text> LastInit<T> {
    /// Of a client of which nothing is known.
    #[must_use]
    pub fn new(client: ClientId) -> Self {
        Self {
            client,
            number: 0,
            check: 0,
            first: First::Void,
            task: None,
            text: T::default(),
            until: Instant::NEVER,
        }
    }
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
    fn answer(&mut self, _question: &str) -> Option<&str> {
        None
    }

    /// Whether another answer can be held.
    fn can_hold(&self) -> bool;
    /// Adds a held answer; gives it back when no more fit.
    ///
    /// # Errors
    /// The waiter, when there is no room for it.
    fn hold(&mut self, waiter: Waiter<Self::Peer>) -> Result<(), Waiter<Self::Peer>>;
    /// Takes out a held answer that is wanted. Each is shown, and may be changed, until one is.
    fn release(
        &mut self,
        wanted: impl Fn(&mut Waiter<Self::Peer>) -> bool,
    ) -> Option<Waiter<Self::Peer>>;
    /// When the first of the held answers is due; [`Instant::NEVER`] without any.
    fn next_answer(&self) -> Instant;

    /// The last INIT of a client.
    fn last_init(&self, client: &ClientId) -> Option<&LastInit<Self::Text>>;
    /// The last INIT of a client that led to this task, if it is still its last.
    fn init_of(&self, task: TaskId) -> Option<&LastInit<Self::Text>>;
    /// A client's last INIT, to be changed; a void one if it has none, and `None` when no more clients
    /// fit.
    fn remember(&mut self, client: &ClientId) -> Option<&mut LastInit<Self::Text>>;
    /// Told when the last INIT of a client has been changed, so that a memory can keep an order.
    fn on_remembered(&mut self, client: &ClientId);
    /// Forgets those whose time has passed.
    fn forget_inits(&mut self, now: Instant);
    /// The first time at which one may be forgotten; [`Instant::NEVER`] when there is none.
    fn next_forgetting(&self) -> Instant;
}

/// A memory without a heap: `SCOPES` scopes, `TASKS` tasks with texts of at most `TEXT` bytes, and
/// `HELD` answers held at a time; the last INIT of as many clients.
// In this order, the largest last: a Cortex-M0 reaches what comes first with shorter code.
#[derive(Debug)]
#[repr(C)]
pub struct Fixed<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize> {
    scopes: [&'static str; SCOPES],
    held: heapless::Vec<Waiter<P>, HELD>,
    tasks: TaskTable<TaskId, Scope, TASKS, TEXT>,
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

    fn can_hold(&self) -> bool {
        !self.held.is_full()
    }

    fn hold(&mut self, waiter: Waiter<P>) -> Result<(), Waiter<P>> {
        self.held.push(waiter)
    }

    fn release(&mut self, wanted: impl Fn(&mut Waiter<P>) -> bool) -> Option<Waiter<P>> {
        take_out(&mut self.held, wanted)
    }

    fn next_answer(&self) -> Instant {
        let deadlines = self.held.iter().map(|waiter| waiter.deadline);
        deadlines.fold(Instant::NEVER, Ord::min)
    }

    fn last_init(&self, client: &ClientId) -> Option<&LastInit<Self::Text>> {
        self.inits.iter().find(|init| init.client == *client)
    }

    fn init_of(&self, task: TaskId) -> Option<&LastInit<Self::Text>> {
        self.inits.iter().find(|init| init.task == Some(task))
    }

    fn remember(&mut self, client: &ClientId) -> Option<&mut LastInit<Self::Text>> {
        let known = self.inits.iter().position(|init| init.client == *client);
        let place = known.unwrap_or(self.inits.len());
        if known.is_none() {
            self.inits.push(LastInit::new(*client)).ok()?;
        }
        self.inits.get_mut(place)
    }

    fn on_remembered(&mut self, _client: &ClientId) {}

    fn forget_inits(&mut self, now: Instant) {
        while take_out(&mut self.inits, |init| init.until <= now).is_some() {}
    }

    fn next_forgetting(&self) -> Instant {
        let times = self.inits.iter().map(|init| init.until);
        times.fold(Instant::NEVER, Ord::min)
    }
}
