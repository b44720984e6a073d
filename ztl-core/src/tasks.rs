//! Tasks and what is remembered of them: ids, states, results.
//!
//! The rules are written once, in [`TaskRules`], over any place where tasks are kept ([`Tasks`]):
//! [`TaskTable`] needs no heap, and `ztl-std` has a keeper for thousands. When there is no room for
//! another, the oldest end is given up; a running task and an end that must still be
//! acknowledged never are.

use crate::Instant;
use crate::lifecycle::{Event, State};

/// A task as it is remembered. `X` is what the owner needs besides: a scope, a component.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Task<X, T> {
    /// Where it is in its life.
    pub state: State,
    /// Progress while it runs, the result or the reason once it has ended.
    pub text: T,
    /// When it ended, [`Instant::NEVER`] while it runs; what ended first is given up first.
    pub ended: Instant,
    /// Its end is not given up before it has been acknowledged.
    pub unacknowledged: bool,
    /// What the owner needs besides.
    pub extra: X,
}

impl<X, T: Text> Task<X, T> {
    /// A task that nobody has decided about, and whose end needs no acknowledgement.
    pub fn new(extra: X) -> Self {
        Self {
            state: State::Initiated,
            text: T::default(),
            ended: Instant::NEVER,
            unacknowledged: false,
            extra,
        }
    }

    /// Whether it has ended, and may be given up.
    fn is_over(&self) -> bool {
        self.state.is_final() && !self.unacknowledged
    }

    /// Moves the task on, and says whether that changed anything: a final state never changes.
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

/// A text that is kept: progress, result, reason.
pub trait Text: Default + AsRef<str> {
    /// Replaces the text; what does not fit is cut at a character's boundary, and `…` marks the cut.
    fn set(&mut self, text: &str);
}

/// Marks where a text was cut.
const CUT: &str = "…";

impl<const N: usize> Text for heapless::String<N> {
    fn set(&mut self, text: &str) {
        self.clear();
        if self.push_str(text).is_err() {
            push_cut(self, text);
        }
    }
}

/// Adds of a text what fits, at whole characters, when the mark of a cut has its room behind it; if that is not
/// all, the mark, and says so.
#[cfg_attr(target_os = "none", inline(never))]
pub fn push_cut(kept: &mut heapless::string::StringView, text: &str) -> bool {
    let room = kept.capacity().saturating_sub(CUT.len());
    let fitting = text.floor_char_boundary(room.saturating_sub(kept.len()));
    // Neither can fail: there is room for both.
    let _ = kept.push_str(text.get(..fitting).unwrap_or_default());
    let is_cut = fitting < text.len();
    if is_cut {
        let _ = kept.push_str(CUT);
    }
    is_cut
}

/// Why there is no room for another task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum NoRoom {
    /// Every task runs.
    Running,
    /// Some have ended, and their ends are not acknowledged yet.
    Unacknowledged,
}

impl NoRoom {
    /// What is wrong, as a text.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Running => "too many tasks are running",
            Self::Unacknowledged => "ends not yet acknowledged",
        }
    }
}

impl core::fmt::Display for NoRoom {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl core::error::Error for NoRoom {}

/// A task as a keeper of the type `K` has it.
pub type TaskOf<K> = Task<<K as Tasks>::Extra, <K as Tasks>::Text>;

/// Takes out the first entry that is wanted; the last one moves there. Not with `swap_remove`, which
/// calls `memmove`: that costs a Cortex-M0 0.7 KiB.
pub(crate) fn take_out<T, const N: usize>(
    entries: &mut heapless::Vec<T, N>,
    wanted: impl FnMut(&mut T) -> bool,
) -> Option<T> {
    let place = entries.iter_mut().position(wanted)?;
    if let Some((last, others)) = entries.split_last_mut()
        && let Some(here) = others.get_mut(place)
    {
        core::mem::swap(here, last);
    }
    entries.pop()
}

/// Where tasks are kept. Only keeps; the rules are in [`TaskRules`].
pub trait Tasks {
    /// The number by which a task is found.
    type Id: Copy + Ord;
    /// What the owner needs besides.
    type Extra;
    /// How texts are kept.
    type Text: Text;

    /// The task with this id.
    fn get(&self, id: Self::Id) -> Option<&TaskOf<Self>>;
    /// The task with this id, to be changed.
    fn get_mut(&mut self, id: Self::Id) -> Option<&mut TaskOf<Self>>;
    /// Whether one more task may run, whether or not there is room to remember it. Default: yes.
    fn may_run(&self) -> bool {
        true
    }
    /// Whether no more tasks fit.
    fn is_full(&self) -> bool;
    /// Adds a task whose id is not kept yet; `None` when no more fit.
    fn insert(&mut self, id: Self::Id, task: TaskOf<Self>) -> Option<&mut TaskOf<Self>>;
    /// Forgets a task.
    fn remove(&mut self, id: Self::Id);
    /// Told once when a task has ended, so that a keeper can keep the order of the ends.
    fn on_ended(&mut self, id: Self::Id);
    /// Of the ends that need no acknowledgement, the first.
    fn oldest_end(&self) -> Option<(Self::Id, Instant)>;
    /// Every task, in any order.
    fn iter(&self) -> impl Iterator<Item = (Self::Id, &TaskOf<Self>)>;
}

/// The rules by which tasks come, change and go; every keeper has them.
pub trait TaskRules: Tasks {
    /// Adds a task. When there is no room, the oldest end is given up for it.
    ///
    /// # Errors
    /// [`NoRoom`] when every task runs, or its end is unacknowledged.
    fn admit(&mut self, id: Self::Id, task: TaskOf<Self>) -> Result<&mut TaskOf<Self>, NoRoom> {
        if !self.may_run() {
            return Err(NoRoom::Running);
        }
        if self.is_full() {
            let Some((oldest, _)) = self.oldest_end() else {
                let ended = self.iter().any(|(_, task)| task.state.is_final());
                return Err(if ended {
                    NoRoom::Unacknowledged
                } else {
                    NoRoom::Running
                });
            };
            self.remove(oldest);
        }
        self.insert(id, task).ok_or(NoRoom::Running)
    }

