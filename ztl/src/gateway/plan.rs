//! The options of `ztl gateway`, and the plan that they and the configuration file make.

use std::fmt;
use std::path::{Path, PathBuf};

use ztl_std::gateway::config::{
    BUS_HAS_NO_FIRMWARE, Config, DeviceConfig, name_mistake, same_line,
};
use ztl_std::gateway::{Endpoint, READING_FORMATS, ReadingFormat};

use crate::journal_options::JournalOptions;
use crate::listen_options::{ConfigError, ListenOptions, ListenPlace};
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
fn with_elfs(
    devices: &mut [DeviceConfig],
    elfs: Vec<(String, PathBuf)>,
) -> Result<(), ConfigError> {
    for (name, path) in elfs {
        let Some(device) = devices.iter_mut().find(|device| device.name == name) else {
            let names: Vec<&str> = devices.iter().map(|d| d.name.as_str()).collect();
            let names = names.join(", ");
            let mistake = format!("--elf: no device '{name}'; there are: {names}");
            return Err(ConfigError::Whole(mistake));
        };
        if matches!(device.endpoint, Endpoint::Bus { .. }) {
            let mistake = format!("--elf: '{name}': {BUS_HAS_NO_FIRMWARE}");
            return Err(ConfigError::Whole(mistake));
        }
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
            return Err(ConfigError::Whole(mistake));
        }
    }
    Ok(())
}

/// What the gateway serves, and where.
pub(super) struct Plan {
    pub(super) scope: String,
    pub(super) place: ListenPlace,
    pub(super) publish_format: ReadingFormat,
    pub(super) leave_running: bool,
    pub(super) devices: Vec<DeviceConfig>,
    pub(super) journal: JournalOptions,
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
    pub(super) fn plan(self) -> Result<Plan, ConfigError> {
        let config = match &self.file {
            Some(path) => Config::load(path, ztl_sim::endpoint).map_err(ConfigError::File)?,
            None => Config::default(),
        };
        let file = self.file.map(|path| path.display().to_string());
        let missing = |what: &str, option: &str, key: &str| {
            ConfigError::missing(file.as_deref(), what, option, key)
        };
        let mut devices = config.devices;
        for device in self.devices {
            if devices.iter().any(|known| known.name == device.name) {
                let mistake = format!(
                    "two devices are named '{}'; give each its own name",
                    device.name
                );
                return Err(ConfigError::Whole(mistake));
            }
            if let Some(other) = same_line(&devices, &device) {
                let mistake = format!(
                    "'{}' and '{}' are both at {}",
                    other.name, device.name, other.endpoint
                );
                return Err(ConfigError::Whole(mistake));
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
        Ok(Plan {
            place,
            scope: scope.ok_or_else(|| missing("scope", "--scope <SCOPE>", "scope: /lab"))?,
            publish_format: self
                .publish_format
                .or(config.publish_format)
                .unwrap_or_default(),
            leave_running: self.leave_running,
            devices,
            journal: self.journal.or(config.journal),
        })
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
