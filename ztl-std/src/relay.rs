//! Passes requests on as they are: a server's socket without a task table, and a client's without rules of its own.
//!
//! What stands between clients and a server decides with these what to send where; ids, states and envelopes stay those of
//! the two ends.

#[cfg(feature = "publish")]
mod streams;

use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ztl_core::envelope::Envelope;
use ztl_zmtp::curve;
use ztl_zmtp::session::Security;

use crate::keys::{KeyPair, PublicKey};
use crate::native::Endpoint;
use crate::native::dialer::Dialer;
use crate::random;
use crate::server::incoming::{Received, ReturnPath};
use crate::server::relayed::{Router, Signal, Waker};
use crate::server::{Access, BindError, Limits, MAX_MESSAGE};
use crate::transport::Transport;

#[cfg(feature = "publish")]
pub use streams::{RelayPublisher, RelaySubscriber, WantedTopic};

/// Longest answer that a relay accepts, in bytes: four times the longest request, as [12.8] says.
const LONGEST_ANSWER: usize = 4 * MAX_MESSAGE + 4096;

/// Most idle connections that a [`RelayClient`] keeps.
const IDLE: usize = 8;

/// A server's socket whose requests somebody else answers.
pub struct RelayServer {
    router: Router,
    endpoint: String,
    waker: Arc<Waker>,
    answers: Arc<Answers>,
}

/// A request as it arrived.
#[derive(Debug)]
pub struct RelayedRequest {
    /// The connection that it came over; a later connection has a higher number.
    pub connection: u64,
    /// Leads the answer back.
    pub path: RelayPath,
    /// The client and the request's number, if the client sends them.
    pub envelope: Option<Envelope>,
    /// The body; `None` if it was not exactly one frame.
    pub body: Option<Vec<u8>>,
    /// The client's key, if the server encrypts.
    pub client: Option<PublicKey>,
}

/// Leads one answer back to its client.
#[derive(Debug)]
pub struct RelayPath(ReturnPath);

type Answers = Mutex<VecDeque<(RelayPath, Vec<u8>)>>;

/// Answers the requests of a [`RelayServer`], from any thread.
#[derive(Clone)]
pub struct RelayAnswers {
    answers: Arc<Answers>,
    waker: Arc<Waker>,
}

impl RelayServer {
    /// Listens at a ZeroMQ endpoint, such as `tcp://127.0.0.1:12345`.
    ///
    /// # Errors
    /// [`BindError`].
    pub fn bind(endpoint: &str, access: Access, limits: Limits) -> Result<Self, BindError> {
        let (router, endpoint, signal): (_, _, Signal) =
            Router::bind(Transport::Native, access, limits, endpoint)?;
        Ok(Self {
            router,
            endpoint,
            waker: Waker::new(signal),
            answers: Arc::default(),
        })
    }

    /// Where it listens, with the port that was chosen.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Answers requests, and stops the server.
    #[must_use]
    pub fn answers(&self) -> RelayAnswers {
        RelayAnswers {
            answers: Arc::clone(&self.answers),
            waker: Arc::clone(&self.waker),
        }
    }

    /// Gives each request to `handle`, which must return at once, until the server is stopped. Answers go out after each round,
    /// in which each connection has its turn.
    ///
    /// # Errors
    /// The system's error if it can no longer wait for messages. No request can cause it.
    pub fn listen(mut self, mut handle: impl FnMut(RelayedRequest)) -> io::Result<()> {
        while !self.waker.stopped() {
            let mut next = match self.waker.may_sleep() {
                true => self.router.wait(Duration::MAX)?,
                false => self.router.look()?,
            };
            self.waker.on_awake();
            while let Some(received) = next {
                if let Received::Request(request) = received {
                    let client = request.sender.key();
                    handle(RelayedRequest {
                        connection: request.path.connection(),
                        path: RelayPath(request.path),
                        envelope: request.envelope,
                        body: request.content.map(|content| content.to_vec()),
                        client,
                    });
                }
                next = self.router.receive()?;
            }
            let mut answers = self.answers.lock().unwrap_or_else(PoisonError::into_inner);
            let ready = std::mem::take(&mut *answers);
            drop(answers);
            for (RelayPath(path), body) in ready {
                self.router.send(path, &body);
            }
        }
        Ok(())
    }
}

