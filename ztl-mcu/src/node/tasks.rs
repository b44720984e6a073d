//! What becomes of tasks: how they begin, wait, replace each other and end.

use ztl_core::link::{Busy, LinkId, Loss};
use ztl_core::tasks::{Task, TaskRules, Tasks, Text};
use ztl_core::time::earliest;
use ztl_core::{Event, Instant};

use super::commands::Answer;
use super::{Components, Inner};
use crate::component::{Refused, Report, Run};

/// Longest progress, result or reason of a task, and longest goal that can wait, in bytes.
pub(crate) const TEXT: usize = 48;

const STOPPED: &str = "emergency stop";
const LINK_LOST: &str = "link was lost";
const REPLACED: &str = "replaced by a later task";

/// What a node knows of a task besides its state and text.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Job {
    pub(super) component: u8,
    /// When the end or the progress is told next.
    pub(super) due: Instant,
    /// Whether the text has changed since it was told.
    pub(super) news: bool,
    stage: Stage,
}

/// How far a task is that has not ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Stage {
    /// Waits for its turn; its text is its goal.
    Waiting,
    Moving,
    /// Told to stop.
    Aborting,
    /// Told to stop, since a later task takes its place.
    Replaced,
}

pub(super) type Slot = Task<Job, heapless::String<TEXT>>;

pub(super) fn has_ended(task: &Slot) -> bool {
    task.state.is_final()
}

pub(super) fn waits(task: &Slot) -> bool {
    !has_ended(task) && task.extra.stage == Stage::Waiting
}

/// Whether it has its component for itself.
fn moves(task: &Slot) -> bool {
    !has_ended(task) && task.extra.stage != Stage::Waiting
}

