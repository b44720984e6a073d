//! The USB port, which is there or not: what moves does not wait for it.

use core::convert::Infallible;

use embassy_rp::peripherals::USB;
use embassy_rp::usb::Driver;
use embassy_usb::class::cdc_acm;
use embedded_io_async::{ErrorType, Read, Write};

type Usb = Driver<'static, USB>;

/// What the host says; nothing while there is none.
pub(crate) struct Receiver(pub(crate) cdc_acm::BufferedReceiver<'static, Usb>);

impl ErrorType for Receiver {
    type Error = Infallible;
}

impl Read for Receiver {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        loop {
            match self.0.read(buffer).await {
                Ok(count) => return Ok(count),
                Err(_) => self.0.wait_connection().await,
            }
        }
    }
}

/// What the host hears, packet by packet.
pub(crate) struct Sender(pub(crate) cdc_acm::Sender<'static, Usb>);

impl ErrorType for Sender {
    type Error = Infallible;
}

impl Write for Sender {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        // Shorter than the longest, so that the host does not wait for more.
        let most = usize::from(self.0.max_packet_size()).saturating_sub(1);
        let packet = bytes.get(..most).unwrap_or(bytes);
        loop {
            match self.0.write_packet(packet).await {
                Ok(()) => return Ok(packet.len()),
                Err(_) => self.0.wait_connection().await,
            }
        }
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
