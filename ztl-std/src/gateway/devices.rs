//! The devices of a gateway.

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ztl_core::TaskId;

use super::bus::{LineStatus, SharedLine};
use super::device::{Device, OwnTasksCell};
use super::endpoint::Endpoint;
use super::journal::{Journal, UnendedUpdate};
use super::logs::RawLog;
use super::opener::Opener;
use super::readings::Observers;
use super::report::DeviceReports;

/// A gateway's devices, which can be seen and changed while the gateway serves.
#[derive(Debug, Clone)]
pub struct Devices(pub(super) Arc<Shared>);

#[derive(Debug)]
pub(super) struct Shared {
    /// The gateway's id, as its devices know it.
    pub(super) id: u64,
    pub(super) journal: Option<Journal>,
    pub(super) observers: Observers,
    pub(super) own_tasks: OwnTasksCell,
    pub(super) devices: Mutex<DeviceMap>,
}

#[derive(Debug, Default)]
pub(super) struct DeviceMap {
    pub(super) served: BTreeMap<String, Device>,
    /// Devices that are no longer served but may have tasks. A device that is served again keeps its tasks.
    pub(super) retired: BTreeMap<String, Device>,
    /// Shared lines, whose nodes are devices.
    pub(super) lines: BTreeMap<String, SharedLine>,
    /// Tasks of the journal without an end that were not resumed yet, with their device.
    pub(super) unended: HashMap<TaskId, (String, ztl_link::Restored)>,
    /// The same for firmware updates.
    pub(super) updates: HashMap<TaskId, UnendedUpdate>,
}

impl DeviceMap {
    /// A device, served or retired.
    pub(super) fn device(&self, name: &str) -> Option<&Device> {
        self.served.get(name).or_else(|| self.retired.get(name))
    }

    /// Whether a device that is not served may be a node of a shared line that was not found yet.
    pub(super) fn is_expected(&self, name: &str) -> bool {
        let of = |bus: &String| {
            name.strip_prefix(bus)
                .is_some_and(|rest| rest.starts_with('.'))
        };
        self.lines.keys().any(of)
    }

    /// All devices.
    pub(super) fn all(&self) -> impl Iterator<Item = &Device> {
        self.served.values().chain(self.retired.values())
    }
}

/// Why a device cannot be added.
#[derive(Debug)]
#[non_exhaustive]
pub enum AddError {
    /// The name is in use.
    Served,
    /// The system has no more threads.
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
    pub(super) fn lock(&self) -> MutexGuard<'_, DeviceMap> {
        self.0
            .devices
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a device, like [`Gateway::add`](super::Gateway::add). One that was served before may still have tasks: those that
    /// [`remove`](Self::remove) aborted end first; those of the journal are settled by the device's reports.
    ///
    /// # Errors
    /// [`AddError`].
    pub fn add(&self, name: &str, endpoint: Endpoint) -> Result<(), AddError> {
        let mut map = self.lock();
        if map.served.contains_key(name) || map.lines.contains_key(name) {
            return Err(AddError::Served);
        }
        let Endpoint::Bus { wait, .. } = endpoint else {
            return self.add_device(&mut map, name, endpoint.into());
        };
        let (devices, bus) = (self.clone(), name.to_owned());
        let add_node = move |name: &str, opener: Opener, status: &LineStatus| {
            let added = devices.add_node(&bus, name, opener, status);
            added.map_err(|error| error.to_string())
        };
        let line = SharedLine::spawn(name, endpoint.into(), wait, Box::new(add_node));
        let line = line.map_err(AddError::Thread)?;
        map.lines.insert(name.to_owned(), line);
        Ok(())
    }

    /// Adds a node that was found on the shared line `bus`, unless the line was removed meanwhile.
    fn add_node(
        &self,
        bus: &str,
        name: &str,
        opener: Opener,
        status: &LineStatus,
    ) -> Result<(), AddError> {
        let mut map = self.lock();
        if !map.lines.get(bus).is_some_and(|line| line.is(status)) {
            return Ok(());
        }
        if map.served.contains_key(name) {
            return Err(AddError::Served);
        }
        self.add_device(&mut map, name, opener)?;
        if let Some(line) = map.lines.get_mut(bus) {
            line.devices.push(name.to_owned());
        }
        Ok(())
    }

    fn add_device(&self, map: &mut DeviceMap, name: &str, opener: Opener) -> Result<(), AddError> {
        map.retired.retain(|_, device| !device.is_unused());
        let device = match map.retired.remove(name) {
            Some(mut device) => {
                device.serve(opener);
                device
            }
            None => self
                .spawn(map, name, Some(opener))
                .map_err(AddError::Thread)?,
        };
        map.served.insert(name.to_owned(), device);
        Ok(())
    }

    /// Removes a device, or a shared line and its devices: aborts their tasks, and closes the line when they have ended.
    /// Returns whether there was one.
    pub fn remove(&self, name: &str) -> bool {
        let mut map = self.lock();
        let Some(line) = map.lines.remove(name) else {
            return Self::retire(&mut map, name);
        };
        for device in &line.devices {
            Self::retire(&mut map, device);
        }
        true
    }

    fn retire(map: &mut DeviceMap, name: &str) -> bool {
        let Some(device) = map.served.remove(name) else {
            return false;
        };
        device.retire();
        map.retired.insert(name.to_owned(), device);
        true
    }

    /// Starts the thread of a device; without `opener` for one that is not served.
    pub(super) fn spawn(
        &self,
        map: &DeviceMap,
        name: &str,
        opener: Option<Opener>,
    ) -> io::Result<Device> {
        let Shared {
            id,
            journal,
            observers,
            own_tasks,
            ..
        } = &*self.0;
        let journal = journal.as_ref().map(|journal| journal.of_device(name));
        let its = |(device, _): &&(String, ztl_link::Restored)| device == name;
        let updates = map.updates.values();
        let updates = updates.filter(|update| update.device == name).count();
        let awaited = map.unended.values().filter(its).count() + updates;
        let (observers, own_tasks) = (observers.clone(), own_tasks.clone());
        Device::spawn(name, opener, *id, journal, awaited, observers, own_tasks)
    }

    /// Decodes the defmt log of a device's firmware with its ELF file, and logs the messages.
    ///
    /// # Errors
    /// A message if the file cannot be used or there is no such device.
    #[cfg(feature = "defmt")]
    pub fn read_log(&self, device: &str, elf: &std::path::Path) -> Result<(), String> {
        let wrong = |error: &dyn std::fmt::Display| format!("{}: {error}", elf.display());
        let decoder = crate::defmt::Decoder::of_file(elf).map_err(|error| wrong(&error))?;
        let log = self.lock().served.get(device).map(Device::log);
        let name = elf.display().to_string();
        let reading = log.ok_or("no such device")?.read_by(device, decoder, name);
        reading.map_err(|error| wrong(&error))
    }

    /// A report on each device, and on each shared line.
    #[must_use]
    pub fn reports(&self) -> DeviceReports {
        let map = self.lock();
        let devices = map.served.iter();
        let devices = devices.map(|(name, it)| (name.clone(), it.status().report(it.url())));
        let lines = map.lines.iter();
        let lines = lines.map(|(name, line)| (name.clone(), line.report()));
        devices.chain(lines).collect()
    }

    /// The latest log of a device's firmware; `None` if there is no such device.
    #[must_use]
    pub fn raw_log(&self, device: &str) -> Option<RawLog> {
        let log = self.lock().served.get(device)?.log();
        Some(log.raw())
    }
}
