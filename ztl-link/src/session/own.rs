//! What the device does itself (`docs/link.md`, section 14): tasks that its firmware has started, and events.

use std::time::Duration;

use ztl_core::link::{Body, LinkId, Loss, NO_SEQ};
use ztl_core::{Instant, TaskId};

use super::Session;
use super::send::frame_bytes;
use crate::event::LinkEvent;
use crate::journal::{Sent, SessionJournal};
use crate::task::{Stage, Task};

/// Pause before the device is asked again about a task [14.5].
const ASK_PAUSE: Duration = Duration::from_millis(100);
/// Most tasks of a device itself that have not ended. A device holds at most 255 tasks.
const MOST: usize = 255;

/// What a session knows of the device's own work.
#[derive(Debug, Clone, Default)]
pub(crate) struct Own {
    begun: Option<BegunTask>,
    /// The boot of the device, and the latest of its tasks that was taken up [14.4].
    latest: Option<(u32, LinkId)>,
    /// Number of the latest event since the boot.
    event: u32,
}

/// A task that the firmware has started and the gateway has not taken up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BegunTask {
    link: LinkId,
    loss: Loss,
    /// Name of the component.
    pub component: String,
    /// The goal.
    pub goal: String,
}

impl Own {
    pub(crate) fn new(latest: Option<(u32, LinkId)>) -> Self {
        Self {
            latest,
            ..Self::default()
        }
    }

    /// The device was reset, or is greeted for the first time.
    pub(crate) fn on_boot(&mut self, replaces: u32) {
        self.begun = None;
        self.event = 0;
        if replaces == 0 {
            // Its tasks are numbered from the start again, even if the firmware uses the same boot id.
            self.latest = None;
        }
    }
}

impl<J: SessionJournal> Session<J> {
    /// The task that the firmware has started and that waits to be [taken up](Self::take_up).
    #[must_use]
    pub const fn begun(&self) -> Option<&BegunTask> {
        self.own.begun.as_ref()
    }

    /// Takes up the task that the firmware has [begun](Self::begun) under an id for clients: writes it into the journal and
    /// tells the device. Returns `false` if the device no longer announces a task, or the journal cannot be written; if the
    /// device still holds the task, [`LinkEvent::Begun`] follows again.
    pub fn take_up(&mut self, now: Instant, id: TaskId) -> bool {
        let (Some(begun), Some(device)) = (self.own.begun.take(), &self.device) else {
            return false;
        };
        let sent = Sent {
            link: begun.link,
            boot: device.boot,
            loss: begun.loss,
            link_timeout: device.link_timeout,
        };
        let mut task = Task::new(&begun.component, &begun.goal, now, Stage::Running(sent));
        task.ask_at = now + device.link_timeout;
        if self.journal.starting(&task.entry(id)).is_err() {
            return false;
        }
        self.own.latest = Some((sent.boot, sent.link));
        self.tasks.insert(id, task);
        self.note(sent.link);
        true
    }

    /// Whether the firmware of the device has started this task.
    #[must_use]
    pub fn is_own(&self, id: TaskId) -> bool {
        self.tasks.get(&id).is_some_and(Task::is_own)
    }

    /// Handles the announcement of a task.
    pub(crate) fn on_begun(&mut self, now: Instant, link: LinkId, component: u8, goal: &str) {
        if !link.is_local() {
            return;
        }
        if self.find(link).is_some() || self.was_taken_up(link) {
            self.on_own_heard(now, link);
            return self.note(link);
        }
        let mut components = self.device.iter().flat_map(|device| &device.components);
        // Until the device has described it, the name is unknown; the announcement comes again.
        let Some(info) = components.nth(component.into()) else {
            return;
        };
        if self.tasks.values().filter(|task| task.is_own()).count() >= MOST {
            return;
        }
        self.own.begun = Some(BegunTask {
            link,
            loss: info.loss,
            component: info.name.clone(),
            goal: goal.to_owned(),
        });
        self.events.push_back(LinkEvent::Begun);
    }

    /// Handles an event of the device.
    pub(crate) fn on_event(&mut self, number: u32, text: &str) {
        if number > self.own.event {
            self.own.event = number;
            self.events.push_back(LinkEvent::Reported(text.to_owned()));
        }
        let ack = frame_bytes(
            self.address,
            self.session,
            NO_SEQ,
            Body::EventAck { number },
        );
        self.out.extend_from_slice(&ack);
    }

    /// Whether this gateway has taken up a task, which may have ended since: a device announces its tasks in their order.
    pub(crate) fn was_taken_up(&self, link: LinkId) -> bool {
        let boot = self.device.as_ref().map(|device| device.boot);
        let latest = self.own.latest;
        latest.is_some_and(|(of, latest)| Some(of) == boot && link <= latest)
    }

    /// A frame about a task of the firmware has arrived: the device holds the task.
    pub(crate) fn on_own_heard(&mut self, now: Instant, link: LinkId) {
        let again = now + self.link_timeout();
        if let Some(task) = self.find(link).and_then(|id| self.tasks.get_mut(&id))
            && task.is_own()
        {
            task.ask_at = again;
        }
    }

    /// A new session has begun: asks soon about each task of the firmware, unless a frame about it arrives first.
    pub(crate) fn ask_about_own_soon(&mut self, now: Instant) {
        for task in self.tasks.values_mut().filter(|task| task.is_own()) {
            task.ask_at = now + ASK_PAUSE;
        }
    }

    /// Asks the device about tasks of its firmware about which no frame has arrived for a while [14.5].
    pub(crate) fn ask_about_own(&mut self, now: Instant) {
        if !self.answers() {
            return;
        }
        let mut asked = Vec::new();
        let (shared, boot) = (self.is_shared(), self.device.as_ref().map(|it| it.boot));
        for task in self.tasks.values_mut() {
            if let Some(sent) = task.stage.sent()
                && task.waits_for_word()
                // Another board would not know it.
                && (!shared || Some(sent.boot) == boot)
                && now >= task.ask_at
            {
                task.ask_at = now + ASK_PAUSE;
                asked.push(sent.link);
            }
        }
        for link in asked {
            self.note(link);
        }
    }

    fn note(&mut self, task: LinkId) {
        let noted = frame_bytes(self.address, self.session, NO_SEQ, Body::Noted { task });
        self.out.extend_from_slice(&noted);
    }
}

impl Task {
    /// Whether the firmware of the device has started this task.
    pub(crate) fn is_own(&self) -> bool {
        self.stage.sent().is_some_and(|sent| sent.link.is_local())
    }

    /// Whether to ask the device about this task when no frame about it arrives.
    pub(crate) fn waits_for_word(&self) -> bool {
        self.is_own() && self.may_run()
    }
}
