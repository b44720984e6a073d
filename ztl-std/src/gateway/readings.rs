//! Readings that devices publish. They go to observers in this process and to ZeroMQ subscribers, which can never
//! make a device wait.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tracing::warn;

use super::reading_value::{ReadingFormat, value};
use super::ring::{Empty, RingIn, RingOut, ring};
use crate::log_targets::GATEWAY;
use crate::native::publisher::PubMessage;
use crate::server::{BindError, TaskServer};

/// A reading of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reading {
    /// `device/component/topic`
    pub topic: String,
    /// The bytes as the component wrote them.
    pub bytes: Vec<u8>,
}

/// The observers of a gateway's readings, shared by its devices.
#[derive(Debug, Clone, Default)]
pub(super) struct Observers(Arc<Mutex<Vec<RingIn<Arc<Reading>>>>>);

impl Observers {
    pub(super) fn add(&self, capacity: usize) -> Readings {
        let (put, take) = ring(capacity);
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.push(put);
        Readings(take)
    }

    /// Passes a reading to all observers, and removes those that were dropped.
    pub(super) fn publish(&self, topic: impl FnOnce() -> String, bytes: &[u8]) {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.is_empty() {
            return;
        }
        let reading = Arc::new(Reading {
            topic: topic(),
            bytes: bytes.to_vec(),
        });
        all.retain(|observer| observer.put(Arc::clone(&reading)));
    }

    /// Ends the readings of all observers.
    pub(super) fn close(&self) {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.clear();
    }
}

/// The readings of a gateway's devices since this observer was created.
///
/// An iterator that blocks, and ends with the gateway. A slow observer loses the oldest readings; no device
/// waits.
#[derive(Debug)]
pub struct Readings(RingOut<Arc<Reading>>);

impl Readings {
    /// The next reading, if it comes within `limit`.
    #[must_use]
    pub fn next_within(&self, limit: Duration) -> Option<Arc<Reading>> {
        self.0.take(limit).ok()
    }

    /// How many readings were lost because they were not taken in time.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.0.lost()
    }

    /// Publishes the readings; see [`Gateway::publish`](super::Gateway::publish).
    pub(super) fn publish(
        self,
        server: &mut TaskServer,
        endpoint: &str,
        format: ReadingFormat,
    ) -> Result<String, BindError> {
        let publisher = server.publish_at(endpoint)?;
        let endpoint = publisher.endpoint().to_owned();
        let publish = move || {
            loop {
                let mut dropped = 0;
                match self.0.take(Duration::MAX) {
                    Ok(reading) => {
                        // Never waits for a slow subscriber.
                        let message = |body: &[u8]| {
                            PubMessage::new(&reading.topic, "", body, false).for_all()
                        };
                        let queued = publisher.publish(match format {
                            ReadingFormat::Values => message(&value(&reading.bytes).to_bytes()),
                            ReadingFormat::Raw => message(&reading.bytes),
                        });
                        dropped += u64::from(!queued);
                    }
                    Err(Empty::Now) => {}
                    Err(Empty::Forever) => return,
                }
                let lost = self.0.take_lost() + dropped;
                if lost > 0 {
                    warn!(target: GATEWAY, "{lost} readings were lost before they were published.");
                }
            }
        };
        let spawned = std::thread::Builder::new()
            .name("ztl-readings".to_owned())
            .spawn(publish);
        match spawned {
            Ok(_) => Ok(endpoint),
            Err(error) => Err(BindError::System(error)),
        }
    }
}

impl Iterator for Readings {
    type Item = Arc<Reading>;

    fn next(&mut self) -> Option<Arc<Reading>> {
        loop {
            match self.0.take(Duration::MAX) {
                Ok(reading) => return Some(reading),
                Err(Empty::Now) => {}
                Err(Empty::Forever) => return None,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_observer_loses_the_oldest_and_delays_no_other() {
        let observers = Observers::default();
        let slow = observers.add(2);
        let quick = observers.add(100);
        let gone = observers.add(100);
        drop(gone);
        for number in 0..10u8 {
            observers.publish(|| format!("arm/lift/{number}"), &[number]);
        }
        observers.close();
        let bytes = |readings: Readings| readings.map(|one| one.bytes[0]).collect::<Vec<u8>>();
        assert_eq!(slow.lost(), 8);
        assert_eq!(bytes(slow), [8, 9]);
        assert_eq!(quick.lost(), 0);
        assert_eq!(bytes(quick), (0..10).collect::<Vec<u8>>());
    }
}
