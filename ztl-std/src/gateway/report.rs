//! What the gateway tells people of its devices: `ztl devices`, and whoever asks `$ztl` for
//! `devices`.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use ztl_core::link::{Busy, Loss};
use ztl_core::{Instant, TaskSpec};

use crate::time::{millis, now};
use ztl_link::{ComponentInfo, DeviceInfo, LinkCounters, RoundTrips, Session, SessionJournal};

/// Each device of a gateway, by the name under which clients know it.
pub type DeviceReports = BTreeMap<String, DeviceReport>;

/// A device, as its gateway sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeviceReport {
    /// Where it is, as in `--device NAME=URL`.
    pub url: String,
    /// Whether it takes tasks now.
    pub ready: bool,
    /// What is wrong with it, for people.
    pub trouble: Option<String>,
    /// What it has told of itself; `null` before it did.
    pub firmware: Option<FirmwareReport>,
    /// Its components.
    pub components: Vec<ComponentReport>,
    /// How its link does.
    pub link: LinkReport,
}

/// What a device has told of itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FirmwareReport {
    /// What the firmware calls its device.
    pub name: String,
    /// Its version.
    pub version: String,
    /// Random since the last reset.
    pub boot: u32,
    /// How long it has run since its reset, in milliseconds; what it was when it was last heard,
    /// and the time since.
    pub uptime_ms: u64,
    /// After how long without a new command it acts by itself, in milliseconds.
    pub link_timeout_ms: u64,
}

/// A component, as its device describes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ComponentReport {
    /// Name, as a client writes it.
    pub name: String,
    /// Smallest and greatest number it takes.
    pub range: Option<(f32, f32)>,
    /// Unit of the numbers.
    pub unit: String,
    /// Words that it takes.
    pub words: Vec<String>,
    /// What happens to a second task while one runs: `refuse`, `queue N` or `replace`.
    #[serde(default)]
    pub busy: String,
    /// What it does when the link is lost, with or without a task: `abort`, `hold` or `carry on`.
    pub loss: String,
    /// Topics under which it publishes readings.
    #[serde(default)]
    pub topics: Vec<String>,
}

/// Whether a device would take a task, by what it has told of itself.
pub(super) fn would_take(devices: &DeviceReports, spec: &TaskSpec<'_>) -> Result<(), String> {
    let names = |names: Vec<&str>| names.join(", ");
    let Some(device) = devices.get(spec.handler) else {
        let there = names(devices.keys().map(String::as_str).collect());
        return Err(format!("no device '{}'; there are: {there}", spec.handler));
    };
    if !device.ready {
        let trouble = device
            .trouble
            .as_deref()
            .unwrap_or("it has not told of itself yet");
        return Err(format!(
            "device '{}' takes no tasks now: {trouble}",
            spec.handler
        ));
    }
    let mut components = device.components.iter();
    let Some(component) = components.find(|component| component.name == spec.component) else {
        let there = names(
            device
                .components
                .iter()
                .map(|known| known.name.as_str())
                .collect(),
        );
        let (part, of) = (spec.component, spec.handler);
        return Err(format!("no component '{part}' on '{of}'; it has: {there}"));
    };
    component.would_take(spec.goal)
}

impl ComponentReport {
    /// Whether it would take a goal, as far as its description tells.
    fn would_take(&self, goal: &str) -> Result<(), String> {
        let goal = goal.trim();
        // Without either it has not said what it takes.
        let says = self.range.is_some() || !self.words.is_empty();
        if !says || self.words.iter().any(|word| word == goal) {
            return Ok(());
        }
        let words = self.words.join(", ");
        let Some((least, most)) = self.range else {
            return Err(format!("'{goal}' is none of its words: {words}"));
        };
        let fits = |number: &f32| (least..=most).contains(number);
        match goal.parse::<f32>() {
            Ok(number) if fits(&number) => Ok(()),
            _ => {
                let or = if words.is_empty() {
                    String::new()
                } else {
                    format!(", or {words}")
                };
                let unit = &self.unit;
                Err(format!(
                    "'{goal}' is not a number from {least} to {most} {unit}{or}"
                ))
            }
        }
    }
}

