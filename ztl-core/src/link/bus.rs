//! Messages that only shared lines have: which node may send, and which nodes there are (`docs/link.md` section 15).
//!
//! All are checked under [`NO_SESSION`](super::NO_SESSION) and have no sequence number. A node that is alone on its line
//! needs none of this.

use super::decoder::Decoder;
use super::frame::{FrameError, FrameWriter};
use super::wire::{BodyError, Reader, WriteValues};
use super::{NO_SEQ, NO_SESSION};
use crate::sink::Sink;

/// Address of a node that has none yet. It answers only [`BusMessage::Search`] and [`BusMessage::Assign`].
pub const ADDR_NONE: u8 = 0;
/// Address of all nodes of a bus.
pub const ADDR_ALL: u8 = 255;
/// Highest address of a node. The lowest is 1.
pub const ADDR_MOST: u8 = 32;

/// The shortest frames of a bus: address and check, in four bytes. A damaged one can only make two nodes send at once, which
/// damages their frames, so they need no longer check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Turn {
    /// Gateway: the node may send one frame.
    Poll,
    /// Node: it has nothing to send.
    Idle,
}

impl Turn {
    const fn check(self, addr: u8) -> u8 {
        match self {
            Self::Poll => addr ^ 0xff,
            Self::Idle => addr ^ 0xaa,
        }
    }

    /// The frame with its delimiter. `addr` is 1 to [`ADDR_MOST`].
    #[must_use]
    pub const fn encode(self, addr: u8) -> [u8; 4] {
        [3, addr, self.check(addr), 0]
    }

    const fn parse(bytes: &[u8]) -> Option<(u8, Self)> {
        match *bytes {
            [addr, check] if check == Self::Poll.check(addr) => Some((addr, Self::Poll)),
            [addr, check] if check == Self::Idle.check(addr) => Some((addr, Self::Idle)),
            _ => None,
        }
    }
}

/// A message of a shared line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BusMessage<'a> {
    /// Gateway, to all: nodes whose id begins like this, and that have not had an [`Assign`](Self::Assign) in this round,
    /// answer [`Here`](Self::Here).
    Search {
        /// Number of the round.
        round: u8,
        /// How many of the first bits of the id count, 0 to 64.
        bits: u8,
        /// The bits, as the most significant of the number.
        prefix: u64,
    },
    /// Node: answers `Search` and `Assign`. The frame has the node's address.
    Here {
        /// Unique among all nodes that can be on one bus.
        id: u64,
        /// Name of the device.
        name: &'a str,
    },
    /// Gateway, to all: the node with this id has this address from now on, and answers `Here`. The address 0 changes
    /// nothing.
    Assign {
        /// Number of the round.
        round: u8,
        /// The node.
        id: u64,
        /// Its address, at most [`ADDR_MOST`].
        address: u8,
    },
}

impl<'a> BusMessage<'a> {
    /// Parses a message.
    ///
    /// # Errors
    /// [`BodyError`] if the bytes are not exactly one message of a shared line.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(bytes);
        let message = match reader.u32() {
            64 => Self::Search {
                round: reader.u8(),
                bits: reader.u8(),
                prefix: reader.u64(),
            },
            65 => Self::Here {
                id: reader.u64(),
                name: reader.text(),
            },
            66 => Self::Assign {
                round: reader.u8(),
                id: reader.u64(),
                address: reader.u8(),
            },
            tag => reader.fail(
                BodyError::UnknownTag { tag },
                Self::Here { id: 0, name: "" },
            ),
        };
        reader.finish(message)
    }

    /// Writes the message.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        match *self {
            Self::Search {
                round,
                bits,
                prefix,
            } => sink.byte(64).byte(round).byte(bits).long(prefix),
            Self::Here { id, name } => sink.byte(65).long(id).bytes(name.as_bytes()),
            Self::Assign { round, id, address } => sink.byte(66).byte(round).long(id).byte(address),
        };
    }

    /// Writes a frame into `buffer`, and returns its length with the delimiter; `None` if it does not fit. All but `Here`
    /// fit 32 bytes.
    #[must_use]
    pub fn encode(&self, addr: u8, buffer: &mut [u8]) -> Option<usize> {
        let mut frame = FrameWriter::new(NO_SESSION, addr, NO_SEQ, buffer);
        self.put(&mut frame);
        frame.finish()
    }

    /// Whether a node with this id answers a `Search` for these bits.
    #[must_use]
    pub const fn matches(id: u64, bits: u8, prefix: u64) -> bool {
        match 64u32.checked_sub(bits as u32) {
            None => false,
            Some(64) => true,
            Some(rest) => (id ^ prefix) >> rest == 0,
        }
    }
}

