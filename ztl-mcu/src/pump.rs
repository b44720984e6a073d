//! A node on a serial port: bytes from and to anything that speaks `embedded-io`.

use embedded_io::{Read, ReadReady, Write};
use ztl_core::Instant;

use crate::{Components, Node};

/// One turn of a main loop: takes the bytes that are there, lets the components move on, sends
/// what is to be sent. Returns when the next turn is due even if no byte arrives.
///
/// Reads only what is ready; sending blocks as the stream's `write` does.
///
/// # Errors
/// Those of the stream. The node is unharmed; bytes not sent are lost, as on a bad line.
pub fn turn<S, C, const TASKS: usize, const FRAME: usize>(
    node: &mut Node<'_, C, TASKS, FRAME>,
    stream: &mut S,
    now: Instant,
) -> Result<Instant, S::Error>
where
    S: Read + ReadReady + Write,
    C: Components,
{
    let mut buffer = [0; 32];
    while stream.read_ready()? {
        let count = stream.read(&mut buffer)?;
        if count == 0 {
            break;
        }
        node.handle_bytes(now, buffer.get(..count).unwrap_or_default());
    }
    node.handle_timeout(now);
    loop {
        let count = node.poll_transmit(now, &mut buffer);
        if count == 0 {
            break;
        }
        // Not `write_all`, which panics when a stream writes nothing, or more than it was given.
        let mut rest = buffer.get(..count).unwrap_or_default();
        while !rest.is_empty() {
            let written = stream.write(rest)?;
            if written == 0 {
                break;
            }
            rest = rest.get(written..).unwrap_or_default();
        }
    }
    stream.flush()?;
    Ok(node.poll_timeout(now))
}
