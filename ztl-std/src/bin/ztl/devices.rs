//! `ztl devices`: what a gateway has connected, and how the links do.

use std::collections::BTreeMap;
use std::process::ExitCode;

use ztl_std::ListedTask;
use ztl_std::gateway::{ComponentReport, DeviceReport, DeviceReports};

use crate::Done;
use crate::ask::{Server, read, spoken};
use crate::ps::{flat, state};
use crate::terminal::line;

#[derive(Debug, clap::Args)]
pub(crate) struct Devices {
    #[command(flatten)]
    server: Server,

    /// Only this device
    #[arg(value_name = "NAME")]
    name: Option<String>,

    /// What the gateway says, in JSON
    #[arg(long)]
    json: bool,
}

impl Devices {
    pub(crate) fn run(self) -> Done {
        let json = self.server.ask("devices")?.ok_or_else(|| {
            format!(
                "the server at {} has no devices: it is no gateway of this version",
                self.server.endpoint()
            )
        })?;
        if self.json {
            line(json);
            return Ok(ExitCode::SUCCESS);
        }
        let scopes: BTreeMap<String, DeviceReports> = read(&json)?;
        let (_, listing) = self.server.tasks()?;
        let mut found = false;
        let mut names = Vec::new();
        for (scope, devices) in &scopes {
            for (name, device) in devices {
                names.push(name.as_str());
                if self.name.as_ref().is_some_and(|wanted| wanted != name) {
                    continue;
                }
                found = true;
                let prefix = format!("{name}:");
                let own = |task: &&ListedTask| {
                    task.ended_ms.is_none()
                        && task.scope == *scope
                        && task.task.starts_with(&prefix)
                };
                show(scope, name, device, listing.tasks.iter().filter(own));
            }
        }
        match self.name {
            Some(name) if !found => {
                Err(format!("no device '{name}'; there are: {}", names.join(", ")).into())
            }
            _ => Ok(ExitCode::SUCCESS),
        }
    }
}

fn show<'a>(
    scope: &str,
    name: &str,
    device: &DeviceReport,
    tasks: impl Iterator<Item = &'a ListedTask>,
) {
    let how = match (&device.trouble, device.ready) {
        (_, true) => "ready".to_owned(),
        (Some(trouble), false) => format!("not ready: {trouble}"),
        (None, false) => "not ready yet".to_owned(),
    };
    line(format_args!("{scope} {name} at {}: {how}", device.url));
    if let Some(firmware) = &device.firmware {
        line(format_args!(
            "  firmware {} {}, up {}; acts by itself {} after the link's last word",
            flat(&firmware.name),
            flat(&firmware.version),
            spoken(firmware.uptime_ms),
            spoken(firmware.link_timeout_ms)
        ));
    }
    for component in &device.components {
        line(format_args!("  {}", described(component)));
    }
    for task in tasks {
        line(format_args!(
            "  task {} {}: {} since {}, {}",
            task.id,
            flat(&task.task),
            state(task),
            spoken(task.age_ms),
            flat(&task.text)
        ));
    }
    let link = &device.link;
    let counters = &link.counters;
    line(format_args!(
        "  link: {} frames; dropped {} (damaged {}, cut short {}, too long {}, not understood {}); {} commands repeated, {} duplicates dropped",
        counters.frames,
        counters.errors(),
        counters.damaged,
        counters.truncated,
        counters.too_long,
        counters.not_understood,
        counters.repeats,
        counters.duplicates,
    ));
    let trip = match (link.round_trip_p50_us, link.round_trip_p99_us) {
        (Some(p50), Some(p99)) => format!("round trip {} ms (p50), {} ms (p99)", ms(p50), ms(p99)),
        _ => "no round trip yet".to_owned(),
    };
    line(format_args!(
        "  {trip}; sessions {}, resets {}, lost {} times, tasks queued {}",
        counters.sessions, counters.resets, counters.lost, link.queue
    ));
}

fn ms(micros: u64) -> String {
    format!("{}.{:02}", micros / 1000, micros / 10 % 100)
}

fn described(component: &ComponentReport) -> String {
    let mut goals = Vec::new();
    if let Some((least, most)) = component.range {
        goals.push(
            format!("{least} to {most} {}", component.unit)
                .trim_end()
                .to_owned(),
        );
    }
    goals.extend(component.words.iter().cloned());
    let goals = if goals.is_empty() {
        "any goal".to_owned()
    } else {
        goals.join(", ")
    };
    let loss = match component.loss.as_str() {
        "abort" => "stops",
        "hold" => "holds its position",
        "carry on" => "carries on",
        other => other,
    };
    flat(&format!(
        "{}: {goals}; without link it {loss}",
        component.name
    ))
}
