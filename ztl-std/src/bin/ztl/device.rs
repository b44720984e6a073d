//! `ztl device`: a simulated device standing alone.

use std::path::PathBuf;
use std::process::ExitCode;

use ztl_std::sim::{Kind, Running};

use crate::terminal::line;
use crate::{Done, signals};

#[derive(Debug, clap::Args)]
pub(crate) struct Device {
    /// What to simulate: sim:gripper or sim:head
    #[arg(value_parser = kind)]
    device: Kind,

    /// Where it listens: tcp:PORT, tcp:HOST:PORT, pty (its path is printed), or pty:LINK (a link to it is made)
    #[arg(long, value_name = "WHERE", value_parser = place)]
    on: Place,
}

#[derive(Debug, Clone)]
enum Place {
    Tcp(String),
    Pty(Option<PathBuf>),
}

fn kind(text: &str) -> Result<Kind, String> {
    let name = text.strip_prefix("sim:").unwrap_or(text);
    name.parse()
        .map_err(|error: ztl_std::gateway::EndpointError| error.to_string())
}

fn place(text: &str) -> Result<Place, String> {
    let wrong = || "use tcp:PORT, tcp:HOST:PORT, pty or pty:LINK".to_owned();
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
        let (running, url) = match self.on {
            Place::Tcp(address) => {
                let (running, address) = Running::on_tcp(kind, &address)
                    .map_err(|error| format!("cannot listen at tcp:{address}: {error}"))?;
                (running, format!("tcp:{address}"))
            }
            Place::Pty(link) => {
                let (running, path) = on_pty(kind, link)?;
                (running, format!("serial:{path}"))
            }
        };
        line(format_args!("Simulated {kind} at {url}. Serve it with"));
        line(format_args!(
            "  ztl gateway --device {kind}={url} -p 12345 -s /lab"
        ));
        signals::wait();
        drop(running);
        Ok(ExitCode::SUCCESS)
    }
}

#[cfg(unix)]
fn on_pty(kind: Kind, link: Option<PathBuf>) -> std::io::Result<(Running, String)> {
    Running::on_pty(kind, link)
}

#[cfg(not(unix))]
fn on_pty(_kind: Kind, _link: Option<PathBuf>) -> std::io::Result<(Running, String)> {
    Err(std::io::Error::new(
        std::io::ErrorKind::Unsupported,
        "this system has no ptys; use --on tcp:PORT",
    ))
}
