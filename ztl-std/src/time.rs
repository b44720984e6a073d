//! The operating system's clocks: monotonic, as the state machines use it, and wall-clock time as RFC 3339.

#[cfg(feature = "config")]
pub mod rfc3339;

use std::sync::OnceLock;
use std::time::Duration;

use ztl_core::Instant;

/// The monotonic time since the first call in this process.
#[must_use]
pub fn now() -> Instant {
    static START: OnceLock<std::time::Instant> = OnceLock::new();
    let elapsed = START.get_or_init(std::time::Instant::now).elapsed();
    Instant::from_micros(u64::try_from(elapsed.as_micros()).unwrap_or(u64::MAX))
}

/// The monotonic time since some moment in the past. On Linux it also counts the time for which the machine is suspended.
#[must_use]
pub fn since_boot() -> Duration {
    #[cfg(target_os = "linux")]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
        // It is never negative.
        Duration::try_from(time).unwrap_or_default()
    }
    #[cfg(not(target_os = "linux"))]
    {
        Duration::from_micros(now().as_micros())
    }
}

/// A duration in whole milliseconds, for messages.
#[must_use]
pub fn millis(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}
