//! Who may use a server: from which addresses, and with which keys at which scopes.
//!
//! ZeroMQ asks for each connection (ZAP, RFC 27), and marks what comes over one that was let in; a
//! message without the mark is dropped, so whatever fails, fails closed.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use std::thread::JoinHandle;

use ipnet::IpNet;
use tracing::warn;

use super::connections::Connections;
use super::{LOG, Limits};
use crate::frames;
use crate::keys::{KeyPair, PublicKey};

/// Where ZeroMQ asks (RFC 27).
const QUESTIONS: &str = "inproc://zeromq.zap.01";
/// Where the door's thread hears that it is over.
const END: &str = "inproc://door";
/// The mark of a connection that has no key.
const NO_KEY: &str = "-";

/// Who may use a server. By default everybody who reaches it may use all of it, as the original's.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Access {
    networks: Vec<IpNet>,
    keys: Option<KeyPair>,
    clients: BTreeSet<PublicKey>,
    clients_of: BTreeMap<String, BTreeSet<PublicKey>>,
}

impl Access {
    /// Everybody may use all.
    #[must_use]
    pub fn everybody() -> Self {
        Self::default()
    }

    /// Only clients with an address in this network, or in another one that is given so.
    #[must_use]
    pub fn from_network(mut self, network: IpNet) -> Self {
        self.networks.push(network);
        self
    }

    /// Encrypts with this pair. Then only clients whose keys are allowed may use anything.
    #[must_use]
    pub fn with_keys(mut self, keys: KeyPair) -> Self {
        self.keys = Some(keys);
        self
    }

    /// Allows a client every scope.
    #[must_use]
    pub fn allow(mut self, client: PublicKey) -> Self {
        self.clients.insert(client);
        self
    }

    /// Allows a client one scope.
    #[must_use]
    pub fn allow_scope(mut self, scope: &str, client: PublicKey) -> Self {
        let clients = self.clients_of.entry(scope.to_owned()).or_default();
        clients.insert(client);
        self
    }

    /// Whether both serve with the same keys of their own.
    #[must_use]
    pub fn has_keys_of(&self, other: &Self) -> bool {
        self.keys == other.keys
    }

    /// Whether connections are encrypted.
    #[must_use]
    pub const fn encrypts(&self) -> bool {
        self.keys.is_some()
    }

    /// Who may use it, for people: what follows `Reachable for`, `where_from` being who reaches it at
    /// all.
    #[must_use]
    pub fn describe(&self, where_from: &str) -> String {
        let mut said = where_from.to_owned();
        if !self.networks.is_empty() {
            let networks: Vec<String> = self.networks.iter().map(IpNet::to_string).collect();
            said = format!("{said}, if its address is in {}", networks.join(" or "));
        }
        said.push_str(
            match (&self.keys, self.clients.len() + self.clients_of.len()) {
                (None, _) => "",
                (Some(_), 0) => ", encrypted; but no client's key is allowed, so nobody gets in",
                (Some(_), _) => ", encrypted, with an allowed key",
            },
        );
        said
    }

    fn is_open(&self) -> bool {
        self.networks.is_empty() && self.keys.is_none()
    }

    fn is_from_there(&self, address: &str) -> bool {
        let address = address.parse::<IpAddr>();
        // A v4 address may come as one of v6.
        let address = address.map(|address| address.to_canonical());
        let from_there = |network: &IpNet| address.as_ref().is_ok_and(|a| network.contains(a));
        self.networks.is_empty() || self.networks.iter().any(from_there)
    }

    fn may_connect(&self, address: &str, client: Option<&PublicKey>) -> bool {
        if !self.is_from_there(address) {
            return false;
        }
        match (&self.keys, client) {
            (None, _) => true,
            (Some(_), None) => false,
            (Some(_), Some(client)) => {
                self.clients.contains(client)
                    || self
                        .clients_of
                        .values()
                        .any(|clients| clients.contains(client))
            }
        }
    }

    fn may_use(&self, client: &PublicKey, scope: &str) -> bool {
        let here = self.clients_of.get(scope);
        self.clients.contains(client) || here.is_some_and(|clients| clients.contains(client))
    }
}

/// Who sent a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Who {
    /// Somebody who may use all.
    Anybody,
    /// The owner of a key.
    Client(PublicKey),
}

/// The access of a server that runs, which may be changed.
#[derive(Clone)]
pub(super) struct Present {
    access: Arc<RwLock<Access>>,
    /// Whether ZeroMQ asks for each connection, which was decided when the server was bound.
    asks: bool,
}

impl Present {
    fn read(&self) -> RwLockReadGuard<'_, Access> {
        self.access.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says whether that is possible without binding anew.
    pub(super) fn change(&self, access: Access) -> bool {
        let mut present = self.access.write().unwrap_or_else(PoisonError::into_inner);
        let possible = present.has_keys_of(&access) && (self.asks || access.is_open());
        if possible {
            *present = access;
        }
        possible
    }
}

/// The door of a server: lets connections in, on a thread of its own, and knows who a message is from.
pub(super) struct Door {
    access: Present,
    /// Ends the thread.
    end: zmq::Socket,
    thread: Option<JoinHandle<()>>,
}

