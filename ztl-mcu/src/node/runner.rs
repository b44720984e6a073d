//! Starts, queues, replaces and ends tasks.

use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::update::UpdatePhase;
use ztl_core::link::{Busy, LinkId, Loss};

use super::refusal::{EMERGENCY_STOP, RESTARTING, Reason, Refusal, UPDATING};
use super::tasks::{Stage, TEXT, Table, Task, TaskText};
use crate::component::{Component, Components, Refused, Report, Run};

/// How often a component that fails to reach its safe state is made safe again.
const SAFETY_INTERVAL: Duration = Duration::from_millis(50);
const LINK_LOST: &str = "link was lost";
const REPLACED: &str = "replaced by a later task";

/// The components and their tasks, which come from a gateway or from a server in the same firmware.
// Small fields come first, where one instruction of a Cortex-M0 reaches them. With the attribute of `handle_timeout`,
// this saves 108 bytes in `microbit-quiet`.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[repr(C)]
pub(crate) struct TaskRunner<C, const TASKS: usize> {
    pub(super) stopped: bool,
    /// When to poll the idle components that have not reached the safe state yet; [`Instant::NEVER`] if all
    /// have.
    pub(super) safety_wake: Instant,
    /// When components that failed to become safe are made safe again, at the earliest.
    pub(super) retry_at: Instant,
    /// When an idle component wants to be asked for a reading; [`Instant::ZERO`] if a component may have changed since it was
    /// asked.
    pub(super) readings_wake: Instant,
    pub(super) components: C,
    /// Why a component refused the last goal, if one did.
    pub(super) reason: Reason,
    pub(super) tasks: Table<TASKS>,
    /// The components that were made safe and have not reached the safe state yet.
    pub(super) unsafe_components: IndexSet,
}

/// Indices of components.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct IndexSet([u32; 8]);

impl IndexSet {
    pub(super) const fn new() -> Self {
        Self([0; 8])
    }

    pub(super) fn has(&self, index: usize) -> bool {
        let bits = self.0.get(index / 32);
        bits.is_some_and(|bits| bits >> (index % 32) & 1 != 0)
    }

    fn set(&mut self, index: usize, has: bool) {
        if let Some(bits) = self.0.get_mut(index / 32) {
            *bits &= !(1 << (index % 32));
            *bits |= u32::from(has) << (index % 32);
        }
    }
}

impl<C, const TASKS: usize> TaskRunner<C, TASKS> {
    /// The state after a reset.
    #[cfg(feature = "zmtp")]
    pub(crate) const fn new(components: C) -> Self {
        Self {
            stopped: false,
            safety_wake: Instant::NEVER,
            retry_at: Instant::ZERO,
            readings_wake: Instant::ZERO,
            unsafe_components: IndexSet::new(),
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
        self.readings_wake = Instant::ZERO;
        &mut self.components
    }
}

impl<C: Components, const TASKS: usize> TaskRunner<C, TASKS> {
    /// Polls the components that have a task, the idle ones that are going to the safe state, and those with a
    /// tick. Then starts waiting tasks.
    // Not inlined in firmware: its stack is then free for what a server sends.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        let safety = now >= self.safety_wake;
        if safety {
            self.safety_wake = Instant::NEVER;
        }
        let retry = now >= self.retry_at;
        for index in 0..self.components.count() {
            let next_tick = self.components.next_tick(index);
            // The first condition is constant, and so the second absent, if no component has ticks.
            let tick = next_tick != Instant::NEVER && now >= next_tick;
            let Some(component) = self.components.component_mut(index) else {
                continue;
            };
            let task = self.tasks.running_on(index);
            let to_safety = self.unsafe_components.has(index);
            let due = match &task {
                Some(task) => now >= task.wake,
                None => safety && to_safety,
            };
            if !due && !tick {
                continue;
            }
            // A start, an abort, the way to the safe state and a tick all lead here.
            self.readings_wake = Instant::ZERO;
            let mut text = TaskText::new();
            let mut run = component.poll(now, &mut Report::new(&mut text));
            let mut wake = component.poll_timeout(now);
            if to_safety && run == Run::Failed {
                if retry {
                    component.make_safe(now);
                    self.retry_at = now + SAFETY_INTERVAL;
                }
                run = Run::Running;
                wake = self.retry_at;
            } else {
                wake = wake.min(self.components.next_tick(index));
            }
            let Some(task) = task else {
                if run != Run::Running || wake == Instant::NEVER {
                    self.unsafe_components.set(index, false);
                } else if to_safety {
                    self.safety_wake = self.safety_wake.min(wake);
                }
                continue;
            };
            task.wake = wake;
            task.changed |= text != task.text;
            task.text = text;
            let end = match run {
                Run::Running => continue,
                Run::Failed => Stage::Failed,
                Run::Aborted => Stage::Aborted,
                Run::Completed => Stage::Completed,
            };
            self.unsafe_components.set(index, false);
            let (end, why) = match task.stage {
                Stage::Replaced if end == Stage::Aborted => (end, REPLACED),
                stage => forced_end::<C>(stage).unwrap_or((end, "")),
            };
            task.set_end(end, now, why);
            if end == Stage::Completed && !self.components.result(index).is_empty() {
                task.keep_result();
            }
        }
        // The loop terminates: each pass starts or fails one waiting task.
        while let Some(task) = self
            .tasks
            .next_in_turn(|task| kept_result(&self.components, task).is_some())
        {
            let goal = core::mem::take(&mut task.text);
            let mut why = Report::new(&mut task.text);
            let component = self.components.component_mut(usize::from(task.component));
            match component.map(|component| component.start(now, &goal, &mut why)) {
                Some(Ok(())) => {
                    task.text.clear();
                    task.stage = Stage::Running;
                    task.wake = now;
                    task.changed = true;
                }
                Some(Err(Refused)) | None => task.set_end(Stage::Failed, now, ""),
            }
        }
    }

