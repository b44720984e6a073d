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

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tracing::{info, warn};
use ztl_core::{State, TaskId, TaskSpec};

pub use device::Device;
pub use endpoint::{BAUD, Endpoint, EndpointError, Line};
#[cfg(feature = "sim")]
pub(crate) use endpoint::{READ_TIMEOUT, is_pause};
pub use journal::{DeviceBook, Journal, JournalError, Log, Moment, Storage};
pub use logs::{LogPiece, RawLog};
use reader::Opener;
use readings::Observers;
pub use readings::{Reading, Readings};
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
    devices: Devices,
    leave_running: bool,
}

/// A gateway's devices, also when the gateway is registered at a server: devices can come and go while
/// it serves.
#[derive(Debug, Clone)]
pub struct Devices(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    /// Who this gateway is, towards its devices.
    id: u64,
    journal: Option<Journal>,
    observers: Observers,
    fleet: Mutex<Fleet>,
}

#[derive(Debug, Default)]
struct Fleet {
    served: BTreeMap<String, Device>,
    /// Devices that are not served any more and may have tasks. Where they have no line, their tasks end as those
    /// of a device that does not answer. One that is served again keeps its tasks.
    absent: BTreeMap<String, Device>,
    /// Tasks of the journal that have no end and that nobody has been given yet, by device.
    unended: HashMap<TaskId, (String, session::Restored)>,
}

impl Fleet {
    /// A device, served or not.
    fn device(&self, name: &str) -> Option<&Device> {
        self.served.get(name).or_else(|| self.absent.get(name))
    }

    fn all(&self) -> impl Iterator<Item = &Device> {
        self.served.values().chain(self.absent.values())
    }
}

/// Why a device cannot be served.
#[derive(Debug)]
#[non_exhaustive]
pub enum AddError {
    /// One of this name is served.
    Served,
    /// The system gives no more threads.
    Thread(io::Error),
}

impl std::fmt::Display for AddError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Served => f.write_str("a device of this name is served already"),
            Self::Thread(cause) => write!(f, "no thread for it: {cause}"),
        }
    }
}

impl std::error::Error for AddError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Thread(cause) => Some(cause),
            Self::Served => None,
        }
    }
}

impl Devices {
    fn fleet(&self) -> MutexGuard<'_, Fleet> {
        self.0.fleet.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves one more device, as [`Gateway::add`] does. One that was served before may still have tasks: those that
    /// [`remove`](Self::remove) aborted end first; those of the journal are settled by the device's own word.
    ///
    /// # Errors
    /// As [`AddError`] says.
    pub fn add(&self, name: &str, endpoint: Endpoint) -> Result<(), AddError> {
        let mut fleet = self.fleet();
        if fleet.served.contains_key(name) {
            return Err(AddError::Served);
        }
        fleet.absent.retain(|_, device| !device.is_idle());
        let opener = endpoint.into();
        let device = match fleet.absent.remove(name) {
            Some(mut device) => {
                device.serve(opener);
                device
            }
            None => self
                .spawn(&fleet, name, Some(opener))
                .map_err(AddError::Thread)?,
        };
        fleet.served.insert(name.to_owned(), device);
        Ok(())
    }

    /// Serves a device no more: its tasks are aborted, and its line is closed when they have ended. Says whether
    /// there was one.
    pub fn remove(&self, name: &str) -> bool {
        let mut fleet = self.fleet();
        let Some(device) = fleet.served.remove(name) else {
            return false;
        };
        device.retire();
        fleet.absent.insert(name.to_owned(), device);
        true
    }

    fn spawn(&self, fleet: &Fleet, name: &str, opener: Option<Opener>) -> io::Result<Device> {
        let Shared {
            id,
            journal,
            observers,
            ..
        } = &*self.0;
        let book = journal.as_ref().map(|journal| journal.book(name));
        let its = |(device, _): &&(String, session::Restored)| device == name;
        let awaited = fleet.unended.values().filter(its).count();
        Device::spawn(name, opener, *id, book, awaited, observers.clone())
    }

