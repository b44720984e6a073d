//! Bounds on the memory and work that a peer can cause.

/// Bounds on memory, work and nesting.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// The longest payload of a message, in bytes. Default 16 MiB.
    pub payload: usize,
    /// The most values in a message, where each element of a list counts; a message has at most one value more than
    /// it has bytes, plus 64. Default 256 Ki, which take 12 MiB.
    pub values: usize,
    /// How deep values and signatures may be nested. Default 32.
    pub depth: usize,
    /// The longest signature, in bytes. Default 8 KiB.
    pub signature: usize,
    /// The most calls under way or waiting. Default 1024.
    pub calls: usize,
    /// The most signals that wait for [`poll_event`](crate::Session::poll_event), in messages; the oldest are
    /// dropped and counted. Default 1024.
    pub signals: usize,
    /// The same in bytes. Default 4 MiB.
    pub signal_bytes: usize,
    /// The most bytes that wait to be sent to one peer. Default 4 MiB.
    pub output: usize,
    /// The most connections. Default 64.
    pub connections: usize,
    /// The most services whose names the session keeps; a robot has about 100. A name has at most
    /// 256 bytes. Services beyond that can still be called. Default 4096.
    pub services: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            payload: 16 << 20,
            values: 256 << 10,
            depth: 32,
            signature: 8 << 10,
            calls: 1024,
            signals: 1024,
            signal_bytes: 4 << 20,
            output: 4 << 20,
            connections: 64,
            services: 4096,
        }
    }
}
