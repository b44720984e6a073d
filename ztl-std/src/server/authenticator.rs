//! The authenticator: decides which connections are accepted, and identifies the sender of a message.
//!
//! ZeroMQ asks for each connection (ZAP, RFC 27) and attaches the answer to every message that arrives over
//! it. Messages without an answer are dropped, so any failure denies access.

use std::net::IpAddr;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use std::thread::JoinHandle;

use tracing::warn;

use super::access::Access;
use super::connections::Connections;
use super::limits::Limits;
use crate::keys::PublicKey;
use crate::log_targets::TASKS;
use crate::sockets;

/// Where ZeroMQ sends its requests (RFC 27).
const REQUESTS: &str = "inproc://zeromq.zap.01";
/// Where the authenticator's thread receives the request to end.
const END: &str = "inproc://authenticator-end";
/// The user id of a connection without a key.
const NO_KEY: &str = "-";

/// Who sent a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sender {
    /// Anyone; the server does not encrypt.
    Anyone,
    /// The owner of a key.
    Client(PublicKey),
}

/// The access of a running server, which can be changed.
#[derive(Clone)]
pub(super) struct CurrentAccess {
    access: Arc<RwLock<Access>>,
    /// Whether ZeroMQ asks for each connection. Fixed when the server is bound.
    asks: bool,
}

impl CurrentAccess {
    /// The access of a server that asks by itself.
    pub(super) fn new(access: Access) -> Self {
        Self {
            access: Arc::new(RwLock::new(access)),
            asks: true,
        }
    }

    /// Whether a client may connect.
    pub(super) fn admits(&self, address: IpAddr, key: Option<PublicKey>) -> bool {
        let address = address.to_string();
        let allowed = self.read().may_connect(&address, key.as_ref());
        if !allowed {
            log_denied(&address, key.as_ref());
        }
        allowed
    }

    /// Who a client is; `None` if it may not use the server any more.
    pub(super) fn sender(&self, address: IpAddr, key: Option<PublicKey>) -> Option<Sender> {
        let access = self.read();
        if access.is_open() {
            return Some(Sender::Anyone);
        }
        let admitted = access.may_connect(&address.to_string(), key.as_ref());
        admitted.then(|| key.map_or(Sender::Anyone, Sender::Client))
    }

    /// Whether a sender may use a scope.
    pub(super) fn may_use(&self, sender: Sender, scope: &str) -> bool {
        match sender {
            Sender::Anyone => true,
            Sender::Client(client) => self.read().may_use(&client, scope),
        }
    }

    fn read(&self) -> RwLockReadGuard<'_, Access> {
        self.access.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the access; returns whether that is possible without binding again.
    pub(super) fn change(&self, access: Access) -> bool {
        let mut current = self.access.write().unwrap_or_else(PoisonError::into_inner);
        let possible = current.has_keys_of(&access) && (self.asks || access.is_open());
        if possible {
            *current = access;
        }
        possible
    }
}

/// Decides about a server's connections on a thread of its own.
pub(super) struct Authenticator {
    access: CurrentAccess,
    /// Ends the thread.
    end: zmq::Socket,
    thread: Option<JoinHandle<()>>,
}

/// What the thread owns.
struct Worker {
    access: CurrentAccess,
    requests: zmq::Socket,
    connections: Connections,
    /// Readable when the thread is to end.
    end: zmq::Socket,
}

/// The answer about a connection.
enum Decision {
    /// Accepted, with this user id.
    Accept(String),
    /// Refused for now; the client tries again.
    TryLater,
    Deny,
}

impl Authenticator {
    /// Prepares a socket that is bound afterwards, for at most `connections` connections.
    pub(super) fn new(
        access: Access,
        connections: usize,
        context: &zmq::Context,
        socket: &zmq::Socket,
    ) -> Result<Self, zmq::Error> {
        let access = CurrentAccess {
            asks: !access.is_open() || connections < Limits::default().connections,
            access: Arc::new(RwLock::new(access)),
        };
        let requests = context.socket(zmq::REP)?;
        requests.set_linger(0)?;
        requests.bind(REQUESTS)?;
        let [end, ended] = [context.socket(zmq::PAIR)?, context.socket(zmq::PAIR)?];
        ended.bind(END)?;
        end.set_linger(0)?;
        end.connect(END)?;
        let worker = Worker {
            access: access.clone(),
            requests,
            connections: Connections::of(socket, context, connections)?,
            end: ended,
        };
        let thread = std::thread::Builder::new()
            .name("ztl-access".to_owned())
            .spawn(move || worker.run());
        let authenticator = Self {
            access,
            end,
            // The system has no more threads.
            thread: Some(thread.map_err(|_| zmq::Error::EAGAIN)?),
        };
        authenticator.protect(socket)?;
        Ok(authenticator)
    }