    /// Sends every component except `CarryOn` ones to its safe state.
    pub(super) fn on_link_lost(&mut self, now: Instant) {
        self.make_safe(now, false);
    }

    /// Sends the components to the safe state, idle ones too: `all`, or those that do not carry on without a
    /// link. Ends waiting tasks at once, and running ones when their component is safe.
    pub(super) fn make_safe(&mut self, now: Instant, all: bool) {
        let stage = if all {
            stop_stage(&self.components)
        } else {
            Stage::Lost
        };
        let (end, why) = forced_end::<C>(stage).unwrap_or((Stage::Failed, ""));
        for index in 0..self.components.count() {
            let Some(component) = self.components.component_mut(index) else {
                continue;
            };
            if !goes_to_safety(component, all) {
                continue;
            }
            component.make_safe(now);
            self.unsafe_components.set(index, true);
            for task in self.tasks.open_mut() {
                if usize::from(task.component) != index {
                    continue;
                }
                if task.waits() {
                    task.set_end(end, now, why);
                } else if !task.is_made_safe() {
                    task.stage = stage;
                }
                task.wake = now;
            }
        }
        self.safety_wake = now;
        self.retry_at = now;
        self.handle_timeout(now);
    }

    /// When `handle_timeout` has work, or [`Instant::NEVER`].
    pub(crate) fn next_move(&self) -> Instant {
        let running = self.tasks.0.iter().filter(|task| task.runs());
        let moving = running.fold(self.safety_wake, |wake, task| wake.min(task.wake));
        let indices = 0..self.components.count();
        indices.fold(moving, |wake, index| {
            wake.min(self.components.next_tick(index))
        })
    }