    /// Moves a task on, as [`Task::apply`] does.
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

    /// Sets the progress of a task that has not ended; says whether there is one.
    fn progress(&mut self, id: Self::Id, text: &str) -> bool {
        match self.get_mut(id) {
            Some(task) if !task.state.is_final() => {
                task.text.set(text);
                true
            }
            _ => false,
        }
    }

    /// The end of a task is known where it must be: it is forgotten. One that runs is kept.
    fn acknowledge(&mut self, id: Self::Id) {
        if self.get(id).is_some_and(|task| task.state.is_final()) {
            self.remove(id);
        }
    }

    /// Forgets what ended at `end` or before and needs no acknowledgement.
    fn forget_until(&mut self, end: Instant) {
        while let Some((id, ended)) = self.oldest_end()
            && ended <= end
        {
            self.remove(id);
        }
    }
}

impl<T: Tasks + ?Sized> TaskRules for T {}

/// At most `N` tasks with texts of at most `TEXT` bytes, without a heap. `I` is the id.
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
/// assert!(table.admit(3, Task::new(())).is_err(), "a running task is never given up");
/// table.apply(now, 1, Event::Complete, Some("40.0"));
/// assert!(!table.apply(now, 1, Event::Abort, None), "an end is an end");
/// table.admit(3, Task::new(())).unwrap();
/// assert!(table.get(1).is_none(), "its end was given up");
/// assert_eq!(table.get(2).unwrap().state, State::Accepted);
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct TaskTable<I, X, const N: usize, const TEXT: usize> {
    entries: heapless::Vec<Entry<I, X, TEXT>, N>,
}

type Entry<I, X, const TEXT: usize> = (I, Task<X, heapless::String<TEXT>>);

impl<I, X, const N: usize, const TEXT: usize> TaskTable<I, X, N, TEXT> {
    /// An empty table.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            entries: heapless::Vec::new(),
        }
    }

    /// How many tasks there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Every task, to be changed.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut Entry<I, X, TEXT>> {
        self.entries.iter_mut()
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

    fn is_full(&self) -> bool {
        self.entries.is_full()
    }

    fn insert(&mut self, id: I, task: Task<X, Self::Text>) -> Option<&mut Task<X, Self::Text>> {
        self.entries.push((id, task)).ok()?;
        let (_, task) = self.entries.last_mut()?;
        Some(task)
    }

    fn remove(&mut self, id: I) {
        take_out(&mut self.entries, |(known, _)| *known == id);
    }

    fn on_ended(&mut self, _id: I) {}

    fn oldest_end(&self) -> Option<(I, Instant)> {
        let mut oldest: Option<&Entry<I, X, TEXT>> = None;
        for end in self.entries.iter().filter(|(_, task)| task.is_over()) {
            let (id, task) = end;
            let is_older = |(known, first): &Entry<I, X, TEXT>| {
                task.ended < first.ended || task.ended == first.ended && id < known
            };
            if oldest.is_none_or(is_older) {
                oldest = Some(end);
            }
        }
        oldest.map(|(id, task)| (*id, task.ended))
    }

    fn iter(&self) -> impl Iterator<Item = (I, &Task<X, Self::Text>)> {
        self.entries.iter().map(|(id, task)| (*id, task))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Table = TaskTable<u8, (), 2, 16>;

    fn unacknowledged() -> Task<(), heapless::String<16>> {
        let mut task = Task::new(());
        task.unacknowledged = true;
        task
    }

    #[test]
    fn an_end_that_must_be_acknowledged_is_not_given_up() {
        let mut table = Table::new();
        table.admit(1, unacknowledged()).unwrap();
        table.admit(2, unacknowledged()).unwrap();
        assert_eq!(table.admit(3, unacknowledged()), Err(NoRoom::Running));
        table.apply(Instant::ZERO, 1, Event::Fail, Some("no"));
        assert_eq!(
            table.admit(3, unacknowledged()),
            Err(NoRoom::Unacknowledged)
        );
        table.acknowledge(2);
        assert!(table.get(2).is_some(), "it runs");
        table.acknowledge(1);
        table.admit(3, unacknowledged()).unwrap();
    }

    #[test]
    fn the_oldest_end_goes_first_and_time_goes_over_all() {
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
    fn a_text_that_does_not_fit_is_cut_at_a_character_and_marked() {
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
