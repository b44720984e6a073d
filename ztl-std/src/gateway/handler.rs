//! The gateway: devices as a handler of a task server.

use std::collections::BTreeSet;
use std::io;
use std::sync::{Arc, Mutex};

use tracing::{info, warn};
use ztl_core::{State, TaskId, TaskSpec};

use super::device::{OwnTasksCell, shown};
use super::devices::{DeviceMap, Devices, Shared};
use super::endpoint::{Endpoint, Line};
use super::journal::Journal;
use super::logs::LogPiece;
use super::opener::Opener;
use super::reading_value::ReadingFormat;
use super::readings::{Observers, Readings};
use super::report;
use super::updates::UPDATES;
use crate::describe::Descriptions;
use crate::log_targets::GATEWAY;
use crate::random;
use crate::rate_limit::RateLimit;
use crate::server::{
    Answers, BindError, OwnTasks, ReservedIds, Restored, RestoredTask, TaskHandler, TaskReporter,
    TaskServer, offered, would_take,
};
use crate::task_request::{TaskRequest, encoded};
use crate::time::now;

/// Most readings that wait to be published.
const PUBLISHED: usize = 10_000;

/// Serves devices as handlers. Register it with
/// [`TaskServer::register_handler`](crate::TaskServer::register_handler).
#[derive(Debug)]
pub struct Gateway {
    devices: Devices,
    leave_running: bool,
    /// Limits the lines about tasks for devices that it does not have.
    refusals: RateLimit,
}

impl Default for Gateway {
    fn default() -> Self {
        Self::new()
    }
}

impl Gateway {
    /// A gateway without devices and without a journal: after a restart it does not know its tasks.
    #[must_use]
    pub fn new() -> Self {
        Self::of(random::number(), None)
    }

    /// A gateway without devices that continues from its journal after a restart.
    #[must_use]
    pub fn with_journal(journal: Journal) -> Self {
        Self::of(journal.gateway(), Some(journal))
    }

    fn of(id: u64, journal: Option<Journal>) -> Self {
        let unended = journal.iter().flat_map(Journal::unended);
        let updates = journal.iter().flat_map(Journal::unended_updates);
        let devices = DeviceMap {
            unended: unended
                .map(|(name, task)| (task.id, (name, task)))
                .collect(),
            updates: updates.map(|update| (update.id, update)).collect(),
            ..DeviceMap::default()
        };
        let shared = Shared {
            id,
            journal,
            observers: Observers::default(),
            own_tasks: OwnTasksCell::default(),
            devices: Mutex::new(devices),
        };
        Self {
            devices: Devices(Arc::new(shared)),
            leave_running: false,
            refusals: RateLimit::of_refusals(now()),
        }
    }

    /// Serves a device under a name. It need not be there yet: its line is opened when possible, and reopened when
    /// it breaks. A second device with the same name replaces the first. The nodes of a shared line become devices `name.NODE`
    /// when they are found.
    ///
    /// # Errors
    /// The system's error if it has no more threads.
    pub fn add(&mut self, name: &str, endpoint: Endpoint) -> io::Result<()> {
        if matches!(endpoint, Endpoint::Bus { .. }) {
            self.devices.remove(name);
            return self.devices.add(name, endpoint).map_err(io::Error::other);
        }
        self.serve(name, endpoint.into())
    }

    /// Serves a device at a line of any kind. `open` is called on a thread of its own whenever there is no line,
    /// and may block; `label` names the line in the log.
    ///
    /// # Errors
    /// Those of [`add`](Self::add).
    pub fn add_line(
        &mut self,
        name: &str,
        label: &str,
        open: impl Fn() -> io::Result<Line> + Send + Sync + 'static,
    ) -> io::Result<()> {
        let opener = Opener {
            label: label.to_owned(),
            baud: None,
            may_be_half_open: false,
            path: None,
            seat: None,
            open: Arc::new(open),
        };
        self.serve(name, opener)
    }