    /// Starts a task with a new id on the component with this index.
    ///
    /// # Errors
    /// The [`Refusal`]; the task is then not in the table.
    pub(super) fn start(
        &mut self,
        now: Instant,
        id: LinkId,
        component: u8,
        goal: &str,
    ) -> Result<(), Refusal> {
        if self.stopped {
            return Err(Refusal::EmergencyStop);
        }
        if is_updating(&self.components) {
            // Not with a reason of its own, which all nodes would contain.
            Report::new(&mut self.reason).text(UPDATING);
            return Err(Refusal::ByComponent);
        }
        // Constant if no component has long results.
        let has_result = !self.components.result(component.into()).is_empty();
        let Some(part) = self.components.component_mut(usize::from(component)) else {
            return Err(Refusal::NoSuchComponent);
        };
        let (mut open, mut free, mut runs) = (0, TASKS, false);
        for (index, known) in self.tasks.0.iter().enumerate() {
            if known.is_free() {
                free = free.min(index);
            } else if known.component == component
                && (known.is_open() || has_result && known.is_kept())
            {
                open += 1;
                runs |= known.runs();
            }
        }
        let policy = part.offer().busy;
        let busy = open > 0;
        if busy && policy == Busy::Refuse {
            return Err(Refusal::Busy);
        }
        // With a task on its way, it is safe before the next one begins.
        if !runs && self.unsafe_components.has(component.into()) {
            self.readings_wake = Instant::ZERO;
            let run = part.poll(now, &mut Report::new(&mut self.reason));
            if matches!(run, Run::Running | Run::Failed) {
                return Err(Refusal::GoingToSafeState);
            }
            self.unsafe_components.set(component.into(), false);
        }
        if part
            .check(goal, &mut Report::new(&mut self.reason))
            .is_err()
        {
            return Err(Refusal::ByComponent);
        }
        // One of the open tasks runs; the others wait.
        if busy && matches!(policy, Busy::Queue(most) if open > most) {
            return Err(Refusal::QueueFull);
        }
        if busy && goal.len() > TEXT {
            return Err(Refusal::GoalTooLongToWait);
        }
        if free >= TASKS {
            return Err(Refusal::TableFull);
        }
        if !busy {
            let mut why = Report::new(&mut self.reason);
            if part.start(now, goal, &mut why).is_err() {
                return Err(Refusal::ByComponent);
            }
        } else if policy == Busy::Replace {
            self.replace(component, now);
        }
        if let Some(free) = self.tasks.0.get_mut(free) {
            free.id = id;
            free.component = component;
            free.due = now;
            free.wake = now;
            free.changed = busy;
            free.stage = Stage::Running;
            free.text.clear();
            if busy {
                free.stage = Stage::Waiting;
                // It fits: the length was checked.
                let _ = free.text.push_str(goal);
            }
        }
        Ok(())
    }

    /// Ends the tasks of this component, for a later task.
    fn replace(&mut self, component: u8, now: Instant) {
        for task in self
            .tasks
            .open_mut()
            .filter(|task| task.component == component)
        {
            if task.waits() {
                task.set_end(Stage::Aborted, now, REPLACED);
            } else if task.stage == Stage::Running {
                task.stage = Stage::Replaced;
                task.wake = now;
                if let Some(part) = self.components.component_mut(usize::from(component)) {
                    part.abort(now);
                }
            }
        }
    }

    pub(super) fn abort(&mut self, id: LinkId, now: Instant) -> Result<(), Refusal> {
        let Some(task) = self.tasks.get_mut(id) else {
            return Err(Refusal::NoSuchTask);
        };
        if task.waits() {
            task.set_end(Stage::Aborted, now, "aborted before it began");
        } else if task.stage == Stage::Running {
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

/// The result of an ended task, if its component keeps it.
pub(super) fn kept_result<'c, C: Components>(components: &'c C, task: &Task) -> Option<&'c str> {
    // Constant, and so the rest absent, if no component has long results.
    let result = components.result(task.component.into());
    (!result.is_empty() && task.is_kept()).then_some(result)
}

/// Whether an update keeps the components in the safe state.
fn is_updating<C: Components>(components: &C) -> bool {
    C::UPDATES
        && components
            .update()
            .is_some_and(|(state, _)| state.is_active())
}

/// The stage of the tasks for which all components go to the safe state.
fn stop_stage<C: Components>(components: &C) -> Stage {
    if !is_updating(components) {
        return Stage::Stopped;
    }
    match components.update() {
        Some((state, _)) if state.phase == UpdatePhase::Restarting => Stage::Restarting,
        _ => Stage::Updating,
    }
}

/// How and why a task ends whose component is going to the safe state. The reasons of updates are absent where there are
/// none.
const fn forced_end<C: Components>(stage: Stage) -> Option<(Stage, &'static str)> {
    match stage {
        Stage::Lost => Some((Stage::Failed, LINK_LOST)),
        Stage::Stopped => Some((Stage::Aborted, EMERGENCY_STOP)),
        Stage::Updating if C::UPDATES => Some((Stage::Aborted, UPDATING)),
        Stage::Restarting if C::UPDATES => Some((Stage::Aborted, RESTARTING)),
        _ => None,
    }
}

/// Whether a component goes to the safe state: all do, or it does not carry on without a link.
pub(super) fn goes_to_safety(component: &dyn Component, all: bool) -> bool {
    all || component.offer().loss != Loss::CarryOn
}
