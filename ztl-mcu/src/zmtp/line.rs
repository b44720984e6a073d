//! A stream without connection events: a serial port.

use core::time::Duration;

use embedded_io::{Read, ReadReady, Write};
use ztl_core::Instant;

use ztl_zmtp::{GREETING, SIGNATURE};

use super::server::{Peer, Server};
use crate::Components;
use crate::pump::PumpError;

/// Bytes read at once.
const PIECE: usize = 32;
/// Maximum number of reads per turn.
const PIECES: usize = 8;

/// How long to wait for more bytes of a possible signature.
const PAUSE: Duration = Duration::from_millis(100);

/// A serial port as client number 0 of a server.
///
/// A device is not told when a program opens or closes the port. But every program starts with the ZMTP
/// signature, which cannot occur in a task, because `FF` is not valid UTF-8. So a signature always starts a
/// new connection, and the rest of the former one is dropped. While a signature may have begun, nothing is
/// sent. Otherwise the new program could receive a reply that its own first bytes caused by completing the
/// former program's request.
///
/// ```no_run
/// # use embedded_io::{Read, ReadReady, Write};
/// # use ztl_mcu::{Components, Instant};
/// # use ztl_mcu::zmtp::{Line, Server};
/// # fn clock() -> Instant { Instant::ZERO }
/// # fn firmware<C: Components>(mut server: Server<'_, C, 1, 4, 256, 4>, mut uart: impl Read + ReadReady, mut tx: impl Write) {
/// let mut line = Line::new();
/// loop {
///     let _ = line.turn(&mut server, &mut uart, &mut tx, clock());
/// }
/// # }
/// ```
#[derive(Debug, Clone)]
pub struct Line {
    /// Bytes read but not taken yet.
    piece: [u8; PIECE],
    begin: usize,
    end: usize,
    /// Number of signature bytes matched so far.
    matched: usize,
    /// Until when to wait for the rest of the signature.
    pause: Instant,
}

impl Default for Line {
    fn default() -> Self {
        Self::new()
    }
}

impl Line {
    /// Creates a port that has received nothing yet.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            piece: [0; PIECE],
            begin: 0,
            end: 0,
            matched: 0,
            pause: Instant::ZERO,
        }
    }

    /// Runs one turn of the main loop: reads available bytes, advances the components and sends output.
    /// Returns when the next turn is due if no byte arrives.
    ///
    /// Reads at most 256 bytes without waiting, and none while a request is in progress. Writes at most one
    /// buffer, as fast as the stream takes it.
    ///
    /// # Errors
    /// Those of the stream; the server is not affected.
    pub fn turn<
        R,
        W,
        C,
        const PEERS: usize,
        const TASKS: usize,
        const BUFFER: usize,
        const CLIENTS: usize,
    >(
        &mut self,
        server: &mut Server<'_, C, PEERS, TASKS, BUFFER, CLIENTS>,
        rx: &mut R,
        tx: &mut W,
        now: Instant,
    ) -> Result<Instant, PumpError<R::Error, W::Error>>
    where
        R: Read + ReadReady,
        W: Write,
        C: Components,
    {
        for _ in 0..PIECES {
            if self.begin == self.end {
                if !rx.read_ready().map_err(PumpError::Read)? {
                    break;
                }
                let count = rx.read(&mut self.piece).map_err(PumpError::Read)?;
                (self.begin, self.end) = (0, count.min(PIECE));
            }
            self.feed(server, now);
            if self.begin < self.end {
                break;
            }
        }
        server.handle_timeout(now);
        if self.matched > 0 && now < self.pause {
            return Ok(server.poll_timeout(now).min(self.pause));
        }
        let mut left = BUFFER;
        while left > 0 {
            let pending = server.transmit_buf(Peer(0));
            let pending = pending.get(..left).unwrap_or(pending);
            if pending.is_empty() {
                break;
            }
            // `write_all` panics if a stream writes nothing, or more than it was given.
            let written = tx
                .write(pending)
                .map_err(PumpError::Write)?
                .min(pending.len());
            if written == 0 {
                break;
            }
            server.consume(Peer(0), written);
            left -= written;
        }
        if left < BUFFER {
            tx.flush().map_err(PumpError::Write)?;
        }
        let more = self.begin < self.end || left == 0;
        Ok(if more { now } else { server.poll_timeout(now) })
    }

    /// Passes the bytes read to the server, as long as it takes any.
    fn feed<
        C: Components,
        const PEERS: usize,
        const TASKS: usize,
        const BUFFER: usize,
        const CLIENTS: usize,
    >(
        &mut self,
        server: &mut Server<'_, C, PEERS, TASKS, BUFFER, CLIENTS>,
        now: Instant,
    ) {
        while let Some(&byte) = self.piece.get(self.begin..self.end).and_then(<[u8]>::first) {
            if self.is_signature(byte) {
                server.open(now, Peer(0));
                let signature = GREETING.get(..SIGNATURE).unwrap_or_default();
                server.handle_bytes(now, Peer(0), signature);
            } else if self.matched > 0 {
                self.pause = now + PAUSE;
                // May be dropped: after a request in progress, only a signature begins like this.
                server.handle_bytes(now, Peer(0), &[byte]);
            } else if server.handle_bytes(now, Peer(0), &[byte]) == 0 {
                return;
            }
            self.begin += 1;
        }
    }

    /// Whether this byte completes a signature: `FF`, eight bytes of padding, `7F`.
    ///
    /// The padding holds the length of an identity, so only its last byte can be nonzero.
    fn is_signature(&mut self, byte: u8) -> bool {
        self.matched = match (self.matched, byte) {
            // Another signature may begin here; an identity of 254 bytes does not occur.
            (_, 0xFF) => 1,
            (place @ 1..=7, 0) => place + 1,
            (8, _) => 9,
            (9, 0x7F) => 10,
            _ => 0,
        };
        if self.matched == SIGNATURE {
            self.matched = 0;
            return true;
        }
        false
    }
}
