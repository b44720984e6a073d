//! Constant parts of the wire format: greetings, and `READY` and `ERROR` of each socket type.

/// How long a peer may take from opening the connection to its `READY`.
pub const HANDSHAKE: core::time::Duration = core::time::Duration::from_secs(5);

/// The longest frame that is skipped and answered if it does not fit; a longer one closes the connection.
pub const SKIPPED: u32 = 65536;

/// A greeting of ZMTP 3.1 with the mechanism NULL (RFC 37, Formal Grammar).
pub const GREETING: &[u8; 64] = b"\xFF\0\0\0\0\0\0\0\x01\x7F\
    \x03\x01NULL\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\
    \0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\
    \0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0";

/// Length of the signature. Its first and last byte announce ZMTP 2.0 or newer.
pub const SIGNATURE: usize = 10;
/// How much of the greeting is sent before the peer's version is known: signature and version.
pub(crate) const PARTIAL: usize = SIGNATURE + 1;
/// Position of the mechanism in a greeting.
pub(crate) const MECHANISM: core::ops::Range<usize> = 12..32;

/// Frame flag: more frames of this message follow.
pub(crate) const MORE: u8 = 1;
/// Frame flag: the size takes 8 bytes.
pub(crate) const LONG: u8 = 2;
/// Frame flag: the frame is a command.
pub(crate) const COMMAND: u8 = 4;

/// The empty frame between a message's envelope and its body.
pub(crate) const DELIMITER: [u8; 2] = [MORE, 0];

/// The name of `PING` in a command's body, with its length.
pub(crate) const PING: &[u8] = b"\x04PING";
/// Length of the longest `PING` body: name, time to live, context (RFC 37, Connection Heartbeating).
pub(crate) const LONGEST_PING: usize = 5 + 2 + 16;

/// A socket type, as a type without values (RFC 28, RFC 29).
pub trait Socket {
    /// Its name in the property `Socket-Type`.
    const NAME: &'static [u8];
    /// Its number in ZMTP 2.0, which does not use names.
    const CODE: u8;
    /// Its `READY` command as sent on the wire.
    const READY: &'static [u8];
    /// The socket types it talks to, by name and number (RFC 37, The Socket-Type Property).
    const PARTNERS: &'static [(&'static [u8], u8)];
    /// Its `ERROR` command for other socket types. The reason contains no spaces (RFC 37, Formal Grammar:
    /// VCHAR).
    const ERROR: &'static [u8];
    /// Whether it binds, and waits for the other side's `READY`.
    const BINDS: bool;
}

/// Answers requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Rep;

/// Sends a request and waits for the reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Req;

/// Sends requests and matches replies by an envelope.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Dealer;

/// Answers requests of many clients, in any order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Router;

/// Sends messages to those who subscribed to their topics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Pub;

/// Receives messages of the topics that it subscribed to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sub;

impl Socket for Sub {
    const NAME: &'static [u8] = b"SUB";
    const CODE: u8 = 2;
    const READY: &'static [u8] = b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03SUB";
    const PARTNERS: &'static [(&'static [u8], u8)] = &[(Pub::NAME, 1), (b"XPUB", 9)];
    const ERROR: &'static [u8] = b"\x04\x19\x05ERROR\x12SUB-takes-PUB,XPUB";
    const BINDS: bool = false;
}

impl Socket for Pub {
    const NAME: &'static [u8] = b"PUB";
    const CODE: u8 = 1;
    const READY: &'static [u8] = b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03PUB";
    const PARTNERS: &'static [(&'static [u8], u8)] = &[(Sub::NAME, 2), (b"XSUB", 10)];
    const ERROR: &'static [u8] = b"\x04\x19\x05ERROR\x12PUB-takes-SUB,XSUB";
    const BINDS: bool = true;
}

impl Socket for Router {
    const NAME: &'static [u8] = b"ROUTER";
    const CODE: u8 = 6;
    const READY: &'static [u8] = b"\x04\x1C\x05READY\x0BSocket-Type\0\0\0\x06ROUTER";
    const PARTNERS: &'static [(&'static [u8], u8)] =
        &[(Req::NAME, 3), (Dealer::NAME, 5), (Self::NAME, 6)];
    const ERROR: &'static [u8] = b"\x04\x25\x05ERROR\x1EROUTER-takes-REQ,DEALER,ROUTER";
    const BINDS: bool = true;
}

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

/// Sent to a ZMTP 2.0 peer after the partial greeting: socket type and an empty identity (RFC 15, Formal
/// Grammar).
pub(crate) const fn old_greeting(code: u8) -> [u8; 3] {
    [code, 0, 0]
}