    fn serve(&mut self, name: &str, opener: Opener) -> io::Result<()> {
        let mut map = self.devices.lock();
        let device = self.devices.spawn(&map, name, Some(opener))?;
        let before = map.served.insert(name.to_owned(), device);
        drop(map);
        // Stops the old device, which takes a while.
        drop(before);
        Ok(())
    }

    /// Starts threads for devices that are no longer served but have tasks in the journal.
    fn add_retired(&mut self) {
        let mut map = self.devices.lock();
        let names = map.unended.values().map(|(name, _)| name.clone());
        let names = names.chain(map.updates.values().map(|update| update.device.clone()));
        let names: BTreeSet<String> = names.collect();
        for name in names {
            if map.device(&name).is_some() {
                continue;
            }
            if !map.is_expected(&name) {
                warn!(target: GATEWAY, "Device '{name}' has tasks in the journal but is no longer served.");
            }
            // Without a thread its tasks stay unended.
            if let Ok(device) = self.devices.spawn(&map, &name, None) {
                map.retired.insert(name, device);
            }
        }
    }

    /// Sets what happens to running tasks when the gateway ends. By default they are aborted, which may take a
    /// second. With `true` they are left running: the log says what their components do by themselves, and
    /// clients get no final state.
    pub const fn set_leave_running(&mut self, leave: bool) {
        self.leave_running = leave;
    }

    /// Its devices. They can be inspected and changed also after the gateway is registered at a server.
    #[must_use]
    pub fn devices(&self) -> Devices {
        self.devices.clone()
    }

    /// All readings of its devices from now on. At most `capacity` of them wait to be taken.
    #[must_use]
    pub fn observe(&self, capacity: usize) -> Readings {
        self.devices.0.observers.add(capacity)
    }

    /// Publishes the readings at a ZeroMQ endpoint such as `tcp://127.0.0.1:12346`, until the gateway ends;
    /// returns the endpoint with the chosen port. A message has two frames, the topic and the reading in this format.
    /// Clients that may connect to `server` may subscribe.
    ///
    /// # Errors
    /// [`BindError`].
    pub fn publish(
        &self,
        server: &mut TaskServer,
        endpoint: &str,
        format: ReadingFormat,
    ) -> Result<String, BindError> {
        self.observe(PUBLISHED).publish(server, endpoint, format)
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        let map = std::mem::take(&mut *self.devices.lock());
        // All at once; dropping each waits for it.
        for device in map.all() {
            device.stop(self.leave_running);
            device.log().close();
        }
        self.devices.0.observers.close();
    }
}

/// Names what there is instead of a device: the nodes, if it is a shared line.
fn no_device<'a>(name: &str, served: impl Iterator<Item = &'a String> + Clone) -> String {
    let join = |names: Vec<&str>| names.join(", ");
    let of_line = |node: &&str| {
        let rest = node.strip_prefix(name);
        rest.is_some_and(|rest| rest.starts_with('.'))
    };
    let nodes: Vec<&str> = served.clone().map(String::as_str).filter(of_line).collect();
    if nodes.is_empty() {
        let all = join(served.map(String::as_str).collect());
        return format!("no device '{name}'; there are: {all}");
    }
    let nodes = join(nodes);
    format!("no device '{name}': it is a shared line, and its nodes are: {nodes}")
}

