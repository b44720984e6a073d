//! What a dispatcher stores: the task table, held replies, and the last INIT of each client.
//!
//! The rules are the dispatcher's; a memory only stores. [`Fixed`] needs no heap and suits microcontrollers;
//! `ztl-std` has one that grows.

use crate::envelope::{ClientId, Envelope};
use crate::lifecycle::State;
use crate::repr::{put_yaml, put_yaml_small};
use crate::sink::Sink;
use crate::tasks::{StoredText, TaskTable, Tasks, take_out};
use crate::{Instant, TaskId};

/// A registered scope, by index.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Scope(pub u16);

/// What a held reply waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Awaited {
    /// The handler's decision about an INIT.
    Decision,
    /// Like [`Decision`](Self::Decision), then briefly for a final state, so that one reply reports both.
    EarlyEnd,
    /// The decision about an INIT, requested by `outcome`.
    Outcome,
    /// The final state of a task that is being aborted.
    Abort,
    /// The final state of a task, requested by a STATUS that waits.
    End,
}

/// A held reply: it is sent when the awaited event happens or the deadline passes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Waiter<P> {
    /// How the transport addresses the client.
    pub peer: P,
    /// The task concerned.
    pub task: TaskId,
    /// The event that releases the reply.
    pub awaited: Awaited,
    /// When the reply is sent in any case.
    pub deadline: Instant,
}

/// The state of a client's last INIT.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum First {
    /// The task is not decided yet.
    Pending,
    /// Answered with this state and the stored text.
    Answered(State),
    /// The client was told that the INIT never arrived; if it still arrives, it is rejected.
    Void,
}

/// A client's last INIT, stored so that it never starts a second task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LastInit<T> {
    /// The client.
    pub client: ClientId,
    /// The request's number.
    pub number: u64,
    /// Checksum of scope and payload: detects another INIT under the same number.
    pub check: u32,
    /// What became of it.
    pub first: First,
    /// The task that it started, if any.
    pub task: Option<TaskId>,
    /// Whether the client is known to have the reply, because it has asked about the task.
    pub received: bool,
    /// Text of the reply.
    pub text: T,
    /// When it expires; [`Instant::NEVER`] while it is pending.
    pub until: Instant,
}

impl<T: StoredText> LastInit<T> {
    /// An empty record for a client without one.
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

/// What a dispatcher needs to store.
pub trait Memory {
    /// How the transport addresses a client: a ZeroMQ envelope, a connection number.
    type Peer;
    /// How texts are stored.
    type Text: StoredText;
    /// The task table.
    type Tasks: Tasks<Id = TaskId, Extra = Scope, Text = Self::Text>;
    /// Whether an ended task expires. If not, it is dropped only when its slot is needed.
    const ENDS_EXPIRE: bool = true;

    /// The task table.
    fn tasks(&self) -> &Self::Tasks;
    /// The task table, mutable.
    fn tasks_mut(&mut self) -> &mut Self::Tasks;

    /// The scope with this name, compared byte for byte.
    fn scope(&self, name: &str) -> Option<Scope>;
    /// The name of a scope; empty if it was never registered.
    fn scope_name(&self, scope: Scope) -> &str;
    /// Writes a scope's name as a YAML string in double quotes, for `$ztl`.
    fn put_scope(&self, scope: Scope, sink: &mut dyn Sink) {
        put_yaml(self.scope_name(scope), sink);
    }
    /// Writes what each scope offers, for `$ztl`, as a YAML flow mapping.
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

    /// Answers a question to the reserved scope that is not part of the protocol; `None` if it is unknown.
    /// Defaults to `None`.
    fn answer(&mut self, _question: &str) -> Option<&str> {
        None
    }

    /// The last task id that may be given; `None`, the default, if all may.
    fn last_id(&self) -> Option<TaskId> {
        None
    }

    /// Whether one more reply can be held.
    fn can_hold(&self) -> bool;
    /// Adds a held reply.
    ///
    /// # Errors
    /// Returns the waiter if there is no room.
    fn hold(&mut self, waiter: Waiter<Self::Peer>) -> Result<(), Waiter<Self::Peer>>;
    /// Removes and returns the first held reply that is `wanted`. The closure may change each one it sees.
    fn release(
        &mut self,
        wanted: impl Fn(&mut Waiter<Self::Peer>) -> bool,
    ) -> Option<Waiter<Self::Peer>>;
    /// The earliest deadline of the held replies; [`Instant::NEVER`] if there are none.
    fn next_answer(&self) -> Instant;

