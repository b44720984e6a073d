//! The task table of a node.

use core::fmt;
use core::hash::{Hash, Hasher};

use heapless::String;
use ztl_core::link::LinkId;
use ztl_core::{Instant, State};

/// Longest progress, result or reason of a task, and longest goal of a waiting task, in bytes.
pub(crate) const TEXT: usize = 48;

/// A task's text, with room for the mark of a cut.
pub(crate) type TaskText = String<{ TEXT + 3 }>;

/// A task, or a free place.
// Small fields come first, where one instruction of a Cortex-M0 reaches them. With the attribute of `set_end`, this saves
// 112 bytes in `microbit-smallest`.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[repr(C)]
pub(super) struct Task {
    pub(super) stage: Stage,
    /// Whether the text has changed since it was last reported.
    pub(super) changed: bool,
    pub(super) component: u8,
    pub(super) id: LinkId,
    /// When the outcome or progress is reported next.
    pub(super) due: Instant,
    /// When its component is polled next, while it runs.
    pub(super) wake: Instant,
    /// Progress, then result or reason; the goal while it waits.
    pub(super) text: TaskText,
}

/// The stage of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Stage {
    /// The place is free.
    Free,
    /// Waits for its component; its text is its goal.
    Waiting,
    Running,
    /// Aborted on request; its component is stopping.
    Aborting,
    /// Aborted because a later task replaces it; its component is stopping.
    Replaced,
    /// Its component is going to the safe state because the link was lost.
    Lost,
    /// The same because of an emergency stop.
    Stopped,
    /// The same because of a firmware update.
    Updating,
    /// The same because the device restarts.
    Restarting,
    /// Final, like the next two: kept until acknowledged.
    Failed,
    Aborted,
    Completed,
}

impl Task {
    const FREE: Self = Self {
        stage: Stage::Free,
        changed: false,
        component: 0,
        id: LinkId(0),
        due: Instant::ZERO,
        wake: Instant::ZERO,
        text: String::new(),
    };

    /// The final state, if the task has ended.
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

    /// Whether it occupies its component.
    pub(super) const fn runs(&self) -> bool {
        matches!(
            self.stage,
            Stage::Running | Stage::Aborting | Stage::Replaced
        ) || self.is_made_safe()
    }

    /// Its component keeps its result. Such a task is never polled again, so the time is free to say so: a stage of its own
    /// takes 116 bytes in `microbit-smallest`, which has no long results.
    pub(super) const fn keep_result(&mut self) {
        self.wake = Instant::NEVER;
    }

    /// Whether its component keeps its result, and can take no other task until that is acknowledged.
    pub(super) fn is_kept(&self) -> bool {
        self.stage == Stage::Completed && self.wake == Instant::NEVER
    }

    /// Whether its component is going to the safe state.
    pub(super) const fn is_made_safe(&self) -> bool {
        matches!(
            self.stage,
            Stage::Lost | Stage::Stopped | Stage::Updating | Stage::Restarting
        )
    }

    /// Whether it waits or runs.
    pub(super) fn is_open(&self) -> bool {
        self.runs() || self.waits()
    }

    /// Frees its place.
    pub(super) const fn forget(&mut self) {
        self.stage = Stage::Free;
    }

    /// Whether it has something to report, now or later.
    pub(super) fn is_due(&self) -> bool {
        self.changed || self.end().is_some()
    }

    /// Ends the task, and replaces its text unless `text` is empty. Call it only for an open task, because a
    /// final state never changes.
    pub(super) fn set_end(&mut self, end: Stage, now: Instant, text: &str) {
        self.stage = end;
        self.due = now;
        self.wake = now;
        if !text.is_empty() {
            self.text.clear();
            // Every text that it is called with fits.
            let _ = self.text.push_str(text);
        }
    }
}

/// The tasks of a node, running, waiting or ended.
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

    /// A task that may begin: its component is free, and no task for it with a lower id waits. A component that
    /// keeps a result is not free.
    pub(super) fn next_in_turn(
        &mut self,
        keeps_result: impl Fn(&Task) -> bool,
    ) -> Option<&mut Task> {
        let is_next = |task: &Task| {
            let before = |other: &Task| {
                other.runs() || keeps_result(other) || other.waits() && other.id < task.id
            };
            let mut others = self.0.iter();
            task.waits() && !others.any(|other| other.component == task.component && before(other))
        };
        let index = self.0.iter().position(is_next)?;
        self.0.get_mut(index)
    }

    /// The task that runs on the component with this index.
    pub(super) fn running_on(&mut self, component: usize) -> Option<&mut Task> {
        let mut tasks = self.0.iter_mut();
        tasks.find(|task| task.runs() && usize::from(task.component) == component)
    }

    pub(super) fn get_mut(&mut self, id: LinkId) -> Option<&mut Task> {
        self.held_mut().find(|task| task.id == id)
    }

    /// The gateway knows the outcome of this task. Drops the task if it has ended.
    pub(super) fn acknowledge(&mut self, id: LinkId) {
        if let Some(task) = self.get_mut(id)
            && task.end().is_some()
        {
            task.forget();
        }
    }
}

/// Equal if the same tasks are held in the same order.
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

/// Shows the held tasks.
impl<const N: usize> fmt::Debug for Table<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.held()).finish()
    }
}
