//! `ztl device`: runs a simulated device.

use std::fs::File;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use ztl_core::link::{ADDR_MOST, ADDR_NONE};
#[cfg(feature = "firmware")]
use ztl_core::manifest::Version;
use ztl_sim::{Bus, BusNode, Buttons, Device as Simulated, Kind, Running, Switches};
use ztl_std::gateway::config::name_mistake;

use crate::exit::Done;
#[cfg(feature = "firmware")]
use crate::exit::Misuse;
use crate::signals;
use crate::terminal::{flat, line};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "SIGUSR1 resets the device, or all nodes, as a power cycle does.\nA shared line:\n  ztl device --bus left=sim:gripper@1 right=sim:gripper@2 sim:head --on pty"
)]
pub(crate) struct Device {
    /// What to simulate: sim:gripper, sim:head, or sim:sensor, which only publishes; on a shared line NAME=sim:gripper@ADDRESS
    #[arg(value_parser = node, value_name = "DEVICE", required = true)]
    devices: Vec<BusNode>,

    /// Simulate a shared line with all these nodes; without an address, the gateway gives one
    #[arg(long)]
    bus: bool,

    /// Where it listens: tcp:PORT, tcp:HOST:PORT, pty (prints its path), or pty:LINK (creates a link to it)
    #[arg(long, value_name = "WHERE", value_parser = attachment)]
    on: Attachment,

    /// Send no faster than a UART of this rate, in bits a second
    #[arg(long, value_name = "RATE", value_parser = clap::value_parser!(u32).range(1..))]
    baud: Option<u32>,

    /// Append a line to FILE when a task really begins or ends: seconds, component, event, goal
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,

    /// Take firmware updates into memory, for the board `simulated`, signed for this public key of `ztl firmware keygen`
    #[cfg(feature = "firmware")]
    #[arg(long, value_name = "KEY")]
    firmware_key: Option<PathBuf>,

    /// Version of the firmware that takes updates
    #[cfg(feature = "firmware")]
    #[arg(
        long,
        value_name = "X.Y.Z",
        default_value = "1.0.0",
        requires = "firmware_key"
    )]
    firmware_version: Version,

    /// Read lines from the standard input: `press GOAL` starts a task at the device, `release` aborts it, `report TEXT` reports an event. On a shared line after the node's name, also `NAME off` and `NAME on`
    #[arg(long)]
    buttons: bool,
}

#[derive(Debug, Clone)]
enum Attachment {
    Tcp(String),
    Pty(Option<PathBuf>),
}

fn node(text: &str) -> Result<BusNode, String> {
    let (name, device) = match text.split_once('=') {
        Some((name, device)) => (Some(name), device),
        None => (None, text),
    };
    if let Some(mistake) = name.and_then(name_mistake) {
        return Err(mistake);
    }
    let device = device.strip_prefix("sim:").unwrap_or(device);
    let (kind, address) = match device.split_once('@') {
        Some((kind, address)) => {
            let number = address.parse().ok();
            let number = number.filter(|number| (1..=ADDR_MOST).contains(number));
            let wrong = || format!("'{address}' is not an address from 1 to {ADDR_MOST}");
            (kind, number.ok_or_else(wrong)?)
        }
        None => (device, ADDR_NONE),
    };
    let kind: Kind = kind
        .parse()
        .map_err(|error: ztl_sim::UnknownKind| error.to_string())?;
    Ok(BusNode {
        name: name.unwrap_or(kind.name()).to_owned(),
        kind,
        address,
    })
}

fn attachment(text: &str) -> Result<Attachment, String> {
    let wrong = || "expected tcp:PORT, tcp:HOST:PORT, pty or pty:LINK".to_owned();
    let (scheme, rest) = text.split_once(':').unwrap_or((text, ""));
    match (scheme, rest) {
        ("pty", "") => Ok(Attachment::Pty(None)),
        ("pty", link) => Ok(Attachment::Pty(Some(link.into()))),
        ("tcp", rest) => {
            let (host, port) = rest.rsplit_once(':').unwrap_or(("127.0.0.1", rest));
            port.parse::<u16>().map_err(|_| wrong())?;
            Ok(Attachment::Tcp(format!("{host}:{port}")))
        }
        _ => Err(wrong()),
    }
}

