//! The console's clock: the wall clock at the start of the console, plus the monotonic time since then, with the time in
//! which the machine was suspended. Setting the wall clock must not make old goals look new.

use std::sync::OnceLock;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ztl_std::time::{millis, since_boot};

/// Milliseconds of the console's clock.
pub(crate) fn now_ms() -> u64 {
    static BOOT: OnceLock<Duration> = OnceLock::new();
    let boot = BOOT.get_or_init(|| {
        let wall_clock = SystemTime::now().duration_since(UNIX_EPOCH);
        wall_clock.unwrap_or_default().saturating_sub(since_boot())
    });
    millis(*boot + since_boot())
}
