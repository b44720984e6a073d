//! What a dispatcher remembers besides its tasks: held answers, and the last INIT of each client.
//!
//! The rules are the dispatcher's; a memory only keeps. [`Fixed`] needs no heap and is for a
//! microcontroller; `ztl-std` has one that grows.

use crate::envelope::{ClientId, Envelope};
use crate::lifecycle::State;
use crate::repr::{put_yaml, put_yaml_small};
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
    /// Whether the client has shown that it has the answer: it has asked about the task.
    pub received: bool,
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
            received: false,
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
    /// Whether an ended task is forgotten when its time has passed; else only when another needs its place.
    const ENDS_EXPIRE: bool = true;

    /// The tasks.
    fn tasks(&self) -> &Self::Tasks;
    /// The tasks, to be changed.
    fn tasks_mut(&mut self) -> &mut Self::Tasks;

    /// The scope of this name, compared byte for byte.
    fn scope(&self, name: &str) -> Option<Scope>;
    /// The name of a scope; empty for one that was never registered.
    fn scope_name(&self, scope: Scope) -> &str;
    /// Writes the name of a scope in YAML's double quotes, for `$ztl`.
    fn put_scope(&self, scope: Scope, sink: &mut dyn Sink) {
        put_yaml(self.scope_name(scope), sink);
    }
    /// Writes what the scopes offer, for `$ztl`: a mapping in YAML's flow style.
    fn put_scopes(&self, sink: &mut dyn Sink);

    /// Whether the answer about an id that the scope does not know names that id, as the original's task
    /// server does, or not, as its simple server. Default: it does.
    fn names_unknown_ids(&self, _scope: Scope) -> bool {
        true
    }

    /// The longest message that comes through to here, in bytes, for `$ztl`; `None`, the default, where none is
    /// too long, or what is too long is answered.
    fn longest_message(&self) -> Option<u32> {
        None
    }

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
    /// fit. For it a memory may forget another's. That one, and one for which there is no room, may come again
    /// `until` then: [`on_heard`](Self::on_heard) makes up for it.
    fn remember(&mut self, client: &ClientId, until: Instant) -> Option<&mut LastInit<Self::Text>>;
    /// Told when the last INIT of a client has been changed, so that a memory can keep an order.
    fn on_remembered(&mut self, client: &ClientId);
    /// Told of each request in our envelope, before it is acted upon. Says from which number on an INIT
    /// of this client is surely a new one, if none of its is remembered: 0 while none was forgotten before its
    /// time, and none found no room.
    fn on_heard(
        &mut self,
        now: Instant,
        peer: &Self::Peer,
        envelope: &Envelope,
        is_init: bool,
    ) -> u64;
    /// Told that a client asks about a task. Says whether it had that from its last INIT, and whoever
    /// still waits for the INIT's answer is to be answered, since it may be forgotten from now on.
    ///
    /// Default: that never matters.
    fn on_asked_about(&mut self, _client: &ClientId, _task: TaskId) -> bool {
        false
    }
    /// Forgets those whose time has passed.
    fn forget_inits(&mut self, now: Instant);
    /// The first time at which one may be forgotten; [`Instant::NEVER`] when there is none.
    fn next_forgetting(&self) -> Instant;
}

/// The highest number of a client's requests.
#[derive(Debug, Clone)]
struct Heard<P> {
    /// The beginning of its id, which is random.
    client: u32,
    number: u32,
    /// From where its last request came.
    peer: P,
}

