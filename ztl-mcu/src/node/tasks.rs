//! The tasks that a node holds.

use core::fmt;
use core::hash::{Hash, Hasher};

use heapless::String;
use ztl_core::link::LinkId;
use ztl_core::{Instant, State};

/// Longest progress, result or reason of a task, and longest goal that can wait, in bytes.
pub(crate) const TEXT: usize = 48;

/// The same, and the mark of a cut.
pub(super) type Text = String<{ TEXT + 3 }>;

/// A task, or the place for one.
// What is small stands first: there a Cortex-M0 reaches it with one instruction.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[repr(C)]
pub(super) struct Task {
    pub(super) stage: Stage,
    /// Whether the text has changed since it was told.
    pub(super) news: bool,
    pub(super) component: u8,
    pub(super) id: LinkId,
    /// When the end or the progress is told next.
    pub(super) due: Instant,
    /// When its component is polled next, while it moves.
    pub(super) wake: Instant,
    /// Progress, then result or reason; the goal while it waits.
    pub(super) text: Text,
}

/// How far a task is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Stage {
    /// There is none.
    Free,
    /// Waits for its turn; its text is its goal.
    Waiting,
    Moving,
    /// Told to stop.
    Aborting,
    /// Told to stop, since a later task takes its place.
    Replaced,
    /// Its component goes to the safe state, since the link was lost.
    Lost,
    /// The same in an emergency stop.
    Stopped,
    /// These are kept until they are acknowledged.
    Failed,
    Aborted,
    Completed,
}

impl Task {
    const FREE: Self = Self {
        stage: Stage::Free,
        news: false,
        component: 0,
        id: LinkId(0),
        due: Instant::ZERO,
        wake: Instant::ZERO,
        text: String::new(),
    };

    /// Its final state, when it has ended.
    pub(super) const fn end(&self) -> Option<State> {
        match self.stage {
            Stage::Failed => Some(State::Failed),
            Stage::Aborted => Some(State::Aborted),
            Stage::Completed => Some(State::Completed),
            _ => None,
        }
    }

    pub(super) fn waits(&self) -> bool {
        self.stage == Stage::Waiting
    }

    pub(super) fn is_free(&self) -> bool {
        self.stage == Stage::Free
    }

    /// Whether it has its component for itself.
    pub(super) const fn moves(&self) -> bool {
        matches!(
            self.stage,
            Stage::Moving | Stage::Aborting | Stage::Replaced | Stage::Lost | Stage::Stopped
        )
    }

    /// Whether its component goes to the safe state.
    pub(super) const fn is_made_safe(&self) -> bool {
        matches!(self.stage, Stage::Lost | Stage::Stopped)
    }

    /// Waits or moves.
    pub(super) fn is_open(&self) -> bool {
        self.moves() || self.waits()
    }

    /// Its place is free again.
    pub(super) const fn forget(&mut self) {
        self.stage = Stage::Free;
    }

    /// Whether there is something to tell of it, at once or later.
    pub(super) fn is_due(&self) -> bool {
        self.news || self.end().is_some()
    }

    /// It has ended, with this text in place of its own if there is one. To be called for one that is open: an end
    /// is an end.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn set_end(&mut self, end: Stage, now: Instant, text: &str) {
        self.stage = end;
        self.due = now;
        self.wake = now;
        if !text.is_empty() {
            self.text.clear();
            // All that it is called with fit.
            let _ = self.text.push_str(text);
        }
    }
}

/// The tasks that a node holds.
#[derive(Clone)]
pub(super) struct Table<const N: usize>(pub(super) [Task; N]);

impl<const N: usize> Table<N> {
    pub(super) const fn new() -> Self {
        Self([const { Task::FREE }; N])
    }

    pub(super) fn held(&self) -> impl Iterator<Item = &Task> {
        self.0.iter().filter(|task| !task.is_free())
    }

    pub(super) fn held_mut(&mut self) -> impl Iterator<Item = &mut Task> {
        self.0.iter_mut().filter(|task| !task.is_free())
    }

    pub(super) fn open_mut(&mut self) -> impl Iterator<Item = &mut Task> {
        self.0.iter_mut().filter(|task| task.is_open())
    }

    /// A task that waits for a component that no task moves, and of those the lowest.
    pub(super) fn next_in_turn(&mut self) -> Option<&mut Task> {
        let is_next = |task: &Task| {
            let before = |other: &Task| other.moves() || other.waits() && other.id < task.id;
            let mut others = self.0.iter();
            task.waits() && !others.any(|other| other.component == task.component && before(other))
        };
        let place = self.0.iter().position(is_next)?;
        self.0.get_mut(place)
    }

    /// The task that moves the component of this number.
    pub(super) fn moving(&mut self, component: usize) -> Option<&mut Task> {
        let mut tasks = self.0.iter_mut();
        tasks.find(|task| task.moves() && usize::from(task.component) == component)
    }

    pub(super) fn get_mut(&mut self, id: LinkId) -> Option<&mut Task> {
        self.held_mut().find(|task| task.id == id)
    }

    /// The end of a task is known to the gateway: it is forgotten. One that has not ended is kept.
    pub(super) fn acknowledge(&mut self, id: LinkId) {
        if let Some(task) = self.get_mut(id)
            && task.end().is_some()
        {
            task.forget();
        }
    }
}

/// Equal when the same tasks are held, in the same order.
impl<const N: usize> PartialEq for Table<N> {
    fn eq(&self, other: &Self) -> bool {
        self.held().eq(other.held())
    }
}

impl<const N: usize> Eq for Table<N> {}

impl<const N: usize> Hash for Table<N> {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        self.held().for_each(|task| task.hash(hasher));
    }
}

/// Shows those that there are.
impl<const N: usize> fmt::Debug for Table<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.held()).finish()
    }
}
