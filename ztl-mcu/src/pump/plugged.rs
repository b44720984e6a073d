//! Ports that come and go.

use core::convert::Infallible;

use embedded_hal_async::delay::DelayNs;
use embedded_io_async::{ErrorType, Read, Write};

/// How often a port that fails is tried again, in ms.
const AGAIN: u32 = 10;

/// A port, or half of one, that never fails: the node keeps running after an error, and the port is tried again 10 ms later.
/// So [`Pump::run`](super::Pump::run) never ends. Errors are an unplugged USB host, a framing error of a UART, and a read
/// without bytes.
///
/// It writes at most 63 bytes at a time: a packet of 64 bytes on USB would let the host wait for more.
///
/// For embassy: `Plugged::new(half, Delay)` with the two halves of `CdcAcmClass::split` (of the receiver,
/// `into_buffered`), or those of `BufferedUart::split` of embassy-rp, embassy-stm32 and embassy-nrf. A HAL on
/// `embedded-io-async` 0.6 goes into [`Io06`](super::Io06) first.
///
/// ```
/// use embedded_hal_async::delay::DelayNs;
/// use embedded_io_async::{Read, Write};
/// use ztl_mcu::pump::{Plugged, Pump};
/// use ztl_mcu::{Components, Instant, Node};
///
/// async fn serve<C: Components>(
///     mut node: Node<'_, C, 2, 128>,
///     (rx, tx): (impl Read, impl Write),
///     mut delay: impl DelayNs + Clone,
///     clock: fn() -> Instant,
/// ) {
///     let mut rx = Plugged::new(rx, delay.clone());
///     let mut tx = Plugged::new(tx, delay.clone());
///     let _ = Pump::new().run(&mut node, &mut rx, &mut tx, &mut delay, clock).await; // never ends
/// }
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Plugged<T, D> {
    port: T,
    delay: D,
}

impl<T, D> Plugged<T, D> {
    /// The longest write, in bytes.
    const WRITE: usize = 63;

    /// A port, and a delay that waits between two tries.
    pub const fn new(port: T, delay: D) -> Self {
        Self { port, delay }
    }
}

impl<T, D> ErrorType for Plugged<T, D> {
    type Error = Infallible;
}

impl<T: Read, D: DelayNs> Read for Plugged<T, D> {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        loop {
            match self.port.read(buffer).await {
                Ok(0) if !buffer.is_empty() => {}
                Ok(count) => return Ok(count),
                Err(_) => {}
            }
            self.delay.delay_ms(AGAIN).await;
        }
    }
}

impl<T: Write, D: DelayNs> Write for Plugged<T, D> {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let bytes = bytes.get(..Self::WRITE).unwrap_or(bytes);
        loop {
            match self.port.write(bytes).await {
                Ok(count) => return Ok(count),
                Err(_) => self.delay.delay_ms(AGAIN).await,
            }
        }
    }

    /// Ignores an error: the link resends what was lost, and the next write waits.
    async fn flush(&mut self) -> Result<(), Infallible> {
        let _ = self.port.flush().await;
        Ok(())
    }
}
