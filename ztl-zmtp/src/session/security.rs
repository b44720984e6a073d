//! How a connection is secured.

#[cfg(feature = "curve")]
use crate::curve;

/// How a connection is secured.
#[derive(Debug, Clone)]
pub enum Security {
    /// Not at all: the mechanism NULL.
    Null,
    /// Encrypted, with keys on both sides (RFC 26).
    #[cfg(feature = "curve")]
    Curve(curve::Keys),
}

impl Security {
    /// The mechanism's name in the greeting.
    pub(super) const fn mechanism(&self) -> &'static [u8] {
        match self {
            Self::Null => b"NULL",
            #[cfg(feature = "curve")]
            Self::Curve(_) => b"CURVE",
        }
    }
}
