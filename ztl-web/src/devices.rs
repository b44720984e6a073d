//! The devices of a gateway and their links, from its answer to `devices`.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;
use ztl_std::gateway::DeviceReport;

use crate::cut;

/// Most devices of a server that are shown.
const SHOWN: usize = 50;

/// The devices of a server.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Devices {
    pub(crate) shown: Vec<Device>,
    /// Why there may be more devices than these; empty if these are all.
    pub(crate) text: String,
    /// Why it is not known what a device does: it does not answer, or its answer is unreadable. Includes devices that are not
    /// shown.
    pub(crate) unknown: Vec<String>,
}

/// A device as it is shown.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Device {
    scope: String,
    name: String,
    state: Standing,
    /// Wall clock in ms: since when this console has seen this state.
    since_ms: u64,
    /// Why it is not up.
    text: String,
    /// Name and version; empty until the gateway knows them.
    firmware: String,
    /// Differs after each reset.
    #[serde(skip)]
    boot: Option<u32>,
    /// Wall clock in ms; `null` until the gateway knows how long the device is up.
    reset_ms: Option<u64>,
    /// Median time from a command to its answer, and the 99th percentile; `null` before the first answer.
    round_trip_us: Option<(u64, u64)>,
    resets: u64,
    lost: u64,
    /// Frames that were dropped.
    errors: u64,
    /// Commands that were sent again.
    repeats: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Standing {
    /// It takes tasks.
    Up,
    /// It took tasks before, since its gateway was started.
    Silent,
    /// Its gateway has not reached it yet.
    Absent,
}

impl Devices {
    /// Reads an answer that came at this time. Devices that have not changed since the last answer keep their times.
    pub(crate) fn read(answer: &str, before: &Self, now: u64) -> Self {
        let scopes: BTreeMap<String, BTreeMap<String, Value>> = match serde_json::from_str(answer) {
            Ok(scopes) => scopes,
            Err(error) => {
                let text = format!("its list of devices cannot be read: {error}");
                let text = cut::text(&text, cut::LINE);
                return Self {
                    shown: Vec::new(),
                    unknown: vec![text.clone()],
                    text,
                };
            }
        };
        let (mut shown, mut unknown) = (Vec::new(), Vec::new());
        let (mut more, mut unread) = (0, 0);
        for (scope, devices) in scopes {
            for (name, report) in devices {
                let report: DeviceReport = match serde_json::from_value(report) {
                    Ok(report) if scope.len().max(name.len()) <= cut::NAME => report,
                    _ => {
                        unread += 1;
                        continue;
                    }
                };
                let is_it = |known: &&Device| known.scope == scope && known.name == name;
                let known = before.shown.iter().find(is_it);
                let device = Device::new(scope.clone(), name, &report, known, now);
                unknown.extend(device.unknown());
                match shown.len() < SHOWN {
                    true => shown.push(device),
                    false => more += 1,
                }
            }
        }
        let mut text = Vec::new();
        if more > 0 {
            text.push(format!("{more} more devices are not shown"));
        }
        if unread > 0 {
            text.push(format!("{unread} devices cannot be read"));
            unknown.extend(text.last().cloned());
        }
        Self {
            shown,
            unknown,
            text: text.join("; "),
        }
    }
}

impl Device {
    fn new(
        scope: String,
        name: String,
        report: &DeviceReport,
        known: Option<&Self>,
        now: u64,
    ) -> Self {
        let counters = &report.link.counters;
        let state = match (report.ready, counters.sessions) {
            (true, _) => Standing::Up,
            (false, 0) => Standing::Absent,
            (false, _) => Standing::Silent,
        };
        let text = match (&report.problem, report.ready) {
            (_, true) => String::new(),
            (Some(problem), false) => cut::text(problem, cut::LINE),
            (None, false) => "not ready yet".to_owned(),
        };
        let firmware = report.firmware.as_ref();
        let boot = firmware.map(|firmware| firmware.boot);
        // Computed once for each reset: each answer differs by its travel time.
        let reset_ms = match known.filter(|known| known.boot == boot) {
            Some(known) => known.reset_ms,
            None => firmware.map(|firmware| now.saturating_sub(firmware.uptime_ms)),
        };
        let version = firmware.map(|firmware| format!("{} {}", firmware.name, firmware.version));
        let link = &report.link;
        Self {
            scope,
            name,
            state,
            since_ms: known
                .filter(|known| known.state == state)
                .map_or(now, |known| known.since_ms),
            text,
            firmware: cut::text(&version.unwrap_or_default(), cut::LINE),
            boot,
            reset_ms,
            round_trip_us: link.round_trip_p50_us.zip(link.round_trip_p99_us),
            resets: counters.resets,
            lost: counters.lost,
            errors: counters
                .damaged
                .saturating_add(counters.truncated)
                .saturating_add(counters.too_long)
                .saturating_add(counters.not_understood),
            repeats: counters.repeats,
        }
    }

