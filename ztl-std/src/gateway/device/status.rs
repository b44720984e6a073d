//! A device's status as other threads see it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ztl_core::Instant;
use ztl_link::{ComponentInfo, DeviceInfo, LinkCounters, RoundTrips, Session, SessionJournal};

use crate::gateway::description::{self, DeviceDescriptions};
use crate::gateway::report::{ComponentReport, DeviceReport, FirmwareReport, LinkReport};
use crate::time::{millis, now};

#[derive(Debug, Default)]
struct Status {
    ready: bool,
    problem: Option<String>,
    device: Option<DeviceInfo>,
    /// What its components say of themselves.
    descriptions: DeviceDescriptions,
    /// The device's uptime, and when it was measured.
    uptime: Option<(Duration, Instant)>,
    counters: LinkCounters,
    round_trips: RoundTrips,
    queue: usize,
}

/// A device's status, shared between its thread and others. Locked only briefly.
#[derive(Debug, Clone, Default)]
pub(in crate::gateway) struct SharedStatus(Arc<Mutex<Status>>);

impl SharedStatus {
    fn lock(&self) -> MutexGuard<'_, Status> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Updates the status. Called after each step of the device's thread.
    pub(super) fn update<B: SessionJournal>(
        &self,
        ready: bool,
        problem: Option<&String>,
        session: &Session<B>,
    ) {
        let mut status = self.lock();
        status.ready = ready;
        if status.problem.as_ref() != problem {
            status.problem = problem.cloned();
        }
        status.counters = session.counters();
        status.round_trips.clone_from(session.round_trips());
        status.queue = session.queued();
    }

    /// Updates what the device says of itself, unless the session is with another board at its address.
    pub(super) fn set_device<B: SessionJournal>(
        &self,
        now: Instant,
        name: &str,
        session: &Session<B>,
    ) {
        let mut status = self.lock();
        if status.device.as_ref() != session.device() {
            status.device = session.device().cloned();
            let device = status.device.as_ref();
            let described = device.map(|device| description::of_device(name, device));
            status.descriptions = described.unwrap_or_default();
        }
        status.uptime = session.uptime(now).map(|uptime| (uptime, now));
    }

    /// The names of the components.
    pub(in crate::gateway) fn components(&self) -> Vec<String> {
        let status = self.lock();
        let device = status.device.as_ref();
        device.map_or_else(Vec::new, |device| {
            device.components.iter().map(|c| c.name.clone()).collect()
        })
    }

    /// What the components say of themselves.
    pub(in crate::gateway) fn descriptions(&self) -> DeviceDescriptions {
        self.lock().descriptions.clone()
    }

    pub(in crate::gateway) fn report(&self, url: String) -> DeviceReport {
        let status = self.lock();
        let micros = |percent| {
            let time = status.round_trips.percentile(percent)?;
            u64::try_from(time.as_micros()).ok()
        };
        let device = status.device.as_ref();
        DeviceReport {
            url,
            ready: status.ready,
            problem: status.problem.clone(),
            firmware: device.map(|device| FirmwareReport {
                name: device.name.clone(),
                version: device.firmware.clone(),
                boot: device.boot,
                uptime_ms: status
                    .uptime
                    .map_or(0, |(uptime, at)| millis(uptime + now().since(at))),
                link_timeout_ms: millis(device.link_timeout),
            }),
            components: device.map_or_else(Vec::new, |device| {
                let components = device.components.iter();
                let report = |info: &ComponentInfo| {
                    let is = status.descriptions.get(&info.name);
                    ComponentReport::new(info, is)
                };
                components.map(report).collect()
            }),
            link: LinkReport {
                counters: status.counters,
                round_trip_p50_us: micros(50),
                round_trip_p99_us: micros(99),
                queue: status.queue,
            },
        }
    }
}
