//! The frames that our client puts before a request, and every server returns with its answer.
//!
//! A ZeroMQ reply carries back whatever stood before the empty delimiter. Two frames are ours:
//! `ztl1` and 16 bytes that name the client, then 8 bytes that number the request (big endian; the
//! top bit is a wish, see [`Envelope::early_end`]). A late answer is thus never taken for the next
//! one, and our server knows what it has answered.

/// What the first frame begins with.
pub const MARK: [u8; 4] = *b"ztl1";

/// The bit of the second frame that is [`Envelope::early_end`].
const EARLY_END: u64 = 1 << 63;

/// Who asks: 16 random bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ClientId(pub [u8; 16]);

/// Who asks, and which of its requests it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Envelope {
    /// Who asks.
    pub client: ClientId,
    /// Rises with each request of a client; below 2^63.
    pub number: u64,
    /// Of an INIT: if the task ends within a moment, the client wants to be told that in place of
    /// the handler's reply.
    pub early_end: bool,
}

impl Envelope {
    /// Reads the two frames; `None` when they are not ours.
    #[must_use]
    pub fn parse(first: &[u8], second: &[u8]) -> Option<Self> {
        let client = first.strip_prefix(&MARK)?.try_into().ok()?;
        if second.len() != 8 {
            return None;
        }
        // A byte at a time: they may stand anywhere, which a Cortex-M0 cannot read at once.
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
    fn the_frames_come_back_and_others_are_not_ours() {
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
