//! `ztl devices`: shows a gateway's devices and their links.

use std::collections::BTreeMap;
#[cfg(feature = "defmt")]
use std::path::{Path, PathBuf};
use std::process::ExitCode;
#[cfg(feature = "defmt")]
use std::time::Duration;

use ztl_std::ListedTask;
#[cfg(feature = "defmt")]
use ztl_std::defmt::{Decoder, Level, Message};
use ztl_std::describe::{GoalRule, component as description};
#[cfg(feature = "defmt")]
use ztl_std::gateway::LogPiece;
use ztl_std::gateway::{ComponentReport, DeviceReport};

use crate::columns::spoken;
use crate::data_format::DataFormat;
use crate::exit::Done;
#[cfg(feature = "defmt")]
use crate::server_query::QueriedServer;
use crate::server_query::{QueryOptions, all_named, code, read, state};
#[cfg(feature = "defmt")]
use crate::signals;
use crate::terminal::{flat, line};

#[derive(Debug, clap::Args)]
pub(crate) struct Devices {
    #[command(flatten)]
    server: QueryOptions,

    /// Show only this device
    #[arg(value_name = "NAME")]
    name: Option<String>,

    #[command(flatten)]
    format: DataFormat,

    /// Show the defmt log of this device's firmware until Ctrl-C
    #[cfg(feature = "defmt")]
    #[arg(long, value_name = "NAME", requires = "elf", conflicts_with_all = ["name", "json", "yaml"])]
    log: Option<String>,

    /// The firmware's ELF file, which decodes its log
    #[cfg(feature = "defmt")]
    #[arg(long, value_name = "FIRMWARE", requires = "log")]
    elf: Option<PathBuf>,

    /// Show only the log so far
    #[cfg(feature = "defmt")]
    #[arg(long, requires = "log")]
    once: bool,
}

impl Devices {
    pub(crate) fn run(self) -> Done {
        let server = self.server.server()?;
        #[cfg(feature = "defmt")]
        if let (Some(name), Some(elf)) = (&self.log, &self.elf) {
            return show_log(&server, name, elf, self.once);
        }
        let json = server.ask("devices")?.ok_or_else(|| {
            let endpoint = server.endpoint();
            format!("the server at {endpoint} has no devices: it is not a gateway of this version")
        })?;
        let name = self.name.as_deref();
        if self.format.is_chosen() {
            // As they came: a newer gateway may report more.
            let scopes: Scopes<serde_json::Value> = read(&json)?;
            self.format.print(&chosen(scopes, name)?)?;
            return Ok(ExitCode::SUCCESS);
        }
        let scopes: Scopes<DeviceReport> = chosen(read(&json)?, name)?;
        let known = server.tasks()?;
        let all_named = all_named(&known);
        let running = known.tasks.iter().filter(|task| task.may_run);
        let running: Vec<_> = running.filter_map(|task| task.listed.as_ref()).collect();
        for (scope, devices) in &scopes {
            for (name, device) in devices {
                let prefix = format!("{name}:");
                let own =
                    |task: &&ListedTask| task.scope == *scope && task.task.starts_with(&prefix);
                show(scope, name, device, running.iter().copied().filter(own));
            }
        }
        Ok(code(all_named))
    }
}

/// The devices of each scope by their names.
type Scopes<T> = BTreeMap<String, BTreeMap<String, T>>;

/// The devices of this name, or all without a name. An error if there is none.
fn chosen<T>(mut scopes: Scopes<T>, name: Option<&str>) -> Result<Scopes<T>, String> {
    let Some(name) = name else {
        return Ok(scopes);
    };
    let all = scopes.values().flat_map(BTreeMap::keys);
    let all = all.map(String::as_str).collect::<Vec<_>>().join(", ");
    scopes.retain(|_, devices| {
        devices.retain(|device, _| device == name);
        !devices.is_empty()
    });
    match scopes.is_empty() {
        true => Err(format!("no device '{name}'; there are: {}", flat(&all))),
        false => Ok(scopes),
    }
}

/// Pause between two requests for a log.
#[cfg(feature = "defmt")]
const LOG_AGAIN: Duration = Duration::from_millis(200);

