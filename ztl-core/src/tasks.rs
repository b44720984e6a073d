//! Tasks and what is remembered of them: ids, states, results.
//!
//! The rules are written once, in [`TaskRules`], over any place where tasks are kept ([`Tasks`]):
//! [`TaskTable`] needs no heap, and `ztl-std` has a keeper for thousands. When there is no room for
//! another, the oldest end is given up; a running task never is.

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
    /// What the owner needs besides.
    pub extra: X,
}

impl<X, T: Text> Task<X, T> {
    /// A task that nobody has decided about.
    pub fn new(extra: X) -> Self {
        Self {
            state: State::Initiated,
            text: T::default(),
            ended: Instant::NEVER,
            extra,
        }
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

/// There is no room for another task: every one that is remembered runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NoRoom;

impl NoRoom {
    /// What is wrong, as a text.
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

/// A task as a keeper of the type `K` has it.
pub type TaskOf<K> = Task<<K as Tasks>::Extra, <K as Tasks>::Text>;

/// Takes out the first entry that is wanted.
pub(crate) fn take_out<T>(
    places: &mut [Option<T>],
    mut wanted: impl FnMut(&mut T) -> bool,
) -> Option<T> {
    for place in places {
        if place.as_mut().is_some_and(&mut wanted) {
            return place.take();
        }
    }
    None
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
    /// Makes room for one more, if need be by forgetting the oldest end; says whether there is some now.
    fn make_room(&mut self) -> bool;
    /// Adds a task whose id is not kept yet; `None` when no more fit.
    fn insert(&mut self, id: Self::Id, task: TaskOf<Self>) -> Option<&mut TaskOf<Self>>;
    /// Forgets a task.
    fn remove(&mut self, id: Self::Id);
    /// Told once when a task has ended, so that a keeper can keep the order of the ends.
    fn on_ended(&mut self, id: Self::Id);
    /// The first of the ends.
    fn oldest_end(&self) -> Option<(Self::Id, Instant)>;
    /// Every task, in any order.
    fn iter(&self) -> impl Iterator<Item = (Self::Id, &TaskOf<Self>)>;
}

/// The rules by which tasks come, change and go; every keeper has them.
pub trait TaskRules: Tasks {
    /// Adds a task. When there is no room, the oldest end is given up for it.
    ///
    /// # Errors
    /// [`NoRoom`] when every task runs.
    fn admit(&mut self, id: Self::Id, task: TaskOf<Self>) -> Result<&mut TaskOf<Self>, NoRoom> {
        if !self.may_run() || !self.make_room() {
            return Err(NoRoom);
        }
        self.insert(id, task).ok_or(NoRoom)
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

    /// Forgets what ended at `end` or before.
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
    // Places, and no list: to close a gap costs a Cortex-M0 more code than to pass over it.
    places: [Option<Entry<I, X, TEXT>>; N],
}

type Entry<I, X, const TEXT: usize> = (I, Task<X, heapless::String<TEXT>>);

impl<I, X, const N: usize, const TEXT: usize> TaskTable<I, X, N, TEXT> {
    /// An empty table.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            places: [const { None }; N],
        }
    }

    /// How many tasks there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.places.iter().flatten().count()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.places.iter().all(Option::is_none)
    }

    /// Every task, to be changed.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut Entry<I, X, TEXT>> {
        self.places.iter_mut().flatten()
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
        for place in &mut self.places {
            match place {
                None => return true,
                Some((_, task)) if task.ended < end => {
                    end = task.ended;
                    oldest = Some(place);
                }
                Some(_) => {}
            }
        }
        if let Some(place) = oldest {
            *place = None;
            return true;
        }
        false
    }

    fn insert(&mut self, id: I, task: Task<X, Self::Text>) -> Option<&mut Task<X, Self::Text>> {
        let place = self.places.iter_mut().find(|place| place.is_none())?;
        let (_, task) = place.insert((id, task));
        Some(task)
    }

    fn remove(&mut self, id: I) {
        take_out(&mut self.places, |(known, _)| *known == id);
    }

    fn on_ended(&mut self, _id: I) {}

    fn oldest_end(&self) -> Option<(I, Instant)> {
        let ends = self.iter().filter(|(_, task)| task.state.is_final());
        let (id, task) = ends.min_by_key(|(_, task)| task.ended)?;
        Some((id, task.ended))
    }

    fn iter(&self) -> impl Iterator<Item = (I, &Task<X, Self::Text>)> {
        self.places.iter().flatten().map(|(id, task)| (*id, task))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Table = TaskTable<u8, (), 2, 16>;

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
