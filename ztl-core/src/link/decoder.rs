//! Splits a stream of bytes into frames.

use super::NO_SEQ;
use super::body::{Body, LinkCommand, OwnAnswer};
use super::frame::{CommandFrame, Frame, FrameError, begin, checked};
use super::parameter::ParameterCommand;
use super::update::UpdateCommand;

/// The result of [`Decoder::push_all`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Pushed {
    /// No frame is complete.
    Nothing,
    /// A frame is complete; read it now.
    Frame,
    /// A frame was dropped: [`FrameError::Truncated`].
    Truncated,
    /// A frame was dropped: [`FrameError::TooLong`].
    TooLong,
}

/// Copies at most `most` bytes, up to the first zero, as far as they fit. Returns how many.
// Not inlined in firmware for speed, like `checked`.
#[cfg_attr(target_os = "none", inline(never))]
fn copy(to: &mut [u8], from: &[u8], most: usize) -> usize {
    let mut count = 0;
    for (to, from) in to.iter_mut().zip(from).take(most) {
        if *from == 0 {
            break;
        }
        *to = *from;
        count += 1;
    }
    count
}

/// Splits a stream into frames of at most `N` decoded bytes (address, sequence number, body, checksum).
///
/// After an overrun it ignores everything up to the next delimiter, so it never mistakes a truncated frame for a complete
/// one.
#[derive(Clone)]
pub struct Decoder<const N: usize> {
    buffer: [u8; N],
    /// `N + 1` after an overrun.
    len: usize,
    /// Bytes left in the current COBS block.
    left: u8,
    /// Whether the current block stands for a zero at its end.
    zero: bool,
    /// Whether the last byte completed a frame; the next byte starts another one.
    complete: bool,
}

impl<const N: usize> Decoder<N> {
    /// The state that affects later frames, without the remains of earlier ones.
    fn state(&self) -> (&[u8], usize, u8, bool, bool) {
        (self.bytes(), self.len, self.left, self.zero, self.complete)
    }
}

/// Shows the bytes of the current frame, not the whole buffer.
impl<const N: usize> core::fmt::Debug for Decoder<N> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (frame, ..) = self.state();
        f.debug_struct("Decoder")
            .field("frame", &frame)
            .field("overrun", &(self.len > N))
            .finish_non_exhaustive()
    }
}

impl<const N: usize> PartialEq for Decoder<N> {
    fn eq(&self, other: &Self) -> bool {
        self.state() == other.state()
    }
}

impl<const N: usize> Eq for Decoder<N> {}

impl<const N: usize> core::hash::Hash for Decoder<N> {
    fn hash<H: core::hash::Hasher>(&self, hasher: &mut H) {
        self.state().hash(hasher);
    }
}