    /// Why it is not known what it does; `None` while it answers.
    fn unknown(&self) -> Option<String> {
        let why = match self.state {
            Standing::Up => return None,
            Standing::Silent => "is SILENT",
            Standing::Absent => "is NOT THERE",
        };
        Some(format!(
            "device {} {why} ({}): whether it moves is not known",
            self.name, self.text
        ))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn report(ready: bool, sessions: u64, boot: u32) -> Value {
        json!({
            "url": "serial:/dev/ttyACM0", "ready": ready, "problem": (!ready).then_some("device is not answering"),
            "firmware": { "name": "gripper", "version": "1.0", "boot": boot, "uptime_ms": 700, "link_timeout_ms": 500 },
            "components": [],
            "link": {
                "frames": 9, "damaged": u64::MAX, "truncated": 1, "too_long": 0, "not_understood": 0, "repeats": 3,
                "duplicates": 0, "sessions": sessions, "resets": 4, "lost": 5,
                "round_trip_p50_us": 1200, "round_trip_p99_us": 4100, "queue": 0,
            },
        })
    }

    fn read(report: Value, before: &Devices, now: u64) -> Devices {
        let answer = json!({ "/lab": { "arm": report } });
        Devices::read(&answer.to_string(), before, now)
    }

    #[test]
    fn a_device_keeps_since_when_it_is_so() {
        let states = [
            (report(false, 0, 1), 1000, Standing::Absent, 1000),
            (report(false, 0, 1), 2000, Standing::Absent, 1000),
            (report(true, 1, 1), 3000, Standing::Up, 3000),
            (report(true, 1, 1), 9000, Standing::Up, 3000),
            (report(false, 1, 1), 9500, Standing::Silent, 9500),
        ];
        let mut devices = Devices::default();
        for (report, now, state, since) in states {
            devices = read(report, &devices, now);
            let device = devices.shown.first().expect("a device");
            assert_eq!((device.state, device.since_ms), (state, since));
            assert_eq!(device.reset_ms, Some(300), "the first answer tells it");
            assert_eq!(device.text.is_empty(), state == Standing::Up);
            assert_eq!(device.round_trip_us, Some((1200, 4100)));
            assert_eq!((device.resets, device.errors), (4, u64::MAX));
        }
        let devices = read(report(true, 2, 7), &devices, 20_000);
        assert_eq!(devices.shown[0].reset_ms, Some(19_300), "it was reset");
    }

    #[test]
    fn what_is_shown_is_limited_and_an_unreadable_device_hides_no_other() {
        let mut all: BTreeMap<String, Value> = (0..SHOWN + 7)
            .map(|number| (format!("{number:03}"), report(true, 1, 1)))
            .collect();
        all.insert("x".repeat(cut::NAME + 1), report(true, 1, 1));
        all.insert("odd".to_owned(), json!({ "ready": true }));
        let devices = Devices::read(&json!({ "/lab": all }).to_string(), &Devices::default(), 0);
        assert_eq!(devices.shown.len(), SHOWN);
        assert_eq!(
            devices.text,
            "7 more devices are not shown; 2 devices cannot be read"
        );
        let mut hostile = report(true, 1, 1);
        hostile["firmware"]["version"] = "v".repeat(100_000).into();
        let devices = read(hostile, &Devices::default(), 0);
        assert!(devices.shown[0].firmware.len() < 310);
        for wrong in ["", "[]", "{\"/lab\": 7}"] {
            let devices = Devices::read(wrong, &Devices::default(), 0);
            assert!(devices.text.contains("cannot be read"), "{wrong}");
        }
        assert_eq!(
            Devices::read("{}", &Devices::default(), 0),
            Devices::default()
        );
    }
}