    /// A client's last INIT.
    fn last_init(&self, client: &ClientId) -> Option<&LastInit<Self::Text>>;
    /// The INIT that started this task, if it is still its client's last.
    fn init_of(&self, task: TaskId) -> Option<&LastInit<Self::Text>>;
    /// A client's last INIT, mutable: a void record if there was none, `None` if there is no room.
    ///
    /// May evict another client's record. An INIT that was evicted or found no room can still arrive again
    /// until `until`; [`on_heard`](Self::on_heard) guards against that.
    fn remember(&mut self, client: &ClientId, until: Instant) -> Option<&mut LastInit<Self::Text>>;
    /// Called after a client's last INIT has changed, so that the memory can keep an order.
    fn on_remembered(&mut self, client: &ClientId);
    /// Called for each request in our envelope, before it takes effect. Returns the number from which on an
    /// INIT of this client is certainly new, if the client has no record: 0 unless a record was evicted early
    /// or found no room.
    fn on_heard(
        &mut self,
        now: Instant,
        peer: &Self::Peer,
        envelope: &Envelope,
        is_init: bool,
    ) -> u64;
    /// Called when a client asks about a task. Returns whether the task is from its last INIT and a held
    /// reply to that INIT must be sent now, because its record may be evicted from here on.
    ///
    /// Defaults to `false`.
    fn on_asked_about(&mut self, _client: &ClientId, _task: TaskId) -> bool {
        false
    }
    /// Drops expired INITs.
    fn forget_inits(&mut self, now: Instant);
    /// When the next INIT expires; [`Instant::NEVER`] if none does.
    fn next_forgetting(&self) -> Instant;
}

/// The highest request number of a client.
#[derive(Debug, Clone)]
struct Heard<P> {
    /// The start of the client's id, which is random.
    client: u32,
    number: u32,
    /// Where its last request came from.
    peer: P,
}

/// A memory without a heap: `SCOPES` scopes, `TASKS` tasks with texts of at most `TEXT` bytes, `HELD` held
/// replies, and the last INIT of `HELD` clients. An ended task is kept until its slot is needed.
///
/// To make room for an INIT, it evicts a record whose client has the reply, or which was rejected or void.
/// After that, an INIT from a client without a record counts as new only if its number is higher than every
/// number heard from that client (`docs/protocol.md`, 9.5).
#[derive(Debug)]
pub struct Fixed<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize> {
    scopes: [&'static str; SCOPES],
    /// Until when an INIT that was evicted or found no room can arrive again.
    forgotten: Instant,
    heard: heapless::Vec<Heard<P>, HELD>,
    held: [Option<Waiter<P>>; HELD],
    tasks: TaskTable<TaskId, Scope, TASKS, TEXT>,
    inits: [Option<LastInit<heapless::String<TEXT>>>; HELD],
}

impl<P, const SCOPES: usize, const TASKS: usize, const TEXT: usize, const HELD: usize>
    Fixed<P, SCOPES, TASKS, TEXT, HELD>
{
    /// Creates an empty memory with these scopes. Their names may contain printable characters beyond ASCII,
    /// but no others: `$ztl` writes them unescaped.
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
        let index = self.scopes.iter().position(|scope| *scope == name)?;
        u16::try_from(index).ok().map(Scope)
    }

    fn scope_name(&self, scope: Scope) -> &str {
        self.scopes
            .get(usize::from(scope.0))
            .copied()
            .unwrap_or_default()
    }

    /// Leaves characters beyond ASCII unescaped.
    fn put_scope(&self, scope: Scope, sink: &mut dyn Sink) {
        put_yaml_small(self.scope_name(scope), sink);
    }

    fn put_scopes(&self, sink: &mut dyn Sink) {
        sink.put(b"{");
        for index in 0..SCOPES {
            if index > 0 {
                sink.put(b", ");
            }
            self.put_scope(Scope(index as u16), sink);
            sink.put(b": {}");
        }
        sink.put(b"}");
    }

    fn can_hold(&self) -> bool {
        self.held.iter().any(Option::is_none)
    }

    fn hold(&mut self, waiter: Waiter<P>) -> Result<(), Waiter<P>> {
        match self.held.iter_mut().find(|slot| slot.is_none()) {
            Some(slot) => *slot = Some(waiter),
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
            |slot: &Option<LastInit<_>>| matches!(slot, Some(init) if init.client == *client);
        let known = self.inits.iter().position(is_its);
        let index = known.or_else(|| self.inits.iter().position(Option::is_none));
        if let Some(index) = index {
            let slot = self.inits.get_mut(index)?;
            return Some(slot.get_or_insert_with(|| LastInit::new(*client)));
        }
        self.forgotten = until;
        // Evict a record whose client has the reply, or which has no task.
        let evictable = |init: &&mut LastInit<_>| {
            init.task.is_none() || init.received && init.first != First::Pending
        };
        let init = self.inits.iter_mut().flatten().find(evictable)?;
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
            // An INIT does not count here: it can arrive again after its record is evicted.
            let heard = Heard {
                client,
                number,
                peer,
            };
            if let Err(heard) = self.heard.push(heard) {
                // The client that used this connection before is gone.
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
