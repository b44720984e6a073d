//! Requests of clients about the parameters of a device, one after the other.

use std::collections::VecDeque;

use tracing::info;
use ztl_core::{Instant, State};
use ztl_link::{
    DeviceInfo, ParameterAnswer, ParameterFailure, ParameterInfo, ParameterRequest, Session,
    SessionJournal,
};

use super::input::DeviceRequest;
use crate::gateway::parameters::{ParameterGoal, ParameterReport, find, full_name, read_value};
use crate::log_targets::GATEWAY;
use crate::server::TaskReporter;
use crate::terminal::quoted;

/// A request of a client.
struct Job {
    task: TaskReporter,
    request: DeviceRequest,
    goal: ParameterGoal,
    /// The index of the parameter that was asked for last.
    reading: u8,
    /// The parameter that is being set, as it was before.
    before: Option<ParameterInfo>,
}

/// The requests that wait and the one that is being carried out, the first.
#[derive(Default)]
pub(super) struct Parameters {
    jobs: VecDeque<Job>,
    /// The number of the last request to the session.
    asked: u64,
}

impl Parameters {
    pub(super) fn is_empty(&self) -> bool {
        self.jobs.is_empty()
    }

    /// Takes a request of a client, which the journal has.
    pub(super) fn start<J: SessionJournal>(
        &mut self,
        now: Instant,
        session: &mut Session<J>,
        task: TaskReporter,
        request: DeviceRequest,
        goal: ParameterGoal,
    ) {
        self.jobs.push_back(Job {
            task,
            request,
            goal,
            reading: 0,
            before: None,
        });
        if self.jobs.len() == 1 {
            self.begin(now, session);
        }
    }

    fn begin<J: SessionJournal>(&mut self, now: Instant, session: &mut Session<J>) {
        if let Some(job) = self.jobs.front_mut() {
            let first = job.first(session.device());
            self.ask(now, session, first);
        }
    }

    fn ask<J: SessionJournal>(
        &mut self,
        now: Instant,
        session: &mut Session<J>,
        request: ParameterRequest,
    ) {
        self.asked += 1;
        session.request_parameter(now, self.asked, request);
    }

    /// Handles the answer to the request with this number.
    pub(super) fn on_answer<J: SessionJournal>(
        &mut self,
        now: Instant,
        name: &str,
        session: &mut Session<J>,
        number: u64,
        answer: ParameterAnswer,
    ) {
        let Some(job) = self.jobs.front_mut().filter(|_| number == self.asked) else {
            return;
        };
        let next = match (answer, session.device()) {
            (Ok(answer), Some(device)) => job.on_answer(device, answer),
            (Ok(_), None) => Next::End(Err("the device is not answering".to_owned())),
            (Err(failure), _) => Next::End(Err(reason(name, &job.goal, failure))),
        };
        match next {
            Next::Ask(request) => self.ask(now, session, request),
            Next::End(end) => {
                if let Some(job) = self.jobs.pop_front() {
                    job.end(name, session, end);
                }
                self.begin(now, session);
            }
        }
    }
}

/// What follows an answer.
enum Next {
    Ask(ParameterRequest),
    /// The result for the client and the text for the log; or why there is no result.
    End(Result<(String, String), String>),
}

impl Next {
    fn done(result: &impl serde::Serialize, told: String) -> Self {
        let result = serde_json::to_string(result);
        Self::End(
            result
                .map(|json| (json, told))
                .map_err(|error| error.to_string()),
        )
    }
}

impl Job {
    fn first(&mut self, device: Option<&DeviceInfo>) -> ParameterRequest {
        let index = match (&self.goal, device) {
            (ParameterGoal::Save, _) => return ParameterRequest::Save,
            // The answer to any other tells that there is none of this name.
            (ParameterGoal::Get(name) | ParameterGoal::Set(name, _), Some(device)) => {
                find(device, name).unwrap_or(0)
            }
            _ => 0,
        };
        self.read(index)
    }

    /// Asks for the parameter with this index.
    fn read(&mut self, index: usize) -> ParameterRequest {
        // A device has at most 255.
        self.reading = u8::try_from(index).unwrap_or(u8::MAX);
        ParameterRequest::Read(self.reading)
    }

    fn on_answer(&mut self, device: &DeviceInfo, answer: Option<ParameterInfo>) -> Next {
        let Some(info) = answer else {
            return Next::End(Ok(("saved".to_owned(), "saved".to_owned())));
        };
        if let Some(before) = &self.before {
            return on_set(device, before, &info);
        }
        let (Self { goal, .. }, reading) = (&self, usize::from(self.reading));
        let (ParameterGoal::Get(name) | ParameterGoal::Set(name, _)) = goal else {
            return match reading + 1 {
                next if next < device.parameters.into() => Next::Ask(self.read(next)),
                _ => {
                    let known = device.known_parameters.iter();
                    let all: Vec<_> = known.map(|it| ParameterReport::new(device, it)).collect();
                    Next::done(&all, "read".to_owned())
                }
            };
        };
        match (find(device, name), goal) {
            (Err(reason), _) => Next::End(Err(reason)),
            (Ok(index), _) if index != reading => Next::Ask(self.read(index)),
            (Ok(_), ParameterGoal::Set(_, text)) => {
                match read_value(&full_name(device, &info), &info, text) {
                    Ok(value) => {
                        self.before = Some(info);
                        Next::Ask(ParameterRequest::Set(self.reading, value))
                    }
                    Err(reason) => Next::End(Err(reason)),
                }
            }
            (Ok(_), _) => Next::done(&ParameterReport::new(device, &info), "read".to_owned()),
        }
    }

    /// Tells the log, the journal and the client.
    fn end<J: SessionJournal>(
        self,
        device: &str,
        session: &mut Session<J>,
        end: Result<(String, String), String>,
    ) {
        let (state, told) = match &end {
            Ok((_, told)) => (State::Completed, told),
            Err(reason) => (State::Failed, reason),
        };
        let entry = self.request.own_entry(self.task.id());
        // The device has acted already, so the client gets the true outcome even if the disk is full.
        let _ = session.journal_mut().ended(&entry, state, told);
        if matches!(self.goal, ParameterGoal::Set(..) | ParameterGoal::Save) {
            let (task, goal) = (self.task.id().get(), quoted(&self.request.goal));
            info!(target: GATEWAY, device, task, "Device '{device}': parameters, {goal:?}: {told}");
        }
        match end {
            Ok((result, _)) => self.task.completed(result),
            Err(reason) => self.task.failed(reason),
        }
    }
}

fn on_set(device: &DeviceInfo, before: &ParameterInfo, info: &ParameterInfo) -> Next {
    let report = ParameterReport::new(device, info);
    let before = ParameterReport::new(device, before).value;
    let told = format!("{} is {} {}", report.name, report.value, report.unit);
    Next::done(&report, format!("{}, was {before}", told.trim_end()))
}

/// Why a request has failed, for people.
fn reason(device: &str, goal: &ParameterGoal, failure: ParameterFailure) -> String {
    match failure {
        ParameterFailure::NoParameters => {
            format!("the firmware of '{device}' has no parameters, or is older than parameters")
        }
        ParameterFailure::NotSent(reason) => format!("not done: {reason}"),
        ParameterFailure::Refused(reason) => format!("the device refuses: {reason}"),
        ParameterFailure::Unknown => match goal {
            ParameterGoal::Set(..) | ParameterGoal::Save => {
                "the link was lost before the answer: it is unknown whether the device did it; list the parameters to see"
            }
            _ => "the link was lost before the answer",
        }
        .to_owned(),
    }
}
