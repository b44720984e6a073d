//! Messages that were received and not passed on to their stream.

use std::collections::VecDeque;

/// The most bytes of messages that wait for the thread of all streams. Then the oldest is dropped.
const MOST: usize = 16 << 20;

#[derive(Debug, Default)]
pub(crate) struct Waiting {
    messages: VecDeque<Vec<u8>>,
    bytes: usize,
}

impl Waiting {
    /// Adds a message. Returns whether it is the only one.
    pub(crate) fn push(&mut self, message: Vec<u8>) -> bool {
        let was_empty = self.messages.is_empty();
        self.bytes += message.len();
        self.messages.push_back(message);
        while self.bytes > MOST
            && let Some(oldest) = self.messages.pop_front()
        {
            self.bytes -= oldest.len();
        }
        was_empty
    }

    /// Takes all messages.
    pub(crate) fn take(&mut self) -> VecDeque<Vec<u8>> {
        std::mem::take(self).messages
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_stream_keeps_the_newest_messages() {
        let mut waiting = Waiting::default();
        for count in 0..20 {
            assert_eq!(waiting.push(vec![count; 1 << 20]), count == 0);
        }
        assert_eq!(waiting.messages.len(), 16);
        assert_eq!(
            waiting.messages.front().map(|it| it.first().copied()),
            Some(Some(4))
        );
        waiting.push(vec![0; MOST + 1]);
        assert!(waiting.messages.is_empty());
    }
}
