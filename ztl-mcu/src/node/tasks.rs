//! What becomes of tasks: how they begin, wait, replace each other and end.

use core::fmt;
use core::hash::{Hash, Hasher};

use heapless::String;
use ztl_core::link::{Busy, LinkId, Loss};
use ztl_core::tasks::NoRoom;
use ztl_core::{Instant, State};

use super::commands::NOT_TAKEN;
use super::{Components, Inner};
use crate::component::{Refused, Report, Run};

/// Longest progress, result or reason of a task, and longest goal that can wait, in bytes.
pub(crate) const TEXT: usize = 48;

/// The same, and the mark of a cut.
type Text = String<{ TEXT + 3 }>;

const STOPPED: &str = "emergency stop";
const LINK_LOST: &str = "link was lost";
const REPLACED: &str = "replaced by a later task";

/// A task, or the place for one.
// What is small stands first: there a Cortex-M0 reaches it with one instruction.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[repr(C)]
pub(super) struct Task {
    stage: Stage,
    /// Whether the text has changed since it was told.
    pub(super) news: bool,
    component: u8,
    pub(super) id: LinkId,
    /// When the end or the progress is told next.
    pub(super) due: Instant,
    /// Progress, then result or reason; the goal while it waits.
    pub(super) text: Text,
}

/// How far a task is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Stage {
    /// There is none.
    Free,
    /// Waits for its turn; its text is its goal.
    Waiting,
    Moving,
    /// Told to stop.
    Aborting,
    /// Told to stop, since a later task takes its place.
    Replaced,
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

    fn is_free(&self) -> bool {
        self.stage == Stage::Free
    }

    /// Whether it has its component for itself.
    const fn moves(&self) -> bool {
        matches!(
            self.stage,
            Stage::Moving | Stage::Aborting | Stage::Replaced
        )
    }

    /// Waits or moves.
    fn is_open(&self) -> bool {
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
    fn set_end(&mut self, end: Stage, now: Instant, text: &str) {
        self.stage = end;
        self.due = now;
        if !text.is_empty() {
            self.text.clear();
            // All that it is called with fit.
            let _ = self.text.push_str(text);
        }
    }
}

/// The tasks that a node holds.
#[derive(Clone)]
pub(super) struct Table<const N: usize>([Task; N]);

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

    fn open_mut(&mut self) -> impl Iterator<Item = &mut Task> {
        self.0.iter_mut().filter(|task| task.is_open())
    }

    /// Whether a task moves the component.
    fn is_taken(&self, component: u8) -> bool {
        let mut tasks = self.0.iter();
        tasks.any(|task| task.moves() && task.component == component)
    }

    /// The lowest task that waits for a component that no task moves.
    fn next_in_turn(&mut self) -> Option<&mut Task> {
        let mut next: Option<(LinkId, usize)> = None;
        for (place, task) in self.0.iter().enumerate() {
            if task.waits()
                && next.is_none_or(|(lowest, _)| task.id < lowest)
                && !self.is_taken(task.component)
            {
                next = Some((task.id, place));
            }
        }
        self.0.get_mut(next?.1)
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

/// A `Start` as it came.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted<'a> {
    pub(super) task: LinkId,
    pub(super) component: u8,
    pub(super) goal: &'a str,
    pub(super) before_ms: u64,
}

