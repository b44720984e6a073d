//! One turn of a main loop.

use core::time::Duration;

use embedded_io::{Read, ReadReady, Write};
use ztl_core::Instant;

use crate::log::LogSource;
#[cfg(feature = "critical-section")]
use crate::shared::StopFlag;
use crate::{Components, Node};

/// Maximum number of bytes that a turn reads.
const READ: usize = 256;
/// How often the log is polled while there is nothing else to do.
pub(super) const LOG_AGAIN: Duration = Duration::from_millis(10);

/// Why a turn ended early. The node is not affected: continue, or recover the port first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum PumpError<R, W> {
    /// Reading failed.
    Read(R),
    /// Writing failed.
    Write(W),
    /// The stream has ended.
    Closed,
}

impl<R: core::fmt::Debug, W: core::fmt::Debug> core::fmt::Display for PumpError<R, W> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Read(cause) => write!(f, "reading failed: {cause:?}"),
            Self::Write(cause) => write!(f, "writing failed: {cause:?}"),
            Self::Closed => f.write_str("the stream has ended"),
        }
    }
}

impl<R: core::fmt::Debug, W: core::fmt::Debug> core::error::Error for PumpError<R, W> {}

/// Runs a node on a serial port: a turn of a main loop, or the whole loop for an async executor. Connects it with the
/// emergency stop and the log of the firmware.
///
/// ```no_run
/// # use embedded_io::{Read, ReadReady, Write};
/// # use ztl_mcu::{Components, Instant, Node};
/// # fn clock() -> Instant { Instant::ZERO }
/// use ztl_mcu::pump::Pump;
///
/// # fn firmware<C: Components>(mut node: Node<'_, C, 2, 128>, mut uart: impl Read + ReadReady + Write) {
/// let pump = Pump::new();
/// loop {
///     let _ = pump.turn(&mut node, &mut uart, clock());
/// }
/// # }
/// ```
///
/// If an interrupt receives, with the feature `critical-section`:
///
/// ```no_run
/// # #[cfg(feature = "critical-section")] mod firmware {
/// # use embedded_io::Write;
/// # use ztl_mcu::{Components, Instant, Node};
/// # fn clock() -> Instant { Instant::ZERO }
/// use ztl_mcu::pump::Pump;
/// use ztl_mcu::shared::{LogQueue, ReceiveQueue, StopFlag};
///
/// static RECEIVED: ReceiveQueue<128> = ReceiveQueue::new();
/// static STOP: StopFlag = StopFlag::new();
/// static LOG: LogQueue<512> = LogQueue::new();
///
/// # fn firmware<C: Components>(mut node: Node<'_, C, 2, 128>, mut tx: impl Write) {
/// let pump = Pump::new().with_stop(&STOP).with_log(&LOG);
/// loop {
///     let _ = pump.turn_split(&mut node, &mut &RECEIVED, &mut tx, clock());
/// }
/// # }
/// # }
/// ```
#[derive(Clone, Copy)]
pub struct Pump<'a> {
    #[cfg(feature = "critical-section")]
    pub(super) stop: Option<&'a StopFlag>,
    pub(super) log: Option<&'a dyn LogSource>,
}

impl core::fmt::Debug for Pump<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Pump")
    }
}

impl Default for Pump<'_> {
    fn default() -> Self {
        Self::new()
    }
}

