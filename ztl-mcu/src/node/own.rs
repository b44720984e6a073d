//! Tasks that the firmware starts itself, and its events (`docs/link.md`, section 14).

use core::time::Duration;

use ztl_core::link::{Body, LinkId, Loss, NO_SEQ, OwnAnswer};
use ztl_core::{Instant, State};

use super::link_state::LinkState;
use super::refusal::{Reason, Refusal};
use super::tasks::{TEXT, Table};
use super::{Components, Node};
use crate::acting::OwnWork;

/// How often a task or an event is announced until the gateway knows it.
const INTERVAL: Duration = Duration::from_millis(100);
const NO_LINK: &str = "no link";
const TOO_LONG: &str = "the goal is too long: more than 48 bytes";
/// The end of a task that was forgotten before the gateway learned its end.
const GONE: &str = "the device no longer holds the task";

fn reason(text: &str) -> Reason {
    let mut reason = Reason::new();
    // Every text here fits.
    let _ = reason.push_str(text);
    reason
}

impl<const N: usize> Table<N> {
    fn holds(&self, id: LinkId) -> bool {
        self.held().any(|task| task.id == id)
    }
}

impl<C: Components, const TASKS: usize, const FRAME: usize> LinkState<'_, C, TASKS, FRAME> {
    fn start_here(&mut self, now: Instant, component: u8, goal: &str) -> Result<LinkId, Reason> {
        self.check_link_timer(now);
        let index = usize::from(component);
        let part = self.runner.components.component(index);
        let acts = part.is_some_and(|part| part.offer().loss != Loss::CarryOn);
        let up = self.is_heard();
        if !up && acts && !self.runner.is_stopped() {
            return Err(reason(NO_LINK));
        }
        if goal.len() > TEXT {
            return Err(reason(TOO_LONG));
        }
        if !up {
            self.make_room_here(component);
        }
        let runner = &mut self.runner;
        let own = runner.components.own_work();
        let Some(id) = own.and_then(|own| own.next_id(|id| runner.tasks.holds(id))) else {
            return Err(reason(self.no_room().as_str()));
        };
        // The answer to the gateway's last command may be needed again.
        let answered = core::mem::take(&mut runner.reason);
        // Before the table holds the task, since its place among the own ones must be free then.
        if let Err(refusal) = runner.start(now, id, component, goal) {
            let why = core::mem::replace(&mut runner.reason, answered);
            return Err(match refusal {
                Refusal::ByComponent => why,
                Refusal::TableFull => reason(self.no_room().as_str()),
                refusal => reason(refusal.as_str()),
            });
        }
        runner.reason = answered;
        if let Some(own) = runner.components.own_work_mut() {
            own.keep(now, id, goal, |id| runner.tasks.holds(id));
        }
        Ok(id)
    }

    /// Why there is no room for a task.
    fn no_room(&self) -> Refusal {
        match self.runner.tasks.held().any(|task| task.end().is_some()) {
            true => Refusal::TableFullOfEnded,
            false => Refusal::TableFull,
        }
    }

    /// Without a gateway, no end of a task of the firmware is acknowledged. So ended tasks give up their places: those whose
    /// results the component keeps, and the oldest one if there is no other room.
    fn make_room_here(&mut self, component: u8) {
        let tasks = &mut self.runner.tasks;
        for task in tasks.held_mut() {
            if task.id.is_local() && task.component == component && task.is_kept() {
                task.forget();
            }
        }
        let own = self.runner.components.own_work();
        let has_id = own.is_some_and(|own| own.next_id(|id| tasks.holds(id)).is_some());
        if has_id && tasks.held().count() < TASKS {
            return;
        }
        let ended = tasks
            .held_mut()
            .filter(|task| task.id.is_local() && task.end().is_some());
        if let Some(oldest) = ended.min_by_key(|task| task.id) {
            oldest.forget();
        }
    }

    /// Handles what the gateway says of tasks and events of the firmware.
    pub(super) fn on_own_answer(&mut self, now: Instant, answer: OwnAnswer) {
        match answer {
            OwnAnswer::Noted { task } => self.on_noted(now, task),
            OwnAnswer::EventAck { number } => {
                if let Some(own) = self.runner.components.own_work_mut() {
                    own.on_event_ack(now, number);
                }
            }
        }
    }

    /// The gateway knows a task of the firmware. Answered by its progress or its outcome.
    fn on_noted(&mut self, now: Instant, id: LinkId) {
        let Some(own) = self.runner.components.own_work_mut() else {
            return;
        };
        match self.runner.tasks.get_mut(id) {
            Some(task) => {
                task.changed = true;
                own.on_noted(now, id);
            }
            None if id.is_local() => own.gone = Some(id),
            None => {}
        }
    }

    /// Encodes the answer to a `Noted` of a task that is not held, or announces a task of the firmware. Returns whether
    /// there was one.
    pub(super) fn encode_own_task(&mut self, now: Instant) -> bool {
        let address = self.address();
        let Some(own) = self.runner.components.own_work_mut() else {
            return false;
        };
        if let Some(task) = own.gone.take() {
            return self
                .frame_out
                .encode(address, self.session, NO_SEQ, |frame| {
                    Body::Ended {
                        task,
                        state: State::Failed,
                        result: GONE,
                    }
                    .put(frame);
                });
        }
        if now < own.begun_due {
            return false;
        }
        let tasks = &self.runner.tasks;
        let Some((task, goal)) = own.unnoted(|id| tasks.holds(id)) else {
            return false;
        };
        let component = tasks.held().find(|held| held.id == task);
        let component = component.map_or(u8::MAX, |held| held.component);
        let sent = self
            .frame_out
            .encode(address, self.session, NO_SEQ, |frame| {
                Body::Begun {
                    task,
                    component,
                    goal,
                }
                .put(frame);
            });
        own.begun_due = now + INTERVAL;
        sent
    }

    /// Encodes the first event; returns whether there was one.
    pub(super) fn encode_event(&mut self, now: Instant) -> bool {
        let address = self.address();
        let Some(own) = self.runner.components.own_work_mut() else {
            return false;
        };
        if now < own.event_due {
            return false;
        }
        own.event_due = now + INTERVAL;
        let Some((number, text)) = own.next_event() else {
            return false;
        };
        self.frame_out
            .encode(address, self.session, NO_SEQ, |frame| {
                Body::Event { number, text }.put(frame);
            })
    }

    /// When a task or an event of the firmware is to be sent, or [`Instant::NEVER`].
    pub(super) fn next_own(&self) -> Instant {
        let mut wake = Instant::NEVER;
        let Some(own) = self.runner.components.own_work() else {
            return wake;
        };
        if own.gone.is_some() {
            return Instant::ZERO;
        }
        if own.unnoted(|id| self.runner.tasks.holds(id)).is_some() {
            wake = own.begun_due;
        }
        if own.has_event() && self.is_heard() {
            wake = wake.min(own.event_due.max(self.receiving));
        }
        wake
    }
}

