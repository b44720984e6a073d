//! The options of `ztl gateway`, and the plan that they and the configuration file make.

use std::fmt;
use std::path::{Path, PathBuf};

use ztl_std::gateway::config::{
    BUS_HAS_NO_FIRMWARE, Config, DeviceConfig, name_mistake, same_line,
};
use ztl_std::gateway::{Endpoint, READING_FORMATS, ReadingFormat};
use ztl_yaml::Span;

use crate::config_file::{ConfigError, ConfigFile};
use crate::journal_options::JournalOptions;
use crate::listen_options::{ListenOptions, ListenPlace};
use crate::option_values::{one_of, scope_to_serve};

#[derive(Debug, Clone, clap::Args)]
#[command(
    after_help = "URLs: serial:/dev/ttyACM0?baud=115200 (or a pty's path), tcp:HOST:PORT, sim:gripper, sim:head,\n      rs485:/dev/ttyUSB0?baud=115200 (a shared line, whose nodes are devices NAME.NODE)\nAn option overrides what FILE says; devices are added to the file's."
)]
pub(crate) struct Gateway {
    /// Configuration in YAML: scope, port, devices and more (docs/gateway.md)
    #[arg(value_name = "FILE")]
    pub(super) file: Option<PathBuf>,

    /// A device: its name for clients, and its URL (repeatable)
    #[arg(short, long = "device", value_name = "NAME=URL", value_parser = device)]
    devices: Vec<DeviceConfig>,

    /// The ELF file of a device's firmware, whose defmt log goes to the gateway's log (repeatable)
    #[cfg(feature = "defmt")]
    #[arg(long = "elf", value_name = "NAME=FILE", value_parser = elf)]
    elfs: Vec<(String, PathBuf)>,

    /// Scope to serve, as /lab
    #[arg(short, long, value_parser = scope_to_serve)]
    scope: Option<String>,

    #[command(flatten)]
    listen: ListenOptions,

    /// How readings are published: values (numbers, text or bytes as pickles), or raw (the component's bytes) [default: values]
    #[arg(long, value_name = "FORMAT", value_parser = reading_format)]
    publish_format: Option<ReadingFormat>,

    /// When stopped, leave running tasks alone instead of aborting them
    #[arg(long)]
    leave_running: bool,

    /// Only check the configuration
    #[arg(long)]
    pub(super) check: bool,

    #[command(flatten)]
    journal: JournalOptions,
}

fn reading_format(text: &str) -> Result<ReadingFormat, String> {
    one_of(text, &READING_FORMATS)
}

fn device(text: &str) -> Result<DeviceConfig, String> {
    let (name, url) = text
        .split_once('=')
        .ok_or("write NAME=URL, as gripper=serial:/dev/ttyACM0")?;
    match name_mistake(name) {
        Some(mistake) => Err(mistake),
        None => Ok(DeviceConfig::new(name, ztl_sim::endpoint(url)?)),
    }
}

#[cfg(feature = "defmt")]
fn elf(text: &str) -> Result<(String, PathBuf), String> {
    let (name, path) = text
        .split_once('=')
        .ok_or("write NAME=FILE, as gripper=target/thumbv6m-none-eabi/release/gripper")?;
    Ok((name.to_owned(), path.into()))
}

/// Sets the ELF files of the command line, and checks that all can be read.
#[cfg(feature = "defmt")]
fn with_elfs(devices: &mut [DeviceConfig], elfs: Vec<(String, PathBuf)>, file: &mut ConfigFile) {
    let mut given = Vec::new();
    for (name, path) in elfs {
        let Some(device) = devices.iter_mut().find(|device| device.name == name) else {
            let names: Vec<&str> = devices.iter().map(|d| d.name.as_str()).collect();
            let names = names.join(", ");
            file.wrong(
                None,
                format!("--elf: no device '{name}'; there are: {names}"),
            );
            continue;
        };
        if matches!(device.endpoint, Endpoint::Bus { .. }) {
            file.wrong(None, format!("--elf: '{name}': {BUS_HAS_NO_FIRMWARE}"));
            continue;
        }
        device.elf = Some(path);
        given.push(name);
    }
    for device in devices {
        let (name, Some(path)) = (&device.name, &device.elf) else {
            continue;
        };
        if let Err(error) = ztl_std::defmt::Decoder::of_file(path) {
            let place = file.place(&["devices", name, "elf"]);
            let mistake = format!("the firmware of '{name}', {}: {error}", path.display());
            file.wrong(place.filter(|_| !given.contains(name)), mistake);
        }
    }
}

