//! The firmware's log on its way to the gateway.

/// Where a node finds the log that it sends when it has nothing else to send.
///
/// The log is a stream of bytes; a node cuts it anywhere, and some of it may be lost on the line.
pub trait LogSource {
    /// Takes the next bytes into `buffer` and says how many.
    fn read(&self, buffer: &mut [u8]) -> usize;

    /// How many bytes were dropped since the boot because there was no room; wraps.
    fn lost(&self) -> u32;
}

/// No log.
impl LogSource for () {
    fn read(&self, _buffer: &mut [u8]) -> usize {
        0
    }

    fn lost(&self) -> u32 {
        0
    }
}
