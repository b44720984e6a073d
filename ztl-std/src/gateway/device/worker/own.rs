//! What the device does itself: tasks that its firmware starts, and events that it reports.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tracing::info;

use super::Worker;
use crate::gateway::device::input::{DeviceRequest, Input};
use crate::log_targets::GATEWAY;
use crate::rate_limit::RateLimit;
use crate::server::{OwnTasks, ReservedId};
use crate::task_request::{TaskRequest, encoded};
use crate::time::now;

/// At most so many lines about events at once, and then one in this time.
const LINES: (u32, Duration) = (100, Duration::from_secs(1));

/// At most so many tasks of the firmware are taken up at once, and then one in this time: no device may push the outcomes
/// of others out of the journal. The rest wait in the device, which announces them again.
pub(super) const STARTS: (u32, Duration) = (20, Duration::from_millis(200));

/// The id for the next task of the firmware.
#[derive(Debug, Default)]
pub(super) enum NextId {
    #[default]
    Unasked,
    /// The server's thread sends it.
    Asked,
    Reserved(ReservedId),
}

/// Logs the events of a device, which may report any number of them.
#[derive(Debug)]
pub(super) struct EventLog {
    limit: RateLimit,
    /// Events that were not logged since the last line.
    left_out: u64,
}

impl EventLog {
    pub(super) fn new() -> Self {
        Self {
            limit: RateLimit::new(LINES.0, LINES.1, now()),
            left_out: 0,
        }
    }

    fn log(&mut self, device: &str, text: &str) {
        if !self.limit.take(now()) {
            self.left_out += 1;
            return;
        }
        let more = match std::mem::take(&mut self.left_out) {
            0 => String::new(),
            count => format!(" ({count} events before it were not logged)"),
        };
        info!(target: GATEWAY, device, "Device '{device}' reports: {text}{more}");
    }
}

impl Worker {
    /// The firmware has started a task: takes it up under an id for clients, as soon as there is one.
    pub(super) fn on_begun(&mut self) {
        if self.rejects_tasks().is_some() {
            return;
        }
        let id = match std::mem::take(&mut self.next_id) {
            NextId::Reserved(id) => id,
            NextId::Asked => {
                self.next_id = NextId::Asked;
                return;
            }
            NextId::Unasked => {
                if let Some(tasks) = self.own_tasks.get() {
                    let inputs = self.inputs.clone();
                    tasks.reserve(move |id| {
                        let _ = inputs.send(Input::Reserved(id));
                    });
                    self.next_id = NextId::Asked;
                }
                return;
            }
        };
        let Some(begun) = self.session.begun().cloned() else {
            self.next_id = NextId::Reserved(id);
            return;
        };
        if !self.starts.take(now()) {
            self.next_id = NextId::Reserved(id);
            return;
        }
        // Before any client sees it: a restarted gateway must know the id.
        if !self.session.take_up(now(), id.id()) {
            self.next_id = NextId::Reserved(id);
            return;
        }
        let request = TaskRequest {
            id: id.id(),
            handler: self.name.clone(),
            component: begun.component,
            goal: begun.goal,
        };
        let shown = DeviceRequest::from(&request);
        self.log_task(request.id, &shown, "was started by the device");
        let task = id.begin(encoded(&request.handler, &request.component, &request.goal));
        self.tasks.insert(request.id, (task, shown));
        self.transmit();
    }

    /// An id was reserved. The task may have ended meanwhile; the next one gets it then.
    pub(super) fn on_reserved(&mut self, id: ReservedId) {
        self.next_id = NextId::Reserved(id);
        if self.session.begun().is_some() {
            self.on_begun();
        }
    }

    /// The firmware reports an event.
    pub(super) fn on_reported(&mut self, text: &str) {
        self.event_log.log(&self.name, text);
        let topic = || format!("{}/events", self.name);
        self.observers.publish(topic, text.as_bytes());
    }
}

/// Where devices get ids, once the gateway is registered at a server.
#[derive(Debug, Clone, Default)]
pub(in crate::gateway) struct OwnTasksCell(Arc<Mutex<Option<OwnTasks>>>);

impl OwnTasksCell {
    pub(in crate::gateway) fn set(&self, tasks: OwnTasks) {
        let mut cell = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *cell = Some(tasks);
    }

    pub(super) fn get(&self) -> Option<OwnTasks> {
        let cell = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        cell.clone()
    }
}