/// Where it is decided about connections.
struct Desk {
    access: Present,
    /// Where ZeroMQ asks.
    questions: zmq::Socket,
    connections: Connections,
    /// Something comes when it is over.
    end: zmq::Socket,
}

/// What ZeroMQ is answered about a connection.
enum Decision {
    /// It is let in, with this mark.
    In(String),
    /// Not now: it tries again.
    Later,
    /// Never.
    Out,
}

impl Door {
    /// Prepares a socket that is to be bound afterwards, for so many connections.
    pub(super) fn new(
        access: Access,
        connections: usize,
        context: &zmq::Context,
        socket: &zmq::Socket,
    ) -> Result<Self, zmq::Error> {
        let access = Present {
            asks: !access.is_open() || connections < Limits::default().connections,
            access: Arc::new(RwLock::new(access)),
        };
        let questions = context.socket(zmq::REP)?;
        questions.set_linger(0)?;
        questions.bind(QUESTIONS)?;
        let [end, over] = [context.socket(zmq::PAIR)?, context.socket(zmq::PAIR)?];
        over.bind(END)?;
        end.set_linger(0)?;
        end.connect(END)?;
        let desk = Desk {
            access: access.clone(),
            questions,
            connections: Connections::of(socket, context, connections)?,
            end: over,
        };
        let thread = std::thread::Builder::new()
            .name("ztl-door".to_owned())
            .spawn(move || desk.serve());
        let door = Self {
            access,
            end,
            // The system gives no more threads.
            thread: Some(thread.map_err(|_| zmq::Error::EAGAIN)?),
        };
        door.guard(socket)?;
        Ok(door)
    }

    /// Lets only those connect to a socket, which is to be bound afterwards, who may connect at all.
    pub(super) fn guard(&self, socket: &zmq::Socket) -> Result<(), zmq::Error> {
        // Without a domain ZeroMQ does not ask. With one it lets in nobody who is older than ZMTP
        // 3.0 and cannot say who he is: libzmq 3, JeroMQ 0.3.
        if self.access.asks {
            socket.set_zap_domain("ztl")?;
        }
        if let Some(keys) = &self.access.read().keys {
            socket.set_curve_server(true)?;
            socket.set_curve_secretkey(keys.secret())?;
        }
        Ok(())
    }

    /// Who a message is from; `None` when it has not come through this door.
    pub(super) fn who(&self, message: &mut zmq::Message) -> Option<Who> {
        let access = self.access.read();
        if access.is_open() {
            return Some(Who::Anybody);
        }
        // The rules may be others by now than when it connected.
        if !access.networks.is_empty() && !access.is_from_there(message.gets("Peer-Address")?) {
            return None;
        }
        match (message.gets("User-Id")?, &access.keys) {
            (NO_KEY, None) => Some(Who::Anybody),
            (key, Some(_)) => key.parse().ok().map(Who::Client),
            (_, None) => None,
        }
    }

    /// The access, to be changed.
    pub(super) fn access(&self) -> Present {
        self.access.clone()
    }

    /// Whether somebody may use a scope.
    pub(super) fn lets_use(&self, who: Who, scope: &str) -> bool {
        match who {
            Who::Anybody => true,
            Who::Client(client) => self.access.read().may_use(&client, scope),
        }
    }
}

impl Drop for Door {
    fn drop(&mut self) {
        let _ = self.end.send(&b""[..], zmq::DONTWAIT);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}

impl Desk {
    /// Until the door is closed.
    fn serve(self) {
        loop {
            let sockets = [&self.questions, self.connections.socket(), &self.end];
            let mut items = sockets.map(|socket| socket.as_poll_item(zmq::POLLIN));
            match zmq::poll(&mut items, -1) {
                Ok(_) | Err(zmq::Error::EINTR) => {}
                Err(_) => return,
            }
            let [_, _, end] = items;
            if end.is_readable() {
                return;
            }
            self.decide();
        }
    }

    /// Answers what ZeroMQ has asked.
    fn decide(&self) {
        self.connections.count();
        while let Ok(asked) = frames::receive(&self.questions) {
            let decision = self.decision(&asked);
            let number = asked.get(1).map_or(&b""[..], Vec::as_slice);
            let (code, text, who) = match &decision {
                Decision::In(who) => ("200", "", who.as_str()),
                Decision::Later => ("300", "too many connections", ""),
                Decision::Out => ("400", "not allowed", ""),
            };
            let frames: [&[u8]; 6] = [
                b"1.0",
                number,
                code.as_bytes(),
                text.as_bytes(),
                who.as_bytes(),
                b"",
            ];
            // ZeroMQ waits for it and takes it.
            let _ = frames::send(&self.questions, &frames);
        }
    }

    fn decision(&self, asked: &[Vec<u8>]) -> Decision {
        let [
            version,
            _number,
            _domain,
            address,
            _identity,
            mechanism,
            credentials @ ..,
        ] = asked
        else {
            return Decision::Out;
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
            warn!(target: LOG, "A client at {address} {who} is not allowed, and was not let in.");
            return Decision::Out;
        }
        if self.connections.are_too_many() {
            return Decision::Later;
        }
        Decision::In(key.map_or_else(|| NO_KEY.to_owned(), |key| key.to_string()))
    }
}
