//! The log of dropped messages, rate-limited because anyone can send any number of them.

use std::time::Duration;

use tracing::debug;
use ztl_core::Instant;

use crate::log_targets::TASKS;
use crate::rate_limit::RateLimit;

/// Shortest time between two lines.
const PAUSE: Duration = Duration::from_secs(30);

/// Logs dropped messages, at most one line per [`PAUSE`].
#[derive(Debug)]
pub(super) struct DroppedLog {
    limit: RateLimit,
    /// Messages dropped since the last line.
    left_out: u64,
}

impl DroppedLog {
    pub(super) const fn new(now: Instant) -> Self {
        Self {
            limit: RateLimit::new(1, PAUSE, now),
            left_out: 0,
        }
    }

    /// Logs that a message was dropped; `which` says what kind of message.
    pub(super) fn log(&mut self, now: Instant, which: &str) {
        if let Some(line) = self.line(now, which) {
            debug!(target: TASKS, "{line}");
        }
    }

    fn line(&mut self, now: Instant, which: &str) -> Option<String> {
        if !self.limit.take(now) {
            self.left_out += 1;
            return None;
        }
        let more = match std::mem::take(&mut self.left_out) {
            0 => String::new(),
            count => format!(" (and {count} more since the last line)"),
        };
        Some(format!("dropped a message {which}{more}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_one_line_and_the_next_line_counts_the_rest() {
        let mut log = DroppedLog::new(Instant::ZERO);
        let mut now = Instant::ZERO;
        let mut lines = Vec::new();
        for _ in 0..300 {
            now = now + Duration::from_millis(101);
            lines.extend(log.line(now, "without a delimiter"));
        }
        let first = "dropped a message without a delimiter";
        let counted = format!("{first} (and 297 more since the last line)");
        assert_eq!(lines, [first, &counted]);
    }
}
