//! Ports of HALs that implement the traits of `embedded-io` 0.6.

use embedded_io_06 as io06;
#[cfg(feature = "async")]
use embedded_io_async_06 as async06;

/// A port, or half of one, that implements `embedded-io` 0.6 or `embedded-io-async` 0.6, as one of version 0.7. The
/// [`Pump`](super::Pump) takes it. Requires the feature `embedded-io-06`.
///
/// ```
/// use embedded_io_06::{Read, ReadReady, Write};
/// use ztl_mcu::pump::{Io06, Pump};
/// use ztl_mcu::{Components, Instant, Node};
///
/// fn turn<C: Components>(node: &mut Node<'_, C, 2, 128>, uart: impl Read + ReadReady + Write, now: Instant) {
///     let _ = Pump::new().turn(node, &mut Io06(uart), now);
/// }
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Io06<T>(pub T);

/// An error of such a port, of the kind `Other`; the port's own error is inside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Error06<E>(pub E);

impl<E: core::fmt::Debug> core::fmt::Display for Error06<E> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{:?}", self.0)
    }
}

impl<E: core::fmt::Debug> core::error::Error for Error06<E> {}

impl<E: core::fmt::Debug> embedded_io::Error for Error06<E> {
    fn kind(&self) -> embedded_io::ErrorKind {
        embedded_io::ErrorKind::Other
    }
}

impl<T: io06::ErrorType> embedded_io::ErrorType for Io06<T> {
    type Error = Error06<T::Error>;
}

impl<T: io06::ReadReady> embedded_io::ReadReady for Io06<T> {
    fn read_ready(&mut self) -> Result<bool, Self::Error> {
        self.0.read_ready().map_err(Error06)
    }
}

impl<T: io06::Read> embedded_io::Read for Io06<T> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Self::Error> {
        self.0.read(buffer).map_err(Error06)
    }
}

impl<T: io06::Write> embedded_io::Write for Io06<T> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Self::Error> {
        self.0.write(bytes).map_err(Error06)
    }

    fn flush(&mut self) -> Result<(), Self::Error> {
        self.0.flush().map_err(Error06)
    }
}

#[cfg(feature = "async")]
impl<T: async06::Read> embedded_io_async::Read for Io06<T> {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Self::Error> {
        self.0.read(buffer).await.map_err(Error06)
    }
}

#[cfg(feature = "async")]
impl<T: async06::Write> embedded_io_async::Write for Io06<T> {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Self::Error> {
        self.0.write(bytes).await.map_err(Error06)
    }

    async fn flush(&mut self) -> Result<(), Self::Error> {
        self.0.flush().await.map_err(Error06)
    }
}
