//! The gateway: microcontrollers as handlers of a task server.
//!
//! Each device has a [`Session`](session::Session) on a thread of its own, so a slow or dead one
//! harms no other. A client's `gripper:finger:40` goes to the device named `gripper`.

pub mod config;
mod device;
mod endpoint;
mod journal;
mod logs;
mod reader;
mod readings;
mod report;
mod ring;
pub mod session;
mod voice;

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use tracing::{info, warn};
use ztl_core::{State, TaskId, TaskSpec};

pub use device::Device;
pub use endpoint::{BAUD, Endpoint, EndpointError, Line};
#[cfg(feature = "sim")]
pub(crate) use endpoint::{READ_TIMEOUT, is_pause};
pub use journal::{DeviceBook, Journal, JournalError, Log, Moment, Storage};
use logs::DeviceLog;
pub use logs::{LogPiece, RawLog};
use reader::Opener;
use readings::Observers;
pub use readings::{Reading, Readings};
use report::Window;
pub use report::{ComponentReport, DeviceReport, DeviceReports, FirmwareReport, LinkReport};
use voice::LOG;

use crate::random;
use crate::remote::encoded;
use crate::server::{
    Answers, Restored, RestoredTask, TaskHandler, TaskReporter, offered, would_take,
};

/// Devices as handlers: register it at a [`TaskServer`](crate::TaskServer) with
/// [`register_handler`](crate::TaskServer::register_handler).
#[derive(Debug)]
pub struct Gateway {
    /// Who this gateway is, towards its devices.
    id: u64,
    devices: BTreeMap<String, Device>,
    journal: Option<Journal>,
    /// Tasks of the journal that have no end and that nobody has been given yet, by device.
    unended: HashMap<TaskId, (String, session::Restored)>,
    /// Devices that have such tasks, and are not served any more: their tasks end as those of a
    /// device that does not answer.
    absent: BTreeMap<String, Device>,
    leave_running: bool,
    observers: Observers,
}

impl Default for Gateway {
    fn default() -> Self {
        Self::new()
    }
}

impl Gateway {
    /// A gateway without devices, and without a journal: after a restart it knows nothing of its
    /// tasks.
    #[must_use]
    pub fn new() -> Self {
        Self {
            id: random::number(),
            devices: BTreeMap::new(),
            leave_running: false,
            observers: Observers::default(),
            journal: None,
            unended: HashMap::new(),
            absent: BTreeMap::new(),
        }
    }

    /// A gateway without devices that keeps its promises across a restart: towards devices and
    /// clients it is the one that wrote the journal before.
    #[must_use]
    pub fn with_journal(journal: Journal) -> Self {
        let unended = journal.unended().into_iter();
        let mut gateway = Self::new();
        gateway.id = journal.gateway();
        gateway.unended = unended
            .map(|(name, task)| (task.id, (name, task)))
            .collect();
        gateway.journal = Some(journal);
        gateway
    }

    /// Serves a device under a name. It need not be there yet: its line is opened when it can be,
    /// and again whenever it breaks. A second one of the same name replaces the first.
    ///
    /// # Errors
    /// When the system gives no more threads.
    pub fn add(&mut self, name: &str, endpoint: Endpoint) -> std::io::Result<()> {
        self.serve(name, endpoint.into())
    }

    /// The same with a line of any kind: `open` is called on a thread of its own, whenever there is
    /// none, and may take its time; `label` is what it is called in the log.
    ///
    /// # Errors
    /// When the system gives no more threads.
    pub fn add_line(
        &mut self,
        name: &str,
        label: &str,
        open: impl Fn() -> std::io::Result<Line> + Send + Sync + 'static,
    ) -> std::io::Result<()> {
        let opener = Opener {
            label: label.to_owned(),
            baud: None,
            may_be_half_open: false,
            path: None,
            open: Arc::new(open),
        };
        self.serve(name, opener)
    }

    fn serve(&mut self, name: &str, opener: Opener) -> std::io::Result<()> {
        let device = self.spawn(name, Some(opener))?;
        self.devices.insert(name.to_owned(), device);
        Ok(())
    }

    fn spawn(&self, name: &str, opener: Option<Opener>) -> std::io::Result<Device> {
        let book = self.journal.as_ref().map(|journal| journal.book(name));
        let its = |(device, _): &&(String, session::Restored)| device == name;
        let awaited = self.unended.values().filter(its).count();
        let observers = self.observers.clone();
        Device::spawn(name, opener, self.id, book, awaited, observers)
    }

    /// A device, served or not.
    fn device(&self, name: &str) -> Option<&Device> {
        self.devices.get(name).or_else(|| self.absent.get(name))
    }