impl Device {
    pub(crate) fn run(self) -> Done {
        signals::catch()?;
        let record = self.record.as_ref().map(|path| {
            let file = File::options().append(true).create(true).open(path);
            file.map_err(|error| format!("cannot write to {}: {error}", path.display()))
        });
        let record = record.transpose()?;
        let machine = machine(&self.devices, self.bus, self.baud, record)?;
        #[cfg(feature = "firmware")]
        let machine = match &self.firmware_key {
            Some(key) => {
                let verify = crate::firmware::read_key(key).map_err(Misuse::of)?;
                match machine {
                    Machine::Device(it) => {
                        Machine::Device(it.with_updates(self.firmware_version, verify))
                    }
                    Machine::Bus(it) => {
                        Machine::Bus(it.with_updates(self.firmware_version, verify))
                    }
                }
            }
            None => machine,
        };
        let (running, url) = match self.on {
            Attachment::Tcp(address) => {
                let (running, address) = machine
                    .on_tcp(&address)
                    .map_err(|error| format!("cannot listen at tcp:{address}: {error}"))?;
                let bus = if self.bus { "rs485:" } else { "" };
                (running, format!("{bus}tcp:{address}"))
            }
            Attachment::Pty(link) => {
                let (running, path) = machine.on_pty(link)?;
                let scheme = if self.bus { "rs485" } else { "serial" };
                (running, format!("{scheme}:{path}"))
            }
        };
        signals::at_usr1(running.reset())?;
        let name = match (self.bus, self.devices.first()) {
            (false, Some(device)) => device.kind.name(),
            _ => "bus",
        };
        line(format_args!("Simulated {name} at {url}. Serve it with"));
        line(format_args!(
            "  ztl gateway --device {name}={url} -p 12345 -s /lab"
        ));
        if self.buttons {
            let (buttons, switches) = (running.buttons(), running.switches());
            let bus = self.bus;
            std::thread::Builder::new()
                .name("ztl-buttons".to_owned())
                .spawn(move || {
                    follow_input(|text| match bus {
                        true => push_on_bus(&switches, text),
                        false => push(&buttons, text),
                    });
                })?;
        }
        signals::wait();
        drop(running);
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }
}

/// What is to run.
enum Machine {
    Device(Simulated),
    Bus(Bus),
}

fn machine(
    devices: &[BusNode],
    bus: bool,
    baud: Option<u32>,
    record: Option<File>,
) -> Result<Machine, String> {
    if bus {
        let mut bus = Bus::new(devices.to_vec());
        if let Some(baud) = baud {
            bus = bus.with_baud(baud);
        }
        if let Some(record) = record {
            bus = bus.with_record(record);
        }
        return Ok(Machine::Bus(bus));
    }
    let [device] = devices else {
        return Err("only a shared line has several devices; use --bus".to_owned());
    };
    if device.address != ADDR_NONE || device.name != device.kind.name() {
        return Err("only a node of a shared line has a name and an address; use --bus".to_owned());
    }
    let mut device = Simulated::new(device.kind);
    if let Some(baud) = baud {
        device = device.with_baud(baud);
    }
    if let Some(record) = record {
        device = device.with_record(record);
    }
    Ok(Machine::Device(device))
}

impl Machine {
    fn on_tcp(self, address: &str) -> std::io::Result<(Running, SocketAddr)> {
        match self {
            Self::Device(device) => device.on_tcp(address),
            Self::Bus(bus) => bus.on_tcp(address),
        }
    }

    #[cfg(unix)]
    fn on_pty(self, link: Option<PathBuf>) -> std::io::Result<(Running, String)> {
        match self {
            Self::Device(device) => device.on_pty(link),
            Self::Bus(bus) => bus.on_pty(link),
        }
    }

    #[cfg(not(unix))]
    fn on_pty(self, _link: Option<PathBuf>) -> std::io::Result<(Running, String)> {
        Err(std::io::Error::new(
            std::io::ErrorKind::Unsupported,
            "this system has no ptys; use --on tcp:PORT",
        ))
    }
}

/// Does what the lines of the standard input say.
fn follow_input(mut act: impl FnMut(&str) -> Result<(), String>) {
    for text in std::io::stdin().lines().map_while(Result::ok) {
        let text = text.trim();
        if !text.is_empty()
            && let Err(reason) = act(text)
        {
            line(format_args!("{}: {reason}", flat(text)));
        }
    }
}

/// A word, and the rest of a line.
fn word(text: &str) -> (&str, &str) {
    let (word, rest) = text.split_once(' ').unwrap_or((text, ""));
    (word, rest.trim())
}

/// Pushes the button that a line names.
fn push(buttons: &Buttons, text: &str) -> Result<(), String> {
    match word(text) {
        ("press", goal) => buttons.press(goal),
        ("release", _) => buttons.release(),
        ("report", event) => buttons.report(event),
        _ => Err("expected press GOAL, release or report TEXT".to_owned()),
    }
}

/// Switches a node, or pushes its button.
fn push_on_bus(switches: &Switches, text: &str) -> Result<(), String> {
    let (name, rest) = word(text);
    match rest {
        "on" => return switches.power(name, true),
        "off" => return switches.power(name, false),
        _ => {}
    }
    let buttons = switches.buttons(name);
    let buttons = buttons.ok_or_else(|| format!("no node '{name}'; a line begins with one"))?;
    push(&buttons, rest).map_err(|reason| match word(rest).0 {
        "press" | "release" | "report" => reason,
        _ => format!("expected {name} on, off, press GOAL, release or report TEXT"),
    })
}