impl<C: Components, const TASKS: usize, const FRAME: usize> Inner<'_, C, TASKS, FRAME> {
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        self.look_at_link(now);
        for task in self.tasks.0.iter_mut().filter(|task| task.moves()) {
            let place = usize::from(task.component);
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            let mut text = Text::new();
            let run = component.poll(now, &mut Report::new(&mut text));
            task.news |= text != task.text;
            task.text = text;
            let end = match run {
                Run::Running => continue,
                Run::Failed => Stage::Failed,
                Run::Aborted => Stage::Aborted,
                Run::Completed => Stage::Completed,
            };
            let replaced = task.stage == Stage::Replaced && end == Stage::Aborted;
            task.set_end(end, now, if replaced { REPLACED } else { "" });
        }
        // Each of them moves then, or has ended.
        while let Some(task) = self.tasks.next_in_turn() {
            let goal = core::mem::take(&mut task.text);
            let mut why = Report::new(&mut task.text);
            let component = self.components.component_mut(usize::from(task.component));
            match component.map(|component| component.start(now, &goal, &mut why)) {
                Some(Ok(())) => {
                    task.text.clear();
                    task.stage = Stage::Moving;
                    task.news = true;
                }
                Some(Err(Refused)) | None => task.set_end(Stage::Failed, now, ""),
            }
        }
    }

    /// Acts when the link timer has run out. Looked at before a command is carried out too: after
    /// a pause of the firmware the bytes that waited come first.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn look_at_link(&mut self, now: Instant) {
        if now < self.lost_at {
            return;
        }
        self.lost_at = Instant::NEVER;
        for task in self.tasks.open_mut() {
            let place = usize::from(task.component);
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            if component.offer().loss == Loss::CarryOn {
                continue;
            }
            if task.moves() {
                component.make_safe(now);
            }
            task.set_end(Stage::Failed, now, LINK_LOST);
        }
    }

    /// When `handle_timeout` has something to do; perhaps never.
    pub(super) fn next_move(&self, now: Instant) -> Instant {
        let moving = self.tasks.0.iter().filter(|task| task.moves());
        moving.fold(self.lost_at, |wake, task| {
            let component = self.components.component(usize::from(task.component));
            component.map_or(wake, |component| wake.min(component.poll_timeout(now)))
        })
    }

    pub(super) fn start(&mut self, wanted: &Wanted<'_>, now: Instant) -> Result<(), &'static str> {
        let Wanted {
            task,
            component,
            goal,
            before_ms,
        } = *wanted;
        if now.as_millis() > before_ms {
            return Err("the command came too late");
        }
        if task <= self.highest {
            return Err("a task of this or a later id was started already");
        }
        if self.stopped {
            return Err(STOPPED);
        }
        let Some(part) = self.components.component_mut(usize::from(component)) else {
            return Err("no such component");
        };
        let (mut open, mut free, mut full) = (0, TASKS, NoRoom::Running);
        for (place, known) in self.tasks.0.iter().enumerate() {
            if known.is_free() {
                free = free.min(place);
            } else if known.end().is_some() {
                full = NoRoom::Unacknowledged;
            } else if known.component == component {
                open += 1;
            }
        }
        let policy = part.offer().busy;
        // All but one of them wait.
        let busy = open > 0;
        if busy {
            match policy {
                Busy::Refuse => return Err("busy with another task"),
                Busy::Queue(most) if open > most => {
                    return Err("busy, and no more tasks may wait");
                }
                _ if goal.len() > TEXT => {
                    return Err("busy, and the goal is too long to wait: more than 48 bytes");
                }
                _ => {}
            }
        }
        // An end that is not acknowledged is never given up.
        if free >= TASKS {
            return Err(full.as_str());
        }
        let mut why = Report::new(&mut self.reason);
        if part.check(goal, &mut why).is_err() {
            return Err(NOT_TAKEN);
        }
        if !busy {
            let mut why = Report::new(&mut self.reason);
            if part.start(now, goal, &mut why).is_err() {
                return Err(NOT_TAKEN);
            }
        } else if policy == Busy::Replace {
            self.replace(component, now);
        }
        self.highest = task;
        if let Some(free) = self.tasks.0.get_mut(free) {
            free.id = task;
            free.component = component;
            free.due = now;
            free.news = busy;
            free.stage = Stage::Moving;
            free.text.clear();
            if busy {
                free.stage = Stage::Waiting;
                // It was seen to fit.
                let _ = free.text.push_str(goal);
            }
        }
        Ok(())
    }

    /// Makes way for a later task.
    fn replace(&mut self, component: u8, now: Instant) {
        for task in self
            .tasks
            .open_mut()
            .filter(|task| task.component == component)
        {
            if task.waits() {
                task.set_end(Stage::Aborted, now, REPLACED);
            } else if task.stage == Stage::Moving {
                task.stage = Stage::Replaced;
                if let Some(part) = self.components.component_mut(usize::from(component)) {
                    part.abort(now);
                }
            }
        }
    }

    pub(super) fn abort(&mut self, id: LinkId, now: Instant) -> Result<(), &'static str> {
        let Some(task) = self.tasks.get_mut(id) else {
            return Err("no such task");
        };
        if task.waits() {
            task.set_end(Stage::Aborted, now, "aborted before it began");
        } else if task.stage == Stage::Moving {
            task.stage = Stage::Aborting;
            if let Some(part) = self.components.component_mut(usize::from(task.component)) {
                part.abort(now);
            }
        }
        Ok(())
    }

    pub(super) fn stop_everything(&mut self, now: Instant) {
        self.stopped = true;
        for place in 0..self.components.count() {
            if let Some(component) = self.components.component_mut(place) {
                component.make_safe(now);
            }
        }
        for task in self.tasks.open_mut() {
            task.set_end(Stage::Aborted, now, STOPPED);
        }
    }
}
