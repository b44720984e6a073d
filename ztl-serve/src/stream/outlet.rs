//! The publishing end of a stream: makes a value of each frame, and limits how often one goes out.

use std::fmt::Display;
use std::sync::Arc;
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
    /// When the next frame may go out, if there is a rate.
    next: Option<Instant>,
    /// The newest value, which is to go out then.
    waiting: Option<Vec<u8>>,
    /// Frames that were dropped and not logged yet.
    dropped: u64,
    quiet_until: Option<Instant>,
}

impl Outlet {
    pub(super) fn new(config: Arc<StreamConfig>, publisher: Publisher) -> Self {
        Self {
            config,
            publisher,
            next: None,
            waiting: None,
            dropped: 0,
            quiet_until: None,
        }
    }

    /// The splitter has found this.
    pub(super) fn handle(&mut self, now: Instant, piece: Piece<'_>) {
        let value = match piece {
            Piece::Frame(frame) => value(self.config.framing, frame),
            Piece::TooLong => {
                let longest = human_size(self.config.longest);
                Err(format!("it is longer than {longest} (longest)"))
            }
            Piece::NotJpeg => Err("it is not a JPEG image".to_owned()),
        };
        match value {
            Ok(Some(value)) => self.put(now, value.to_bytes()),
            Ok(None) => {}
            Err(why) => self.drop_one(now, why),
        }
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.next.filter(|_| self.waiting.is_some())
    }

    /// Publishes the value that waits, if its time has come.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
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
        self.next = self
            .config
            .interval
            .and_then(|interval| now.checked_add(interval));
        let (path, latest) = (&self.config.path, self.config.latest);
        if !self.publisher.publish_bytes(path, body, latest) {
            self.drop_one(now, "it came faster than it could be sent");
        }
    }

    fn drop_one(&mut self, now: Instant, why: impl Display) {
        self.dropped += 1;
        if self.quiet_until.is_some_and(|until| now < until) {
            return;
        }
        self.quiet_until = now.checked_add(QUIET);
        let topic = self.config.topic();
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
