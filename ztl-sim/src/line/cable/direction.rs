//! One direction between two real ends: a [`FaultyLine`] that one thread fills and another drains.

use std::io::{Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::line::faults::{Counts, FaultyLine};
use ztl_std::gateway::{READ_TIMEOUT, is_pause};
use ztl_std::time::now;

/// Longest delay added to collect bytes, so that few wake-ups carry many.
const BURST: Duration = Duration::from_millis(1);
/// Bytes read at once.
const PIECE: usize = 1024;

pub(super) struct Direction {
    line: Mutex<FaultyLine>,
    /// Signals that bytes were added or removed.
    changed: Condvar,
    /// The receiving end; `None` while it is closed.
    out: Mutex<Option<Box<dyn Write + Send>>>,
}

impl Direction {
    pub(super) fn new(line: FaultyLine) -> Self {
        Self {
            line: Mutex::new(line),
            changed: Condvar::new(),
            out: Mutex::new(None),
        }
    }

    pub(super) fn counts(&self) -> Counts {
        self.line().counts()
    }

    pub(super) fn set_out(&self, out: Option<Box<dyn Write + Send>>) {
        *self.out.lock().unwrap_or_else(PoisonError::into_inner) = out;
    }

    /// Reads from the stream until it breaks, no faster than the line rate.
    pub(super) fn take(&self, mut reader: impl Read, stop: &AtomicBool) {
        let mut buffer = [0; PIECE];
        while !stop.load(Ordering::Acquire) {
            let room = self.wait_room();
            let Some(buffer) = buffer.get_mut(..room).filter(|buffer| !buffer.is_empty()) else {
                continue;
            };
            match reader.read(buffer) {
                Ok(0) => return,
                Ok(count) => {
                    let bytes = buffer.get(..count).unwrap_or_default();
                    self.line().handle_bytes(now(), bytes);
                    self.changed.notify_all();
                }
                Err(error) if is_pause(&error) => {}
                Err(_) => return,
            }
        }
    }

    /// Passes each byte on when it is due.
    pub(super) fn carry(&self, stop: &AtomicBool) {
        let mut buffer = [0; PIECE];
        while !stop.load(Ordering::Acquire) {
            let count = self.wait_bytes(&mut buffer);
            let bytes = buffer.get(..count).unwrap_or_default();
            if !bytes.is_empty() && !self.write(bytes) {
                self.line().count_lost(count);
            }
        }
    }

    /// Writes the bytes; returns `false` if there is no receiver.
    fn write(&self, bytes: &[u8]) -> bool {
        let mut out = self.out.lock().unwrap_or_else(PoisonError::into_inner);
        match out.as_mut() {
            Some(out) => out.write_all(bytes).is_ok(),
            None => false,
        }
    }

    /// Number of bytes that may be sent. If it is 0, waits briefly.
    fn wait_room(&self) -> usize {
        let line = self.line();
        let room = line.room(now());
        if room > 0 {
            return room.min(PIECE);
        }
        // Room appears with time, even if no bytes move.
        drop(self.changed.wait_timeout(line, BURST));
        0
    }

    /// Returns bytes that are due. If there are none, waits briefly.
    fn wait_bytes(&self, buffer: &mut [u8]) -> usize {
        let mut line = self.line();
        let time = now();
        match line.poll_timeout(BURST) {
            Some(due) if due <= time => line.poll_bytes(time, buffer),
            due => {
                let wait = due.map_or(READ_TIMEOUT, |due| due.since(time).min(READ_TIMEOUT));
                drop(self.changed.wait_timeout(line, wait));
                0
            }
        }
    }

    fn line(&self) -> MutexGuard<'_, FaultyLine> {
        self.line.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
