//! One connection of a server, and the messages it sends.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::Duration;

use ztl_core::Instant;
use ztl_zmtp::session::{Inbound, Message, Outbound};
use ztl_zmtp::{Pub, Router};

use crate::native::sockets::Stream;

/// Above so many unsent bytes, a peer is not read from.
pub(in crate::native) const UNSENT: usize = 256 * 1024;

/// A socket type whose messages come from many peers.
pub(crate) trait Served: ztl_zmtp::Socket {
    /// Whether its peers subscribe.
    const SUBSCRIBED: bool;

    /// The frames before the delimiter, and the content if it is one frame. `None` without a delimiter.
    fn split(message: Message<'_>) -> Option<(&[u8], Option<&[u8]>)>;
}

impl Served for Router {
    const SUBSCRIBED: bool = false;

    fn split(message: Message<'_>) -> Option<(&[u8], Option<&[u8]>)> {
        message.split()
    }
}

impl Served for Pub {
    const SUBSCRIBED: bool = true;

    fn split(message: Message<'_>) -> Option<(&[u8], Option<&[u8]>)> {
        let mut frames = message.frames();
        let only = frames.next().filter(|_| frames.next().is_none());
        Some((b"", only))
    }
}

/// A connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(test, derive(Default))]
pub(crate) struct PeerId {
    pub(super) slot: usize,
    pub(super) number: u64,
}

impl PeerId {
    /// Later connections have higher ones.
    pub(crate) const fn number(self) -> u64 {
        self.number
    }
}

/// A message.
pub(crate) struct Incoming {
    pub(crate) peer: PeerId,
    /// The frames that lead an answer back, as on the wire, with the delimiter; `None` if the message has no delimiter.
    pub(crate) envelope: Option<Box<[u8]>>,
    /// The only frame after the envelope; `None` if there are several.
    pub(crate) body: Option<Box<[u8]>>,
    pub(crate) from: IpAddr,
    /// The public key of the sender, if the connection is encrypted.
    pub(crate) key: Option<[u8; 32]>,
}

pub(super) struct Peer<S> {
    pub(super) stream: Stream,
    pub(super) address: IpAddr,
    pub(super) key: Option<[u8; 32]>,
    pub(super) number: u64,
    pub(super) inbound: Inbound<S>,
    pub(super) out: Outbound,
    /// Bytes that its buffers take, as counted.
    pub(super) held: usize,
    /// Whether it is in `ready`, and in `unsent`.
    pub(super) is_ready: bool,
    pub(super) is_unsent: bool,
    /// The system may have bytes of it.
    pub(super) readable: bool,
    /// The system has its end, perhaps after bytes.
    pub(super) has_ended: bool,
    /// Its end was read; it is closed when all is sent.
    pub(super) is_leaving: bool,
    /// Messages of it that wait until it has read its answers, and their bytes.
    pub(super) later: VecDeque<Incoming>,
    pub(super) later_held: usize,
    /// When bytes of it were last read.
    pub(super) heard: Instant,
    /// How many of its requests have no answer yet, and whether it has sent any.
    pub(super) unanswered: usize,
    pub(super) has_asked: bool,
    /// When it last took bytes, or began to have too many.
    pub(super) took: Instant,
}

impl Incoming {
    /// Bytes that it takes, roughly.
    pub(super) fn held(&self) -> usize {
        let part = |bytes: &Option<Box<[u8]>>| bytes.as_ref().map_or(0, |bytes| bytes.len() + 32);
        size_of::<Self>() + part(&self.envelope) + part(&self.body)
    }
}

impl<S: Served> Peer<S> {
    pub(super) fn id(&self, slot: usize) -> PeerId {
        PeerId {
            slot,
            number: self.number,
        }
    }

    /// Whether it has to read answers before it is served again.
    pub(super) fn is_full(&self) -> bool {
        self.out.waiting() >= UNSENT || !self.later.is_empty()
    }

    /// Whether it has done nothing for this time, and waits for nothing.
    pub(super) fn is_idle(&self, now: Instant, time: Duration) -> bool {
        self.inbound.is_ready()
            && self.unanswered == 0
            && self.out.waiting() == 0
            && !self.is_ready
            && self.heard + time <= now
    }

    pub(super) fn incoming(
        &self,
        slot: usize,
        envelope: Option<Box<[u8]>>,
        body: Option<Box<[u8]>>,
    ) -> Incoming {
        Incoming {
            peer: self.id(slot),
            envelope,
            body,
            from: self.address,
            key: self.key,
        }
    }
}
