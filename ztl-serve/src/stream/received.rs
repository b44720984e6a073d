//! Streams of what a subscription receives: messages wait for the thread of all streams.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use crate::kind::{Effect, Job, JobContext, Outcome, StopReason};

/// The most bytes of messages that wait for the thread of all streams. Then the oldest is dropped.
pub(crate) const MOST: usize = 16 << 20;

/// How many messages are passed on in a turn of the thread, so that it does other things, too.
const BATCH: usize = 256;

/// What a message takes beside its bytes: a node may flood with empty ones.
const OVERHEAD: usize = 64;

/// Where the callback of a subscription leaves its messages.
pub(crate) struct Inbox {
    waiting: Arc<Mutex<Waiting>>,
    context: JobContext,
}

impl Inbox {
    pub(crate) fn push(&self, message: Vec<u8>) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.push(message) {
            self.context.mailbox.wake();
        }
    }

    /// Ends the stream: no more messages come, for this reason.
    #[cfg(feature = "http")]
    pub(crate) fn end(&self, reason: String) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.ended = Some(reason);
        self.context.mailbox.wake();
    }
}

/// A stream from a subscription, which ends when it is dropped.
pub(crate) struct ReceivingJob<S> {
    waiting: Arc<Mutex<Waiting>>,
    /// `Err`: why there is none.
    subscription: Result<S, String>,
    /// Makes the output for a message.
    output: Box<dyn Fn(Vec<u8>) -> Vec<u8> + Send>,
    is_accepted: bool,
    /// Whether messages wait that the last turn has not passed on.
    has_more: bool,
}

impl<S> ReceivingJob<S> {
    pub(crate) fn new(
        context: JobContext,
        subscribe: impl FnOnce(Inbox) -> Result<S, String>,
        output: impl Fn(Vec<u8>) -> Vec<u8> + Send + 'static,
    ) -> Self {
        let waiting = Arc::new(Mutex::new(Waiting::default()));
        let inbox = Inbox {
            waiting: Arc::clone(&waiting),
            context,
        };
        Self {
            waiting,
            subscription: subscribe(inbox),
            output: Box::new(output),
            is_accepted: false,
            has_more: false,
        }
    }
}

impl<S: Send> Job for ReceivingJob<S> {
    fn stop(&mut self, _: Instant, _: StopReason, effects: &mut Vec<Effect>) {
        effects.push(Effect::End(Outcome::Aborted(String::new())));
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let is_due = !self.is_accepted || self.has_more || self.subscription.is_err();
        is_due.then(Instant::now)
    }

    fn handle_timeout(&mut self, _: Instant, effects: &mut Vec<Effect>) {
        if !std::mem::replace(&mut self.is_accepted, true) {
            effects.push(Effect::Accept);
        }
        if let Err(reason) = &self.subscription {
            return effects.push(Effect::End(Outcome::Failed(reason.clone())));
        }
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let messages = waiting.take();
        self.has_more = !waiting.messages.is_empty();
        let ended = waiting.ended.take_if(|_| !self.has_more);
        drop(waiting);
        let outputs = messages.into_iter().map(&self.output);
        effects.extend(outputs.map(Effect::Output));
        if let Some(reason) = ended {
            effects.push(Effect::End(Outcome::Failed(reason)));
        }
    }
}

/// Messages that were received and not passed on.
#[derive(Debug, Default)]
struct Waiting {
    messages: VecDeque<Vec<u8>>,
    bytes: usize,
    /// Why no more come.
    ended: Option<String>,
}

impl Waiting {
    /// Adds a message. Returns whether it is the only one.
    fn push(&mut self, message: Vec<u8>) -> bool {
        let was_empty = self.messages.is_empty();
        self.bytes += OVERHEAD + message.len();
        self.messages.push_back(message);
        while self.bytes > MOST
            && let Some(oldest) = self.messages.pop_front()
        {
            self.bytes -= OVERHEAD + oldest.len();
        }
        was_empty
    }

    /// Takes the oldest messages.
    fn take(&mut self) -> Vec<Vec<u8>> {
        let count = self.messages.len().min(BATCH);
        let taken: Vec<_> = self.messages.drain(..count).collect();
        let bytes = taken.iter().map(|message| OVERHEAD + message.len());
        self.bytes -= bytes.sum::<usize>();
        taken
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
        assert_eq!(waiting.messages.len(), 15);
        assert_eq!(
            waiting.messages.front().map(|it| it.first().copied()),
            Some(Some(5))
        );
        waiting.push(vec![0; MOST + 1]);
        assert!(waiting.messages.is_empty());
        // Also empty messages take memory.
        for _ in 0..MOST {
            waiting.push(Vec::new());
        }
        assert!(waiting.messages.len() < MOST / 32);
        while !waiting.messages.is_empty() {
            assert!(waiting.take().len() <= BATCH);
        }
        assert_eq!(waiting.bytes, 0);
    }
}