/// A memory without a heap: `SCOPES` scopes, `TASKS` tasks with texts of at most `TEXT` bytes, and
/// `HELD` answers held at a time; the last INIT of as many clients. A task that has ended is remembered until
/// another needs its place.
///
/// When it needs a place for an INIT, it forgets one whose client has its answer, or that was refused or
/// given up. What then comes of a client of which it knows no INIT is new only if all that was heard of
/// this client has a lower number (`docs/protocol.md`, 9.5).
// In this order, the largest last: a Cortex-M0 reaches what comes first with shorter code.
#[derive(Debug)]
#[repr(C)]
pub struct Fixed<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize> {
    scopes: [&'static str; SCOPES],
    /// Until when what was forgotten for another, or had no room, may come again.
    forgotten: Instant,
    heard: heapless::Vec<Heard<P>, HELD>,
    held: [Option<Waiter<P>>; HELD],
    tasks: TaskTable<TaskId, Scope, TASKS, TEXT>,
    inits: [Option<LastInit<heapless::String<TEXT>>>; HELD],
}

impl<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize>
    Fixed<P, SCOPES, TASKS, TEXT, HELD>
{
    /// An empty memory that knows these scopes. What of their names is beyond ASCII has to be letters and signs that can be
    /// printed: `$ztl` shows it as it is, and a reader of YAML refuses others.
    #[must_use]
    pub const fn new(scopes: [&'static str; SCOPES]) -> Self {
        Self {
            scopes,
            forgotten: Instant::ZERO,
            heard: heapless::Vec::new(),
            tasks: TaskTable::new(),
            held: [const { None }; HELD],
            inits: [const { None }; HELD],
        }
    }
}

impl<
    P: Clone + PartialEq,
    const SCOPES: usize,
    const TASKS: usize,
    const TEXT: usize,
    const HELD: usize,
> Memory for Fixed<P, SCOPES, TASKS, TEXT, HELD>
{
    type Peer = P;
    type Text = heapless::String<TEXT>;
    type Tasks = TaskTable<TaskId, Scope, TASKS, TEXT>;
    const ENDS_EXPIRE: bool = false;

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

    /// Letters beyond ASCII stay what they are.
    fn put_scope(&self, scope: Scope, sink: &mut dyn Sink) {
        put_yaml_small(self.scope_name(scope), sink);
    }

    fn put_scopes(&self, sink: &mut dyn Sink) {
        sink.put(b"{");
        for place in 0..SCOPES {
            if place > 0 {
                sink.put(b", ");
            }
            self.put_scope(Scope(place as u16), sink);
            sink.put(b": {}");
        }
        sink.put(b"}");
    }

    fn can_hold(&self) -> bool {
        self.held.iter().any(Option::is_none)
    }

    fn hold(&mut self, waiter: Waiter<P>) -> Result<(), Waiter<P>> {
        match self.held.iter_mut().find(|place| place.is_none()) {
            Some(place) => *place = Some(waiter),
            None => return Err(waiter),
        }
        Ok(())
    }

    fn release(&mut self, wanted: impl Fn(&mut Waiter<P>) -> bool) -> Option<Waiter<P>> {
        take_out(&mut self.held, wanted)
    }

    fn next_answer(&self) -> Instant {
        let deadlines = self.held.iter().flatten().map(|waiter| waiter.deadline);
        deadlines.fold(Instant::NEVER, Ord::min)
    }

    fn last_init(&self, client: &ClientId) -> Option<&LastInit<Self::Text>> {
        self.inits
            .iter()
            .flatten()
            .find(|init| init.client == *client)
    }

    fn init_of(&self, task: TaskId) -> Option<&LastInit<Self::Text>> {
        self.inits
            .iter()
            .flatten()
            .find(|init| init.task == Some(task))
    }

    fn remember(&mut self, client: &ClientId, until: Instant) -> Option<&mut LastInit<Self::Text>> {
        let is_its =
            |place: &Option<LastInit<_>>| matches!(place, Some(init) if init.client == *client);
        let known = self.inits.iter().position(is_its);
        let place = known.or_else(|| self.inits.iter().position(Option::is_none));
        if let Some(place) = place {
            let place = self.inits.get_mut(place)?;
            return Some(place.get_or_insert_with(|| LastInit::new(*client)));
        }
        self.forgotten = until;
        // One whose answer its client has, or that has no task.
        let over = |init: &&mut LastInit<_>| {
            init.task.is_none() || init.received && init.first != First::Pending
        };
        let init = self.inits.iter_mut().flatten().find(over)?;
        init.client = *client;
        Some(init)
    }

    fn on_remembered(&mut self, _client: &ClientId) {}

    fn on_heard(&mut self, now: Instant, peer: &P, envelope: &Envelope, is_init: bool) -> u64 {
        let number = u32::try_from(envelope.number).unwrap_or(u32::MAX);
        let [a, b, c, d, ..] = envelope.client.0;
        let client = u32::from_ne_bytes([a, b, c, d]);
        let peer = peer.clone();
        let mut new_from = u64::MAX;
        if let Some(known) = self.heard.iter_mut().find(|heard| heard.client == client) {
            new_from = known.number.checked_add(1).map_or(u64::MAX, u64::from);
            known.number = known.number.max(number);
            known.peer = peer;
        } else if !is_init {
            // Not by an INIT, which may come again when it and those after it are forgotten.
            let heard = Heard {
                client,
                number,
                peer,
            };
            if let Err(heard) = self.heard.push(heard) {
                // Who had its connection before has gone.
                let gone = self.heard.iter().position(|gone| gone.peer == heard.peer);
                if let Some(gone) = self.heard.get_mut(gone.unwrap_or_default()) {
                    *gone = heard;
                }
            }
        }
        if now < self.forgotten { new_from } else { 0 }
    }

    fn on_asked_about(&mut self, client: &ClientId, task: TaskId) -> bool {
        let its = |init: &&mut LastInit<_>| init.client == *client && init.task == Some(task);
        let init = self.inits.iter_mut().flatten().find(its);
        init.map(|init| init.received = true).is_some()
    }

    fn forget_inits(&mut self, now: Instant) {
        while take_out(&mut self.inits, |init| init.until <= now).is_some() {}
    }

    fn next_forgetting(&self) -> Instant {
        let times = self.inits.iter().flatten().map(|init| init.until);
        times.fold(Instant::NEVER, Ord::min)
    }
}
