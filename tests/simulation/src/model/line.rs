//! The line as a sequence of frames, which can be lost, delayed and repeated.

use std::collections::VecDeque;
use std::fmt::{self, Debug};
use std::rc::Rc;

use ztl_core::link::{Decoder, NO_SEQ, NO_SESSION, session_key};

/// A direction of the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// To the node.
    Down,
    /// To the gateways.
    Up,
}

/// A frame in transit.
#[derive(Clone)]
pub(super) struct Parcel {
    pub(super) bytes: Rc<[u8]>,
    /// Its session, sequence number and message.
    pub(super) session: u32,
    pub(super) seq: u8,
    says: Rc<str>,
}

impl Debug for Parcel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            session, seq, says, ..
        } = self;
        write!(f, "session: {session}, seq: {seq}, {says}")
    }
}

impl Parcel {
    /// Parses a frame of one of these sessions in one of these boots.
    pub(super) fn new(bytes: &[u8], opened: u32, boots: u32) -> Self {
        let mut decoder = Decoder::<256>::new();
        for byte in bytes {
            if decoder.push(*byte) == Ok(true) {
                break;
            }
        }
        if let Some((_, turn)) = decoder.turn() {
            return Self {
                bytes: bytes.into(),
                session: NO_SESSION,
                seq: NO_SEQ,
                says: format!("{turn:?}").into(),
            };
        }
        let mut keys = vec![NO_SESSION];
        for hello in (1..=opened).rev().map(|number| number << 8) {
            keys.push(hello);
            keys.extend((1..=boots).rev().map(|boot| session_key(hello, boot)));
        }
        let (index, frame) = decoder.frame(&keys).expect("both ends send good frames");
        Self {
            bytes: bytes.into(),
            session: keys[index],
            seq: frame.seq,
            says: format!("{:?}", frame.body).into(),
        }
    }

    /// Whether it has this message, by name.
    pub(super) fn is(&self, message: &str) -> bool {
        self.says.starts_with(message)
    }
}

/// One direction.
#[derive(Debug, Clone, Default)]
pub(super) struct Lane {
    pub(super) queue: VecDeque<Parcel>,
    /// All frames are lost.
    pub(super) cut: bool,
    /// Nothing arrives.
    pub(super) stalled: bool,
    /// The frames recorded since this began, to arrive again as a whole.
    pub(super) tape: Option<Vec<Parcel>>,
}

/// Maximum number of recorded frames.
const TAPE: usize = 8;
/// Maximum number of frames that a stalled line delays; the rest is lost.
const STALLED: usize = 3;

impl Lane {
    /// Splits the bytes into frames and sends them. Returns the frames.
    pub(super) fn send(&mut self, bytes: &[u8], opened: u32, boots: u32) -> Vec<Parcel> {
        let frames = bytes.split_inclusive(|byte| *byte == 0);
        let sent: Vec<Parcel> = frames
            .filter(|frame| frame.len() > 1)
            .map(|frame| Parcel::new(frame, opened, boots))
            .collect();
        if let Some(tape) = &mut self.tape {
            let room = TAPE - tape.len();
            tape.extend(sent.iter().take(room).cloned());
        }
        if !self.cut {
            let room = if self.stalled {
                STALLED.saturating_sub(self.queue.len())
            } else {
                sent.len()
            };
            self.queue.extend(sent.iter().take(room).cloned());
        }
        sent
    }

    /// Whether a frame can be delivered.
    pub(super) fn brings(&self) -> bool {
        !self.stalled && !self.queue.is_empty()
    }
}
