//! The task table: ids, states and results.
//!
//! The rules are written once, in [`TaskRules`], for any storage ([`Tasks`]). [`TaskTable`] needs no heap;
//! `ztl-std` has a storage for thousands of tasks. To make room for a new task, the oldest ended task is
//! dropped; a running task never is.

use crate::Instant;
use crate::lifecycle::{Event, State};

/// A task in the task table. `X` is what the owner adds: a scope, a component.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Task<X, T> {
    /// Its state.
    pub state: State,
    /// Progress while the task runs; result or reason once it has ended.
    pub text: T,
    /// When the task ended; [`Instant::NEVER`] while it runs. The task that ended first is dropped first.
    pub ended: Instant,
    /// What the owner adds.
    pub extra: X,
}

impl<X, T: StoredText> Task<X, T> {
    /// Creates a task that is not decided yet.
    pub fn new(extra: X) -> Self {
        Self {
            state: State::Initiated,
            text: T::default(),
            ended: Instant::NEVER,
            extra,
        }
    }

    /// Applies an event and returns whether it changed anything: a final state never changes.
    pub fn apply(&mut self, now: Instant, event: Event, text: Option<&str>) -> bool {
        let Some(state) = self.state.after(event) else {
            return false;
        };
        self.state = state;
        if let Some(text) = text {
            self.text.set(text);
        }
        if state.is_final() {
            self.ended = now;
        }
        true
    }
}

/// Storage for a text: progress, result or reason.
pub trait StoredText: Default + AsRef<str> {
    /// Replaces the text. Text that does not fit is cut at a character boundary and ends in `…`.
    fn set(&mut self, text: &str);
}

/// Ends a text that was cut.
pub const CUT: &str = "…";

impl<const N: usize> StoredText for heapless::String<N> {
    fn set(&mut self, text: &str) {
        self.clear();
        if self.push_str(text).is_err() {
            push_cut(self, text);
        }
    }
}

/// Appends as much of `text` as fits, in whole characters, and `…` if it had to be cut. Returns whether it
/// was.
pub fn push_cut(kept: &mut heapless::string::StringView, text: &str) -> bool {
    let room = kept.capacity().saturating_sub(CUT.len());
    let fitting = text.floor_char_boundary(room.saturating_sub(kept.len()));
    // Neither push can fail: the capacity was checked.
    let _ = kept.push_str(text.get(..fitting).unwrap_or_default());
    let is_cut = fitting < text.len();
    if is_cut {
        let _ = kept.push_str(CUT);
    }
    is_cut
}

/// Every task in the table is running, so there is no room for another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NoRoom;

impl NoRoom {
    /// The error message.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        "too many tasks are running"
    }
}

impl core::fmt::Display for NoRoom {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl core::error::Error for NoRoom {}

/// A task as storage `K` holds it.
pub type TaskOf<K> = Task<<K as Tasks>::Extra, <K as Tasks>::Text>;

/// Removes and returns the first item that is `wanted`.
pub(crate) fn take_out<T>(
    slots: &mut [Option<T>],
    mut wanted: impl FnMut(&mut T) -> bool,
) -> Option<T> {
    for slot in slots {
        if slot.as_mut().is_some_and(&mut wanted) {
            return slot.take();
        }
    }
    None
}

/// Storage for tasks. It only stores; the rules are in [`TaskRules`].
pub trait Tasks {
    /// Identifies a task.
    type Id: Copy + Ord;
    /// What the owner adds to each task.
    type Extra;
    /// How texts are stored.
    type Text: StoredText;

    /// The task with this id.
    fn get(&self, id: Self::Id) -> Option<&TaskOf<Self>>;
    /// The task with this id, mutable.
    fn get_mut(&mut self, id: Self::Id) -> Option<&mut TaskOf<Self>>;
    /// Whether one more task may run, regardless of storage. Defaults to `true`.
    fn may_run(&self) -> bool {
        true
    }
    /// Makes room for one more task, by dropping the oldest ended task if necessary. Returns whether there is
    /// room.
    fn make_room(&mut self) -> bool;
    /// Adds a task under a new id; `None` if the table is full.
    fn insert(&mut self, id: Self::Id, task: TaskOf<Self>) -> Option<&mut TaskOf<Self>>;
    /// Drops a task.
    fn remove(&mut self, id: Self::Id);
    /// Called once when a task has ended, so that the storage can keep the order of ends.
    fn on_ended(&mut self, id: Self::Id);
    /// The task that ended first.
    fn oldest_end(&self) -> Option<(Self::Id, Instant)>;
    /// All tasks, in any order.
    fn iter(&self) -> impl Iterator<Item = (Self::Id, &TaskOf<Self>)>;
}

/// The rules for adding, changing and dropping tasks; the same for every storage.
pub trait TaskRules: Tasks {
    /// Adds a task. If the table is full, drops the oldest ended task to make room.
    ///
    /// # Errors
    /// [`NoRoom`] if every task is running.
    fn admit(&mut self, id: Self::Id, task: TaskOf<Self>) -> Result<&mut TaskOf<Self>, NoRoom> {
        if !self.may_run() || !self.make_room() {
            return Err(NoRoom);
        }
        self.insert(id, task).ok_or(NoRoom)
    }

    /// Applies an event to a task, see [`Task::apply`].
    fn apply(&mut self, now: Instant, id: Self::Id, event: Event, text: Option<&str>) -> bool {
        let Some(task) = self.get_mut(id) else {
            return false;
        };
        let changed = task.apply(now, event, text);
        if changed && task.state.is_final() {
            self.on_ended(id);
        }
        changed
    }

