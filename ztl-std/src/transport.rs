//! How ZMTP is spoken.

use std::time::Duration;

/// Shortest and longest pause of a client before it connects again.
pub(crate) const RETRY: (Duration, Duration) = (Duration::from_millis(20), Duration::from_secs(1));

/// How a server or client speaks ZMTP.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Transport {
    /// By this crate.
    #[default]
    Native,
    /// By libzmq.
    #[cfg(feature = "libzmq")]
    Libzmq,
}

impl Transport {
    /// All transports of this build, by name.
    pub const ALL: &[(&str, Self)] = &[
        ("native", Self::Native),
        #[cfg(feature = "libzmq")]
        ("libzmq", Self::Libzmq),
    ];

    /// The version of libzmq in this build.
    #[must_use]
    pub fn libzmq_version() -> Option<String> {
        #[cfg(feature = "libzmq")]
        {
            let (major, minor, patch) = zmq::version();
            Some(format!("{major}.{minor}.{patch}"))
        }
        #[cfg(not(feature = "libzmq"))]
        None
    }

    /// Whether connections can be encrypted. By libzmq, that depends on how it was built.
    pub(crate) fn can_encrypt(self) -> bool {
        match self {
            Self::Native => true,
            #[cfg(feature = "libzmq")]
            Self::Libzmq => crate::libzmq::can_encrypt(),
        }
    }
}
