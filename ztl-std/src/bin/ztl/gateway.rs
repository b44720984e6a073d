//! `ztl gateway`: microcontrollers as handlers of a task server.

use std::collections::BTreeSet;
use std::process::ExitCode;

use tracing::Level;
use ztl_std::TaskServer;
use ztl_std::gateway::{Endpoint, Gateway as Devices};

use crate::terminal::line;
use crate::tool::{port, unreachable};
use crate::{Done, log, signals};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "URLs: serial:/dev/ttyACM0?baud=115200 (or a pty's path), tcp:HOST:PORT, sim:gripper, sim:head"
)]
pub(crate) struct Gateway {
    /// A device: the name under which clients know it, and where it is (repeatable)
    #[arg(short, long = "device", value_name = "NAME=URL", required = true, value_parser = device)]
    devices: Vec<(String, Endpoint)>,

    /// Port to serve at
    #[arg(short, long, value_parser = port)]
    port: u16,

    /// Scope to serve, as /lab
    #[arg(short, long)]
    scope: String,

    /// Address to serve at; '*' is every interface of this machine, and nobody is asked who they are
    #[arg(long, default_value = "127.0.0.1", value_name = "ADDR")]
    bind: String,
}

fn device(text: &str) -> Result<(String, Endpoint), String> {
    let (name, url) = text
        .split_once('=')
        .ok_or("write NAME=URL, as gripper=serial:/dev/ttyACM0")?;
    if name.is_empty() || name.contains(':') {
        return Err(format!(
            "'{name}' is no name for a device: one word without ':'"
        ));
    }
    let endpoint = url.parse::<Endpoint>().map_err(|error| error.to_string())?;
    Ok((name.to_owned(), endpoint))
}

impl Gateway {
    pub(crate) fn run(self) -> Done {
        log::init(Level::INFO);
        if let Some(error) = unreachable(&self.scope) {
            return Err(error.into());
        }
        signals::catch()?;
        let mut names = BTreeSet::new();
        for (name, _) in &self.devices {
            if !names.insert(name.as_str()) {
                return Err(
                    format!("two devices are named '{name}'; give each its own name").into(),
                );
            }
        }
        let mut server = TaskServer::bind(&format!("tcp://{}:{}", self.bind, self.port))?;
        let names: Vec<String> = names.into_iter().map(str::to_owned).collect();
        let mut devices = Devices::new();
        for (name, endpoint) in self.devices {
            devices.add(&name, endpoint)?;
        }
        server.register_handler(&self.scope, devices);
        let who = match self.bind.as_str() {
            "*" | "0.0.0.0" => "everybody in its networks",
            bind if bind.starts_with("127.") || bind == "localhost" => "only this machine",
            _ => "everybody in that network",
        };
        line(format_args!(
            "Serving {} at {}, scope {}. Reachable for {who}.",
            names.join(", "),
            server.endpoint(),
            self.scope
        ));
        let stopper = server.stopper();
        signals::then(move || stopper.stop());
        server.listen()?;
        line("Stopped.");
        Ok(ExitCode::SUCCESS)
    }
}