    /// Makes threads for the devices that are not served any more.
    fn add_absent(&mut self) {
        let names: Vec<String> = self
            .unended
            .values()
            .map(|(name, _)| name.clone())
            .collect();
        for name in names {
            if self.device(&name).is_some() {
                continue;
            }
            warn!(target: LOG, "Device '{name}' has tasks in the journal, and is not served any more.");
            // Without a thread its tasks stay as they are.
            if let Ok(device) = self.spawn(&name, None) {
                self.absent.insert(name, device);
            }
        }
    }

    /// Logs what the device's firmware logs by defmt, made readable with its ELF file. To be called after
    /// the device was added.
    ///
    /// # Errors
    /// When the file is no use for that, or there is no such device.
    #[cfg(feature = "defmt")]
    pub fn read_log(&mut self, device: &str, elf: &std::path::Path) -> Result<(), String> {
        let wrong = |error: &dyn std::fmt::Display| format!("{}: {error}", elf.display());
        let found = self.devices.get(device).ok_or("no such device")?;
        let decoder = crate::defmt::Decoder::of_file(elf).map_err(|error| wrong(&error))?;
        let name = elf.display().to_string();
        let reading = found.log().read_by(device, decoder, name);
        reading.map_err(|error| wrong(&error))
    }

    /// What becomes of running tasks when the gateway ends. Default: each is aborted, which is waited
    /// for, for a second. With `true` they are left alone: what their components do then by
    /// themselves is logged, and no client is told an end.
    pub const fn set_leave_running(&mut self, leave: bool) {
        self.leave_running = leave;
    }

    /// To see the devices that there are now, also when the gateway is registered at a server.
    #[must_use]
    pub fn watch(&self) -> Watch {
        let devices = self.devices.iter();
        let seen = devices.map(|(name, device)| Seen {
            name: name.clone(),
            url: device.url(),
            window: device.window(),
            log: device.log(),
        });
        Watch(seen.collect())
    }

    fn names(&self) -> String {
        let names: Vec<&str> = self.devices.keys().map(String::as_str).collect();
        names.join(", ")
    }
}

/// Sees a gateway's devices from outside.
#[derive(Debug, Clone)]
pub struct Watch(Arc<[Seen]>);

/// What is seen of one device.
#[derive(Debug)]
struct Seen {
    name: String,
    url: String,
    window: Window,
    log: DeviceLog,
}

impl Watch {
    /// What there is to be said of each device now.
    #[must_use]
    pub fn reports(&self) -> DeviceReports {
        let report = |seen: &Seen| (seen.name.clone(), seen.window.report(seen.url.clone()));
        self.0.iter().map(report).collect()
    }

    /// The latest of what a device's firmware has logged; `None` when there is no such device.
    #[must_use]
    pub fn raw_log(&self, device: &str) -> Option<RawLog> {
        let seen = self.0.iter().find(|seen| seen.name == device)?;
        Some(seen.log.raw())
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        // All at once; each is waited for as it is dropped.
        for device in self.devices.values().chain(self.absent.values()) {
            device.stop(self.leave_running);
            device.log().close();
        }
        self.observers.close();
    }
}

impl TaskHandler for Gateway {
    fn start(&mut self, task: TaskReporter, payload: &str) {
        let mut buffer = vec![0; payload.len()];
        let spec = match TaskSpec::decode(payload, &mut buffer) {
            Ok(spec) => spec,
            Err(error) => return task.threw(error.to_string()),
        };
        match self.devices.get(spec.handler) {
            Some(device) => device.start(task, &spec),
            None => {
                let names = self.names();
                task.rejected(format!("no device '{}'; there are: {names}", spec.handler));
            }
        }
    }

    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        let devices: Vec<(String, Window)> = self
            .devices
            .iter()
            .map(|(name, device)| (name.clone(), device.window()))
            .collect();
        Box::new(move || {
            let components: Vec<_> = devices
                .iter()
                .map(|(_, window)| window.components())
                .collect();
            let names = devices.iter().map(|(name, _)| name.as_str());
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
        let Some(journal) = self.journal.clone() else {
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
        let (ended, unended) = (tasks.len(), self.unended.len());
        info!(target: LOG, "Journal {}: tasks without an end {unended}, ends remembered {ended}.", journal.path().display());
        tasks.extend(self.unended.values().map(|(device, task)| {
            let text = if self.devices.contains_key(device) {
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
        let Some((name, known)) = self.unended.remove(&task.id()) else {
            return task.leave();
        };
        match self.device(&name) {
            Some(device) => device.resume(task, known),
            None => task.leave(),
        }
    }

    fn abort(&mut self, id: TaskId) {
        // The one that has the task knows it; there are few.
        for device in self.devices.values().chain(self.absent.values()) {
            device.abort(id);
        }
    }
}
