//! Readings that devices publish, handed to whoever wants them: in this process, and to any ZeroMQ
//! subscriber. Neither can make a device wait.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tracing::warn;

use super::ring::{Empty, RingIn, RingOut, ring};
use super::voice::LOG;
use crate::frames;
use crate::server::{BindError, TaskServer};

/// How many readings a publisher may be behind.
const PUBLISHED: usize = 10_000;

/// A reading of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reading {
    /// `device/component/topic`
    pub topic: String,
    /// As the component wrote them.
    pub bytes: Vec<u8>,
}

/// All who want readings; shared by a gateway's devices.
#[derive(Debug, Clone, Default)]
pub(super) struct Observers(Arc<Mutex<Vec<RingIn<Arc<Reading>>>>>);

impl Observers {
    pub(super) fn add(&self, capacity: usize) -> Readings {
        let (put, take) = ring(capacity);
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.push(put);
        Readings(take)
    }

    /// Hands a reading to everybody; those who are gone are forgotten.
    pub(super) fn tell(&self, topic: impl FnOnce() -> String, bytes: &[u8]) {
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

    /// There will be no more.
    pub(super) fn close(&self) {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.clear();
    }
}

/// The readings of a gateway's devices, from the moment on in which this was made.
///
/// An iterator that waits, and ends with the gateway. Whoever takes them too slowly loses the
/// oldest; no device waits.
#[derive(Debug)]
pub struct Readings(RingOut<Arc<Reading>>);

impl Readings {
    /// The next one, if it comes within `limit`.
    #[must_use]
    pub fn next_within(&self, limit: Duration) -> Option<Arc<Reading>> {
        self.0.take(limit).ok()
    }

    /// How many were lost because they were not taken in time.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.0.lost()
    }

    /// Publishes them at a ZeroMQ endpoint, as `tcp://127.0.0.1:12346`, until the gateway ends, and
    /// says where that is. A message has two frames, the topic and the bytes. Whoever may connect to
    /// `server` may subscribe.
    ///
    /// # Errors
    /// As [`BindError`] says.
    pub fn publish(self, server: &TaskServer, endpoint: &str) -> Result<String, BindError> {
        let (socket, endpoint) = server.bind_another(zmq::PUB, endpoint)?;
        let publish = move || {
            loop {
                match self.0.take(Duration::MAX) {
                    Ok(reading) => {
                        let frames = [reading.topic.as_bytes(), &reading.bytes];
                        // Never waits: each slow subscriber has a queue of its own, which loses.
                        if let Err(cause) = frames::send(&socket, &frames) {
                            warn!(target: LOG, "Readings are no longer published: {}", cause.message());
                            return;
                        }
                    }
                    Err(Empty::Now) => {}
                    Err(Empty::ForEver) => return,
                }
                let lost = self.0.take_lost();
                if lost > 0 {
                    warn!(target: LOG, "{lost} readings were lost before they were published.");
                }
            }
        };
        let spawned = std::thread::Builder::new()
            .name("ztl-readings".to_owned())
            .spawn(publish);
        match spawned {
            Ok(_) => Ok(endpoint),
            Err(_) => Err(BindError::Socket(zmq::Error::ENOMEM)),
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
                Err(Empty::ForEver) => return None,
            }
        }
    }
}

impl super::Gateway {
    /// All readings of its devices from now on; at most `capacity` of them wait to be taken.
    #[must_use]
    pub fn observe(&self, capacity: usize) -> Readings {
        self.devices.0.observers.add(capacity)
    }

    /// As [`Readings::publish`] says, with room for some thousands.
    ///
    /// # Errors
    /// As [`BindError`] says.
    pub fn publish(&self, server: &TaskServer, endpoint: &str) -> Result<String, BindError> {
        self.observe(PUBLISHED).publish(server, endpoint)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_observer_loses_the_oldest_and_harms_no_other() {
        let observers = Observers::default();
        let slow = observers.add(2);
        let quick = observers.add(100);
        let gone = observers.add(100);
        drop(gone);
        for number in 0..10u8 {
            observers.tell(|| format!("arm/lift/{number}"), &[number]);
        }
        observers.close();
        let bytes = |readings: Readings| readings.map(|one| one.bytes[0]).collect::<Vec<u8>>();
        assert_eq!(slow.lost(), 8);
        assert_eq!(bytes(slow), [8, 9]);
        assert_eq!(quick.lost(), 0);
        assert_eq!(bytes(quick), (0..10).collect::<Vec<u8>>());
    }
}
