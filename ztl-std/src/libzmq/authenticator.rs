//! The authenticator: decides which connections are accepted, and identifies the sender of a message.
//!
//! ZeroMQ asks for each connection (ZAP, RFC 27) and attaches the answer to every message that arrives over
//! it. Messages without an answer are dropped, so any failure denies access.

use std::net::IpAddr;
use std::thread::JoinHandle;

use tracing::warn;

use super::connections::Connections;
use super::{NO_HANDSHAKE_LIMIT, sockets};
use crate::keys::PublicKey;
use crate::log_targets::TASKS;
use crate::server::{Access, CurrentAccess, Limits, Sender};

/// Where ZeroMQ sends its requests (RFC 27).
const REQUESTS: &str = "inproc://zeromq.zap.01";
/// Where the authenticator's thread receives the request to end.
const END: &str = "inproc://authenticator-end";
/// The user id of a connection without a key.
const NO_KEY: &str = "-";

/// Decides about a server's connections on a thread of its own.
pub(crate) struct Authenticator {
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
    /// Prepares a socket that is bound afterwards, with these limits for its connections.
    pub(crate) fn new(
        access: Access,
        limits: Limits,
        context: &zmq::Context,
        socket: &zmq::Socket,
    ) -> Result<Self, zmq::Error> {
        // ZeroMQ asks only if there is a domain. With one, it rejects peers older than ZMTP 3.0 (libzmq 3,
        // JeroMQ 0.3), which cannot authenticate.
        let asks = !access.is_open() || limits.connections < Limits::default().connections;
        let mut handshake = NO_HANDSHAKE_LIMIT;
        if asks {
            socket.set_zap_domain("ztl")?;
            let millis = i32::try_from(limits.handshake.as_millis());
            handshake = millis.unwrap_or(i32::MAX).max(1);
        }
        socket.set_handshake_ivl(handshake)?;
        if let Some(keys) = access.keys() {
            socket.set_curve_server(true)?;
            socket.set_curve_secretkey(keys.secret())?;
        }
        let access = CurrentAccess::with(access, asks);
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
            connections: Connections::of(socket, context, limits.connections)?,
            end: ended,
        };
        let thread = std::thread::Builder::new()
            .name("ztl-access".to_owned())
            .spawn(move || worker.run());
        Ok(Self {
            access,
            end,
            // The system has no more threads.
            thread: Some(thread.map_err(|_| zmq::Error::EAGAIN)?),
        })
    }

    /// Who sent a message; `None` if its connection was not accepted.
    pub(crate) fn sender(&self, message: &mut zmq::Message) -> Option<Sender> {
        let access = self.access.read();
        if access.is_open() {
            return Some(Sender::Anyone);
        }
        // The rules may have changed since the client connected.
        if access.has_networks() {
            let address = message.gets("Peer-Address")?.parse();
            if !address.is_ok_and(|address| access.admits_address(address)) {
                return None;
            }
        }
        match (message.gets("User-Id")?, access.keys()) {
            (NO_KEY, None) => Some(Sender::Anyone),
            (key, Some(_)) => key.parse().ok().map(Sender::Client),
            (_, None) => None,
        }
    }

    /// Who may use the server.
    pub(crate) const fn access(&self) -> &CurrentAccess {
        &self.access
    }
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
        // Without one, it is on this machine (`ipc://`).
        let place = address.parse().unwrap_or(IpAddr::from([127, 0, 0, 1]));
        let key = match (mechanism.as_slice(), credentials) {
            (b"CURVE", [key]) => key.as_slice().try_into().ok().map(PublicKey::from_bytes),
            _ => None,
        };
        let allowed = version == b"1.0" && self.access.read().may_connect(place, key.as_ref());
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
