//! What becomes of a device's tasks when the gateway stops.

use tracing::{info, warn};
use ztl_core::link::Loss;
use ztl_core::{Instant, TaskId};

use super::Worker;
use crate::log_targets::GATEWAY;
use crate::time::now;

impl Worker {
    /// Why it rejects tasks, if it does.
    pub(super) fn rejects_tasks(&self) -> Option<&'static str> {
        match (self.stopping, self.retired, &self.next) {
            (Some(_), _, _) => Some("the gateway is stopping"),
            (None, true, None) => Some("the device is not served any more"),
            (None, true, Some(_)) => Some("the device's tasks from before have not stopped yet"),
            (None, false, _) => None,
        }
    }

    /// Why it rejects what clients ask for, if it does. Tasks that the firmware has started are still taken up.
    pub(super) fn rejects_requests(&self) -> Option<String> {
        let reason = self.rejects_tasks().map(str::to_owned);
        reason.or_else(|| self.conflict())
    }

    /// Leaves tasks with an unknown outcome. Their clients get no final state.
    pub(super) fn leave_unconfirmed(&mut self) {
        let left = std::mem::take(&mut self.tasks);
        for (task, request) in left.into_values() {
            warn!(
                target: GATEWAY,
                device = self.name,
                "Device '{}' has not confirmed that {} stopped; the device acts by itself after hearing nothing for its link timeout.",
                self.name,
                request.shown
            );
            task.leave();
        }
        self.leave_update();
    }

    pub(super) fn on_stop(&mut self, leave_running: bool, end: Instant) {
        if self.stopping.is_some_and(|before| before <= end) {
            return;
        }
        self.stopping = Some(end);
        self.hand_over_update();
        for id in self.tasks.keys().copied().collect::<Vec<_>>() {
            match self.session.policy(id) {
                // The device started it without the gateway, and goes on without it.
                Some(policy) if leave_running || self.session.is_own(id) => self.leave(id, policy),
                _ => self.session.abort(now(), id),
            }
        }
        self.leave_update();
    }

    /// Leaves a task to its device.
    fn leave(&mut self, id: TaskId, policy: Loss) {
        let Some((task, request)) = self.tasks.remove(&id) else {
            return;
        };
        let what = match policy {
            Loss::Abort => "stops by itself after hearing nothing for its link timeout (abort)",
            Loss::Hold => {
                "stops by itself after hearing nothing for its link timeout, and keeps its position (hold)"
            }
            Loss::CarryOn => "carries on",
        };
        let (name, spec) = (&self.name, &request.shown);
        info!(target: GATEWAY, device = name, "Device '{name}': {spec} is left running; it {what}.");
        task.leave();
    }
}
