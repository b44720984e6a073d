//! Calls of this node to the master and to other nodes. Each has a connection of its own, since masters close it
//! after the answer.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Engine, Role};
use crate::http;
use crate::node::net::ConnectionId;
use crate::node::net_error::NetError;
use crate::uri::Address;
use crate::xmlrpc::{self, Response, Value};

/// The longest answer: the parameters of a large robot, in bytes.
const LONGEST: usize = 16 * 1024 * 1024;

/// What to do with an answer.
pub(crate) type Then = Box<dyn FnOnce(&mut Engine, Instant, Result<Value, CallError>) + Send>;

/// Why a call to the master or to a node has no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum CallError {
    /// The text is not an address of the form `http://robot:11311`.
    Address {
        /// What it is.
        uri: String,
    },
    /// The connection failed.
    Net(NetError),
    /// The answer is not what ROS sends.
    Malformed {
        /// Who sent it.
        peer: String,
        /// What is wrong.
        error: String,
    },
    /// The answer is a refusal.
    Refused {
        /// The reason.
        reason: String,
    },
    /// The node was stopped.
    Stopped,
}

impl fmt::Display for CallError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Address { uri } => {
                write!(f, "invalid address '{uri}': expected http://HOST:PORT")
            }
            Self::Net(error) => error.fmt(f),
            Self::Malformed { peer, error } => write!(f, "malformed answer from {peer}: {error}"),
            Self::Refused { reason } => f.write_str(reason),
            Self::Stopped => f.write_str("the ROS node has stopped"),
        }
    }
}

impl std::error::Error for CallError {}

impl From<NetError> for CallError {
    fn from(error: NetError) -> Self {
        Self::Net(error)
    }
}

impl Engine {
    /// Calls a method of the master or a node.
    pub(crate) fn rpc(
        &mut self,
        now: Instant,
        uri: &str,
        method: &str,
        params: &[Value],
        limit: Duration,
        then: Then,
    ) {
        let Some(address) = Address::parse(uri, "http") else {
            let uri = uri.to_owned();
            return then(self, now, Err(CallError::Address { uri }));
        };
        let request = http::request(&address.to_string(), &xmlrpc::call(method, params));
        let id = self.net.open(now, address, now + limit);
        self.net.send(id, Arc::from(request), 1);
        self.roles
            .insert(id, Role::Rpc(http::Reader::new(LONGEST), then));
    }

    pub(crate) fn on_rpc_bytes(
        &mut self,
        now: Instant,
        id: ConnectionId,
        mut reader: http::Reader,
        then: Then,
        bytes: &[u8],
    ) -> Option<Role> {
        reader.handle_bytes(bytes);
        let answer = match reader.poll_message(false) {
            Ok(None) => return Some(Role::Rpc(reader, then)),
            Ok(Some(message)) => Ok(message),
            Err(error) => Err(error.to_string()),
        };
        let peer = self.net.peer(id);
        self.net.close(id);
        then(self, now, read(answer, peer));
        None
    }

    pub(crate) fn on_rpc_closed(
        &mut self,
        now: Instant,
        mut reader: http::Reader,
        then: Then,
        error: NetError,
    ) {
        let answer = match (error, reader.poll_message(true)) {
            (NetError::Closed { peer }, Ok(Some(message))) => read(Ok(message), peer),
            (NetError::Closed { peer }, Err(error)) => read(Err(error.to_string()), peer),
            (error, _) => Err(error.into()),
        };
        then(self, now, answer);
    }
}

/// The value of an answer. In ROS, each is a list of a code, a text and the value.
fn read(answer: Result<http::Message, String>, peer: String) -> Result<Value, CallError> {
    let malformed = |error: String| CallError::Malformed {
        peer: peer.clone(),
        error,
    };
    let message = answer.map_err(malformed)?;
    if message.status != Some(200) {
        let status = message.status.unwrap_or_default();
        return Err(malformed(format!("HTTP status {status}")));
    }
    let response = xmlrpc::parse_response(&message.body);
    let parts = match response.map_err(|error| malformed(error.to_string()))? {
        Response::Fault(reason) => return Err(CallError::Refused { reason }),
        Response::Value(Value::Array(parts)) => <[Value; 3]>::try_from(parts).ok(),
        Response::Value(_) => None,
    };
    match parts {
        Some([Value::Int(1), _, value]) => Ok(value),
        Some([Value::Int(_), Value::String(reason), _]) => Err(CallError::Refused { reason }),
        _ => Err(malformed("not a list of code, text and value".to_owned())),
    }
}

/// Reads `["TCPROS", host, port]`.
pub(crate) fn read_offer(value: &Value) -> Option<Address> {
    let [protocol, host, port] = value.as_array()? else {
        return None;
    };
    if protocol.as_str() != Some("TCPROS") {
        return None;
    }
    Some(Address {
        host: host.as_str()?.to_owned(),
        port: u16::try_from(port.as_int()?).ok()?,
    })
}
