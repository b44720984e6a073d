//! `ztl device`: runs a simulated device.

use std::fs::File;
use std::path::PathBuf;
use std::process::ExitCode;

use ztl_sim::{Buttons, Device as Simulated, Kind, Running};

use crate::exit::Done;
use crate::signals;
use crate::terminal::{flat, line};

#[derive(Debug, clap::Args)]
#[command(after_help = "SIGUSR1 resets the device, as a power cycle does.")]
pub(crate) struct Device {
    /// What to simulate: sim:gripper, sim:head, or sim:sensor, which only publishes
    #[arg(value_parser = kind)]
    device: Kind,

    /// Where it listens: tcp:PORT, tcp:HOST:PORT, pty (prints its path), or pty:LINK (creates a link to it)
    #[arg(long, value_name = "WHERE", value_parser = place)]
    on: Place,

    /// Send no faster than a UART of this rate, in bits a second
    #[arg(long, value_name = "RATE", value_parser = clap::value_parser!(u32).range(1..))]
    baud: Option<u32>,

    /// Append a line to FILE when a task really begins or ends: seconds, component, event, goal
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,

    /// Read lines from the standard input: `press GOAL` starts a task at the device, `release` aborts it, `report TEXT` reports an event
    #[arg(long)]
    buttons: bool,
}

#[derive(Debug, Clone)]
enum Place {
    Tcp(String),
    Pty(Option<PathBuf>),
}

fn kind(text: &str) -> Result<Kind, String> {
    let name = text.strip_prefix("sim:").unwrap_or(text);
    name.parse()
        .map_err(|error: ztl_sim::UnknownKind| error.to_string())
}

fn place(text: &str) -> Result<Place, String> {
    let wrong = || "expected tcp:PORT, tcp:HOST:PORT, pty or pty:LINK".to_owned();
    let (scheme, rest) = text.split_once(':').unwrap_or((text, ""));
    match (scheme, rest) {
        ("pty", "") => Ok(Place::Pty(None)),
        ("pty", link) => Ok(Place::Pty(Some(link.into()))),
        ("tcp", rest) => {
            let (host, port) = rest.rsplit_once(':').unwrap_or(("127.0.0.1", rest));
            port.parse::<u16>().map_err(|_| wrong())?;
            Ok(Place::Tcp(format!("{host}:{port}")))
        }
        _ => Err(wrong()),
    }
}

impl Device {
    pub(crate) fn run(self) -> Done {
        signals::catch()?;
        let kind = self.device;
        let mut device = Simulated::new(kind);
        if let Some(baud) = self.baud {
            device = device.with_baud(baud);
        }
        if let Some(path) = self.record {
            let file = File::options().append(true).create(true).open(&path);
            let file =
                file.map_err(|error| format!("cannot write to {}: {error}", path.display()))?;
            device = device.with_record(file);
        }
        let (running, url) = match self.on {
            Place::Tcp(address) => {
                let (running, address) = device
                    .on_tcp(&address)
                    .map_err(|error| format!("cannot listen at tcp:{address}: {error}"))?;
                (running, format!("tcp:{address}"))
            }
            Place::Pty(link) => {
                let (running, path) = on_pty(device, link)?;
                (running, format!("serial:{path}"))
            }
        };
        signals::at_usr1(running.reset())?;
        line(format_args!("Simulated {kind} at {url}. Serve it with"));
        line(format_args!(
            "  ztl gateway --device {kind}={url} -p 12345 -s /lab"
        ));
        if self.buttons {
            let buttons = running.buttons();
            std::thread::Builder::new()
                .name("ztl-buttons".to_owned())
                .spawn(move || push(&buttons))?;
        }
        signals::wait();
        drop(running);
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }
}

/// Pushes the buttons that the lines of the standard input name.
fn push(buttons: &Buttons) {
    for text in std::io::stdin().lines().map_while(Result::ok) {
        let (word, rest) = text.trim().split_once(' ').unwrap_or((text.trim(), ""));
        let done = match word {
            "" => continue,
            "press" => buttons.press(rest.trim()),
            "release" => buttons.release(),
            "report" => buttons.report(rest.trim()),
            _ => Err("expected press GOAL, release or report TEXT".to_owned()),
        };
        if let Err(reason) = done {
            line(format_args!("{}: {reason}", flat(text.trim())));
        }
    }
}

#[cfg(unix)]
fn on_pty(device: Simulated, link: Option<PathBuf>) -> std::io::Result<(Running, String)> {
    device.on_pty(link)
}

#[cfg(not(unix))]
fn on_pty(_device: Simulated, _link: Option<PathBuf>) -> std::io::Result<(Running, String)> {
    Err(std::io::Error::new(
        std::io::ErrorKind::Unsupported,
        "this system has no ptys; use --on tcp:PORT",
    ))
}