/// Shows a device's decoded log.
#[cfg(feature = "defmt")]
fn show_log(server: &QueriedServer, name: &str, elf: &Path, once: bool) -> Done {
    let mut decoder =
        Decoder::of_file(elf).map_err(|error| format!("{}: {error}", elf.display()))?;
    signals::catch()?;
    let mut remote = server.connect("$ztl")?;
    let (mut next, mut known) = (0, None);
    while !signals::stopped() {
        let json = remote.ask_server(&format!("log {name} {next}"))?;
        let json = json.ok_or_else(|| {
            format!(
                "no device '{name}' with a log is known at {}; `ztl devices` lists them",
                server.endpoint()
            )
        })?;
        let pieces: BTreeMap<String, LogPiece> = read(&json)?;
        // The device of the first scope that has one of this name.
        let piece = pieces.into_values().next().ok_or("the answer is empty")?;
        let bytes = piece.bytes().ok_or("the reply is not a log")?;
        if let Some((boot, lost)) = known
            && (piece.boot, piece.lost) != (boot, lost)
        {
            match piece.boot == boot {
                true => line(format_args!(
                    "({} bytes were lost: the device's buffer was full)",
                    piece.lost.wrapping_sub(lost)
                )),
                false => line("(the device was reset)"),
            }
        }
        known = Some((piece.boot, piece.lost));
        if piece.from > next {
            decoder.skip();
        }
        next = piece.from + bytes.len() as u64;
        decoder.push(&bytes, &mut |message| {
            if let Ok(message) = message {
                line(logged(&message));
            }
        });
        if once {
            break;
        }
        std::thread::sleep(LOG_AGAIN);
    }
    Ok(signals::exit_code_or(ExitCode::SUCCESS))
}

#[cfg(feature = "defmt")]
fn logged(message: &Message) -> String {
    let level = match message.level {
        Some(Level::Error) => "ERROR",
        Some(Level::Warn) => "WARN ",
        Some(Level::Info) => "INFO ",
        Some(Level::Debug) => "DEBUG",
        Some(Level::Trace) => "TRACE",
        None => "     ",
    };
    let time = message.timestamp.as_deref().unwrap_or_default();
    let place = message.place.as_deref().map(|place| format!(" ({place})"));
    flat(&format!(
        "{time} {level} {}{}",
        message.text,
        place.unwrap_or_default()
    ))
    .trim()
    .to_owned()
}

fn show<'a>(
    scope: &str,
    name: &str,
    device: &DeviceReport,
    tasks: impl Iterator<Item = &'a ListedTask>,
) {
    let how = match (&device.problem, device.ready) {
        (_, true) => "ready".to_owned(),
        (Some(problem), false) => format!("not ready: {problem}"),
        (None, false) => "not ready yet".to_owned(),
    };
    line(flat(&format!("{scope} {name} at {}: {how}", device.url)));
    if let Some(firmware) = &device.firmware {
        line(format_args!(
            "  firmware {} {}, up {}; link timeout {}",
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
        "  link: {} frames; dropped {} (damaged {}, truncated {}, too long {}, unknown {}); {} commands resent, {} duplicates dropped",
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
    let is = component.is.as_ref().and_then(description);
    let goals = match &is {
        _ if !goals.is_empty() => goals.join(", "),
        Some(is) if !matches!(is.goal, GoalRule::Any) => is.goal.to_string(),
        _ => "any goal".to_owned(),
    };
    let about = match is.and_then(|is| is.about) {
        Some(about) => format!("; {about}"),
        None => String::new(),
    };
    let loss = match component.loss.as_str() {
        "abort" => "goes to its safe state, also when idle",
        "hold" => "goes to its safe state and keeps its position, also when idle",
        "carry on" => "carries on",
        other => other,
    };
    let busy = match component.busy.as_str() {
        "" => "",
        "refuse" => "; a second task is refused",
        "replace" => "; a second task replaces the first",
        _ => "; a second task waits",
    };
    let topics = match component.topics.as_slice() {
        [] => String::new(),
        topics => format!("; publishes {}", topics.join(", ")),
    };
    flat(&format!(
        "{}: {goals}{about}{busy}; without link it {loss}{topics}",
        component.name
    ))
    .into_owned()
}
