//! `ztl doctor`: checks a machine, and shows each problem with a remedy.

mod finding;
mod network;
#[cfg(unix)]
mod ros1;
mod serial;
mod storage;
mod system;

use std::path::PathBuf;
use std::process::ExitCode;

use serde_json::{Value, json};
use ztl_std::host;

use crate::connect_options::ConnectOptions;
use crate::data_format::DataFormat;
use crate::exit::{Done, Misuse};
use crate::option_values::port;
use crate::server_address::AddressOptions;
use crate::terminal::{flat, line};
use crate::version;
use finding::{Finding, Health};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit code 0: nothing is wrong; 1: there are problems, each shown with a remedy; 2: the options are wrong."
)]
pub(crate) struct Doctor {
    /// Checks no server without --remote, --port and ZTL_PORT.
    #[command(flatten)]
    address: AddressOptions,

    #[command(flatten)]
    connecting: ConnectOptions,

    /// Check whether this port is free for a server on this machine (repeatable)
    #[arg(long, value_name = "PORT", value_parser = port)]
    listen: Vec<u16>,

    /// Check this serial port (repeatable) [default: all]
    #[arg(long, value_name = "PATH")]
    serial: Vec<PathBuf>,

    /// Check this directory for the journal [default: in $STATE_DIRECTORY, else in $XDG_STATE_HOME/ztl, else in ~/.local/state/ztl]
    #[arg(long, value_name = "DIR")]
    journal: Option<PathBuf>,

    /// Check a master of ROS 1 with its nodes and actions [default: that of $ROS_MASTER_URI, else that of this machine]
    #[cfg(unix)]
    #[arg(long, value_name = "URI", num_args = 0..=1)]
    ros1: Option<Option<String>>,

    #[command(flatten)]
    format: DataFormat,
}

impl Doctor {
    pub(crate) fn run(self) -> Done {
        let address = self.address.resolve_if_any()?;
        let host = address.as_ref().map(|address| address.host.as_str());
        if let Some(mistake) = host.and_then(host::mistake) {
            return Err(Misuse(mistake).into());
        }
        let mut found = vec![
            Finding::good("ztl", version::text().replace('\n', "; ")),
            system::kernel(),
            system::processor(),
            system::memory(),
            system::wall_clock(),
            system::monotonic_clock(),
            system::randomness(),
            system::files(),
        ];
        found.extend(network::names());
        found.push(network::addresses());
        found.extend(network::ports(&self.listen));
        found.extend(serial::ports(&self.serial));
        found.push(storage::journal(self.journal.as_deref()));
        if let Some(address) = &address {
            found.push(network::server(address, &self.connecting));
        }
        #[cfg(unix)]
        if let Some(master) = &self.ros1 {
            found.extend(ros1::master(master.as_deref()));
        }
        let problems = found.iter().filter(|f| f.health == Health::Problem).count();
        if self.format.is_chosen() {
            let findings: Vec<Value> = found.iter().map(Finding::to_json).collect();
            self.format
                .print(&json!({ "problems": problems, "findings": findings }))?;
        } else {
            show(&found, problems);
        }
        Ok(ExitCode::from(u8::from(problems > 0)))
    }
}

fn show(found: &[Finding], problems: usize) {
    for Finding {
        about,
        health,
        text,
        remedy,
        ..
    } in found
    {
        let mark = match health {
            Health::Good => "ok",
            Health::Note => "note",
            Health::Problem => "WRONG",
        };
        line(format_args!("{mark:<6}{about:<10} {}", flat(text)));
        if let Some(remedy) = remedy {
            line(format_args!("{:<17}-> {remedy}", ""));
        }
    }
    match problems {
        0 => line("Nothing is wrong."),
        1 => line("One thing is wrong."),
        many => line(format_args!("{many} things are wrong.")),
    }
}
