//! What becomes of tasks: how they begin, wait, replace each other and end.

use ztl_core::Instant;
use ztl_core::link::{Busy, LinkId, Loss};

use super::commands::{NO_PLACE, NOT_TAKEN};
use super::tasks::{Stage, TEXT, Table, Text};
use super::{Components, Reason};
use crate::component::{Component, Refused, Report, Run};

const STOPPED: &str = "emergency stop";
const LINK_LOST: &str = "link was lost";
const REPLACED: &str = "replaced by a later task";
/// Why a component without a task takes none.
const NOT_SAFE: &str = "busy going to its safe state";

/// The components and their tasks, whoever wants these: a gateway, or a server in the same firmware.
// What is small stands first: there a Cortex-M0 reaches it with one instruction.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[repr(C)]
pub(crate) struct Runner<C, const TASKS: usize> {
    pub(super) stopped: bool,
    /// Whether the components that carry on without a link go to the safe state too.
    pub(super) all_to_safety: bool,
    /// When the components without a task that are not in the safe state yet are polled next;
    /// [`Instant::NEVER`] when there are none.
    pub(super) safety_wake: Instant,
    pub(super) components: C,
    /// What the component said when it did not take the last goal.
    pub(super) reason: Reason,
    pub(super) tasks: Table<TASKS>,
}

impl<C, const TASKS: usize> Runner<C, TASKS> {
    /// After a reset.
    #[cfg(feature = "zmtp")]
    pub(crate) const fn new(components: C) -> Self {
        Self {
            stopped: false,
            all_to_safety: false,
            safety_wake: Instant::NEVER,
            components,
            reason: Reason::new(),
            tasks: Table::new(),
        }
    }

    pub(crate) const fn clear_stop(&mut self) {
        self.stopped = false;
    }

    pub(crate) const fn is_stopped(&self) -> bool {
        self.stopped
    }

    pub(crate) const fn components(&self) -> &C {
        &self.components
    }

    pub(crate) const fn components_mut(&mut self) -> &mut C {
        &mut self.components
    }
}

impl<C: Components, const TASKS: usize> Runner<C, TASKS> {
    /// Polls the components that move for a task, and those without one that are not in the safe state yet; then lets
    /// begin what waits.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        let safety = now >= self.safety_wake;
        if safety {
            self.safety_wake = Instant::NEVER;
        }
        for place in 0..self.components.count() {
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            let task = self.tasks.moving(place);
            let due = match &task {
                Some(task) => now >= task.wake,
                None => safety && goes_to_safety(component, self.all_to_safety),
            };
            if !due {
                continue;
            }
            let mut text = Text::new();
            let run = component.poll(now, &mut Report::new(&mut text));
            let wake = component.poll_timeout(now);
            let Some(task) = task else {
                if run == Run::Running {
                    self.safety_wake = self.safety_wake.min(wake);
                }
                continue;
            };
            task.wake = wake;
            task.news |= text != task.text;
            task.text = text;
            let end = match run {
                Run::Running => continue,
                Run::Failed => Stage::Failed,
                Run::Aborted => Stage::Aborted,
                Run::Completed => Stage::Completed,
            };
            let (end, why) = match task.stage {
                Stage::Lost => (Stage::Failed, LINK_LOST),
                Stage::Stopped => (Stage::Aborted, STOPPED),
                Stage::Replaced if end == Stage::Aborted => (end, REPLACED),
                _ => (end, ""),
            };
            task.set_end(end, now, why);
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
                    task.wake = now;
                    task.news = true;
                }
                Some(Err(Refused)) | None => task.set_end(Stage::Failed, now, ""),
            }
        }
    }

    /// The gateway is gone: what becomes of the components and their tasks is the components' choice.
    pub(super) fn on_link_lost(&mut self, now: Instant) {
        self.make_safe(now, false);
    }

    /// Sends the components to the safe state, idle ones too: `all`, or those that do not carry on without a link.
    /// What waits ends at once, what moves as soon as its component is safe.
    fn make_safe(&mut self, now: Instant, all: bool) {
        let (moving, end, why) = if all {
            (Stage::Stopped, Stage::Aborted, STOPPED)
        } else {
            (Stage::Lost, Stage::Failed, LINK_LOST)
        };
        for place in 0..self.components.count() {
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            if !goes_to_safety(component, all) {
                continue;
            }
            component.make_safe(now);
            for task in self.tasks.open_mut() {
                if usize::from(task.component) != place {
                    continue;
                }
                if task.waits() {
                    task.set_end(end, now, why);
                } else if !task.is_made_safe() {
                    task.stage = moving;
                }
                task.wake = now;
            }
        }
        self.all_to_safety = all || self.all_to_safety && self.safety_wake != Instant::NEVER;
        self.safety_wake = now;
        self.handle_timeout(now);
    }

    /// When `handle_timeout` has something to do; perhaps never.
    pub(crate) fn next_move(&self) -> Instant {
        let moving = self.tasks.0.iter().filter(|task| task.moves());
        moving.fold(self.safety_wake, |wake, task| wake.min(task.wake))
    }

    /// Starts a task on the component of this number. Its id is new.
    ///
    /// # Errors
    /// Why it is refused; [`NOT_TAKEN`] if the component has said so, [`NO_PLACE`] if there is none.
    pub(super) fn start(
        &mut self,
        now: Instant,
        id: LinkId,
        component: u8,
        goal: &str,
    ) -> Result<(), &'static str> {
        if self.stopped {
            return Err(STOPPED);
        }
        let Some(part) = self.components.component_mut(usize::from(component)) else {
            return Err("no such component");
        };
        let (mut open, mut free) = (0, TASKS);
        for (place, known) in self.tasks.0.iter().enumerate() {
            if known.is_free() {
                free = free.min(place);
            } else if known.component == component && known.is_open() {
                open += 1;
            }
        }
        let policy = part.offer().busy;
        // All but one of them wait.
        let busy = open > 0;
        if busy && policy == Busy::Refuse {
            return Err("busy with another task");
        }
        if !busy
            && self.safety_wake != Instant::NEVER
            && goes_to_safety(part, self.all_to_safety)
            && part.poll(now, &mut Report::new(&mut self.reason)) == Run::Running
        {
            return Err(NOT_SAFE);
        }
        if part
            .check(goal, &mut Report::new(&mut self.reason))
            .is_err()
        {
            return Err(NOT_TAKEN);
        }
        if busy && matches!(policy, Busy::Queue(most) if open > most) {
            return Err("busy, and no more tasks may wait");
        }
        if busy && goal.len() > TEXT {
            return Err("busy, and the goal is too long to wait: more than 48 bytes");
        }
        if free >= TASKS {
            return Err(NO_PLACE);
        }
        if !busy {
            let mut why = Report::new(&mut self.reason);
            if part.start(now, goal, &mut why).is_err() {
                return Err(NOT_TAKEN);
            }
        } else if policy == Busy::Replace {
            self.replace(component, now);
        }
        if let Some(free) = self.tasks.0.get_mut(free) {
            free.id = id;
            free.component = component;
            free.due = now;
            free.wake = now;
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
                task.wake = now;
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
            task.wake = now;
            if let Some(part) = self.components.component_mut(usize::from(task.component)) {
                part.abort(now);
            }
        }
        Ok(())
    }

    pub(crate) fn stop_everything(&mut self, now: Instant) {
        self.stopped = true;
        self.make_safe(now, true);
    }
}

/// Whether a component goes to the safe state: when all do, or when the link is lost.
fn goes_to_safety(component: &dyn Component, all: bool) -> bool {
    all || component.offer().loss != Loss::CarryOn
}