impl<const N: usize> Default for Decoder<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> Decoder<N> {
    /// A decoder at the start of a frame.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            buffer: [0; N],
            len: 0,
            left: 0,
            zero: false,
            complete: false,
        }
    }

    /// Drops the current frame, after a reconnection.
    pub fn reset(&mut self) {
        self.len = 0;
        self.left = 0;
        self.zero = false;
        self.complete = false;
    }

    /// Whether a frame has begun and is not complete.
    #[must_use]
    pub const fn has_begun(&self) -> bool {
        !self.complete && (self.len | self.left as usize | self.zero as usize) > 0
    }

    /// Takes the next byte. Returns `true` if it completed a frame; read that with [`frame`](Self::frame) before the next
    /// byte.
    ///
    /// # Errors
    /// [`FrameError::Truncated`] or [`FrameError::TooLong`], at the delimiter.
    pub fn push(&mut self, byte: u8) -> Result<bool, FrameError> {
        match self.push_all(&mut [byte].as_slice()) {
            Pushed::Nothing => Ok(false),
            Pushed::Frame => Ok(true),
            Pushed::Truncated => Err(FrameError::Truncated),
            Pushed::TooLong => Err(FrameError::TooLong),
        }
    }

    /// Takes the next bytes up to the end of a frame, and leaves the rest in `bytes`. Read the frame, then call this again
    /// until no bytes are left.
    pub fn push_all(&mut self, bytes: &mut &[u8]) -> Pushed {
        if self.complete {
            self.reset();
        }
        let (mut len, mut left) = (self.len, usize::from(self.left));
        let mut taken = 0;
        let ended = loop {
            // Most bytes are within a block.
            if let (Some(to), Some(from)) = (self.buffer.get_mut(len..), bytes.get(taken..)) {
                let count = copy(to, from, left);
                (taken, len, left) = (taken + count, len + count, left - count);
            }
            let Some(&byte) = bytes.get(taken) else {
                break false;
            };
            taken += 1;
            if byte == 0 {
                break true;
            }
            if left == 0 {
                left = usize::from(byte);
                len = self.begin_block(len, byte);
            } else {
                // The buffer is full.
                len = N + 1;
            }
            left -= 1;
        };
        *bytes = bytes.get(taken..).unwrap_or_default();
        (self.len, self.left) = (len, left as u8);
        if !ended {
            return Pushed::Nothing;
        }
        if len <= N && left == 0 {
            // A delimiter alone is not a frame.
            self.complete = len > 0 || self.zero;
            return if self.complete {
                Pushed::Frame
            } else {
                Pushed::Nothing
            };
        }
        self.reset();
        if len > N {
            Pushed::TooLong
        } else {
            Pushed::Truncated
        }
    }

    /// Stores the zero at the end of the previous block. Returns the number of bytes.
    fn begin_block(&mut self, len: usize, code: u8) -> usize {
        if !core::mem::replace(&mut self.zero, code != 0xff) {
            return len;
        }
        match self.buffer.get_mut(len) {
            Some(slot) => {
                *slot = 0;
                len + 1
            }
            None => N + 1,
        }
    }

    /// The complete frame, if its checksum is valid under one of the `sessions`, and the index of that session.
    ///
    /// # Errors
    /// See [`FrameError`].
    pub fn frame(&self, sessions: &[u32]) -> Result<(usize, Frame<'_>), FrameError> {
        let (session_index, addr, seq, body) = self.checked(sessions)?;
        let body = Body::parse(body).map_err(FrameError::Body)?;
        Ok((session_index, Frame { addr, seq, body }))
    }

    /// Like [`frame`](Self::frame), for frames of a gateway only.
    ///
    /// # Errors
    /// See [`FrameError`]; the messages of a node are unknown.
    pub fn command(&self, sessions: &[u32]) -> Result<CommandFrame<'_>, FrameError> {
        let (session_index, addr, seq, body) = self.checked(sessions)?;
        let command = LinkCommand::parse(body).map_err(FrameError::Body)?;
        Ok(CommandFrame {
            session_index,
            addr,
            seq,
            command,
        })
    }

    /// The decoded bytes.
    pub(super) fn bytes(&self) -> &[u8] {
        self.buffer.get(..self.len).unwrap_or_default()
    }

    /// The complete frame, if it belongs to this session and is an answer of a gateway about tasks and events of the node itself.
    #[must_use]
    pub fn own_answer(&self, addr: u8, session: u32) -> Option<OwnAnswer> {
        let (_, to, seq, body) = self.checked(&[session]).ok()?;
        let own = to == addr && seq == NO_SEQ;
        own.then(|| OwnAnswer::parse(body).ok()).flatten()
    }

    /// Like [`command`](Self::command), for commands about parameters only, of a gateway's `session`: the address, the
    /// sequence number and the command.
    ///
    /// # Errors
    /// See [`FrameError`]; all other messages are unknown.
    pub fn parameter_command(
        &self,
        session: u32,
    ) -> Result<(u8, u8, ParameterCommand<'_>), FrameError> {
        let (_, addr, seq, body) = self.checked(&[session])?;
        let command = ParameterCommand::parse(body).map_err(FrameError::Body)?;
        Ok((addr, seq, command))
    }

    /// Like [`parameter_command`](Self::parameter_command), for commands about updates only.
    ///
    /// # Errors
    /// See [`FrameError`]; all other messages are unknown.
    pub fn update_command(&self, session: u32) -> Result<(u8, u8, UpdateCommand<'_>), FrameError> {
        let (_, addr, seq, body) = self.checked(&[session])?;
        let command = UpdateCommand::parse(body).map_err(FrameError::Body)?;
        Ok((addr, seq, command))
    }

    /// The index of the session, the address, the sequence number, and the body.
    pub(super) fn checked(&self, sessions: &[u32]) -> Result<(usize, u8, u8, &[u8]), FrameError> {
        let (covered, sent) = self
            .bytes()
            .split_last_chunk::<4>()
            .ok_or(FrameError::Truncated)?;
        let [addr, seq, body @ ..] = covered else {
            return Err(FrameError::Truncated);
        };
        let sent = u32::from_le_bytes(*sent);
        let session_index = sessions
            .iter()
            .position(|session| !checked(begin(*session), covered) == sent)
            .ok_or(FrameError::Check)?;
        Ok((session_index, *addr, *seq, body))
    }
}
