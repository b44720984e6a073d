//! A message as subscribers get it.

use std::ops::Range;
use std::sync::Arc;

/// What a message takes in a queue besides its bytes, roughly.
pub(super) const ENTRY: usize = 128;

/// A message for subscribers: a topic and a body, as on the wire. Clones share the bytes.
#[derive(Debug, Clone)]
pub(crate) struct PubMessage {
    pub(super) wire: Arc<Vec<u8>>,
    topic: Range<usize>,
    /// How much of the topic is the scope.
    scope: usize,
    /// How much of the topic is a scope whose clients may hear it, too; 0 if there is none.
    wider: usize,
    /// Whether it replaces the one before it with the same topic.
    pub(super) is_state: bool,
    /// Whether every subscriber may hear it; otherwise those that may use its scope.
    pub(super) is_for_all: bool,
}

impl PubMessage {
    /// The topic is `scope` and `path`. `is_state`: only the newest one of its topic counts.
    pub(crate) fn new(scope: &str, path: &str, body: &[u8], is_state: bool) -> Self {
        let length = scope.len() + path.len();
        let mut wire = Vec::with_capacity(length + body.len() + 18);
        put_header(1, length, &mut wire);
        let begin = wire.len();
        wire.extend_from_slice(scope.as_bytes());
        wire.extend_from_slice(path.as_bytes());
        let topic = begin..wire.len();
        put_header(0, body.len(), &mut wire);
        wire.extend_from_slice(body);
        Self {
            wire: Arc::new(wire),
            topic,
            scope: scope.len(),
            wider: 0,
            is_state,
            is_for_all: false,
        }
    }

    /// The same, also for those who may use a scope that the message's own scope begins with.
    pub(crate) fn also_for(mut self, wider: &str) -> Self {
        self.wider = wider.len();
        self
    }

    /// The same for every subscriber: its topic does not begin with a scope.
    #[cfg(feature = "gateway")]
    pub(crate) fn for_all(mut self) -> Self {
        self.is_for_all = true;
        self
    }

    pub(super) fn topic(&self) -> &[u8] {
        self.wire.get(self.topic.clone()).unwrap_or_default()
    }

    pub(super) fn scope(&self) -> &[u8] {
        self.topic().get(..self.scope).unwrap_or_default()
    }

    /// A wider scope whose clients may hear it, too.
    pub(super) fn wider(&self) -> Option<&[u8]> {
        let wider = Some(self.wider).filter(|wider| *wider > 0);
        self.topic().get(..wider?)
    }

    /// Bytes that it takes in a queue.
    pub(super) fn held(&self) -> usize {
        self.wire.len() + ENTRY
    }
}

/// Messages that did not arrive at a publisher which passes on what others publish.
#[derive(Debug)]
pub(crate) struct Unheard {
    /// Their topics are below it.
    pub(crate) root: String,
    /// Their scopes: who may hear one of them is told.
    pub(crate) scopes: Vec<String>,
    pub(crate) count: u64,
}

/// The header of a frame, as on the wire.
fn put_header(flags: u8, size: usize, out: &mut Vec<u8>) {
    match u8::try_from(size) {
        Ok(size) => out.extend_from_slice(&[flags, size]),
        Err(_) => {
            out.push(flags | 2);
            out.extend_from_slice(&(size as u64).to_be_bytes());
        }
    }
}
