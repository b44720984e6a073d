//! A rate-limited log of a device's changes, for devices that misbehave for months.

use std::time::Duration;

use tracing::{info, warn};
use ztl_core::Instant;

use crate::log_targets::GATEWAY;
use crate::rate_limit::RateLimit;

/// Most lines at once.
const BURST: u32 = 20;
/// Time after which one more line is allowed.
const REFILL: Duration = Duration::from_secs(30);

/// Severity of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Severity {
    Info,
    Warn,
}

/// Logs the changes of a device. A line that comes too soon waits, and a newer one replaces it.
#[derive(Debug)]
pub(super) struct RateLimitedLog {
    device: String,
    limit: RateLimit,
    waiting: Option<(Severity, String)>,
    /// Lines that were replaced since the last one was logged.
    left_out: u64,
}

impl RateLimitedLog {
    pub(super) fn new(device: &str, now: Instant) -> Self {
        Self {
            device: device.to_owned(),
            limit: RateLimit::new(BURST, REFILL, now),
            waiting: None,
            left_out: 0,
        }
    }

    /// Logs a change, now or as soon as the limit allows.
    pub(super) fn log(&mut self, now: Instant, severity: Severity, text: String) {
        self.put(severity, text);
        self.handle_timeout(now);
    }

    /// Logs the waiting line, if the limit allows.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        if let Some((severity, text)) = self.next(now) {
            let name = &self.device;
            match severity {
                Severity::Info => info!(target: GATEWAY, device = name, "Device '{name}'{text}"),
                Severity::Warn => warn!(target: GATEWAY, device = name, "Device '{name}'{text}"),
            }
        }
    }

    /// When the waiting line may be logged.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.waiting.as_ref().map(|_| self.limit.next())
    }

    fn put(&mut self, severity: Severity, text: String) {
        self.left_out += u64::from(self.waiting.is_some());
        self.waiting = Some((severity, text));
    }

    fn next(&mut self, now: Instant) -> Option<(Severity, String)> {
        self.waiting.as_ref()?;
        if !self.limit.take(now) {
            return None;
        }
        let (severity, mut text) = self.waiting.take()?;
        let left_out = std::mem::take(&mut self.left_out);
        if left_out > 0 {
            text.push_str(&format!(
                " (it has changed {left_out} times more since the last line)"
            ));
        }
        Some((severity, text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_keeps_changing_is_logged_at_the_limit_and_its_last_change_is_logged() {
        let mut log = RateLimitedLog::new("arm", Instant::ZERO);
        let mut lines = Vec::new();
        let mut now = Instant::ZERO;
        // Ten times a second for an hour.
        for number in 0..36_000 {
            now = now + Duration::from_millis(100);
            log.put(Severity::Warn, format!(": {number}"));
            lines.extend(log.next(now));
        }
        let most = usize::try_from(BURST).unwrap() + 3600 / 30;
        assert!((most - 2..=most).contains(&lines.len()), "{}", lines.len());
        assert_eq!(lines[0].1, ": 0");
        let counted = " (it has changed 299 times more since the last line)";
        assert!(lines[30].1.ends_with(counted), "{lines:?}");
        let last = log.poll_timeout().expect("a line waits");
        assert!(last > now && last <= now + REFILL);
        let end = log.next(last).expect("it is logged");
        assert!(end.1.starts_with(": 35999 "), "{end:?}");
        assert_eq!(log.poll_timeout(), None);
    }
}
