//! `ztl gateway`: microcontrollers as handlers of a task server.

mod reload;

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use ztl_std::gateway::config::{Config, DeviceConfig, name_mistake, same_line};
use ztl_std::scope;

use crate::exit::Done;
use crate::reach::{self, Findings, MISCONFIGURED, Unfit};
use crate::service::{self, Service};
use crate::terminal::{error_line, line};
use crate::tool::port;
use crate::{journal, log, signals};
use reload::Reload;

#[derive(Debug, Clone, clap::Args)]
#[command(
    after_help = "URLs: serial:/dev/ttyACM0?baud=115200 (or a pty's path), tcp:HOST:PORT, sim:gripper, sim:head\nAn option overrides what FILE says; devices are added to the file's."
)]
pub(crate) struct Gateway {
    /// Configuration in YAML: scope, port, devices and more (docs/gateway.md)
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,

    /// A device: the name under which clients know it, and where it is (repeatable)
    #[arg(short, long = "device", value_name = "NAME=URL", value_parser = device)]
    devices: Vec<DeviceConfig>,

    /// The ELF file of a device's firmware: what it logs by defmt goes to the log (repeatable)
    #[cfg(feature = "defmt")]
    #[arg(long = "elf", value_name = "NAME=FILE", value_parser = elf)]
    elfs: Vec<(String, PathBuf)>,

    /// Scope to serve, as /lab
    #[arg(short, long, value_parser = scope)]
    scope: Option<String>,

    #[command(flatten)]
    listen: reach::Listening,

    /// Publish the devices' readings at this port, for any ZeroMQ subscriber
    #[arg(long, value_name = "PORT", value_parser = port)]
    publish: Option<u16>,

    /// When stopped, leave running tasks alone instead of aborting them
    #[arg(long)]
    leave_running: bool,

    /// Only say what is wrong with the configuration
    #[arg(long)]
    check: bool,

    #[command(flatten)]
    journal: journal::Options,
}

fn device(text: &str) -> Result<DeviceConfig, String> {
    let (name, url) = text
        .split_once('=')
        .ok_or("write NAME=URL, as gripper=serial:/dev/ttyACM0")?;
    fits(name, name_mistake)?;
    let endpoint = ztl_sim::endpoint(url)?;
    Ok(DeviceConfig::new(name, endpoint))
}

#[cfg(feature = "defmt")]
fn elf(text: &str) -> Result<(String, PathBuf), String> {
    let (name, path) = text
        .split_once('=')
        .ok_or("write NAME=FILE, as gripper=target/thumbv6m-none-eabi/release/gripper")?;
    Ok((name.to_owned(), path.into()))
}

fn fits(text: &str, mistake: fn(&str) -> Option<String>) -> Result<String, String> {
    mistake(text).map_or_else(|| Ok(text.to_owned()), Err)
}

fn scope(text: &str) -> Result<String, String> {
    fits(text, scope::cannot_be_served)
}

/// Adds the ELF files of the command line to the devices, and looks whether all are of use.
#[cfg(feature = "defmt")]
fn with_elfs(devices: &mut [DeviceConfig], elfs: Vec<(String, PathBuf)>) -> Result<(), Unfit> {
    for (name, path) in elfs {
        let Some(device) = devices.iter_mut().find(|device| device.name == name) else {
            let names: Vec<&str> = devices.iter().map(|d| d.name.as_str()).collect();
            let names = names.join(", ");
            let mistake = format!("--elf: no device '{name}'; there are: {names}");
            return Err(Unfit::Whole(mistake));
        };
        device.elf = Some(path);
    }
    for device in devices {
        let Some(path) = &device.elf else { continue };
        if let Err(error) = ztl_std::defmt::Decoder::of_file(path) {
            let mistake = format!(
                "the firmware of '{}', {}: {error}",
                device.name,
                path.display()
            );
            return Err(Unfit::Whole(mistake));
        }
    }
    Ok(())
}

