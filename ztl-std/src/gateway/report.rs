//! What the gateway reports about its devices: the answer to the question `devices`, as `ztl devices` asks it.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use ztl_core::TaskSpec;
use ztl_core::link::{Busy, Loss};
use ztl_link::{ComponentInfo, LinkCounters};

use super::parameters::{PARAMETERS, ParameterGoal};
use crate::describe::ComponentDescription;

/// The devices of a gateway by name.
pub type DeviceReports = BTreeMap<String, DeviceReport>;

/// A device as its gateway sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeviceReport {
    /// Its URL, as in `--device NAME=URL`.
    pub url: String,
    /// Whether it accepts tasks now.
    pub ready: bool,
    /// What is wrong with it, to be shown to people.
    pub problem: Option<String>,
    /// How it described itself; `null` before it did.
    pub firmware: Option<FirmwareReport>,
    /// Its components.
    pub components: Vec<ComponentReport>,
    /// The state of its link.
    pub link: LinkReport,
}

/// A device's description of itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FirmwareReport {
    /// The device's name in its firmware.
    pub name: String,
    /// Its version.
    pub version: String,
    /// Random number chosen at the last reset.
    pub boot: u32,
    /// Milliseconds since its reset: the last value it sent plus the time since then.
    pub uptime_ms: u64,
    /// Milliseconds without a new command after which it acts by itself.
    pub link_timeout_ms: u64,
}

/// A component as its device describes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ComponentReport {
    /// Its name.
    pub name: String,
    /// Smallest and greatest number that it takes.
    pub range: Option<(f32, f32)>,
    /// The unit of the numbers.
    pub unit: String,
    /// Words that it takes.
    pub words: Vec<String>,
    /// What a second task does while one runs: `refuse`, `queue N` or `replace`.
    #[serde(default)]
    pub busy: String,
    /// What it does when the link is lost: `abort`, `hold` or `carry on`.
    pub loss: String,
    /// The topics of its readings.
    #[serde(default)]
    pub topics: Vec<String>,
    /// What it says of itself, as in the answer to `describe`.
    #[serde(default)]
    pub is: Option<serde_json::Value>,
}

impl DeviceReport {
    /// The report on a shared line, which has no components of its own.
    pub(super) fn of_line(url: String, ready: bool, problem: Option<String>) -> Self {
        Self {
            url,
            ready,
            problem,
            firmware: None,
            components: Vec::new(),
            link: LinkReport {
                counters: LinkCounters::default(),
                round_trip_p50_us: None,
                round_trip_p99_us: None,
                queue: 0,
            },
        }
    }
}

/// Whether a device would take a task, by its description.
pub(super) fn would_take(devices: &DeviceReports, spec: &TaskSpec<'_>) -> Result<(), String> {
    let names = |names: Vec<&str>| names.join(", ");
    let Some(device) = devices.get(spec.handler) else {
        let there = names(devices.keys().map(String::as_str).collect());
        return Err(format!("no device '{}'; there are: {there}", spec.handler));
    };
    if !device.ready {
        let problem = device
            .problem
            .as_deref()
            .unwrap_or("it has not described itself yet");
        return Err(format!(
            "device '{}' takes no tasks now: {problem}",
            spec.handler
        ));
    }
    if spec.component == PARAMETERS {
        return ParameterGoal::parse(spec.goal).map(drop);
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
    /// Whether it would take a goal, by its description, which covers plain words and numbers only.
    fn would_take(&self, goal: &str) -> Result<(), String> {
        let goal = goal.trim();
        // Without either, it does not say what it takes.
        let says = self.range.is_some() || !self.words.is_empty();
        // `pulse 200`: a word may need more.
        let first = goal.split_whitespace().next().unwrap_or_default();
        // YAML's `on`, a struct, a list or a quoted text may be taken, too.
        let may =
            matches!(goal, "True" | "False" | "None") || goal.starts_with(['{', '[', '"', '\'']);
        if !says || may || self.words.iter().any(|word| word == first) {
            return Ok(());
        }
        let words = self.words.join(", ");
        let Some((least, most)) = self.range else {
            return Err(format!("'{goal}' is not one of its words: {words}"));
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

/// The state of a link.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkReport {
    /// Frames, errors by kind, retries, and so on.
    #[serde(flatten)]
    pub counters: LinkCounters,
    /// Median time from a command to its answer, of the latest 128, in microseconds.
    pub round_trip_p50_us: Option<u64>,
    /// The 99th percentile of that time.
    pub round_trip_p99_us: Option<u64>,
    /// Tasks whose `Start` was not sent yet.
    pub queue: usize,
}

impl ComponentReport {
    pub(super) fn new(component: &ComponentInfo, is: Option<&ComponentDescription>) -> Self {
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
        Self {
            name: component.name.clone(),
            range: component.range,
            unit: component.unit.clone(),
            words: component.words.clone(),
            topics: component.topics.clone(),
            busy,
            loss: loss.to_owned(),
            is: is.and_then(|is| serde_json::from_str(&is.json().to_string()).ok()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn component(range: Option<(f32, f32)>, words: &[&str]) -> ComponentReport {
        ComponentReport {
            name: "lamp".to_owned(),
            range,
            unit: "ms".to_owned(),
            words: words.iter().map(|&word| word.to_owned()).collect(),
            busy: String::new(),
            loss: String::new(),
            topics: Vec::new(),
            is: None,
        }
    }

    #[test]
    fn a_goal_that_the_component_may_take_is_no_mistake() {
        let lamp = component(Some((1.0, 3_600_000.0)), &["on", "off", "pulse"]);
        let taken = [
            "on",
            " off ",
            "pulse 200",
            "200",
            "True",
            "{'pulse': 200}",
            "'on'",
        ];
        for goal in taken {
            assert_eq!(lamp.would_take(goal), Ok(()), "{goal}");
        }
        for goal in ["0", "blink", "blink 200", ""] {
            let why = lamp.would_take(goal).expect_err(goal);
            let takes = "is not a number from 1 to 3600000 ms, or on, off, pulse";
            assert_eq!(why, format!("'{goal}' {takes}"));
        }
        assert_eq!(component(None, &[]).would_take("anything"), Ok(()));
    }
}
