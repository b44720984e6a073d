//! Requests of clients about the parameters of a device, one after the other.

use std::collections::VecDeque;

use tracing::info;
use ztl_core::{Instant, State};
use ztl_link::{
    DeviceInfo, Entry, ParameterAnswer, ParameterFailure, ParameterInfo, ParameterRequest, Session,
    SessionJournal,
};

use crate::gateway::parameters::{
    PARAMETERS, ParameterGoal, ParameterReport, find, full_name, read_value,
};
use crate::log_targets::GATEWAY;
use crate::server::TaskReporter;

/// A request of a client.
struct Job {
    task: TaskReporter,
    /// The goal's text.
    text: String,
    goal: ParameterGoal,
    /// The parameters read so far.
    known: Vec<ParameterInfo>,
    /// The index of the parameter that is being set.
    setting: Option<usize>,
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

    /// Takes a request of a client.
    pub(super) fn start<J: SessionJournal>(
        &mut self,
        now: Instant,
        session: &mut Session<J>,
        task: TaskReporter,
        text: String,
    ) {
        let goal = match ParameterGoal::parse(&text) {
            Ok(goal) => goal,
            Err(reason) => return task.rejected(reason),
        };
        self.jobs.push_back(Job {
            task,
            text,
            goal,
            known: Vec::new(),
            setting: None,
        });
        if self.jobs.len() == 1 {
            self.begin(now, session);
        }
    }

    fn begin<J: SessionJournal>(&mut self, now: Instant, session: &mut Session<J>) {
        if let Some(job) = self.jobs.front() {
            let first = match job.goal {
                ParameterGoal::Save => ParameterRequest::Save,
                _ => ParameterRequest::Read(0),
            };
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
    fn on_answer(&mut self, device: &DeviceInfo, answer: Option<ParameterInfo>) -> Next {
        let Some(info) = answer else {
            return Next::End(Ok(("saved".to_owned(), "saved".to_owned())));
        };
        if let Some(index) = self.setting {
            return self.on_set(device, index, &info);
        }
        self.known.push(info);
        match u8::try_from(self.known.len()) {
            Ok(next) if next < device.parameters => Next::Ask(ParameterRequest::Read(next)),
            _ => self.on_all_known(device),
        }
    }

    fn on_all_known(&mut self, device: &DeviceInfo) -> Next {
        let report = |info| ParameterReport::new(device, info);
        let found = |name: &str| {
            let index = find(device, &self.known, name)?;
            let info = self.known.get(index).ok_or("no such parameter")?;
            Ok::<_, String>((index, info))
        };
        match &self.goal {
            ParameterGoal::List | ParameterGoal::Save => {
                let all: Vec<_> = self.known.iter().map(report).collect();
                Next::done(&all, "read".to_owned())
            }
            ParameterGoal::Get(name) => match found(name) {
                Ok((_, info)) => Next::done(&report(info), "read".to_owned()),
                Err(reason) => Next::End(Err(reason)),
            },
            ParameterGoal::Set(name, text) => {
                let value = found(name).and_then(|(index, info)| {
                    let value = read_value(&full_name(device, info), info, text)?;
                    Ok((index, value))
                });
                match value.map(|(index, value)| (index, u8::try_from(index), value)) {
                    Ok((index, Ok(number), value)) => {
                        self.setting = Some(index);
                        Next::Ask(ParameterRequest::Set(number, value))
                    }
                    Ok(_) => Next::End(Err("no such parameter".to_owned())),
                    Err(reason) => Next::End(Err(reason)),
                }
            }
        }
    }

    fn on_set(&self, device: &DeviceInfo, index: usize, info: &ParameterInfo) -> Next {
        let report = ParameterReport::new(device, info);
        let before = self
            .known
            .get(index)
            .map(|info| ParameterReport::new(device, info));
        let before = before.map_or_else(String::new, |it| format!(", was {}", it.value));
        let told = format!("{} is {} {}", report.name, report.value, report.unit);
        Next::done(&report, format!("{}{before}", told.trim_end()))
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
        let entry = Entry {
            id: self.task.id(),
            component: PARAMETERS,
            goal: &self.text,
            sent: None,
        };
        // The device has acted already, so the client gets the true outcome even if the disk is full.
        let _ = session.journal_mut().ended(&entry, state, told);
        if matches!(self.goal, ParameterGoal::Set(..) | ParameterGoal::Save) {
            let (task, goal) = (self.task.id().get(), &self.text);
            info!(target: GATEWAY, device, task, "Device '{device}': parameters, {goal:?}: {told}");
        }
        match end {
            Ok((result, _)) => self.task.completed(result),
            Err(reason) => self.task.failed(reason),
        }
    }
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