/// How a link does.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkReport {
    /// Frames, errors by kind, repeats, and so on.
    #[serde(flatten)]
    pub counters: LinkCounters,
    /// Time from a command to its answer that half of the latest 128 did not exceed, in
    /// microseconds.
    pub round_trip_p50_us: Option<u64>,
    /// The same for 99 of 100.
    pub round_trip_p99_us: Option<u64>,
    /// Tasks that wait for their `Start` to be sent.
    pub queue: usize,
}

/// What a device's thread lets others see; never held for long.
#[derive(Debug, Default)]
struct Seen {
    ready: bool,
    trouble: Option<String>,
    device: Option<DeviceInfo>,
    /// The device's uptime, and when it was that.
    uptime: Option<(Duration, Instant)>,
    counters: LinkCounters,
    round_trips: RoundTrips,
    queue: usize,
}

/// A window through which a device's thread is seen.
#[derive(Debug, Clone, Default)]
pub(super) struct Window(Arc<Mutex<Seen>>);

impl Window {
    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows what is so now; to be called often.
    pub(super) fn show<B: SessionJournal>(
        &self,
        now: Instant,
        session: &Session<B>,
        trouble: Option<&String>,
    ) {
        let mut seen = self.seen();
        seen.ready = session.is_up();
        if seen.trouble.as_ref() != trouble {
            seen.trouble = trouble.cloned();
        }
        if seen.device.as_ref() != session.device() {
            seen.device = session.device().cloned();
        }
        seen.uptime = session.uptime(now).map(|uptime| (uptime, now));
        seen.counters = session.counters();
        seen.round_trips.clone_from(session.round_trips());
        seen.queue = session.queued();
    }

    /// The names of the components.
    pub(super) fn components(&self) -> Vec<String> {
        let seen = self.seen();
        let device = seen.device.as_ref();
        device.map_or_else(Vec::new, |device| {
            device.components.iter().map(|c| c.name.clone()).collect()
        })
    }

    pub(super) fn report(&self, url: String) -> DeviceReport {
        let seen = self.seen();
        let micros = |percent| {
            let time = seen.round_trips.percentile(percent)?;
            u64::try_from(time.as_micros()).ok()
        };
        let device = seen.device.as_ref();
        DeviceReport {
            url,
            ready: seen.ready,
            trouble: seen.trouble.clone(),
            firmware: device.map(|device| FirmwareReport {
                name: device.name.clone(),
                version: device.firmware.clone(),
                boot: device.boot,
                uptime_ms: seen
                    .uptime
                    .map_or(0, |(uptime, at)| millis(uptime + now().since(at))),
                link_timeout_ms: millis(device.link_timeout),
            }),
            components: device.map_or_else(Vec::new, |device| {
                device.components.iter().map(component).collect()
            }),
            link: LinkReport {
                counters: seen.counters,
                round_trip_p50_us: micros(50),
                round_trip_p99_us: micros(99),
                queue: seen.queue,
            },
        }
    }
}

fn component(component: &ComponentInfo) -> ComponentReport {
    let busy = match component.busy {
        Busy::Queue(most) => format!("queue {most}"),
        Busy::Replace => "replace".to_owned(),
        _ => "refuse".to_owned(),
    };
    let loss = match component.loss {
        Loss::Abort => "abort",
        Loss::Hold => "hold",
        Loss::CarryOn => "carry on",
    };
    ComponentReport {
        name: component.name.clone(),
        range: component.range,
        unit: component.unit.clone(),
        words: component.words.clone(),
        topics: component.topics.clone(),
        busy,
        loss: loss.to_owned(),
    }
}