/// All that is needed to serve.
struct Plan {
    scope: String,
    place: reach::Place,
    leave_running: bool,
    publish: Option<u16>,
    devices: Vec<DeviceConfig>,
    journal: journal::Options,
}

impl Gateway {
    pub(crate) fn run(self) -> Done {
        let (check, options) = (self.check, self.clone());
        let plan = match self.plan() {
            Ok(plan) => plan,
            Err(unfit) => {
                error_line(unfit);
                return Ok(ExitCode::from(MISCONFIGURED));
            }
        };
        if check {
            return plan.check().tell(format_args!("Nothing is wrong: {plan}."));
        }
        log::init_as(plan.place.log, plan.place.log_format);
        signals::catch()?;
        plan.serve(options)
    }

    /// The files that it names.
    fn files(&self) -> Vec<&Path> {
        let file = self.file.iter().map(PathBuf::as_path);
        #[cfg_attr(not(feature = "defmt"), expect(unused_mut, reason = "no ELF files"))]
        let mut files: Vec<&Path> = file.chain(self.listen.files()).collect();
        #[cfg(feature = "defmt")]
        files.extend(self.elfs.iter().map(|(_, path)| path.as_path()));
        files
    }

    /// What the file and the options say together.
    fn plan(self) -> Result<Plan, Unfit> {
        let config = match &self.file {
            Some(path) => Config::load(path, ztl_sim::endpoint).map_err(Unfit::File)?,
            None => Config::default(),
        };
        let file = self.file.map(|path| path.display().to_string());
        let missing = |what: &str, option: &str, key: &str| {
            Unfit::missing(file.as_deref(), what, option, key)
        };
        let mut devices = config.devices;
        for device in self.devices {
            if devices.iter().any(|known| known.name == device.name) {
                let mistake = format!(
                    "two devices are named '{}'; give each its own name",
                    device.name
                );
                return Err(Unfit::Whole(mistake));
            }
            if let Some(other) = same_line(&devices, &device) {
                let mistake = format!(
                    "'{}' and '{}' are both at {}",
                    other.name, device.name, other.endpoint
                );
                return Err(Unfit::Whole(mistake));
            }
            devices.push(device);
        }
        #[cfg(feature = "defmt")]
        with_elfs(&mut devices, self.elfs)?;
        if devices.is_empty() {
            let key = "devices:";
            return Err(missing("device", "--device <NAME=URL>", key));
        }
        let place = self.listen.with(config.listen)?;
        let place = place.ok_or_else(|| missing("port", "--port <PORT>", "port: 12345"))?;
        let scope = self.scope.or(config.scope);
        let publish = self.publish.or(config.publish);
        if publish == Some(place.port) && place.port != 0 {
            let mistake = format!(
                "port {} is for tasks; publish readings at another port",
                place.port
            );
            return Err(Unfit::Whole(mistake));
        }
        Ok(Plan {
            place,
            scope: scope.ok_or_else(|| missing("scope", "--scope <SCOPE>", "scope: /lab"))?,
            leave_running: self.leave_running,
            publish,
            devices,
            journal: self.journal.or(config.journal),
        })
    }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&str> = self.devices.iter().map(|d| d.name.as_str()).collect();
        let Self { scope, place, .. } = self;
        let (bind, port) = (&place.bind, place.port);
        write!(f, "{}, scope {scope}, at {bind}:{port}", names.join(", "))
    }
}

impl Plan {
    /// Tries all that [`serve`](Self::serve) needs, but for the devices.
    fn check(&self) -> Findings {
        let mut findings = self.place.check(self.publish);
        self.journal
            .check(self.place.port, &self.scope, &mut findings);
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
        if let Some(port) = self.publish {
            let endpoint = format!("tcp://{}:{port}", place.bind);
            let endpoint = devices.publish(&server, &endpoint)?;
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
            service::of_devices(&watch.reports())
        })?;
        signals::leave_at_the_second();
        service.stops(handle);
        server.listen()?;
        line("Stopped.");
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }
}
