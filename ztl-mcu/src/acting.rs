//! What a node's firmware does by itself: it starts tasks and reports events (`docs/link.md`, section 14).

use heapless::{String, Vec};
use ztl_core::Instant;
use ztl_core::link::LinkId;

use crate::component::{Components, Report, forward};
use crate::node::tasks::{TEXT, TaskText};

/// Most tasks of the firmware that a node holds at a time.
const TASKS: usize = 4;
/// Most events that wait.
const EVENTS: usize = 4;
/// How often an event is sent. A gateway that has not acknowledged it after these tries is older than events.
const TRIES: u8 = 50;

/// Components whose firmware starts tasks itself ([`Node::start_here`](crate::Node::start_here)) and reports events
/// ([`Node::report_event`](crate::Node::report_event)). Takes about 0.6 KiB of RAM.
///
/// ```
/// use ztl_mcu::{Acting, Component, Components, Instant, Node};
///
/// fn node<'a>(arm: impl Component, identity: ztl_mcu::Identity<'a>) -> Node<'a, impl Components, 4, 128> {
///     // With descriptions `Acting::new(Described((arm,)))`.
///     Node::new(identity, Acting::new((arm,)))
/// }
///
/// /// Called when a button on the device is pressed.
/// fn on_button<C: Components>(node: &mut Node<'_, C, 4, 128>, now: Instant) {
///     if let Err(reason) = node.start_here(now, 0, "up") {
///         node.report_event(now, &reason);
///     }
/// }
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Acting<C> {
    /// The components.
    pub components: C,
    own: OwnWork,
}

impl<C> Acting<C> {
    /// These components; the firmware has done nothing yet.
    pub const fn new(components: C) -> Self {
        Self {
            components,
            own: OwnWork {
                started: 0,
                tasks: [const { OwnTask::FREE }; TASKS],
                begun_due: Instant::ZERO,
                gone: None,
                events: Vec::new(),
                number: 1,
                tries: 0,
                event_due: Instant::ZERO,
                lost: 0,
            },
        }
    }
}

impl<C: Components> Components for Acting<C> {
    const ACTING: bool = true;

    forward!(components: parts descriptions bus parameters updates);

    fn own_work(&self) -> Option<&OwnWork> {
        Some(&self.own)
    }

    fn own_work_mut(&mut self) -> Option<&mut OwnWork> {
        Some(&mut self.own)
    }
}

/// What a node keeps about the tasks and events of its firmware; only [`Acting`] has it.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct OwnWork {
    /// Number of tasks that the firmware has started since the boot.
    started: u32,
    /// Those of the task table, and earlier ones whose place is free.
    tasks: [OwnTask; TASKS],
    /// When the first task that is not noted is announced next.
    pub(crate) begun_due: Instant,
    /// A task that the gateway knows and the node no longer holds.
    pub(crate) gone: Option<LinkId>,
    events: Vec<TaskText, EVENTS>,
    /// Number of the first event that waits.
    number: u32,
    /// How often that one was sent.
    tries: u8,
    /// When it is sent next.
    pub(crate) event_due: Instant,
    /// Events that found no room or were given up.
    lost: u32,
}

/// A task of the firmware, with what a gateway has to learn about it.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct OwnTask {
    id: LinkId,
    /// Whether the gateway of this session knows it.
    noted: bool,
    goal: String<TEXT>,
}

impl OwnTask {
    const FREE: Self = Self {
        id: LinkId(0),
        noted: true,
        goal: String::new(),
    };
}

impl OwnWork {
    /// A new session: its gateway may know nothing.
    pub(crate) fn on_session(&mut self, now: Instant) {
        for task in &mut self.tasks {
            task.noted = false;
        }
        self.begun_due = now;
        self.event_due = now;
        self.tries = 0;
        self.gone = None;
    }

    /// The id of the next task; `None` if there is no room for it.
    pub(crate) fn next_id(&self, is_held: impl Fn(LinkId) -> bool) -> Option<LinkId> {
        let id = LinkId::local(self.started.checked_add(1)?);
        let room = self.tasks.iter().any(|task| !is_held(task.id));
        (room && id > LinkId::local(self.started)).then_some(id)
    }

    /// Keeps a task that was started. There is room: [`next_id`](Self::next_id) was asked.
    pub(crate) fn keep(
        &mut self,
        now: Instant,
        id: LinkId,
        goal: &str,
        is_held: impl Fn(LinkId) -> bool,
    ) {
        self.started = self.started.saturating_add(1);
        self.begun_due = now;
        if let Some(task) = self.tasks.iter_mut().find(|task| !is_held(task.id)) {
            task.id = id;
            task.noted = false;
            task.goal.clear();
            // It fits: the length was checked.
            let _ = task.goal.push_str(goal);
        }
    }

    /// The gateway knows this task.
    pub(crate) fn on_noted(&mut self, now: Instant, id: LinkId) {
        for task in self.tasks.iter_mut().filter(|task| task.id == id) {
            task.noted = true;
            // The next one.
            self.begun_due = now;
        }
    }

    /// The first task to announce, with its goal.
    pub(crate) fn unnoted(&self, is_held: impl Fn(LinkId) -> bool) -> Option<(LinkId, &str)> {
        let unnoted = self.tasks.iter().filter(|task| !task.noted);
        let first = unnoted
            .filter(|task| is_held(task.id))
            .min_by_key(|task| task.id)?;
        Some((first.id, &first.goal))
    }

    /// Queues an event; returns whether there was room.
    pub(crate) fn add_event(&mut self, now: Instant, text: &str) -> bool {
        let mut kept = TaskText::new();
        Report::new(&mut kept).text(text);
        if self.events.is_empty() {
            self.event_due = now;
        }
        let added = self.events.push(kept).is_ok();
        self.lost = self.lost.wrapping_add(u32::from(!added));
        added
    }

    /// Whether an event waits.
    pub(crate) fn has_event(&self) -> bool {
        !self.events.is_empty()
    }

    /// The event to send, if it was not sent too often already.
    pub(crate) fn next_event(&mut self) -> Option<(u32, &str)> {
        if self.tries >= TRIES {
            self.drop_event();
            self.lost = self.lost.wrapping_add(1);
        }
        let first = self.events.first()?;
        self.tries += 1;
        Some((self.number, first))
    }

    /// The gateway has received an event.
    pub(crate) fn on_event_ack(&mut self, now: Instant, number: u32) {
        if number == self.number && self.tries > 0 {
            self.drop_event();
            self.event_due = now;
        }
    }

    fn drop_event(&mut self) {
        self.tries = 0;
        self.number = self.number.wrapping_add(1);
        if !self.events.is_empty() {
            self.events.remove(0);
        }
    }

    /// Number of events lost since the boot.
    pub(crate) const fn lost(&self) -> u32 {
        self.lost
    }
}
