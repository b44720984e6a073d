//! What a client learns from a handshake that did not complete.

use crate::fault::Fault;

/// Why a client's handshake did not complete, as far as the peer's bytes and the moment of the end tell it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Obstacle {
    /// The peer encrypts, and this end has no keys.
    PeerEncrypts,
    /// This end has keys, and the peer does not encrypt.
    PeerIsPlain,
    /// The peer demands something else, such as a password.
    OtherMechanism,
    /// The peer does not have the key that this end expects: one of them could not open the other's first command.
    OtherKey,
    /// The peer has the expected key, and does not admit the owner of ours.
    KeyNotAdmitted,
    /// The peer does not admit this end, although neither encrypts.
    NotAdmitted,
    /// The peer breaks the protocol, or speaks another one.
    Fault(Fault),
}
