//! The gateway: microcontrollers as handlers of a task server.
//!
//! Each device has a [`Session`](session::Session) on a thread of its own, so a slow or dead one
//! harms no other. A client's `gripper:finger:40` goes to the device named `gripper`.

pub mod config;
mod device;
mod endpoint;
mod report;
pub mod session;

use std::collections::BTreeMap;

use ztl_core::{TaskId, TaskSpec};

pub use device::Device;
pub use endpoint::{BAUD, Endpoint, EndpointError, Line};
pub(crate) use endpoint::{READ_TIMEOUT, is_pause};
use report::Window;
pub use report::{ComponentReport, DeviceReport, DeviceReports, FirmwareReport, LinkReport};

use crate::random;
use crate::server::{Answers, TaskHandler, TaskReporter, quoted};

/// Devices as handlers: register it at a [`TaskServer`](crate::TaskServer) with
/// [`register_handler`](crate::TaskServer::register_handler).
#[derive(Debug)]
pub struct Gateway {
    /// Who this gateway is, towards its devices.
    id: u64,
    devices: BTreeMap<String, Device>,
}

impl Default for Gateway {
    fn default() -> Self {
        Self::new()
    }
}

impl Gateway {
    /// A gateway without devices.
    #[must_use]
    pub fn new() -> Self {
        Self {
            id: random::number(),
            devices: BTreeMap::new(),
        }
    }

    /// Serves a device under a name. It need not be there yet: its line is opened when it can be,
    /// and again whenever it breaks. A second one of the same name replaces the first.
    ///
    /// # Errors
    /// When the system gives no more threads.
    pub fn add(&mut self, name: &str, endpoint: Endpoint) -> std::io::Result<()> {
        let device = Device::spawn(name, endpoint, self.id)?;
        self.devices.insert(name.to_owned(), device);
        Ok(())
    }

    fn names(&self) -> String {
        let names: Vec<&str> = self.devices.keys().map(String::as_str).collect();
        names.join(", ")
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
            .map(|(name, device)| (quoted(name), device.window()))
            .collect();
        Box::new(move || {
            let devices: Vec<String> = devices
                .iter()
                .map(|(name, window)| {
                    let names: Vec<String> =
                        window.components().iter().map(|n| quoted(n)).collect();
                    format!("{name}: [{}]", names.join(", "))
                })
                .collect();
            format!("{{{}}}", devices.join(", "))
        })
    }

    fn answers(&self) -> Answers {
        let devices: Vec<(String, String, Window)> = self
            .devices
            .iter()
            .map(|(name, device)| (name.clone(), device.url(), device.window()))
            .collect();
        Box::new(move |question| {
            let report = |(name, url, window): &(String, String, Window)| {
                (name.clone(), window.report(url.clone()))
            };
            let reports = || devices.iter().map(report).collect::<DeviceReports>();
            match question {
                "devices" => serde_json::to_string(&reports()).ok(),
                _ => None,
            }
        })
    }

    fn abort(&mut self, id: TaskId) {
        // The one that has the task knows it; there are few.
        for device in self.devices.values() {
            device.abort(id);
        }
    }
}
