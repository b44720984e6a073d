//! The frame that a node is sending.

use core::hash::{Hash, Hasher};

use ztl_core::link::FrameWriter;

/// How much fits into a frame.
pub(super) mod longest {
    /// Longest body in bytes: a frame also has address, sequence number, checksum, delimiter and COBS bytes.
    pub(in crate::node) const fn body(frame: usize) -> usize {
        frame - 8 - frame / 254
    }

    /// Bytes of a `Welcome` without its two texts and its ids, with every number at its maximum.
    const WELCOME: usize = 43;

    /// Longest of the two texts of a `Welcome` that lists this many task ids of maximum length.
    pub(in crate::node) const fn name(frame: usize, tasks: usize) -> usize {
        body(frame).saturating_sub(WELCOME + 5 * tasks) / 2
    }

    /// Longest reading; its body also has tag, topic and length.
    pub(in crate::node) const fn reading(frame: usize) -> usize {
        body(frame) - 4
    }

    /// Longest result; its body also has tag, task, state and length.
    pub(in crate::node) const fn result(frame: usize) -> usize {
        body(frame) - 9
    }

    /// Longest piece of the log; its body also has tag, lost bytes and length.
    pub(in crate::node) const fn log(frame: usize) -> usize {
        body(frame) - 8
    }
}

/// An encoded frame, and how much of it has been sent.
// With the attributes in `transmit.rs`, the order of fields saves 112 bytes in `microbit-quiet`.
#[derive(Clone)]
#[repr(C)]
pub(super) struct FrameOut<const FRAME: usize> {
    len: usize,
    sent: usize,
    buffer: [u8; FRAME],
}

impl<const FRAME: usize> FrameOut<FRAME> {
    pub(super) const fn new() -> Self {
        Self {
            len: 0,
            sent: 0,
            buffer: [0; FRAME],
        }
    }

    /// The bytes not sent yet.
    pub(super) fn pending(&self) -> &[u8] {
        self.buffer.get(self.sent..self.len).unwrap_or_default()
    }

    pub(super) fn consume(&mut self, count: usize) {
        self.sent = self.sent.saturating_add(count).min(self.len);
    }

    /// Stores a single delimiter.
    pub(super) fn delimiter(&mut self) {
        if let Some(first) = self.buffer.first_mut() {
            *first = 0;
            (self.len, self.sent) = (1, 0);
        }
    }

    /// Stores a short frame that is encoded already.
    pub(super) fn put(&mut self, frame: &[u8; 4]) {
        if let Some(begin) = self.buffer.first_chunk_mut() {
            *begin = *frame;
            (self.len, self.sent) = (frame.len(), 0);
        }
    }

    /// Encodes a frame. Returns `false`, and sends nothing, if it does not fit.
    pub(super) fn encode(
        &mut self,
        address: u8,
        session: u32,
        seq: u8,
        put: impl FnOnce(&mut FrameWriter<'_>),
    ) -> bool {
        let mut frame = FrameWriter::new(session, address, seq, &mut self.buffer);
        put(&mut frame);
        let len = frame.finish();
        (self.len, self.sent) = (len.unwrap_or_default(), 0);
        len.is_some()
    }

    /// Room for this many bytes at the end of the buffer, from where [`FrameWriter::put_own`] takes them, and
    /// the position where it begins.
    pub(super) fn room(&mut self, bytes: usize) -> (usize, &mut [u8]) {
        let begin = FRAME.saturating_sub(bytes);
        (begin, self.buffer.get_mut(begin..).unwrap_or_default())
    }
}

/// Shows the bytes not sent yet.
impl<const FRAME: usize> core::fmt::Debug for FrameOut<FRAME> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_tuple("FrameOut").field(&self.pending()).finish()
    }
}

/// Equal if the same bytes are not sent yet.
impl<const FRAME: usize> PartialEq for FrameOut<FRAME> {
    fn eq(&self, other: &Self) -> bool {
        self.pending() == other.pending()
    }
}

impl<const FRAME: usize> Eq for FrameOut<FRAME> {}

impl<const FRAME: usize> Hash for FrameOut<FRAME> {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        self.pending().hash(hasher);
    }
}