    /// Applies the rules to a socket that is bound afterwards.
    pub(super) fn protect(&self, socket: &zmq::Socket) -> Result<(), zmq::Error> {
        // ZeroMQ asks only if there is a domain. With one, it rejects peers older than ZMTP 3.0 (libzmq 3,
        // JeroMQ 0.3), which cannot authenticate.
        if self.access.asks {
            socket.set_zap_domain("ztl")?;
        }
        if let Some(keys) = self.access.read().keys() {
            socket.set_curve_server(true)?;
            socket.set_curve_secretkey(keys.secret())?;
        }
        Ok(())
    }

    /// Who sent a message; `None` if its connection was not accepted.
    pub(super) fn sender(&self, message: &mut zmq::Message) -> Option<Sender> {
        let access = self.access.read();
        if access.is_open() {
            return Some(Sender::Anyone);
        }
        // The rules may have changed since the client connected.
        if access.has_networks() && !access.admits_address(message.gets("Peer-Address")?) {
            return None;
        }
        match (message.gets("User-Id")?, access.keys()) {
            (NO_KEY, None) => Some(Sender::Anyone),
            (key, Some(_)) => key.parse().ok().map(Sender::Client),
            (_, None) => None,
        }
    }

    /// Who may use the server.
    pub(super) const fn access(&self) -> &CurrentAccess {
        &self.access
    }
}

fn log_denied(address: &str, key: Option<&PublicKey>) {
    let who = key.map_or_else(
        || "without a key".to_owned(),
        |key| format!("with the key {key}"),
    );
    warn!(target: TASKS, "A client at {address} {who} is not allowed, and was not let in.");
}

impl Drop for Authenticator {
    fn drop(&mut self) {
        let _ = self.end.send(&b""[..], zmq::DONTWAIT);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}

impl Worker {
    /// Runs until the authenticator is dropped.
    fn run(self) {
        loop {
            let sockets = [&self.requests, self.connections.socket(), &self.end];
            let mut items = sockets.map(|socket| socket.as_poll_item(zmq::POLLIN));
            match zmq::poll(&mut items, -1) {
                Ok(_) | Err(zmq::Error::EINTR) => {}
                Err(_) => return,
            }
            let [_, _, end] = items;
            if end.is_readable() {
                return;
            }
            self.answer_requests();
        }
    }

    fn answer_requests(&self) {
        self.connections.count();
        while let Ok(request) = sockets::receive(&self.requests) {
            let decision = self.decide(&request);
            let number = request.get(1).map_or(&b""[..], Vec::as_slice);
            let (code, text, user) = match &decision {
                Decision::Accept(user) => ("200", "", user.as_str()),
                Decision::TryLater => ("300", "too many connections", ""),
                Decision::Deny => ("400", "not allowed", ""),
            };
            let frames: [&[u8]; 6] = [
                b"1.0",
                number,
                code.as_bytes(),
                text.as_bytes(),
                user.as_bytes(),
                b"",
            ];
            // ZeroMQ waits for the answer and takes it.
            let _ = sockets::send(&self.requests, &frames);
        }
    }

    fn decide(&self, request: &[Vec<u8>]) -> Decision {
        let [
            version,
            _number,
            _domain,
            address,
            _identity,
            mechanism,
            credentials @ ..,
        ] = request
        else {
            return Decision::Deny;
        };
        let address = String::from_utf8_lossy(address);
        let key = match (mechanism.as_slice(), credentials) {
            (b"CURVE", [key]) => key.as_slice().try_into().ok().map(PublicKey::from_bytes),
            _ => None,
        };
        let allowed = version == b"1.0" && self.access.read().may_connect(&address, key.as_ref());
        if !allowed {
            let who = key.map_or_else(
                || "without a key".to_owned(),
                |key| format!("with the key {key}"),
            );
            warn!(target: TASKS, "A client at {address} {who} is not allowed and was rejected.");
            return Decision::Deny;
        }
        if self.connections.are_too_many() {
            return Decision::TryLater;
        }
        Decision::Accept(key.map_or_else(|| NO_KEY.to_owned(), |key| key.to_string()))
    }
}