/// Work of the firmware itself, with components in [`Acting`](crate::Acting); with others it does not compile.
impl<C: Components, const TASKS: usize, const FRAME: usize> Node<'_, C, TASKS, FRAME> {
    /// Starts a task from a button or a program of the device, with a goal of at most 48 bytes, under the same rules as
    /// a client's. Returns its id. Clients see the task, can abort it, and learn its final state.
    ///
    /// While the link is lost, and before the first command of a gateway, only components that *carry on* take a task.
    /// Without a gateway, the node forgets ended tasks of the firmware when it needs their places. A node holds at most four
    /// tasks of the firmware.
    ///
    /// # Errors
    /// The reason for a refusal, such as `busy with another task`, `emergency stop` or `no link`.
    pub fn start_here(
        &mut self,
        now: Instant,
        component: u8,
        goal: &str,
    ) -> Result<LinkId, Reason> {
        const { assert!(C::ACTING, "put the components into `Acting`") };
        self.state.start_here(now, component, goal)
    }

    /// Aborts a task, as a client's abort does. Returns whether the node holds the task.
    pub fn abort_here(&mut self, now: Instant, task: LinkId) -> bool {
        const { assert!(C::ACTING, "put the components into `Acting`") };
        self.state.runner.abort(task, now).is_ok()
    }

    /// Reports an event to the gateway, in at most 48 bytes; a longer text is cut and ends in `…`. Four events wait.
    /// Returns `false` if there is no room, and the event is lost.
    ///
    /// The node sends the event until a gateway acknowledges it. A gateway that is older than events does not: then the event
    /// is lost after 5 s.
    pub fn report_event(&mut self, now: Instant, text: &str) -> bool {
        const { assert!(C::ACTING, "put the components into `Acting`") };
        let own = self.state.runner.components.own_work_mut();
        own.is_some_and(|own| own.add_event(now, text))
    }

    /// Number of events lost since the boot; wraps around.
    #[must_use]
    pub fn events_lost(&self) -> u32 {
        const { assert!(C::ACTING, "put the components into `Acting`") };
        let own = self.state.runner.components.own_work();
        own.map_or(0, OwnWork::lost)
    }
}

/// Whether a task is listed in `Welcome` and counted in `Pong`: a gateway that knows nothing of own tasks would abort them.
pub(super) fn is_listed<C: Components>(id: LinkId) -> bool {
    !C::ACTING || !id.is_local()
}