impl TaskHandler for Gateway {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        let map = self.devices.lock();
        match map.served.get(&request.handler) {
            Some(device) => device.start(task, &request),
            None => {
                if self.refusals.take(now()) {
                    let (id, spec) = (task.id().get(), shown(&request.spec()));
                    info!(target: GATEWAY, task = id, "Task {id} {spec} was refused: no such device");
                }
                task.rejected(no_device(&request.handler, map.served.keys()));
            }
        }
    }

    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        let devices = self.devices.clone();
        Box::new(move || {
            let map = devices.lock();
            let components: Vec<_> = map
                .served
                .values()
                .map(|device| device.status().components())
                .collect();
            let names = map.served.keys().map(String::as_str);
            let components = components.iter().map(|all| all.iter().map(AsRef::as_ref));
            offered(names.zip(components))
        })
    }

    fn describe(&self) -> Descriptions {
        let devices = self.devices();
        Box::new(move || {
            let map = devices.lock();
            let all = map.served.iter();
            let all = all.map(|(name, device)| (name.clone(), device.status().descriptions()));
            Arc::new(all.collect())
        })
    }

    fn answers(&self) -> Answers {
        let devices = self.devices();
        let asked = self.devices();
        let takes = would_take(move |spec| report::would_take(&asked.reports(), spec));
        Box::new(move |question| match question {
            "devices" => serde_json::to_string(&devices.reports()).ok(),
            question if question.starts_with("takes ") => takes(question),
            // `log NAME FROM`
            other => {
                let (name, from) = other.strip_prefix("log ")?.rsplit_once(' ')?;
                let piece = LogPiece::of(&devices.raw_log(name)?, from.parse().ok()?);
                serde_json::to_string(&piece).ok()
            }
        })
    }

    fn restored(&mut self) -> Restored {
        let Some(journal) = self.devices.0.journal.clone() else {
            return Restored::default();
        };
        self.add_retired();
        let mut tasks = journal.ended(|[device, component, goal], mut task| {
            task.payload = encoded(device, component, goal);
            if task.state == State::Rejected {
                // The text that its client received.
                let spec = shown(&TaskSpec {
                    handler: device,
                    component,
                    goal,
                });
                task.text = format!("{spec} refused: {}", task.text);
            }
            task
        });
        let map = self.devices.lock();
        let (ended, unended) = (tasks.len(), map.unended.len());
        info!(target: GATEWAY, "Journal {}: tasks without an end {unended}, ends remembered {ended}.", journal.path().display());
        tasks.extend(map.unended.values().map(|(device, task)| {
            let text = if map.served.contains_key(device) || map.is_expected(device) {
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
                by_device: task.sent.link.is_local(),
            }
        }));
        tasks.extend(map.updates.values().map(|update| RestoredTask {
            id: update.id,
            payload: encoded(&update.device, UPDATES, &update.goal),
            state: State::Accepted,
            text:
                "the gateway was restarted; the update goes on when the device answers".to_owned(),
            ended: None,
            by_device: false,
        }));
        Restored {
            tasks,
            last_id: None,
        }
    }

    fn reserved_ids(&self) -> Option<Arc<ReservedIds>> {
        Some(self.devices.0.journal.as_ref()?.reserved_ids())
    }

    fn connect(&mut self, own_tasks: OwnTasks) {
        self.devices.0.own_tasks.set(own_tasks);
    }

    fn resume(&mut self, task: TaskReporter) {
        let mut map = self.devices.lock();
        if let Some(update) = map.updates.remove(&task.id()) {
            return match map.device(&update.device) {
                Some(device) => device.resume_update(task, update),
                None => task.leave(),
            };
        }
        let Some((name, known)) = map.unended.remove(&task.id()) else {
            return task.leave();
        };
        match map.device(&name) {
            Some(device) => device.resume(task, known),
            None => task.leave(),
        }
    }

    fn abort(&mut self, id: TaskId) {
        // Only the device that has the task reacts.
        for device in self.devices.lock().all() {
            device.abort(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::no_device;

    #[test]
    fn a_shared_line_is_named_with_its_nodes() {
        let served = ["arm.left", "arm.right", "army", "hand"].map(str::to_owned);
        assert_eq!(
            no_device("arm", served.iter()),
            "no device 'arm': it is a shared line, and its nodes are: arm.left, arm.right"
        );
        assert_eq!(
            no_device("head", served[2..].iter()),
            "no device 'head'; there are: army, hand"
        );
    }
}
