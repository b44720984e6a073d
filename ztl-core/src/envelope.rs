//! Two frames that our clients put before a request; every server returns them with its reply.
//!
//! A ZeroMQ reply repeats all frames before the empty delimiter. Ours are `ztl1` with a 16-byte client id,
//! and an 8-byte request number (big endian; the top bit is [`Envelope::early_end`]). The client therefore
//! never takes a late reply for the next one, and our server can deduplicate requests.

/// Prefix of the first frame.
const MARK: [u8; 4] = *b"ztl1";

/// The bit of the second frame that carries [`Envelope::early_end`].
const EARLY_END: u64 = 1 << 63;

/// Identifies a client: 16 random bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ClientId(pub [u8; 16]);

/// Identifies a request: the client and the request's number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Envelope {
    /// The client.
    pub client: ClientId,
    /// Increases with each request of a client; below 2^63.
    pub number: u64,
    /// In an INIT: if the task ends within moments, the client wants its final state instead of the handler's
    /// reply.
    pub early_end: bool,
}

impl Envelope {
    /// Parses the two frames; `None` if they are not ours.
    #[must_use]
    pub fn parse(first: &[u8], second: &[u8]) -> Option<Self> {
        let client = first.strip_prefix(&MARK)?.try_into().ok()?;
        if second.len() != 8 {
            return None;
        }
        // Byte by byte: a Cortex-M0 cannot load an unaligned number at once.
        let append = |number, &byte: &u8| number << 8 | u64::from(byte);
        let number = second.iter().fold(0, append);
        Some(Self {
            client: ClientId(client),
            number: number & !EARLY_END,
            early_end: number & EARLY_END != 0,
        })
    }

    /// The two frames, in order.
    #[must_use]
    pub fn frames(&self) -> ([u8; 20], [u8; 8]) {
        let mut first = [0; 20];
        let (mark, client) = first.split_at_mut(4);
        for (to, from) in mark.iter_mut().zip(MARK) {
            *to = from;
        }
        for (to, from) in client.iter_mut().zip(self.client.0) {
            *to = from;
        }
        let wish = if self.early_end { EARLY_END } else { 0 };
        (first, (self.number & !EARLY_END | wish).to_be_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_round_trip_and_foreign_frames_are_ignored() {
        let envelope = Envelope {
            client: ClientId(*b"0123456789abcdef"),
            number: 258,
            early_end: false,
        };
        let (first, second) = envelope.frames();
        assert_eq!(&first, b"ztl10123456789abcdef");
        assert_eq!(second, [0, 0, 0, 0, 0, 0, 1, 2]);
        assert_eq!(Envelope::parse(&first, &second), Some(envelope));
        let wish = Envelope {
            early_end: true,
            ..envelope
        };
        let (_, wished) = wish.frames();
        assert_eq!(wished, [0x80, 0, 0, 0, 0, 0, 1, 2]);
        assert_eq!(Envelope::parse(&first, &wished), Some(wish));
        for (first, second) in [
            (&b"ztl10123456789abcde"[..], &second[..]),
            (b"ztl20123456789abcdef", &second),
            (&first, &second[1..]),
            (b"", b""),
        ] {
            assert_eq!(Envelope::parse(first, second), None);
        }
    }
}