    /// Logs what a device's firmware logs by defmt, made readable with its ELF file.
    ///
    /// # Errors
    /// When the file is no use for that, or there is no such device.
    #[cfg(feature = "defmt")]
    pub fn read_log(&self, device: &str, elf: &std::path::Path) -> Result<(), String> {
        let wrong = |error: &dyn std::fmt::Display| format!("{}: {error}", elf.display());
        let decoder = crate::defmt::Decoder::of_file(elf).map_err(|error| wrong(&error))?;
        let log = self.fleet().served.get(device).map(Device::log);
        let name = elf.display().to_string();
        let reading = log.ok_or("no such device")?.read_by(device, decoder, name);
        reading.map_err(|error| wrong(&error))
    }
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
        Self::of(random::number(), None)
    }

    /// A gateway without devices that keeps its promises across a restart: towards devices and
    /// clients it is the one that wrote the journal before.
    #[must_use]
    pub fn with_journal(journal: Journal) -> Self {
        Self::of(journal.gateway(), Some(journal))
    }

    fn of(id: u64, journal: Option<Journal>) -> Self {
        let unended = journal.iter().flat_map(Journal::unended);
        let fleet = Fleet {
            unended: unended
                .map(|(name, task)| (task.id, (name, task)))
                .collect(),
            ..Fleet::default()
        };
        let shared = Shared {
            id,
            journal,
            observers: Observers::default(),
            fleet: Mutex::new(fleet),
        };
        Self {
            devices: Devices(Arc::new(shared)),
            leave_running: false,
        }
    }

    /// Serves a device under a name. It need not be there yet: its line is opened when it can be,
    /// and again whenever it breaks. A second one of the same name replaces the first.
    ///
    /// # Errors
    /// When the system gives no more threads.
    pub fn add(&mut self, name: &str, endpoint: Endpoint) -> io::Result<()> {
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
        open: impl Fn() -> io::Result<Line> + Send + Sync + 'static,
    ) -> io::Result<()> {
        let opener = Opener {
            label: label.to_owned(),
            baud: None,
            may_be_half_open: false,
            path: None,
            open: Arc::new(open),
        };
        self.serve(name, opener)
    }

    fn serve(&mut self, name: &str, opener: Opener) -> io::Result<()> {
        let mut fleet = self.devices.fleet();
        let device = self.devices.spawn(&fleet, name, Some(opener))?;
        let before = fleet.served.insert(name.to_owned(), device);
        drop(fleet);
        // Stops it, which takes a while.
        drop(before);
        Ok(())
    }

    /// Makes threads for the devices that are not served any more.
    fn add_absent(&mut self) {
        let mut fleet = self.devices.fleet();
        let names = fleet.unended.values().map(|(name, _)| name.clone());
        let names: BTreeSet<String> = names.collect();
        for name in names {
            if fleet.device(&name).is_some() {
                continue;
            }
            warn!(target: LOG, "Device '{name}' has tasks in the journal, and is not served any more.");
            // Without a thread its tasks stay as they are.
            if let Ok(device) = self.devices.spawn(&fleet, &name, None) {
                fleet.absent.insert(name, device);
            }
        }
    }

    /// As [`Devices::read_log`]. To be called after the device was added.
    ///
    /// # Errors
    /// When the file is no use for that, or there is no such device.
    #[cfg(feature = "defmt")]
    pub fn read_log(&mut self, device: &str, elf: &std::path::Path) -> Result<(), String> {
        self.devices.read_log(device, elf)
    }

    /// What becomes of running tasks when the gateway ends. Default: each is aborted, which is waited
    /// for, for a second. With `true` they are left alone: what their components do then by
    /// themselves is logged, and no client is told an end.
    pub const fn set_leave_running(&mut self, leave: bool) {
        self.leave_running = leave;
    }

    /// To see the devices that there are, also when the gateway is registered at a server.
    #[must_use]
    pub fn watch(&self) -> Watch {
        Watch(self.devices.clone())
    }

    /// To change the devices that there are, also when the gateway is registered at a server.
    #[must_use]
    pub fn devices(&self) -> Devices {
        self.devices.clone()
    }
}

/// Sees a gateway's devices from outside.
#[derive(Debug, Clone)]
pub struct Watch(Devices);

impl Watch {
    /// What there is to be said of each device now.
    #[must_use]
    pub fn reports(&self) -> DeviceReports {
        let fleet = self.0.fleet();
        let devices = fleet.served.iter();
        devices
            .map(|(name, device)| (name.clone(), device.window().report(device.url())))
            .collect()
    }

    /// The latest of what a device's firmware has logged; `None` when there is no such device.
    #[must_use]
    pub fn raw_log(&self, device: &str) -> Option<RawLog> {
        let log = self.0.fleet().served.get(device)?.log();
        Some(log.raw())
    }
}

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
