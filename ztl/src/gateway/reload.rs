//! Reloads the configuration of a running gateway. Logs what takes effect only at the next start. Changes nothing if
//! the configuration has mistakes.

use tracing::{error, info, warn};
use ztl_std::files::is_stream;
use ztl_std::gateway::Devices;
use ztl_std::gateway::config::DeviceConfig;
use ztl_std::server::ServerHandle;

use super::plan::{Gateway, Plan};
use crate::log;

/// The target of the gateway's log lines.
const LOG: &str = "gateway";

/// What a reload needs.
pub(super) struct Reload {
    /// The options of the start.
    pub(super) options: Gateway,
    pub(super) fleet: Devices,
    pub(super) control: ServerHandle,
    /// What the gateway serves now.
    pub(super) present: Plan,
}

impl Reload {
    /// Reads the configuration and applies what can change now.
    pub(super) fn run(&mut self) {
        let Some(file) = &self.options.file else {
            return warn!(target: LOG, "There is no configuration file to be reloaded.");
        };
        if let Some(stream) = self
            .options
            .files()
            .into_iter()
            .find(|path| is_stream(path))
        {
            let stream = stream.display();
            return error!(target: LOG, "{stream} cannot be read again, so nothing was reloaded.");
        }
        let file = file.display();
        let plan = match self.options.clone().plan() {
            Ok(plan) => plan,
            Err(unfit) => {
                let (placed, elsewhere) = unfit.sentences();
                for mistake in placed {
                    error!(target: LOG, "{mistake}");
                }
                for mistake in elsewhere {
                    error!(target: LOG, "{file}: {mistake}");
                }
                return error!(target: LOG, "{file}: the configuration was not reloaded; everything stays as it is.");
            }
        };
        for warning in plan.warnings() {
            warn!(target: LOG, "{warning}");
        }
        let mut restart = self.compare(&plan);
        self.change_server(&plan, &mut restart);
        self.change_devices(plan.devices);
        for key in &restart {
            warn!(target: LOG, "'{key}' has changed; restart to apply it.");
        }
        info!(target: LOG, "The configuration was reloaded.");
    }

    /// The changed keys that take effect at the next start.
    fn compare(&self, plan: &Plan) -> Vec<&'static str> {
        let (now, then) = (&self.present, plan);
        let changed = [
            ("scope", now.scope != then.scope),
            ("port", now.place.port != then.place.port),
            ("bind", now.place.bind != then.place.bind),
            ("publish", now.place.publish != then.place.publish),
            ("publish-format", now.publish_format != then.publish_format),
            ("journal", now.journal != then.journal),
            ("log-format", now.place.log_format != then.place.log_format),
        ];
        let changed = changed.into_iter().filter(|(_, changed)| *changed);
        changed.map(|(key, _)| key).collect()
    }

    fn change_server(&mut self, plan: &Plan, restart: &mut Vec<&'static str>) {
        let (now, then) = (&mut self.present.place, &plan.place);
        if now.log != then.log {
            log::set_level(then.log);
            now.log = then.log;
        }
        let (limits, fixed) = then.limits.for_running(&now.limits);
        restart.extend(fixed);
        if now.limits != limits {
            self.control.set_limits(limits);
            now.limits = limits;
        }
        if now.access != then.access {
            if self.control.set_access(then.access.clone()) {
                now.access = then.access.clone();
            } else if now.access.has_keys_of(&then.access) {
                restart.push("allow");
            } else {
                restart.push("key");
            }
        }
    }

    fn change_devices(&mut self, wanted: Vec<DeviceConfig>) {
        let before = std::mem::take(&mut self.present.devices);
        for device in &before {
            let stays =
                |new: &DeviceConfig| new.name == device.name && new.endpoint == device.endpoint;
            if !wanted.iter().any(stays) {
                self.fleet.remove(&device.name);
            }
        }
        for device in wanted {
            let known = before.iter().find(|known| known.name == device.name);
            let stays = known.is_some_and(|known| known.endpoint == device.endpoint);
            if !stays && let Err(error) = self.fleet.add(&device.name, device.endpoint.clone()) {
                warn!(target: LOG, device = device.name, "Device '{}' is not served: {error}", device.name);
                continue;
            }
            #[cfg(feature = "defmt")]
            if let Some(elf) = &device.elf
                && !(stays && known.is_some_and(|known| known.elf == device.elf))
                && let Err(error) = self.fleet.read_log(&device.name, elf)
            {
                warn!(target: LOG, device = device.name, "Device '{}': its log cannot be read: {error}", device.name);
            }
            self.present.devices.push(device);
        }
    }
}
