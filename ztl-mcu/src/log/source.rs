//! Where a node takes its log from.

/// A log that a node sends when it has nothing else to send.
///
/// The log is a byte stream. The node may split it anywhere, and parts may be lost on the line.
pub trait LogSource {
    /// Moves the next bytes into `buffer` and returns how many.
    fn read(&self, buffer: &mut [u8]) -> usize;

    /// Bytes dropped since boot because the log was full; wraps around.
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
