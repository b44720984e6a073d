//! Publishes values.

use std::sync::Arc;

use tracing::info;
use ztl_pickle::Pickle;

use crate::log_targets::PUBLISHER;
use crate::native::publisher::{PubMessage, PubSocket};
use crate::server::{Access, BindError, CurrentAccess, Limits, rules, to_bind};

/// Publishes values under a scope, to any number of subscribers. Never waits for one.
///
/// When it is dropped, with all that [`under`](Self::under) has made of it, it still sends for at most one second what
/// subscribers have not taken yet.
#[derive(Debug)]
pub struct Publisher {
    pub(crate) socket: Arc<PubSocket>,
    pub(crate) scope: String,
}

/// Options of a publisher that is to be bound.
#[derive(Debug, Clone, Default)]
#[must_use]
pub struct PublisherBuilder {
    access: Access,
    limits: Limits,
}

impl PublisherBuilder {
    /// Sets who may subscribe. Default: everyone who reaches it.
    pub fn access(mut self, access: Access) -> Self {
        self.access = access;
        self
    }

    /// Sets the limits; `connections` and `handshake` matter here.
    pub fn limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }

    /// Publishes at an endpoint: `tcp://*:6000`, or `tcp://127.0.0.1:*` for any free port.
    ///
    /// # Errors
    /// [`BindError`].
    pub fn bind(self, endpoint: &str, scope: &str) -> Result<Publisher, BindError> {
        let rules = rules(&self.access, &self.limits);
        let access = CurrentAccess::new(self.access);
        let socket = PubSocket::bind(&to_bind(endpoint)?, rules, access, true)
            .map_err(|error| BindError::at_endpoint(endpoint, &error))?;
        // Logged like the original, but with the port that was chosen.
        let named = endpoint
            .rsplit_once(':')
            .map_or(endpoint, |(named, _)| named);
        let port = socket.endpoint().rsplit_once(':');
        let port = port.map_or("", |(_, port)| port);
        info!(target: PUBLISHER, "Publisher '{scope}' created at '{named}:{port}'");
        Ok(Publisher {
            socket: Arc::new(socket),
            scope: scope.to_owned(),
        })
    }
}

impl Publisher {
    /// A publisher for everyone: as [`PublisherBuilder::bind`].
    ///
    /// # Errors
    /// [`BindError`].
    pub fn bind(endpoint: &str, scope: &str) -> Result<Self, BindError> {
        Self::builder().bind(endpoint, scope)
    }

    /// Sets options before binding.
    pub fn builder() -> PublisherBuilder {
        PublisherBuilder::default()
    }

    /// Where it publishes, with the port that was chosen.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        self.socket.endpoint()
    }

    /// A publisher at the same place, under another scope.
    #[must_use]
    pub fn under(&self, scope: &str) -> Self {
        Self {
            socket: Arc::clone(&self.socket),
            scope: scope.to_owned(),
        }
    }

    /// Calls `changed` whenever the first subscriber comes who hears the topic of `path`, with `true`, and whenever the
    /// last one has left, with `false`. It is called on the publisher's thread, so it must be quick.
    pub fn watch(&self, path: &str, changed: impl FnMut(bool) + Send + 'static) {
        let message = PubMessage::new(&self.scope, path, &[], false);
        self.socket.watch(message, changed);
    }

    /// Whether there is much room for values that wait to be sent. A source that can wait, such as a pipe, should wait until
    /// then.
    #[must_use]
    pub fn has_room(&self) -> bool {
        self.socket.has_room()
    }

    /// How many subscribers there are: connections that have subscribed to something.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.socket.subscribers()
    }

    /// How many messages subscribers have missed since they were too slow, summed over all.
    #[must_use]
    pub fn missed(&self) -> u64 {
        self.socket.missed()
    }

    /// Publishes an event: each one counts. The topic is the scope and `path`, usually [`PATH`](super::PATH).
    ///
    /// Returns `false` if there is no room, since values are published faster than they can be sent: then it is not
    /// published.
    pub fn publish(&self, path: &str, value: &Pickle) -> bool {
        self.publish_bytes(path, &value.to_bytes(), false)
    }

    /// Publishes a state: only the newest one of its topic counts. Slow subscribers get no older ones, late subscribers
    /// get it at once.
    ///
    /// Returns `false` if there is no room: then it is not published.
    pub fn publish_state(&self, path: &str, value: &Pickle) -> bool {
        self.publish_bytes(path, &value.to_bytes(), true)
    }

    /// Publishes bytes as they are, for subscribers that do not expect a pickle.
    ///
    /// Returns `false` if there is no room: then they are not published.
    pub fn publish_bytes(&self, path: &str, body: &[u8], is_state: bool) -> bool {
        let message = PubMessage::new(&self.scope, path, body, is_state);
        self.socket.publish(message)
    }
}
