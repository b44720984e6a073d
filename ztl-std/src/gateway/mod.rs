//! The gateway: microcontrollers as handlers of a task server.
//!
//! Each device has a [`Session`](session::Session) on a thread of its own, so a slow or dead one
//! harms no other. A client's `gripper:finger:40` goes to the device named `gripper`.

pub mod config;
mod device;
mod endpoint;
mod fleet;
mod handler;
mod journal;
mod logs;
mod reader;
mod readings;
mod report;
mod ring;
mod voice;

use std::collections::BTreeSet;
use std::io;
use std::sync::{Arc, Mutex};

use tracing::warn;

pub use device::Device;
pub use endpoint::{
    BAUD, Endpoint, EndpointError, InProcess, Line, ParseEndpoint, READ_TIMEOUT, is_pause,
};
pub use fleet::{AddError, Devices, Watch};
use fleet::{Fleet, Shared};
pub use journal::{DeviceBook, Journal, JournalError, Log, Moment, Storage};
pub use logs::{LogPiece, RawLog};
use reader::Opener;
use readings::Observers;
pub use readings::{Reading, Readings};
pub use report::{ComponentReport, DeviceReport, DeviceReports, FirmwareReport, LinkReport};
use voice::LOG;

use crate::random;

/// Devices as handlers: register it at a [`TaskServer`](crate::TaskServer) with
/// [`register_handler`](crate::TaskServer::register_handler).
#[derive(Debug)]
pub struct Gateway {
    devices: Devices,
    leave_running: bool,
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
