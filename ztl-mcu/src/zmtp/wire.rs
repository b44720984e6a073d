//! What goes over the wire as it stands: greetings, the `READY` and `ERROR` of each kind of socket.

/// The bytes of a greeting of ZMTP 3.1 (RFC 37, Formal Grammar), with the mechanism NULL.
pub(super) const GREETING: &[u8; 64] = b"\xFF\0\0\0\0\0\0\0\x01\x7F\
    \x03\x01NULL\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\
    \0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\
    \0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0";

/// Bytes of a signature: with its first and its last byte a peer says that it speaks ZMTP 2.0 or newer.
pub(super) const SIGNATURE: usize = 10;
/// How much of the greeting goes out before the peer's version is known: the signature, and ours.
pub(super) const PARTIAL: usize = SIGNATURE + 1;
/// Where the mechanism stands in a greeting.
pub(super) const MECHANISM: core::ops::Range<usize> = 12..32;

/// In a frame's flags: more frames of this message follow.
pub(super) const MORE: u8 = 1;
/// In a frame's flags: the size takes 8 bytes.
pub(super) const LONG: u8 = 2;
/// In a frame's flags: it is a command.
pub(super) const COMMAND: u8 = 4;

/// The empty frame between a message's envelope and its body.
pub(super) const DELIMITER: [u8; 2] = [MORE, 0];

/// The name of a `PING` in a command's body, with its length.
pub(super) const PING: &[u8] = b"\x04PING";
/// The longest body of a `PING`: name, time to live, context (RFC 37, Connection Heartbeating).
pub(super) const LONGEST_PING: usize = 5 + 2 + 16;

/// The kind of socket that a peer is.
///
/// Those for which a message has an envelope and a delimiter (RFC 28); each is a type without a value.
pub trait Socket {
    /// Its name in the property `Socket-Type`.
    const NAME: &'static [u8];
    /// Its number in ZMTP 2.0, a version of which the name is not known.
    const CODE: u8;
    /// Its `READY` command, as it goes over the wire.
    const READY: &'static [u8];
    /// The kinds that it talks to, by name and number (RFC 37, The Socket-Type Property).
    const PARTNERS: &'static [(&'static [u8], u8)];
    /// Its `ERROR` command for those that it does not talk to. The reason has no blanks (RFC 37, Formal
    /// Grammar: VCHAR).
    const ERROR: &'static [u8];
    /// Whether it is the one that binds, and waits for the other's `READY`.
    const BINDS: bool;
}

/// Answers requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Rep;

/// Asks, and waits for the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Req;

/// Asks, and tells its questions apart by an envelope.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Dealer;

impl Socket for Rep {
    const NAME: &'static [u8] = b"REP";
    const CODE: u8 = 4;
    const READY: &'static [u8] = b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03REP";
    const PARTNERS: &'static [(&'static [u8], u8)] = &[(Req::NAME, 3), (Dealer::NAME, 5)];
    const ERROR: &'static [u8] = b"\x04\x1B\x05ERROR\x14REP-takes-REQ,DEALER";
    const BINDS: bool = true;
}

impl Socket for Req {
    const NAME: &'static [u8] = b"REQ";
    const CODE: u8 = 3;
    const READY: &'static [u8] = b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03REQ";
    const PARTNERS: &'static [(&'static [u8], u8)] = &[(Rep::NAME, 4), (b"ROUTER", 6)];
    const ERROR: &'static [u8] = b"\x04\x1B\x05ERROR\x14REQ-takes-REP,ROUTER";
    const BINDS: bool = false;
}

impl Socket for Dealer {
    const NAME: &'static [u8] = b"DEALER";
    const CODE: u8 = 5;
    const READY: &'static [u8] = b"\x04\x1C\x05READY\x0BSocket-Type\0\0\0\x06DEALER";
    const PARTNERS: &'static [(&'static [u8], u8)] =
        &[(Rep::NAME, 4), (Self::NAME, 5), (b"ROUTER", 6)];
    const ERROR: &'static [u8] = b"\x04\x25\x05ERROR\x1EDEALER-takes-REP,DEALER,ROUTER";
    const BINDS: bool = false;
}

/// What a peer of ZMTP 2.0 is told after the partial greeting: the kind of socket, and an empty
/// identity (RFC 15, Formal Grammar).
pub(super) const fn old_greeting(code: u8) -> [u8; 3] {
    [code, 0, 0]
}
