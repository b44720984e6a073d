//! Passes published messages on as they are.

use std::io;
use std::time::Duration;

use crate::keys::{KeyPair, PublicKey};
use crate::native::publisher::{EXCEPT, PubMessage, PubSocket, Unheard};
use crate::publish::{Heard, Subscriber};
use crate::server::{Access, BindError, CurrentAccess, Limits, rules, to_bind};

/// A subscription of somebody.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WantedTopic {
    /// The subscriber's key, if the publisher encrypts.
    pub key: Option<PublicKey>,
    /// How the topics begin.
    pub begin: Vec<u8>,
}

/// Publishes what others publish, each below a root of its own, such as `/arm-1`.
#[derive(Debug)]
pub struct RelayPublisher {
    socket: PubSocket,
}

impl RelayPublisher {
    /// Publishes at a ZeroMQ endpoint. Whenever subscriptions begin or end, `changed` is called with all of them, on the
    /// publisher's thread.
    ///
    /// # Errors
    /// [`BindError`].
    pub fn bind(
        endpoint: &str,
        access: Access,
        limits: Limits,
        mut changed: impl FnMut(Vec<WantedTopic>) + Send + 'static,
    ) -> Result<Self, BindError> {
        let rules = rules(&access, &limits);
        let access = CurrentAccess::new(access);
        let socket = PubSocket::bind(&to_bind(endpoint)?, rules, access, false)
            .map_err(|error| BindError::at_endpoint(endpoint, &error))?;
        socket.listen(move |wanted| {
            let wanted = wanted.into_iter();
            changed(
                wanted
                    .map(|(key, begin)| WantedTopic { key, begin })
                    .collect(),
            );
        });
        Ok(Self { socket })
    }

    /// Where it publishes, with the port that was chosen.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        self.socket.endpoint()
    }

    /// Whether its thread has ended, so that nothing is published any more; the log says why.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.socket.has_ended()
    }

    /// Whether there is much room for messages that wait to be sent.
    #[must_use]
    pub fn has_room(&self) -> bool {
        self.socket.has_room()
    }

    /// Publishes a message for those who may use its scope or the whole root. `scope` begins with the root; the topic is
    /// `scope` and `path`. Returns `false` if there is no room.
    pub fn publish(
        &self,
        root: &str,
        scope: &str,
        path: &str,
        body: &[u8],
        is_state: bool,
    ) -> bool {
        let message = PubMessage::new(scope, path, body, is_state);
        self.socket.publish(message.also_for(root))
    }

    /// Forgets the newest states of the topics that are stale, after what was published before.
    pub fn forget(&self, is_stale: impl Fn(&[u8]) -> bool + Send + 'static) {
        self.socket.forget(is_stale);
    }

    /// Tells subscribers that so many messages below a root did not arrive: those who may use one of the scopes or the whole
    /// root, and subscribe to anything below it.
    pub fn tell_missed(&self, root: &str, scopes: Vec<String>, count: u64) {
        self.socket.tell_missed(Unheard {
            root: root.to_owned(),
            scopes,
            count,
        });
    }
}

/// Hears what a publisher publishes, to pass it on.
pub struct RelaySubscriber(Subscriber);

impl RelaySubscriber {
    /// Connects while it is waited for; encrypts with its own keys and the publisher's.
    ///
    /// # Errors
    /// If the endpoint is invalid, or the system has no more files.
    pub fn connect(endpoint: &str, keys: Option<(KeyPair, PublicKey)>) -> io::Result<Self> {
        let builder = match keys {
            Some((own, publisher)) => Subscriber::builder().keys(own, publisher),
            None => Subscriber::builder(),
        };
        let mut subscriber = builder.connect(endpoint)?;
        subscriber.set_begins(Vec::new());
        Ok(Self(subscriber))
    }

    /// Subscribes to the topics that begin so, instead of all before. After a line feed, one may have exceptions: how topics begin
    /// that it does not bring, a line each. Publishers of this crate know exceptions.
    pub fn set_topics(&mut self, topics: &[String]) {
        let (mut exceptions, mut begins) = (Vec::new(), Vec::new());
        for topic in topics {
            let mut lines = topic.split('\n');
            let begin = lines.next().unwrap_or_default();
            // The same topic without exceptions brings everything.
            if begin == topic || !topics.iter().any(|other| other == begin) {
                let exception = |line| format!("{EXCEPT}{begin}\n{line}").into_bytes();
                exceptions.extend(lines.map(exception));
            }
            begins.push(begin.as_bytes().to_vec());
        }
        exceptions.append(&mut begins);
        self.0.set_begins(exceptions);
    }

    /// Asks for the newest states again, which a publisher of this crate sends.
    pub fn ask_newest(&mut self) {
        self.0.ask_newest();
    }

    /// The next message, if it comes within `limit`, and whether it is a state, as a publisher of this crate tells.
    ///
    /// # Errors
    /// If the system can no longer wait for messages. No publisher can cause it.
    pub fn next_within(&mut self, limit: Duration) -> io::Result<Option<(Heard, bool)>> {
        let heard = self.0.next_within(limit)?;
        Ok(heard.map(|heard| (heard, self.0.was_state())))
    }

    /// Whether the publisher is connected.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.0.is_connected()
    }

    /// If the publisher does not let it connect: what is wrong, and what helps.
    #[must_use]
    pub fn advice(&self) -> Option<String> {
        self.0.advice()
    }

    /// How many messages were missed or damaged.
    #[must_use]
    pub const fn missed(&self) -> u64 {
        self.0.missed().saturating_add(self.0.damaged())
    }

    /// How often the connection was lost.
    #[must_use]
    pub const fn lost(&self) -> u64 {
        self.0.lost()
    }
}

impl std::fmt::Debug for RelaySubscriber {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("RelaySubscriber")
    }
}

#[cfg(test)]
mod tests;
