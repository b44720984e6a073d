//! The publishing end of a stream: makes a value of each frame, and limits how often one goes out.

use std::borrow::Cow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tracing::warn;
use ztl_pickle::Pickle;
use ztl_std::Publisher;

use super::StreamConfig;
use super::splitter::{Framing, Piece};
use crate::human::human_size;
use crate::log::LOG;

/// The shortest time between two log lines about dropped frames.
const QUIET: Duration = Duration::from_secs(10);

pub(super) struct Outlet {
    config: Arc<StreamConfig>,
    publisher: Publisher,
    /// Whether anyone subscribes.
    is_heard: Arc<AtomicBool>,
    /// When the next frame may go out, if there is a rate.
    next: Option<Instant>,
    /// The newest value, which is to go out then.
    waiting: Option<Vec<u8>>,
    /// Frames that were dropped and not logged yet, and why the last one was.
    dropped: u64,
    why: Cow<'static, str>,
    quiet_until: Option<Instant>,
}

impl Outlet {
    pub(super) fn new(
        config: Arc<StreamConfig>,
        publisher: Publisher,
        is_heard: Arc<AtomicBool>,
    ) -> Self {
        Self {
            config,
            publisher,
            is_heard,
            next: None,
            waiting: None,
            dropped: 0,
            why: Cow::Borrowed(""),
            quiet_until: None,
        }
    }

    /// The splitter has found this.
    pub(super) fn handle(&mut self, now: Instant, piece: Piece<'_>) {
        let framing = self.config.framing;
        // A late subscriber gets the latest value.
        let is_wanted = self.config.latest || self.is_heard.load(Ordering::Acquire);
        let value = match piece {
            // JSON is checked in any case, since mistakes in it are logged.
            Piece::Frame(_) if !is_wanted && framing != Framing::Json => return,
            Piece::Frame(frame) => value(framing, frame),
            Piece::TooLong => {
                let longest = human_size(self.config.longest);
                Err(format!("it is longer than {longest} (longest)"))
            }
            Piece::NotJpeg => Err("it is not a JPEG image".to_owned()),
        };
        match value {
            Ok(Some(value)) if is_wanted => self.put(now, value.to_bytes()),
            Ok(_) => {}
            Err(why) => self.drop_one(now, why.into()),
        }
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let next = self.next.filter(|_| self.waiting.is_some());
        let log = self.quiet_until.filter(|_| self.dropped > 0);
        next.into_iter().chain(log).min()
    }

    /// Publishes the value that waits, if its time has come, and logs how many frames were dropped.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        self.log_dropped(now);
        if self.next.is_none_or(|next| next <= now)
            && let Some(body) = self.waiting.take()
        {
            self.publish(now, &body);
        }
    }

    fn put(&mut self, now: Instant, body: Vec<u8>) {
        if self.config.interval.is_none() {
            return self.publish(now, &body);
        }
        self.waiting = Some(body);
        self.handle_timeout(now);
    }

    fn publish(&mut self, now: Instant, body: &[u8]) {
        self.next = self.config.interval.and_then(|interval| {
            // A value that goes out late does not delay the next one.
            let due = self.next.filter(|next| now < *next + interval);
            due.unwrap_or(now).checked_add(interval)
        });
        let (path, latest) = (&self.config.path, self.config.latest);
        if !self.publisher.publish_bytes(path, body, latest) {
            self.drop_one(now, "it came faster than it could be sent".into());
        }
    }

    fn drop_one(&mut self, now: Instant, why: Cow<'static, str>) {
        self.dropped += 1;
        self.why = why;
        self.log_dropped(now);
    }

    /// Logs how many frames were dropped, unless that was done a short time ago.
    fn log_dropped(&mut self, now: Instant) {
        if self.dropped == 0 || self.quiet_until.is_some_and(|until| now < until) {
            return;
        }
        self.quiet_until = now.checked_add(QUIET);
        let (topic, why) = (self.config.topic(), &self.why);
        match std::mem::take(&mut self.dropped) {
            1 => warn!(target: LOG, "Stream {topic}: a frame was dropped: {why}"),
            many => {
                warn!(target: LOG, "Stream {topic}: {many} frames were dropped; the last one: {why}")
            }
        }
    }
}

/// The value of a frame. A blank line has none in JSON.
fn value(framing: Framing, frame: &[u8]) -> Result<Option<Pickle>, String> {
    let value = match framing {
        Framing::Line => Pickle::text(&String::from_utf8_lossy(frame)),
        Framing::Json if frame.trim_ascii().is_empty() => return Ok(None),
        Framing::Json => {
            let value = serde_json::from_slice(frame);
            return value
                .map(Some)
                .map_err(|error| format!("it is not JSON: {error}"));
        }
        Framing::Jpeg | Framing::Length | Framing::Fixed(_) => Pickle::bytes(frame),
    };
    value.map(Some).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests;
