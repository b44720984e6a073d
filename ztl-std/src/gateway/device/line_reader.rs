//! The thread that reads a device's line.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;

use super::backpressure::Backpressure;
use super::input::Input;
use crate::gateway::endpoint::is_pause;
use crate::gateway::opener::Opener;

/// Opens the line and passes on what arrives, until the line breaks or `stop` is set.
pub(super) fn read_line(
    number: u64,
    opener: &Opener,
    inputs: &Sender<Input>,
    stop: &AtomicBool,
) -> io::Error {
    let ended = || io::Error::new(io::ErrorKind::UnexpectedEof, "the other end has closed it");
    let mut line = match (opener.open)() {
        Ok(line) => line,
        Err(error) => return error,
    };
    let writer = std::mem::replace(&mut line.writer, Box::new(io::sink()));
    if inputs.send(Input::Opened(number, writer)).is_err() {
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
                if inputs.send(Input::Bytes(number, bytes, permit)).is_err() {
                    break;
                }
            }
            Err(error) if is_pause(&error) => next = Some(permit),
            Err(error) => return error,
        }
    }
    ended()
}
