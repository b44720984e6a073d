//! The sending half of a connection.

use alloc::vec::Vec;

use super::frames::put_header;
#[cfg(feature = "curve")]
use crate::curve::Cipher;

/// Bytes to send. A message is never dropped: what takes too many bytes is the caller's decision, by
/// [`waiting`](Self::waiting).
#[derive(Debug, Default)]
pub struct Outbound {
    bytes: Vec<u8>,
    sent: usize,
    /// Set once the handshake is complete.
    #[cfg(feature = "curve")]
    pub(super) cipher: Option<Cipher>,
}

impl Outbound {
    /// The next bytes to send.
    #[must_use]
    pub fn transmit_buf(&self) -> &[u8] {
        self.bytes.get(self.sent..).unwrap_or_default()
    }

    /// How many bytes wait to be sent.
    #[must_use]
    pub const fn waiting(&self) -> usize {
        self.bytes.len() - self.sent
    }

    /// Bytes that the buffer takes.
    #[must_use]
    pub const fn held(&self) -> usize {
        self.bytes.capacity()
    }

    /// Marks the first `count` bytes of [`transmit_buf`](Self::transmit_buf) as sent.
    pub fn consume(&mut self, count: usize) {
        self.sent = self.bytes.len().min(self.sent + count);
        if self.sent == self.bytes.len() {
            self.sent = 0;
            self.bytes.clear();
            // An idle connection takes no memory; a busy one does not ask for it again and again.
            if self.bytes.capacity() > 4096 {
                self.bytes = Vec::new();
            }
        }
    }

    /// Frees the buffer of an idle connection.
    pub fn shrink(&mut self) {
        if self.bytes.is_empty() {
            self.bytes = Vec::new();
        }
    }

    /// Sends a message: `envelope` has frames as they are on the wire, each of which announces another; `last` is the last
    /// frame.
    pub fn message(&mut self, envelope: &[u8], last: &[u8]) {
        #[cfg(feature = "curve")]
        if let Some(cipher) = &mut self.cipher {
            let frames = super::Message { bytes: envelope };
            for frame in frames.frames() {
                cipher.encrypt(crate::wire::MORE, frame, &mut self.bytes);
            }
            cipher.encrypt(0, last, &mut self.bytes);
            return;
        }
        self.bytes.extend_from_slice(envelope);
        put_header(0, last.len(), &mut self.bytes);
        self.bytes.extend_from_slice(last);
    }

    /// Sends a command.
    pub(super) fn command(&mut self, body: &[u8]) {
        #[cfg(feature = "curve")]
        if let Some(cipher) = &mut self.cipher {
            return cipher.encrypt(crate::wire::COMMAND, body, &mut self.bytes);
        }
        put_header(crate::wire::COMMAND, body.len(), &mut self.bytes);
        self.bytes.extend_from_slice(body);
    }

    /// Sends bytes as they are.
    pub(super) fn raw(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }
}
