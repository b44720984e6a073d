//! Requests that the gateway carries out by itself: about parameters and firmware. The journal has each of them before a client
//! learns its id.

use ztl_core::State;
use ztl_link::SessionJournal as _;

use super::Worker;
use crate::gateway::device::input::DeviceRequest;
use crate::gateway::parameters::ParameterGoal;
use crate::server::TaskReporter;
use crate::time::now;

impl Worker {
    /// Writes the entry of a request. If that fails, the request is rejected.
    pub(super) fn begin_own(
        &mut self,
        task: TaskReporter,
        request: &DeviceRequest,
    ) -> Option<TaskReporter> {
        self.expect_start(&task, request);
        let entry = request.own_entry(task.id());
        match self.session.journal_mut().starting(&entry) {
            Ok(()) => Some(task),
            Err(reason) => {
                task.rejected(reason);
                None
            }
        }
    }

    /// Ends a request that changed nothing.
    pub(super) fn end_own(
        &mut self,
        task: TaskReporter,
        request: &DeviceRequest,
        end: Result<String, String>,
    ) {
        let (state, text) = match &end {
            Ok(result) => (State::Completed, result),
            Err(reason) => (State::Failed, reason),
        };
        let entry = request.own_entry(task.id());
        // Without this entry, the next gateway tells that the request was cut off.
        let _ = self.session.journal_mut().ended(&entry, state, text);
        match end {
            Ok(result) => task.completed(result),
            Err(reason) => task.failed(reason),
        }
    }

    pub(super) fn on_parameter_request(&mut self, task: TaskReporter, request: DeviceRequest) {
        let goal = match ParameterGoal::parse(&request.goal) {
            Ok(goal) => goal,
            Err(reason) => return task.rejected(reason),
        };
        if let Some(task) = self.begin_own(task, &request) {
            let session = &mut self.session;
            self.parameters.start(now(), session, task, request, goal);
        }
    }
}