impl<'a> Pump<'a> {
    /// A pump without emergency stop and log.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            #[cfg(feature = "critical-section")]
            stop: None,
            log: None,
        }
    }

    /// Adds an emergency stop. When `stop` is raised, the node stops at the start of the next turn, in `run` at once.
    #[cfg(feature = "critical-section")]
    #[must_use]
    pub const fn with_stop(mut self, stop: &'a StopFlag) -> Self {
        self.stop = Some(stop);
        self
    }

    /// Adds a log, which is sent when there is nothing else to send.
    #[must_use]
    pub const fn with_log(mut self, log: &'a dyn LogSource) -> Self {
        self.log = Some(log);
        self
    }

    /// Runs one turn of a main loop: reads available bytes, advances the components, and sends output. Returns when the
    /// next turn is due even if no byte arrives.
    ///
    /// Reads at most 256 bytes without waiting. Writes at most `FRAME` bytes and flushes them, which takes as long as the
    /// stream needs: up to 11 ms at 115200 baud with frames of 128 bytes. If the port does not buffer the bytes that
    /// arrive meanwhile, let an interrupt receive.
    ///
    /// # Errors
    /// Those of the stream. The node is not affected; unsent bytes are sent in the next turn.
    pub fn turn<S, C, const TASKS: usize, const FRAME: usize>(
        &self,
        node: &mut Node<'_, C, TASKS, FRAME>,
        stream: &mut S,
        now: Instant,
    ) -> Result<Instant, S::Error>
    where
        S: Read + ReadReady + Write,
        C: Components,
    {
        let more = self.receive(node, stream, now)?;
        self.send(node, stream, now)?;
        Ok(self.due(node, now, more))
    }

    /// Like [`turn`](Self::turn), with a port in two halves.
    ///
    /// # Errors
    /// [`PumpError::Read`] and [`PumpError::Write`], as [`turn`](Self::turn).
    pub fn turn_split<R, W, C, const TASKS: usize, const FRAME: usize>(
        &self,
        node: &mut Node<'_, C, TASKS, FRAME>,
        rx: &mut R,
        tx: &mut W,
        now: Instant,
    ) -> Result<Instant, PumpError<R::Error, W::Error>>
    where
        R: Read + ReadReady,
        W: Write,
        C: Components,
    {
        let more = self.receive(node, rx, now).map_err(PumpError::Read)?;
        self.send(node, tx, now).map_err(PumpError::Write)?;
        Ok(self.due(node, now, more))
    }

    /// Returns whether there may be more to read. Advances the components even if reading fails.
    fn receive<R: Read + ReadReady, C: Components, const TASKS: usize, const FRAME: usize>(
        &self,
        node: &mut Node<'_, C, TASKS, FRAME>,
        rx: &mut R,
        now: Instant,
    ) -> Result<bool, R::Error> {
        self.take_stop(node, now);
        let more = read(node, rx, now);
        node.handle_timeout(now);
        more
    }

    pub(super) fn take_stop<C: Components, const TASKS: usize, const FRAME: usize>(
        &self,
        node: &mut Node<'_, C, TASKS, FRAME>,
        now: Instant,
    ) {
        #[cfg(feature = "critical-section")]
        if self.stop.is_some_and(StopFlag::take) {
            node.stop_everything(now);
        }
        #[cfg(not(feature = "critical-section"))]
        let _ = (node, now);
    }

    pub(super) fn log(&self) -> &dyn LogSource {
        self.log.unwrap_or(&())
    }

    fn send<W: Write, C: Components, const TASKS: usize, const FRAME: usize>(
        &self,
        node: &mut Node<'_, C, TASKS, FRAME>,
        tx: &mut W,
        now: Instant,
    ) -> Result<(), W::Error> {
        // Bounded, because components may always have another reading.
        let mut left = FRAME;
        while left > 0 {
            let pending = node.transmit_buf(now, self.log());
            let pending = pending.get(..left).unwrap_or(pending);
            if pending.is_empty() {
                break;
            }
            // `write_all` panics if a stream writes nothing, or more than it was given.
            let written = tx.write(pending)?.min(pending.len());
            if written == 0 {
                break;
            }
            node.consume(written);
            left -= written;
        }
        if left < FRAME {
            tx.flush()?;
        }
        Ok(())
    }

    fn due<C: Components, const TASKS: usize, const FRAME: usize>(
        &self,
        node: &Node<'_, C, TASKS, FRAME>,
        now: Instant,
        more: bool,
    ) -> Instant {
        match self.log {
            _ if more => now,
            None => node.poll_timeout(now),
            Some(_) => node.poll_timeout(now).min(now + LOG_AGAIN),
        }
    }
}

/// Reads available bytes. Returns whether there may be more.
fn read<R: Read + ReadReady, C: Components, const TASKS: usize, const FRAME: usize>(
    node: &mut Node<'_, C, TASKS, FRAME>,
    rx: &mut R,
    now: Instant,
) -> Result<bool, R::Error> {
    let mut buffer = [0; 32];
    for _ in 0..READ / buffer.len() {
        if !rx.read_ready()? {
            return Ok(false);
        }
        let count = rx.read(&mut buffer)?;
        if count == 0 {
            return Ok(false);
        }
        node.handle_bytes(now, buffer.get(..count).unwrap_or_default());
    }
    Ok(true)
}
