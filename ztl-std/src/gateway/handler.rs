//! The gateway as a handler of a task server.

use tracing::info;
use ztl_core::{State, TaskId, TaskSpec};

use super::voice::LOG;
use super::{Gateway, LogPiece, device, report};
use crate::remote::encoded;
use crate::server::{
    Answers, Restored, RestoredTask, TaskHandler, TaskReporter, offered, would_take,
};

impl Drop for Gateway {
    fn drop(&mut self) {
        let fleet = std::mem::take(&mut *self.devices.fleet());
        // All at once; each is waited for as it is dropped.
        for device in fleet.all() {
            device.stop(self.leave_running);
            device.log().close();
        }
        self.devices.0.observers.close();
    }
}

impl TaskHandler for Gateway {
    fn start(&mut self, task: TaskReporter, payload: &str) {
        let mut buffer = vec![0; payload.len()];
        let spec = match TaskSpec::decode(payload, &mut buffer) {
            Ok(spec) => spec,
            Err(error) => return task.threw(error.to_string()),
        };
        let fleet = self.devices.fleet();
        match fleet.served.get(spec.handler) {
            Some(device) => device.start(task, &spec),
            None => {
                let names: Vec<&str> = fleet.served.keys().map(String::as_str).collect();
                let names = names.join(", ");
                task.rejected(format!("no device '{}'; there are: {names}", spec.handler));
            }
        }
    }

    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        let devices = self.devices.clone();
        Box::new(move || {
            let fleet = devices.fleet();
            let components: Vec<_> = fleet
                .served
                .values()
                .map(|device| device.window().components())
                .collect();
            let names = fleet.served.keys().map(String::as_str);
            let components = components.iter().map(|all| all.iter().map(AsRef::as_ref));
            offered(names.zip(components))
        })
    }

    fn answers(&self) -> Answers {
        let watch = self.watch();
        let asked = self.watch();
        let takes = would_take(move |spec| report::would_take(&asked.reports(), spec));
        Box::new(move |question| match question {
            "devices" => serde_json::to_string(&watch.reports()).ok(),
            question if question.starts_with("takes ") => takes(question),
            // `log NAME FROM`
            other => {
                let (name, from) = other.strip_prefix("log ")?.rsplit_once(' ')?;
                let piece = LogPiece::of(&watch.raw_log(name)?, from.parse().ok()?);
                serde_json::to_string(&piece).ok()
            }
        })
    }

    fn restored(&mut self) -> Restored {
        let Some(journal) = self.devices.0.journal.clone() else {
            return Restored::default();
        };
        self.add_absent();
        let mut tasks = journal.ended(|[device, component, goal], mut task| {
            task.payload = encoded(device, component, goal);
            if task.state == State::Rejected {
                // As its client was told.
                let spec = device::shown(&TaskSpec {
                    handler: device,
                    component,
                    goal,
                });
                task.text = format!("{spec} refused: {}", task.text);
            }
            task
        });
        let fleet = self.devices.fleet();
        let (ended, unended) = (tasks.len(), fleet.unended.len());
        info!(target: LOG, "Journal {}: tasks without an end {unended}, ends remembered {ended}.", journal.path().display());
        tasks.extend(fleet.unended.values().map(|(device, task)| {
            let text = if fleet.served.contains_key(device) {
                "device is not answering yet".to_owned()
            } else {
                format!("device '{device}' is not served any more")
            };
            RestoredTask {
                id: task.id,
                payload: encoded(device, &task.component, &task.goal),
                state: State::Accepted,
                text,
                ended: None,
            }
        }));
        Restored {
            tasks,
            last_id: journal.last_id(),
        }
    }

    fn resume(&mut self, task: TaskReporter) {
        let mut fleet = self.devices.fleet();
        let Some((name, known)) = fleet.unended.remove(&task.id()) else {
            return task.leave();
        };
        match fleet.device(&name) {
            Some(device) => device.resume(task, known),
            None => task.leave(),
        }
    }

    fn abort(&mut self, id: TaskId) {
        // The one that has the task knows it; there are few.
        for device in self.devices.fleet().all() {
            device.abort(id);
        }
    }
}
