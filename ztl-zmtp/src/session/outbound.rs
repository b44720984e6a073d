//! The sending half of a connection.

use alloc::collections::VecDeque;
use alloc::sync::Arc;
use alloc::vec::Vec;

use super::frames::put_header;
#[cfg(feature = "curve")]
use crate::curve::Cipher;

/// Shorter messages are copied rather than shared: each shared one is a system call of its own.
const SHARED: usize = 8 * 1024;

/// Bytes to send. A message is never dropped: what takes too many bytes is the caller's decision, by
/// [`waiting`](Self::waiting).
#[derive(Debug, Default)]
pub struct Outbound {
    bytes: Vec<u8>,
    sent: usize,
    /// What follows `bytes`.
    later: VecDeque<Later>,
    /// Bytes in `later`.
    later_len: usize,
    /// Sent bytes of the first one in `later`.
    later_sent: usize,
    /// Set once the handshake is complete.
    #[cfg(feature = "curve")]
    pub(super) cipher: Option<Cipher>,
}

/// Bytes that other connections send, too, and own ones after them.
#[derive(Debug)]
struct Later {
    shared: Arc<Vec<u8>>,
    own: Vec<u8>,
}

impl Outbound {
    /// The next bytes to send.
    #[must_use]
    pub fn transmit_buf(&self) -> &[u8] {
        let (bytes, sent) = match self.later.front() {
            Some(later) if self.bytes.is_empty() => (later.shared.as_slice(), self.later_sent),
            _ => (self.bytes.as_slice(), self.sent),
        };
        bytes.get(sent..).unwrap_or_default()
    }

    /// How many bytes wait to be sent.
    #[must_use]
    pub const fn waiting(&self) -> usize {
        self.bytes.len() - self.sent + self.later_len - self.later_sent
    }

    /// Bytes that the buffers take, without shared ones.
    #[must_use]
    pub fn held(&self) -> usize {
        let later = self.later.iter().map(|later| later.own.capacity());
        self.bytes.capacity() + later.sum::<usize>()
    }

    /// Marks the first `count` bytes of [`transmit_buf`](Self::transmit_buf) as sent.
    pub fn consume(&mut self, count: usize) {
        if self.bytes.is_empty() {
            return self.consume_shared(count);
        }
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

    fn consume_shared(&mut self, count: usize) {
        let Some(first) = self.later.front() else {
            return;
        };
        let len = first.shared.len();
        self.later_sent += count;
        if self.later_sent >= len
            && let Some(sent) = self.later.pop_front()
        {
            self.later_len -= len + sent.own.len();
            self.later_sent = 0;
            self.bytes = sent.own;
            if self.later.is_empty() {
                self.later = VecDeque::new();
            }
        }
    }

    /// Sends a message: `envelope` has frames as they are on the wire, each of which announces another; `last` is the last
    /// frame.
    pub fn message(&mut self, envelope: &[u8], last: &[u8]) {
        self.put(|to| {
            #[cfg(feature = "curve")]
            if let Some(cipher) = to.cipher {
                let frames = super::Message { bytes: envelope };
                for frame in frames.frames() {
                    cipher.encrypt(crate::wire::MORE, frame, to.bytes);
                }
                return cipher.encrypt(0, last, to.bytes);
            }
            to.bytes.extend_from_slice(envelope);
            put_header(0, last.len(), to.bytes);
            to.bytes.extend_from_slice(last);
        });
    }

    /// Sends a message that other connections send, too: its frames as they are on the wire. It is not copied, unless it
    /// is short, or this connection encrypts.
    pub fn shared(&mut self, message: &Arc<Vec<u8>>) {
        #[cfg(feature = "curve")]
        if self.cipher.is_some() {
            let message = super::Message { bytes: message };
            let (envelope, last) = message.split_last();
            return self.message(envelope, last);
        }
        if message.len() < SHARED {
            return self.raw(message);
        }
        self.later_len += message.len();
        self.later.push_back(Later {
            shared: Arc::clone(message),
            own: Vec::new(),
        });
    }

    /// Sends a command.
    pub(super) fn command(&mut self, body: &[u8]) {
        self.put(|to| {
            #[cfg(feature = "curve")]
            if let Some(cipher) = to.cipher {
                return cipher.encrypt(crate::wire::COMMAND, body, to.bytes);
            }
            put_header(crate::wire::COMMAND, body.len(), to.bytes);
            to.bytes.extend_from_slice(body);
        });
    }

    /// Sends bytes as they are.
    pub(super) fn raw(&mut self, bytes: &[u8]) {
        self.put(|to| to.bytes.extend_from_slice(bytes));
    }

    /// Adds bytes at the end.
    fn put(&mut self, put: impl FnOnce(To<'_>)) {
        let (bytes, is_later) = match self.later.back_mut() {
            Some(later) => (&mut later.own, true),
            None => (&mut self.bytes, false),
        };
        let before = bytes.len();
        put(To {
            bytes,
            #[cfg(feature = "curve")]
            cipher: self.cipher.as_mut(),
        });
        if is_later {
            self.later_len += bytes.len() - before;
        }
    }
}

/// Where bytes are added, and what encrypts them.
struct To<'a> {
    bytes: &'a mut Vec<u8>,
    #[cfg(feature = "curve")]
    cipher: Option<&'a mut Cipher>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_messages_go_out_in_order_and_are_not_cut_by_own_ones() {
        let shared = [b'a', b'b'].map(|byte| Arc::new([byte].repeat(SHARED)));
        let short = Arc::new(b"short".to_vec());
        for piece in [1, 7, SHARED - 1, SHARED, 3 * SHARED] {
            let mut out = Outbound::default();
            out.raw(b"before");
            out.shared(&shared[0]);
            out.consume(3);
            out.command(b"PONG");
            out.shared(&short);
            out.shared(&shared[1]);
            let mut sent = b"bef".to_vec();
            while out.waiting() > 0 {
                let before = out.waiting();
                let next = out.transmit_buf();
                let next = next.get(..piece.min(next.len())).unwrap().to_vec();
                out.consume(next.len());
                assert_eq!(out.waiting(), before - next.len());
                sent.extend_from_slice(&next);
                if sent.len() == 3 + 3 + SHARED / 2 {
                    out.raw(b"in the middle");
                }
            }
            let parts: [&[u8]; 5] = [b"before", &shared[0], b"\x04\x04PONG", b"short", &shared[1]];
            let mut expected = parts.concat();
            if piece == 1 {
                expected.extend_from_slice(b"in the middle");
            }
            assert_eq!(sent, expected, "{piece}");
            assert_eq!((out.transmit_buf(), out.waiting()), (&b""[..], 0));
        }
    }
}
