//! Limits how often something is logged, so that neither a client nor a device can fill the log.

use std::time::Duration;

use ztl_core::Instant;

/// A token bucket: allows `burst` events at once, then one per `interval`.
#[derive(Debug)]
pub(crate) struct RateLimit {
    burst: u32,
    interval: Duration,
    left: u32,
    /// When the last token was added, or when the bucket was last seen full.
    refilled: Instant,
}

impl RateLimit {
    pub(crate) const fn new(burst: u32, interval: Duration, now: Instant) -> Self {
        Self {
            burst,
            interval,
            left: burst,
            refilled: now,
        }
    }

    /// For lines about refused requests: 100 at once, and then one each second.
    pub(crate) const fn of_refusals(now: Instant) -> Self {
        Self::new(100, Duration::from_secs(1), now)
    }

    /// Uses a token; returns `false` if there is none.
    pub(crate) fn take(&mut self, now: Instant) -> bool {
        while self.left < self.burst && now >= self.next() {
            self.refilled = self.next();
            self.left += 1;
        }
        if self.left == self.burst {
            self.refilled = now;
        }
        let allowed = self.left > 0;
        self.left -= u32::from(allowed);
        allowed
    }

    /// When the next token is added.
    pub(crate) fn next(&self) -> Instant {
        self.refilled + self.interval
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_is_allowed_and_then_one_event_per_interval() {
        let at = Instant::from_millis;
        let mut limit = RateLimit::new(3, Duration::from_millis(100), at(0));
        let mut allowed = |time| limit.take(at(time));
        let first: Vec<bool> = (0..5).map(&mut allowed).collect();
        assert_eq!(first, [true, true, true, false, false]);
        assert!(!allowed(99));
        assert!(allowed(102));
        assert!(!allowed(150));
        let later: Vec<bool> = [1000, 1000, 1000, 1000].into_iter().map(allowed).collect();
        assert_eq!(later, [true, true, true, false]);
    }
}