impl RelayAnswers {
    /// Sends an answer. It is dropped if the client is gone.
    pub fn send(&self, path: RelayPath, body: Vec<u8>) {
        let mut answers = self.answers.lock().unwrap_or_else(PoisonError::into_inner);
        answers.push_back((path, body));
        drop(answers);
        self.waker.on_posted();
    }

    /// Ends [`RelayServer::listen`].
    pub fn stop(&self) {
        self.waker.stop();
    }
}

/// Why a relayed request has no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum NotRelayed {
    /// The server was not connected; nothing was sent.
    NotSent,
    /// The request was sent; what the server did is unknown.
    NoAnswer,
}

impl std::fmt::Display for NotRelayed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NotSent => "the robot's server is not connected",
            Self::NoAnswer => "the robot's server does not answer",
        })
    }
}

impl std::error::Error for NotRelayed {}

/// Sends requests to a server as they are, each over a connection that no other request uses meanwhile.
pub struct RelayClient {
    endpoint: Endpoint,
    keys: Option<(KeyPair, PublicKey)>,
    idle: Mutex<Vec<Dialer>>,
}

impl RelayClient {
    /// A client of the server at a ZeroMQ endpoint, which need not be there yet; with its own keys and the server's, if the
    /// server encrypts.
    ///
    /// # Errors
    /// What is wrong with the endpoint.
    pub fn new(endpoint: &str, keys: Option<(KeyPair, PublicKey)>) -> Result<Self, String> {
        Ok(Self {
            endpoint: Endpoint::parse(endpoint)?,
            keys,
            idle: Mutex::default(),
        })
    }

    /// Sends a request and waits at most `limit` for its answer.
    ///
    /// # Errors
    /// [`NotRelayed`]. The connection is closed then, so that no late answer is taken for another.
    pub fn ask(
        &self,
        envelope: Option<Envelope>,
        body: &[u8],
        limit: Duration,
    ) -> Result<Vec<u8>, NotRelayed> {
        self.ask_before(envelope, body, limit, limit)
    }

    /// The same, and sends the request only if the server is reached within `send`.
    ///
    /// # Errors
    /// [`NotRelayed`].
    pub fn ask_before(
        &self,
        envelope: Option<Envelope>,
        body: &[u8],
        send: Duration,
        limit: Duration,
    ) -> Result<Vec<u8>, NotRelayed> {
        let end = Instant::now() + limit;
        let idle = self
            .idle
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .pop();
        let mut dialer = match idle {
            Some(dialer) => dialer,
            None => self.open().map_err(|_| NotRelayed::NotSent)?,
        };
        // An INIT that nobody waits for any more must not arrive later.
        dialer.discard_unsent(true);
        if !matches!(dialer.can_send(send), Ok(true)) {
            return Err(NotRelayed::NotSent);
        }
        // A second answer to an earlier request is none to this one, and without an envelope it could not be told apart.
        while dialer.receive().is_some() {}
        let frames = envelope.map(|envelope| envelope.frames());
        match &frames {
            Some((client, number)) => dialer.send(&[client, number], body),
            None => dialer.send(&[], body),
        }
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if !matches!(dialer.can_receive(left), Ok(true)) {
                return Err(NotRelayed::NoAnswer);
            }
            let frames = dialer.receive().unwrap_or_default();
            let told = frames
                .len()
                .checked_sub(2)
                .and_then(|n| frames.split_at_checked(n));
            let same = |told: &[Vec<u8>]| match (&envelope, told) {
                (None, []) => true,
                (Some(asked), [client, number]) => {
                    let told = Envelope::parse(client, number);
                    told.is_some_and(|told| told == *asked)
                }
                _ => false,
            };
            if let Some((told, [_, answer])) = told
                && same(told)
            {
                let answer = answer.clone();
                let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
                if idle.len() < IDLE {
                    idle.push(dialer);
                }
                return Ok(answer);
            }
        }
    }

    fn open(&self) -> io::Result<Dialer> {
        let keys = self.keys.as_ref().map(|(own, server)| {
            curve::Keys::client(*own.secret(), *server.as_bytes(), random::secret)
        });
        let security = keys.map_or(Security::Null, Security::Curve);
        Dialer::new(self.endpoint.clone(), security, LONGEST_ANSWER)
    }
}

impl std::fmt::Debug for RelayServer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("RelayServer").field(&self.endpoint).finish()
    }
}

impl std::fmt::Debug for RelayAnswers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("RelayAnswers")
    }
}

impl std::fmt::Debug for RelayClient {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("RelayClient").field(&self.endpoint).finish()
    }
}

#[cfg(test)]
mod tests;
