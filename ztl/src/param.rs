//! `ztl param`: shows, sets and saves the parameters of a gateway's devices.

use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand};
use ztl_std::gateway::{DeviceReports, PARAMETERS, ParameterGoal, ParameterReport, ReportedValue};
use ztl_std::{RemoteTask, State};

use crate::columns::table;
use crate::data_format::DataFormat;
use crate::exit::Done;
use crate::server_query::{QueriedServer, QueryOptions, read};
use crate::terminal::{flat, line};

/// Longest wait for a device. At 9600 baud a parameter takes some 0.2 s.
const LIMIT: Duration = Duration::from_secs(60);

#[derive(Debug, Args)]
#[command(
    after_help = "Exit codes: 0 done, 1 not done: the server, the device or its firmware refuses, or is not reached."
)]
pub(crate) struct Param {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Show all parameters of a device
    List(List),
    /// Print the value of a parameter
    Get(Get),
    /// Set a parameter, until the device is restarted; `save` keeps the value
    Set(Set),
    /// Save all values of a device, so that a restart keeps them
    Save(Save),
}

#[derive(Debug, Args)]
pub(crate) struct At {
    #[command(flatten)]
    server: QueryOptions,

    /// The scope, needed if several scopes have a device of this name
    #[arg(short, long)]
    scope: Option<String>,

    /// The device
    pub(crate) device: String,
}

#[derive(Debug, Args)]
struct List {
    #[command(flatten)]
    at: At,

    #[command(flatten)]
    format: DataFormat,
}

#[derive(Debug, Args)]
struct Get {
    #[command(flatten)]
    at: At,

    /// The parameter: `finger.speed`, or `speed` if no other component has one
    name: String,

    #[command(flatten)]
    format: DataFormat,
}

#[derive(Debug, Args)]
struct Set {
    #[command(flatten)]
    at: At,

    /// The parameter: `finger.speed`, or `speed` if no other component has one
    name: String,

    /// The new value
    #[arg(allow_hyphen_values = true)]
    value: String,

    #[command(flatten)]
    format: DataFormat,
}

#[derive(Debug, Args)]
struct Save {
    #[command(flatten)]
    at: At,
}

impl Param {
    pub(crate) fn run(self) -> Done {
        match self.what {
            What::List(List { at, format }) => {
                let (_, json) = at.ask(&ParameterGoal::List)?;
                let all: Vec<ParameterReport> = read(&json)?;
                if format.is_chosen() {
                    format.print(&all)?;
                } else {
                    let rows: Vec<Vec<String>> = all.iter().map(row).collect();
                    table(&rows).iter().for_each(line);
                }
            }
            What::Get(Get { at, name, format }) => {
                let (_, json) = at.ask(&ParameterGoal::Get(name))?;
                let one: ParameterReport = read(&json)?;
                if format.is_chosen() {
                    format.print(&one)?;
                } else {
                    line(flat(&one.value.to_string()));
                }
            }
            What::Set(Set {
                at,
                name,
                value,
                format,
            }) => {
                let (device, json) = at.ask(&ParameterGoal::Set(name, value))?;
                let one: ParameterReport = read(&json)?;
                if format.is_chosen() {
                    format.print(&one)?;
                } else {
                    let until = match one.kept.as_str() {
                        "saved" => String::new(),
                        "never" => {
                            "; until the device is restarted, since its firmware saves nothing"
                                .to_owned()
                        }
                        _ => format!(
                            "; until the device is restarted, unless you run `ztl param save {device}`"
                        ),
                    };
                    line(flat(&format!(
                        "{} = {}{until}",
                        one.name,
                        shown(&one, &one.value)
                    )));
                }
            }
            What::Save(Save { at }) => {
                let (device, _) = at.ask(&ParameterGoal::Save)?;
                line(format_args!("{}: saved", flat(&device)));
            }
        }
        Ok(ExitCode::SUCCESS)
    }
}

impl At {
    /// The device's name and the result of a request.
    fn ask(self, goal: &ParameterGoal) -> Result<(String, String), Box<dyn std::error::Error>> {
        let (server, mut remote) = connect(self.server, self.scope, &self.device)?;
        let status = remote.run(&self.device, PARAMETERS, &goal.to_text(), Some(LIMIT));
        let status = status.map_err(|error| {
            let text = error.to_string();
            match text.contains(&format!("no component '{PARAMETERS}'")) {
                true => format!(
                    "the gateway at {} is older than parameters",
                    server.endpoint()
                ),
                false => text,
            }
        })?;
        match status.state {
            State::Completed => Ok((self.device, status.text)),
            _ => Err(format!("{}: {}", self.device, flat(&status.text)).into()),
        }
    }
}

impl At {
    /// Connects to the scope that has the device.
    #[cfg(feature = "firmware")]
    pub(crate) fn connect(self) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        Ok(connect(self.server, self.scope, &self.device)?.1)
    }
}

/// The server, and the scope that has this device.
fn connect(
    server: QueryOptions,
    scope: Option<String>,
    device: &str,
) -> Result<(QueriedServer, RemoteTask), Box<dyn std::error::Error>> {
    let server = server.server()?;
    let scope = match scope {
        Some(scope) => scope,
        None => scope_of(&server, device)?,
    };
    let remote = server.connect(&scope)?;
    Ok((server, remote))
}

/// The scope that has a device of this name.
fn scope_of(server: &QueriedServer, name: &str) -> Result<String, Box<dyn std::error::Error>> {
    let endpoint = server.endpoint();
    let json = server.ask("devices")?.ok_or_else(|| {
        format!("the server at {endpoint} has no devices: it is not a gateway of this version")
    })?;
    let scopes: BTreeMap<String, DeviceReports> = read(&json)?;
    let mut found = scopes
        .iter()
        .filter(|(_, devices)| devices.contains_key(name));
    match (found.next(), found.next()) {
        (Some((scope, _)), None) => Ok(scope.clone()),
        (Some(_), Some(_)) => {
            Err(format!("several scopes have a device '{name}'; give --scope").into())
        }
        (None, _) => {
            let names: Vec<&str> = scopes
                .values()
                .flatten()
                .map(|(name, _)| name.as_str())
                .collect();
            let names = names.join(", ");
            Err(format!("no device '{name}'; there are: {}", flat(&names)).into())
        }
    }
}

/// A value of a parameter as people read it.
fn shown(one: &ParameterReport, value: &ReportedValue) -> String {
    let text = match one.kind.as_str() {
        "text" => format!("'{value}'"),
        _ => format!("{value} {}", one.unit),
    };
    text.trim_end().to_owned()
}

/// A parameter for people.
fn row(one: &ParameterReport) -> Vec<String> {
    let takes = match (&one.least, &one.most) {
        (Some(least), Some(most)) => format!("{least} to {most}"),
        (None, Some(most)) => format!("at most {most} bytes"),
        _ => "true or false".to_owned(),
    };
    let default = match one.value == one.default {
        true => "default".to_owned(),
        false => format!("default {}", shown(one, &one.default)),
    };
    let kept = match one.kept.as_str() {
        "saved" => "saved",
        "never" => "not kept over a restart",
        "replaced" => "the saved value does not fit",
        _ => "not saved",
    };
    let cells = [
        one.name.clone(),
        shown(one, &one.value),
        takes,
        default,
        kept.to_owned(),
        one.about.clone(),
    ];
    cells.iter().map(|cell| flat(cell).into_owned()).collect()
}
