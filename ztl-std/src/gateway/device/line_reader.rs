//! The thread that reads a device's line.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::backpressure::{Backpressure, Permit};
use crate::gateway::endpoint::{CLOSED, is_pause};
use crate::gateway::opener::Opener;

/// What happens to a line.
pub(in crate::gateway) enum LineEvent {
    Opened(Box<dyn Write + Send>),
    /// Received bytes; the permit is dropped when they have been handled.
    Bytes(Vec<u8>, Permit),
    Closed(io::Error),
}

/// Opens the line and passes on what happens to it, until it breaks or `stop` is set. `put` returns whether anybody wants
/// more.
pub(in crate::gateway) fn run_line(
    opener: &Opener,
    stop: &AtomicBool,
    put: impl Fn(LineEvent) -> bool,
) {
    let error = read_line(opener, stop, &put);
    put(LineEvent::Closed(error));
}

fn read_line(opener: &Opener, stop: &AtomicBool, put: &impl Fn(LineEvent) -> bool) -> io::Error {
    let ended = || io::Error::new(io::ErrorKind::UnexpectedEof, CLOSED);
    let mut line = match (opener.open)() {
        Ok(line) => line,
        Err(error) => return error,
    };
    let writer = std::mem::replace(&mut line.writer, Box::new(io::sink()));
    if !put(LineEvent::Opened(writer)) {
        return ended();
    }
    let mut buffer = [0; 1024];
    let backpressure = Arc::default();
    let mut next = None;
    while !stop.load(Ordering::Acquire) {
        let Some(permit) = next.take().or_else(|| Backpressure::permit(&backpressure)) else {
            continue;
        };
        match line.reader.read(&mut buffer) {
            Ok(0) => return ended(),
            Ok(count) => {
                let bytes = buffer.get(..count).unwrap_or_default().to_vec();
                if !put(LineEvent::Bytes(bytes, permit)) {
                    break;
                }
            }
            Err(error) if is_pause(&error) => next = Some(permit),
            Err(error) => return error,
        }
    }
    ended()
}