/// What the gateway serves, and where.
pub(super) struct Plan {
    pub(super) scope: String,
    pub(super) place: ListenPlace,
    pub(super) publish_format: ReadingFormat,
    pub(super) leave_running: bool,
    pub(super) devices: Vec<DeviceConfig>,
    pub(super) journal: JournalOptions,
    /// Its place in the configuration file, if it is from there.
    pub(super) journal_place: Option<Span>,
}

impl Gateway {
    /// The files in the options.
    pub(super) fn files(&self) -> Vec<&Path> {
        let file = self.file.iter().map(PathBuf::as_path);
        #[cfg_attr(not(feature = "defmt"), expect(unused_mut, reason = "no ELF files"))]
        let mut files: Vec<&Path> = file.chain(self.listen.files()).collect();
        #[cfg(feature = "defmt")]
        files.extend(self.elfs.iter().map(|(_, path)| path.as_path()));
        files
    }

    /// Combines the file and the options.
    ///
    /// # Errors
    /// All that is wrong.
    pub(super) fn plan(self) -> Result<Plan, ConfigError> {
        let (plan, mut file) = self.draft();
        file.finish()?;
        plan.ok_or_else(ConfigError::default)
    }

    /// Combines the file and the options. The plan may only be served if nothing is wrong; otherwise, what could be read is
    /// for further checks. `None` if the file cannot be read.
    pub(super) fn draft(self) -> (Option<Plan>, ConfigFile) {
        let path = self.file.as_deref();
        let mut file = ConfigFile::load(path);
        let base = path.and_then(Path::parent).unwrap_or(Path::new(""));
        let read = file.document();
        let read = read.map(|document| Config::read(document, base, ztl_sim::endpoint));
        let config = match (read, path) {
            (Some((config, mistakes)), _) => {
                file.add(mistakes);
                config
            }
            (None, Some(_)) => None,
            (None, None) => Some(Config::default()),
        };
        let Some(config) = config else {
            return (None, file);
        };
        let mut devices = config.devices;
        for device in self.devices {
            if devices.iter().any(|known| known.name == device.name) {
                let mistake = format!(
                    "two devices are named '{}'; give each its own name",
                    device.name
                );
                file.wrong(None, mistake);
            } else if let Some(other) = same_line(&devices, &device) {
                let mistake = format!(
                    "'{}' and '{}' are both at {}",
                    other.name, device.name, other.endpoint
                );
                file.wrong(None, mistake);
            } else {
                devices.push(device);
            }
        }
        #[cfg(feature = "defmt")]
        with_elfs(&mut devices, self.elfs, &mut file);
        if devices.is_empty() {
            file.missing("device", "--device <NAME=URL>", "devices:");
        }
        let place = self.listen.with(config.listen, &mut file);
        let scope = self.scope.or(config.scope);
        if scope.is_none() {
            file.missing("scope", "--scope <SCOPE>", "scope: /lab");
        }
        let in_file = file.place(&["journal"]);
        let plan = Plan {
            place,
            scope: scope.unwrap_or_default(),
            publish_format: self
                .publish_format
                .or(config.publish_format)
                .unwrap_or_default(),
            leave_running: self.leave_running,
            devices,
            journal_place: in_file.filter(|_| !self.journal.is_given()),
            journal: self.journal.or(config.journal),
        };
        (Some(plan), file)
    }
}

impl Plan {
    /// What keeps clients out, and may not be intended.
    pub(super) fn warnings(&self) -> Vec<String> {
        self.place.warnings(&[&self.scope])
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
