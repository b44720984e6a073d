//! What is said of a device in the log: each change once, and no flood, whatever the device does
//! for months.

use std::time::Duration;

use tracing::{info, warn};
use ztl_core::Instant;

/// Lines that may come at once.
const BURST: u32 = 20;
/// After this long one more.
const REFILL: Duration = Duration::from_secs(30);
/// Name under which the gateway logs.
pub(super) const LOG: &str = "gateway";

/// How grave a line is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Grave {
    Info,
    Warn,
}

/// A device's lines in the log. One that comes too soon waits; a later one takes its place.
#[derive(Debug)]
pub(super) struct Voice {
    name: String,
    left: u32,
    refilled: Instant,
    waiting: Option<(Grave, String)>,
    unsaid: u64,
}

impl Voice {
    pub(super) fn new(name: &str, now: Instant) -> Self {
        Self {
            name: name.to_owned(),
            left: BURST,
            refilled: now,
            waiting: None,
            unsaid: 0,
        }
    }

    /// Says what has changed, now or as soon as it may.
    pub(super) fn say(&mut self, now: Instant, grave: Grave, text: String) {
        self.unsaid += u64::from(self.waiting.is_some());
        self.waiting = Some((grave, text));
        self.handle_timeout(now);
    }

    /// Says what had to wait, if it may.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        if let Some((grave, text)) = self.next(now) {
            let name = &self.name;
            match grave {
                Grave::Info => info!(target: LOG, device = name, "Device '{name}'{text}"),
                Grave::Warn => warn!(target: LOG, device = name, "Device '{name}'{text}"),
            }
        }
    }

    /// When something that waits may be said.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.waiting.as_ref().map(|_| self.refilled + REFILL)
    }

    fn next(&mut self, now: Instant) -> Option<(Grave, String)> {
        while self.left < BURST && now >= self.refilled + REFILL {
            self.refilled = self.refilled + REFILL;
            self.left += 1;
        }
        if self.left == BURST {
            self.refilled = now;
        }
        if self.left == 0 {
            return None;
        }
        let (grave, mut text) = self.waiting.take()?;
        self.left -= 1;
        let unsaid = std::mem::take(&mut self.unsaid);
        if unsaid > 0 {
            text.push_str(&format!(
                " (it has changed {unsaid} times more since the last line)"
            ));
        }
        Some((grave, text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_changes_without_pause_says_the_last_of_it_and_no_flood() {
        let mut voice = Voice::new("arm", Instant::ZERO);
        let mut said = Vec::new();
        let mut now = Instant::ZERO;
        // Ten times a second for an hour.
        for number in 0..36_000 {
            now = now + Duration::from_millis(100);
            voice.unsaid += u64::from(voice.waiting.is_some());
            voice.waiting = Some((Grave::Warn, format!(": {number}")));
            said.extend(voice.next(now));
        }
        let most = usize::try_from(BURST).unwrap() + 3600 / 30;
        assert!((most - 2..=most).contains(&said.len()), "{}", said.len());
        assert_eq!(said[0].1, ": 0");
        let counted = " (it has changed 299 times more since the last line)";
        assert!(said[30].1.ends_with(counted), "{said:?}");
        // What is so in the end is said, though nothing changes any more.
        let last = voice.poll_timeout().expect("something waits");
        assert!(last > now && last <= now + REFILL);
        let end = voice.next(last).expect("it is said");
        assert!(end.1.starts_with(": 35999 "), "{end:?}");
        assert_eq!(voice.poll_timeout(), None);
    }
}