    /// Sets the progress of a running task; returns whether there is such a task.
    fn progress(&mut self, id: Self::Id, text: &str) -> bool {
        match self.get_mut(id) {
            Some(task) if !task.state.is_final() => {
                task.text.set(text);
                true
            }
            _ => false,
        }
    }

    /// Drops every task that ended at `end` or earlier.
    fn forget_until(&mut self, end: Instant) {
        while let Some((id, ended)) = self.oldest_end()
            && ended <= end
        {
            self.remove(id);
        }
    }
}

impl<T: Tasks + ?Sized> TaskRules for T {}

/// At most `N` tasks with texts of at most `TEXT` bytes, without a heap. `I` is the type of ids.
///
/// ```
/// use ztl_core::tasks::{Task, TaskRules, TaskTable, Tasks};
/// use ztl_core::{Event, Instant, State};
///
/// let mut table = TaskTable::<u8, (), 2, 16>::new();
/// let now = Instant::ZERO;
/// for id in [1, 2] {
///     table.admit(id, Task::new(())).unwrap();
///     table.apply(now, id, Event::Accept, None);
/// }
/// assert!(table.admit(3, Task::new(())).is_err(), "a running task is never dropped");
/// table.apply(now, 1, Event::Complete, Some("40.0"));
/// assert!(!table.apply(now, 1, Event::Abort, None), "a final state never changes");
/// table.admit(3, Task::new(())).unwrap();
/// assert!(table.get(1).is_none(), "the ended task made room");
/// assert_eq!(table.get(2).unwrap().state, State::Accepted);
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct TaskTable<I, X, const N: usize, const TEXT: usize> {
    // Slots instead of a compact list: closing a gap takes more flash on a Cortex-M0 than skipping it.
    slots: [Option<Slot<I, X, TEXT>>; N],
}

type Slot<I, X, const TEXT: usize> = (I, Task<X, heapless::String<TEXT>>);

impl<I, X, const N: usize, const TEXT: usize> TaskTable<I, X, N, TEXT> {
    /// An empty table.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            slots: [const { None }; N],
        }
    }

    /// Number of tasks.
    #[must_use]
    pub fn len(&self) -> usize {
        self.slots.iter().flatten().count()
    }

    /// Whether the table is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.slots.iter().all(Option::is_none)
    }

    /// All tasks, mutable.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut Slot<I, X, TEXT>> {
        self.slots.iter_mut().flatten()
    }
}

impl<I, X, const N: usize, const TEXT: usize> Default for TaskTable<I, X, N, TEXT> {
    fn default() -> Self {
        Self::new()
    }
}

impl<I: Copy + Ord, X, const N: usize, const TEXT: usize> Tasks for TaskTable<I, X, N, TEXT> {
    type Id = I;
    type Extra = X;
    type Text = heapless::String<TEXT>;

    fn get(&self, id: I) -> Option<&Task<X, Self::Text>> {
        let (_, task) = self.iter().find(|(known, _)| *known == id)?;
        Some(task)
    }

    fn get_mut(&mut self, id: I) -> Option<&mut Task<X, Self::Text>> {
        let (_, task) = self.iter_mut().find(|(known, _)| *known == id)?;
        Some(task)
    }

    fn make_room(&mut self) -> bool {
        let (mut oldest, mut end) = (None, Instant::NEVER);
        for slot in &mut self.slots {
            match slot {
                None => return true,
                Some((_, task)) if task.ended < end => {
                    end = task.ended;
                    oldest = Some(slot);
                }
                Some(_) => {}
            }
        }
        if let Some(slot) = oldest {
            *slot = None;
            return true;
        }
        false
    }

    fn insert(&mut self, id: I, task: Task<X, Self::Text>) -> Option<&mut Task<X, Self::Text>> {
        let slot = self.slots.iter_mut().find(|slot| slot.is_none())?;
        let (_, task) = slot.insert((id, task));
        Some(task)
    }

    fn remove(&mut self, id: I) {
        take_out(&mut self.slots, |(known, _)| *known == id);
    }

    fn on_ended(&mut self, _id: I) {}

    fn oldest_end(&self) -> Option<(I, Instant)> {
        let ends = self.iter().filter(|(_, task)| task.state.is_final());
        let (id, task) = ends.min_by_key(|(_, task)| task.ended)?;
        Some((id, task.ended))
    }

    fn iter(&self) -> impl Iterator<Item = (I, &Task<X, Self::Text>)> {
        self.slots.iter().flatten().map(|(id, task)| (*id, task))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Table = TaskTable<u8, (), 2, 16>;

    #[test]
    fn the_oldest_ended_task_is_dropped_first_then_all_expired_ones() {
        let mut table = Table::new();
        let at = Instant::from_millis;
        for (id, end) in [(1, 20), (2, 10)] {
            table.admit(id, Task::new(())).unwrap();
            table.apply(at(end), id, Event::Abort, None);
        }
        table.admit(3, Task::new(())).unwrap();
        assert!(table.get(2).is_none());
        table.forget_until(at(19));
        assert!(table.get(1).is_some());
        table.forget_until(at(20));
        assert!(table.get(1).is_none());
        assert!(table.get(3).is_some());
    }

    #[test]
    fn a_text_that_does_not_fit_is_cut_at_a_character_boundary() {
        for (text, kept) in [
            ("12345678", "12345678"),
            ("123456789", "12345…"),
            ("ääääx", "ää…"),
        ] {
            let mut short = heapless::String::<8>::new();
            short.set(text);
            assert_eq!(short.as_str(), kept);
        }
    }
}