impl<const N: usize> Decoder<N> {
    /// The address of the complete frame; its checksum is not verified.
    #[must_use]
    pub fn address(&self) -> Option<u8> {
        self.bytes().first().copied()
    }

    /// The complete frame as a turn, and its address.
    #[must_use]
    pub fn turn(&self) -> Option<(u8, Turn)> {
        Turn::parse(self.bytes())
    }

    /// The complete frame as a message of a shared line, and its address.
    ///
    /// # Errors
    /// [`FrameError::Body`] for valid messages of the link, else see [`FrameError`].
    pub fn bus_message(&self) -> Result<(u8, BusMessage<'_>), FrameError> {
        let (_, addr, _, body) = self.checked(&[NO_SESSION])?;
        let message = BusMessage::parse(body).map_err(FrameError::Body)?;
        Ok((addr, message))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Serialize;

    const MESSAGES: [BusMessage<'static>; 3] = [
        BusMessage::Search {
            round: 3,
            bits: 64,
            prefix: u64::MAX,
        },
        BusMessage::Here {
            id: 300,
            name: "gripper",
        },
        BusMessage::Assign {
            round: 255,
            id: 1 << 63,
            address: 32,
        },
    ];

    #[test]
    fn messages_are_those_of_postcard() {
        #[derive(Serialize)]
        struct Here(u32, u64, &'static str);
        #[derive(Serialize)]
        struct Search(u32, u8, u8, u64);
        #[derive(Serialize)]
        struct Assign(u32, u8, u64, u8);
        let twins = [
            postcard::to_allocvec(&Search(64, 3, 64, u64::MAX)).unwrap(),
            postcard::to_allocvec(&Here(65, 300, "gripper")).unwrap(),
            postcard::to_allocvec(&Assign(66, 255, 1 << 63, 32)).unwrap(),
        ];
        for (message, twin) in MESSAGES.iter().zip(&twins) {
            let mut bytes = std::vec::Vec::new();
            message.put(&mut |piece: &[u8]| bytes.extend_from_slice(piece));
            assert_eq!(&bytes, twin);
            assert_eq!(BusMessage::parse(twin), Ok(*message));
            for len in 0..twin.len() {
                assert!(BusMessage::parse(&twin[..len]).is_err());
            }
        }
    }

    #[test]
    fn a_frame_carries_the_address_and_nodes_of_a_line_of_their_own_know_none() {
        for message in MESSAGES {
            let mut buffer = [0; 32];
            let len = message.encode(7, &mut buffer).unwrap();
            let mut decoder = Decoder::<64>::new();
            for &byte in &buffer[..len - 1] {
                assert_eq!(decoder.push(byte), Ok(false));
            }
            assert_eq!(decoder.push(0), Ok(true));
            assert_eq!(decoder.address(), Some(7));
            assert_eq!(decoder.bus_message(), Ok((7, message)));
            assert!(decoder.command(&[NO_SESSION]).is_err());
        }
    }

    #[test]
    fn a_turn_is_four_bytes_and_no_single_fault_changes_it() {
        for addr in 1..=ADDR_MOST {
            for turn in [Turn::Poll, Turn::Idle] {
                let frame = turn.encode(addr);
                assert_eq!(frame.iter().position(|byte| *byte == 0), Some(3));
                for bit in 0..=16 {
                    let mut bytes = [frame[1], frame[2]];
                    if bit < 16 {
                        bytes[bit / 8] ^= 1 << (bit % 8);
                    }
                    let expected = (bit == 16).then_some((addr, turn));
                    assert_eq!(Turn::parse(&bytes), expected);
                }
                let mut decoder = Decoder::<64>::new();
                for byte in frame {
                    let _ = decoder.push(byte);
                }
                assert_eq!(decoder.turn(), Some((addr, turn)));
                assert!(decoder.command(&[NO_SESSION]).is_err());
            }
        }
    }

    #[test]
    fn a_search_compares_the_first_bits() {
        let id = 0xC000_0000_0000_0001;
        for (bits, prefix, matches) in [
            (0, 0, true),
            (1, 1 << 63, true),
            (2, 1 << 63, false),
            (64, id, true),
            (64, id - 1, false),
            (65, id, false),
        ] {
            assert_eq!(BusMessage::matches(id, bits, prefix), matches, "{bits}");
        }
    }
}