fn end(task: &mut Slot, now: Instant, event: Event, reason: Option<&str>) {
    task.apply(now, event, reason);
    task.extra.due = now;
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
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        self.look_at_link(now);
        for (_, task) in self.tasks.iter_mut().filter(|(_, task)| moves(task)) {
            let place = usize::from(task.extra.component);
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            let before = task.text.clone();
            let run = component.poll(now, &mut Report::new(&mut task.text));
            task.extra.news |= before != task.text;
            let replaced = task.extra.stage == Stage::Replaced;
            match run {
                Run::Running => {}
                Run::Completed => end(task, now, Event::Complete, None),
                Run::Failed => end(task, now, Event::Fail, None),
                Run::Aborted => end(task, now, Event::Abort, replaced.then_some(REPLACED)),
            }
        }
        // Each of them moves then, or has ended.
        while let Some(task) = self.next_in_turn() {
            self.begin(now, task);
        }
    }

    /// Acts when the link timer has run out. Looked at before a command is carried out too: after
    /// a pause of the firmware the bytes that waited come first.
    pub(super) fn look_at_link(&mut self, now: Instant) {
        if let Some(commanded) = self.commanded
            && now >= commanded + self.identity.link_timeout
        {
            self.commanded = None;
            self.on_link_lost(now);
        }
    }

    /// When `handle_timeout` has something to do.
    pub(super) fn next_move(&self, now: Instant) -> Option<Instant> {
        let link = self.commanded.map(|at| at + self.identity.link_timeout);
        let moving = self.tasks.iter().filter(|(_, task)| moves(task));
        moving.fold(link, |wake, (_, task)| {
            let place = usize::from(task.extra.component);
            let component = self.components.component(place);
            earliest(wake, component.map(|c| c.poll_timeout(now)))
        })
    }

    /// The lowest task that waits for a component that no task moves.
    fn next_in_turn(&self) -> Option<LinkId> {
        let taken = |component| {
            let of_it = |task: &Slot| task.extra.component == component;
            self.tasks
                .iter()
                .any(|(_, task)| of_it(task) && moves(task))
        };
        let waiting = self.tasks.iter().filter(|(_, task)| waits(task));
        let in_turn = waiting.filter(|(_, task)| !taken(task.extra.component));
        in_turn.map(|(id, _)| id).min()
    }

    /// A task that waited begins, or ends as FAILED.
    fn begin(&mut self, now: Instant, id: LinkId) {
        let Some(task) = self.tasks.get_mut(id) else {
            return;
        };
        let goal = task.text.clone();
        let mut why = Report::new(&mut task.text);
        let place = usize::from(task.extra.component);
        let component = self.components.component_mut(place);
        match component.map(|component| component.start(now, &goal, &mut why)) {
            Some(Ok(())) => {
                task.text.clear();
                task.extra.stage = Stage::Moving;
                task.extra.news = true;
            }
            Some(Err(Refused)) | None => end(task, now, Event::Fail, None),
        }
    }

    pub(super) fn start(&mut self, now: Instant, wanted: Wanted<'_>) -> Result<(), Answer> {
        let Wanted {
            task,
            component,
            goal,
            before_ms,
        } = wanted;
        let refused = |reason| Err(Answer::Refused(reason));
        if now.as_millis() > before_ms {
            return refused("the command came too late");
        }
        if task <= self.highest {
            return refused("a task of this or a later id was started already");
        }
        if self.stopped {
            return refused(STOPPED);
        }
        let Some(part) = self.components.component_mut(usize::from(component)) else {
            return refused("no such component");
        };
        let of_it = |task: &Slot| task.extra.component == component;
        let open = |task: &Slot| of_it(task) && !has_ended(task);
        let busy = self.tasks.iter().any(|(_, task)| open(task));
        let policy = part.offer().busy;
        if busy && policy == Busy::Refuse {
            return refused("busy with another task");
        }
        part.check(goal, &mut Report::new(&mut self.reason))
            .map_err(|Refused| Answer::NotTaken)?;
        if busy && let Busy::Queue(most) = policy {
            let waiting = |task: &Slot| of_it(task) && waits(task);
            let count = self.tasks.iter().filter(|(_, task)| waiting(task)).count();
            if count >= usize::from(most) {
                return refused("busy, and no more tasks may wait");
            }
        }
        if busy && goal.len() > TEXT {
            return refused("busy, and the goal is too long to wait: more than 48 bytes");
        }
        let stage = if busy { Stage::Waiting } else { Stage::Moving };
        let mut job = Task::new(Job {
            component,
            due: now,
            news: busy,
            stage,
        });
        job.unacknowledged = true;
        if let Err(full) = self.tasks.admit(task, job) {
            return refused(full.as_str());
        }
        if busy {
            if policy == Busy::Replace {
                self.replace(now, component, task);
            }
            if let Some(task) = self.tasks.get_mut(task) {
                task.text.set(goal);
            }
        } else if part.start(now, goal, &mut Report::new(&mut self.reason)) == Err(Refused) {
            self.tasks.remove(task);
            return Err(Answer::NotTaken);
        }
        self.tasks.apply(now, task, Event::Accept, None);
        self.highest = task;
        Ok(())
    }

    /// Makes way for a later task.
    fn replace(&mut self, now: Instant, component: u8, later: LinkId) {
        for (id, task) in self.tasks.iter_mut() {
            if task.extra.component != component || *id == later || has_ended(task) {
                continue;
            }
            match task.extra.stage {
                Stage::Waiting => end(task, now, Event::Abort, Some(REPLACED)),
                Stage::Moving => {
                    task.extra.stage = Stage::Replaced;
                    if let Some(part) = self.components.component_mut(usize::from(component)) {
                        part.abort(now);
                    }
                }
                Stage::Aborting | Stage::Replaced => {}
            }
        }
    }

    pub(super) fn abort(&mut self, now: Instant, id: LinkId) -> Answer {
        let Some(task) = self.tasks.get_mut(id) else {
            return Answer::Refused("no such task");
        };
        if waits(task) {
            end(task, now, Event::Abort, Some("aborted before it began"));
        } else if moves(task) && task.extra.stage == Stage::Moving {
            task.extra.stage = Stage::Aborting;
            let place = usize::from(task.extra.component);
            if let Some(component) = self.components.component_mut(place) {
                component.abort(now);
            }
        }
        Answer::Aborting(id)
    }

    fn on_link_lost(&mut self, now: Instant) {
        for (_, task) in self.tasks.iter_mut().filter(|(_, task)| !has_ended(task)) {
            let place = usize::from(task.extra.component);
            let Some(component) = self.components.component_mut(place) else {
                continue;
            };
            if component.offer().loss == Loss::CarryOn {
                continue;
            }
            if moves(task) {
                component.make_safe(now);
            }
            end(task, now, Event::Fail, Some(LINK_LOST));
        }
    }

    pub(super) fn stop_everything(&mut self, now: Instant) {
        self.stopped = true;
        for place in 0..self.components.count() {
            if let Some(component) = self.components.component_mut(place) {
                component.make_safe(now);
            }
        }
        for (_, task) in self.tasks.iter_mut().filter(|(_, task)| !has_ended(task)) {
            end(task, now, Event::Abort, Some(STOPPED));
        }
    }
}
