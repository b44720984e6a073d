//! The devices of a gateway, those that are served and those that were.

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ztl_core::TaskId;

use super::device::Device;
use super::endpoint::Endpoint;
use super::journal::Journal;
use super::logs::RawLog;
use super::reader::Opener;
use super::readings::Observers;
use super::report::DeviceReports;
use ztl_link;

/// A gateway's devices, also when the gateway is registered at a server: devices can come and go while
/// it serves.
#[derive(Debug, Clone)]
pub struct Devices(pub(super) Arc<Shared>);

#[derive(Debug)]
pub(super) struct Shared {
    /// Who this gateway is, towards its devices.
    pub(super) id: u64,
    pub(super) journal: Option<Journal>,
    pub(super) observers: Observers,
    pub(super) fleet: Mutex<Fleet>,
}

#[derive(Debug, Default)]
pub(super) struct Fleet {
    pub(super) served: BTreeMap<String, Device>,
    /// Devices that are not served any more and may have tasks. Where they have no line, their tasks end as those
    /// of a device that does not answer. One that is served again keeps its tasks.
    pub(super) absent: BTreeMap<String, Device>,
    /// Tasks of the journal that have no end and that nobody has been given yet, by device.
    pub(super) unended: HashMap<TaskId, (String, ztl_link::Restored)>,
}

impl Fleet {
    /// A device, served or not.
    pub(super) fn device(&self, name: &str) -> Option<&Device> {
        self.served.get(name).or_else(|| self.absent.get(name))
    }

    /// All of them.
    pub(super) fn all(&self) -> impl Iterator<Item = &Device> {
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
    pub(super) fn fleet(&self) -> MutexGuard<'_, Fleet> {
        self.0.fleet.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves one more device, as [`Gateway::add`](super::Gateway::add) does. One that was served before may still have tasks: those that
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

    /// A thread for a device; `opener` is none where it is not served.
    pub(super) fn spawn(
        &self,
        fleet: &Fleet,
        name: &str,
        opener: Option<Opener>,
    ) -> io::Result<Device> {
        let Shared {
            id,
            journal,
            observers,
            ..
        } = &*self.0;
        let book = journal.as_ref().map(|journal| journal.book(name));
        let its = |(device, _): &&(String, ztl_link::Restored)| device == name;
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

/// Sees a gateway's devices from outside.
#[derive(Debug, Clone)]
pub struct Watch(pub(super) Devices);

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
