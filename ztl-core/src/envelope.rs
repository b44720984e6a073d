//! The frames that our client puts before a request, and every server returns with its answer.
//!
//! A ZeroMQ reply carries back whatever stood before the empty delimiter. Two frames are ours:
//! `ztl1` and 16 bytes that name the client, then 8 bytes that number the request. A late answer is
//! thus never taken for the next one, and our server knows what it has answered.

/// What the first frame begins with.
pub const MARK: [u8; 4] = *b"ztl1";

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
    /// Rises with each request of a client.
    pub number: u64,
}

impl Envelope {
    /// Reads the two frames; `None` when they are not ours.
    #[must_use]
    pub fn parse(first: &[u8], second: &[u8]) -> Option<Self> {
        let client = first.strip_prefix(&MARK)?.try_into().ok()?;
        let number = second.try_into().ok()?;
        Some(Self {
            client: ClientId(client),
            number: u64::from_be_bytes(number),
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
        (first, self.number.to_be_bytes())
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
        };
        let (first, second) = envelope.frames();
        assert_eq!(&first, b"ztl10123456789abcdef");
        assert_eq!(second, [0, 0, 0, 0, 0, 0, 1, 2]);
        assert_eq!(Envelope::parse(&first, &second), Some(envelope));
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
