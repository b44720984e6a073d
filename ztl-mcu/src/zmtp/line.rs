//! A stream that does not tell when a client comes and goes: a serial port.

use core::time::Duration;

use embedded_io::{Read, ReadReady, Write};
use ztl_core::Instant;

use super::server::{Peer, Server};
use super::wire::{GREETING, SIGNATURE};
use crate::Components;
use crate::pump::PumpError;

/// Bytes read at a time.
const PIECE: usize = 32;
/// Pieces that a turn reads at most.
const PIECES: usize = 8;

/// How long after its last byte what may be the beginning of a signature is waited for.
const PAUSE: Duration = Duration::from_millis(100);

/// A serial port as a server's client number 0.
///
/// Nobody tells the device that a program has opened the port, or left it. But each begins with the
/// signature, which stands in no task: `FF` is no UTF-8. So wherever one is read, a new connection
/// begins, and what was left of the one before is dropped. Nothing is sent while a signature may have
/// begun, so that the next program does not hear what its first bytes made of the last one's request.
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
    /// What was read and not taken yet.
    piece: [u8; PIECE],
    begin: usize,
    end: usize,
    /// How many bytes of a signature have come.
    matched: usize,
    /// Until when the rest of it is waited for.
    pause: Instant,
}

impl Default for Line {
    fn default() -> Self {
        Self::new()
    }
}

impl Line {
    /// A port on which nothing has come yet.
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

    /// One turn of a main loop: takes the bytes that are there, lets the components move on, sends what
    /// is to be sent. Returns when the next turn is due even if no byte arrives.
    ///
    /// Reads only what is ready, at most 256 bytes, and nothing while a request is being dealt with; writes
    /// at most the buffer's length, for as long as the stream takes.
    ///
    /// # Errors
    /// Those of the stream; the server is unharmed.
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
            // Not `write_all`, which panics when a stream writes nothing, or more than it was given.
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

    /// Gives the server what was read, for as long as it takes any.
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
                // Taken or not: behind a request that is dealt with nothing else begins so.
                server.handle_bytes(now, Peer(0), &[byte]);
            } else if server.handle_bytes(now, Peer(0), &[byte]) == 0 {
                return;
            }
            self.begin += 1;
        }
    }

    /// Whether this byte completes a signature: `FF`, eight bytes of padding, `7F`.
    ///
    /// The padding is the length of an identity, so of its bytes only the last is not 0.
    fn is_signature(&mut self, byte: u8) -> bool {
        self.matched = match (self.matched, byte) {
            // Perhaps another begins here; an identity of 254 bytes is nobody's.
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
