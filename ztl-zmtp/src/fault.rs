//! Why a connection is closed.

/// Why this end closed a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Fault {
    /// The first bytes are not a signature: not ZMTP, or ZMTP 1.0.
    // Starts at 1, so that a new connection is all zeros and takes no flash.
    NotZmtp = 1,
    /// The peer's mechanism is not NULL: it requires a password or keys.
    Mechanism,
    /// The peer's socket type does not match this one.
    SocketType,
    /// A frame has undefined flags or an invalid combination.
    Flags,
    /// A frame other than `READY` in the handshake, or a `READY` whose properties are not complete.
    Unexpected,
    /// A frame is longer than [`SKIPPED`](super::SKIPPED) bytes, or an envelope does not fit the buffer.
    TooLong,
    /// The peer sent `ERROR`.
    Refused,
    /// The handshake took longer than [`HANDSHAKE`](crate::HANDSHAKE), or the time to live that the peer announced has passed.
    Silent,
    /// A command of the encryption cannot be opened, or was used before.
    #[cfg(feature = "curve")]
    Security,
}

impl Fault {
    /// The error message.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::NotZmtp => "the peer does not speak ZMTP 2.0 or newer",
            Self::Mechanism => "the peer's mechanism is not NULL",
            Self::SocketType => "the peer's socket type does not match",
            Self::Flags => "a frame has invalid flags",
            Self::Unexpected => "unexpected frame in the handshake",
            Self::TooLong => "a frame is too long",
            Self::Refused => "the peer sent ERROR",
            Self::Silent => "the peer was silent for too long",
            #[cfg(feature = "curve")]
            Self::Security => "the peer's keys do not match, or a frame was changed on its way",
        }
    }
}

impl core::fmt::Display for Fault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl core::error::Error for Fault {}
