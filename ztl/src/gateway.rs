//! `ztl gateway`: serves microcontrollers as handlers of a task server.

mod plan;
mod reload;

use std::process::ExitCode;

use crate::exit::Done;
use crate::listen_options::{CheckFindings, MISCONFIGURED, verdict};
use crate::systemd::{self, Service};
use crate::terminal::{error_line, line};
use crate::{log, signals};
pub(crate) use plan::Gateway;
use plan::Plan;
use reload::Reload;

impl Gateway {
    pub(crate) fn run(self) -> Done {
        let options = self.clone();
        let (check, (plan, mut file)) = (self.check, self.draft());
        let plan = match (plan, file.is_wrong()) {
            // All that a check finds is reported together.
            (Some(plan), true) if check => return plan.check().tell(file, ""),
            (Some(plan), false) => plan,
            _ => {
                file.finish().unwrap_or_else(error_line);
                return Ok(ExitCode::from(MISCONFIGURED));
            }
        };
        let warnings = plan.warnings();
        for warning in &warnings {
            error_line(format_args!("ztl: warning: {warning}"));
        }
        if check {
            let verdict = verdict(warnings.len());
            return plan.check().tell(file, format_args!("{verdict}: {plan}."));
        }
        log::init_as(plan.place.log, plan.place.log_format);
        signals::catch()?;
        plan.serve(options)
    }
}

impl Plan {
    /// Checks all that [`serve`](Self::serve) needs, except the devices.
    fn check(&self) -> CheckFindings {
        let mut findings = self.place.check();
        let (port, place) = (self.place.port, self.journal_place);
        self.journal.check(port, &self.scope, place, &mut findings);
        findings
    }

    fn serve(self, options: Gateway) -> Done {
        let place = &self.place;
        let who = place.reachable();
        let mut server = place.listen()?;
        let names: Vec<&str> = self.devices.iter().map(|d| d.name.as_str()).collect();
        let mut devices = self.journal.gateway(place.port, &self.scope)?;
        devices.set_leave_running(self.leave_running);
        for device in &self.devices {
            devices.add(&device.name, device.endpoint.clone())?;
            #[cfg(feature = "defmt")]
            if let Some(elf) = &device.elf {
                devices.devices().read_log(&device.name, elf)?;
            }
        }
        if let Some(endpoint) = place.publish_endpoint() {
            let endpoint = devices.publish(&mut server, &endpoint, self.publish_format)?;
            line(format_args!("Publishing readings at {endpoint}."));
        }
        let watch = devices.devices();
        let fleet = devices.devices();
        server.register_handler(&self.scope, devices);
        let serving = format!(
            "Serving {} at {}, scope {}. Reachable for {who}.",
            names.join(", "),
            server.endpoint(),
            self.scope
        );
        let mut reload = Reload {
            options,
            fleet,
            control: server.handle(),
            present: self,
        };
        signals::at_reload(move || reload.run())?;
        line(serving);
        let handle = server.handle();
        let service = Service::ready(handle.clone(), move || {
            systemd::of_devices(&watch.reports())
        })?;
        signals::leave_at_the_second();
        service.stops(move || handle.stop());
        server.listen()?;
        line("Stopped.");
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }
}
