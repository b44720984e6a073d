//! One connection to a process that speaks libqi's protocol, without I/O: the handshake, and messages both ways.

use std::fmt;

use crate::decode::decode;
use crate::encode::encode;
use crate::limits::Limits;
use crate::message::{Address, DYNAMIC_PAYLOAD, Frames, Kind, Message};
use crate::signature::Signature;
use crate::value::Value;

/// The function of a server with which a connection begins.
const AUTHENTICATE: Address = Address {
    service: 0,
    object: 0,
    action: 8,
};

/// The key of the handshake's state in an answer.
const STATE: &str = "__qi_auth_state";
const CONTINUE: u32 = 2;
const DONE: u32 = 3;

/// The longest error text that is kept, in bytes.
const ERROR_TEXT: usize = 4096;

/// The longest token, in bytes.
const LONGEST_TOKEN: usize = 1024;

/// Who this client is, for servers that ask for it.
#[derive(Clone, PartialEq, Eq)]
pub struct Credentials {
    /// The user, as `nao`.
    pub user: String,
    /// The user's token: at first the robot's password, then that of the last [`Event::NewToken`](crate::Event::NewToken).
    pub token: String,
}

impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Credentials of {:?}", self.user)
    }
}

/// What has happened on a connection.
#[derive(Debug)]
pub(crate) enum Happened {
    /// The server takes calls.
    Ready,
    /// The server has chosen another token for the user.
    NewToken(String),
    /// An answer or a signal.
    Message(Message),
}

#[derive(Debug, PartialEq)]
enum Stage {
    /// The answer to this message says whether the server takes calls.
    Handshake {
        id: u32,
        new_token: bool,
    },
    Ready,
}

/// A connection.
#[derive(Debug)]
pub(crate) struct Connection {
    frames: Frames,
    output: Vec<u8>,
    stage: Stage,
    credentials: Option<Credentials>,
    next_id: u32,
    /// Whether calls can be cancelled.
    cancels: bool,
    /// Why the server has refused the handshake, when it may still take calls.
    refused: Option<String>,
    limits: Limits,
}

/// There is no room for another message.
#[derive(Debug)]
pub(crate) struct OutputFull;

impl Connection {
    /// A connection that has just been opened.
    pub(crate) fn new(credentials: Option<Credentials>, limits: Limits) -> Self {
        let mut connection = Self {
            frames: Frames::new(limits.payload),
            output: Vec::new(),
            stage: Stage::Handshake {
                id: 1,
                new_token: false,
            },
            credentials,
            next_id: 0,
            cancels: false,
            refused: None,
            limits,
        };
        connection.authenticate(false);
        connection
    }

    /// Takes bytes from the server. Then call [`poll`](Self::poll) until it returns `None`.
    pub(crate) fn handle_input(&mut self, bytes: &[u8]) {
        self.frames.push(bytes);
    }

    /// What has happened next.
    ///
    /// # Errors
    /// Why the connection is of no use any more.
    pub(crate) fn poll(&mut self) -> Result<Option<Happened>, String> {
        while let Some(message) = self.frames.poll().map_err(|error| error.to_string())? {
            match (&self.stage, message.kind) {
                (_, Kind::Capability) => self.learn(&message),
                (Stage::Handshake { id, new_token }, _) if message.id == *id => {
                    let new_token = *new_token;
                    return self.on_authenticated(&message, new_token).map(Some);
                }
                (Stage::Ready, _) => return Ok(Some(Happened::Message(message))),
                _ => {}
            }
        }
        Ok(None)
    }

    /// Sends a message; returns its number.
    ///
    /// # Errors
    /// Too much waits to be sent.
    pub(crate) fn send(
        &mut self,
        kind: Kind,
        address: Address,
        payload: Vec<u8>,
    ) -> Result<u32, OutputFull> {
        if self.output.len().saturating_add(payload.len()) > self.limits.output {
            return Err(OutputFull);
        }
        Ok(self.put(kind, address, payload))
    }

    /// Asks to cancel a call. False if the server cannot.
    pub(crate) fn cancel(&mut self, id: u32, mut address: Address) -> bool {
        if self.cancels {
            address.action = 0;
            // A few bytes for each call; the number of calls is bounded.
            self.put(Kind::Cancel, address, id.to_le_bytes().to_vec());
        }
        self.cancels
    }

    /// The bytes to send. Remove what was sent.
    pub(crate) fn output(&mut self) -> &mut Vec<u8> {
        &mut self.output
    }

    /// Why the server has refused the handshake, which may be why it closes the connection.
    pub(crate) fn refused(&self) -> Option<&str> {
        self.refused.as_deref()
    }

    fn put(&mut self, kind: Kind, address: Address, payload: Vec<u8>) -> u32 {
        self.next_id = self.next_id.wrapping_add(1);
        let message = Message {
            id: self.next_id,
            kind,
            flags: 0,
            address,
            payload,
        };
        message.encode_into(&mut self.output);
        self.next_id
    }

    /// What this client is capable of, and who it is. `relative` endpoints and objects of our own are left out.
    fn capabilities(&self, authenticate: bool) -> Vec<u8> {
        let capability = |key: &str, value| (Value::Text(key.to_owned()), value);
        let mut map = vec![
            capability("ClientServerSocket", Value::Bool(false)),
            capability("MessageFlags", Value::Bool(true)),
            capability("MetaObjectCache", Value::Bool(false)),
            capability("RemoteCancelableCalls", Value::Bool(true)),
            capability("ObjectPtrUID", Value::Bool(false)),
            capability("RelativeEndpointURI", Value::Bool(false)),
        ];
        if let Some(Credentials { user, token }) =
            self.credentials.as_ref().filter(|_| authenticate)
        {
            map.push(capability("auth_user", Value::Text(user.clone())));
            map.push(capability("auth_token", Value::Text(token.clone())));
        }
        let mut payload = Vec::new();
        // Texts and bools fit.
        let _ = encode(&Value::Map(map), &capability_map(), &mut payload);
        payload
    }

    fn authenticate(&mut self, new_token: bool) {
        let payload = self.capabilities(true);
        let id = self.put(Kind::Call, AUTHENTICATE, payload);
        self.stage = Stage::Handshake { id, new_token };
    }

    fn on_authenticated(&mut self, message: &Message, new_token: bool) -> Result<Happened, String> {
        if message.kind != Kind::Reply {
            let refused = error_text(message, &self.limits);
            if self.credentials.is_some() {
                return Err(format!("the robot refused user and token: {refused}"));
            }
            // A server from before this handshake takes calls, and another closes the connection.
            let payload = self.capabilities(false);
            self.put(Kind::Capability, AUTHENTICATE, payload);
            self.refused = Some(refused);
            self.stage = Stage::Ready;
            return Ok(Happened::Ready);
        }
        self.learn(message);
        let map = decode(&message.payload, &capability_map(), &self.limits)
            .map_err(|error| format!("its answer to the handshake cannot be read: {error}"))?;
        match entry(&map, STATE).and_then(Value::as_u32) {
            Some(DONE) => {
                self.stage = Stage::Ready;
                Ok(Happened::Ready)
            }
            Some(CONTINUE) => {
                let token = entry(&map, "auth_newToken").and_then(Value::as_text);
                // It is kept in a file, of which it is the only line.
                let token = token.filter(|it| {
                    it.len() <= LONGEST_TOKEN && !it.contains(char::is_control) && it.trim() == *it
                });
                match (token, &mut self.credentials) {
                    (Some(token), Some(credentials)) if !new_token => {
                        token.clone_into(&mut credentials.token);
                        let token = token.to_owned();
                        self.authenticate(true);
                        Ok(Happened::NewToken(token))
                    }
                    (_, None) => Err("the robot asks for a user and a token".to_owned()),
                    _ => Err("the robot asks for more than user and token".to_owned()),
                }
            }
            _ => Err("the robot refused user and token".to_owned()),
        }
    }

    /// Learns what the server is capable of. What cannot be read says nothing.
    fn learn(&mut self, message: &Message) {
        if let Ok(map) = decode(&message.payload, &capability_map(), &self.limits) {
            self.cancels |= entry(&map, "RemoteCancelableCalls") == Some(&Value::Bool(true));
        }
    }
}

/// The text of an error message.
pub(crate) fn error_text(message: &Message, limits: &Limits) -> String {
    let text = match decode(&message.payload, &Signature::Dynamic, limits) {
        Ok(Value::Text(text)) => text,
        Ok(other) => other.to_string(),
        Err(_) => return "an error whose text cannot be read".to_owned(),
    };
    let mut text = text.trim().to_owned();
    text.truncate(text.floor_char_boundary(ERROR_TEXT));
    text
}

/// What a reply or signal brings, by its signature.
///
/// # Errors
/// Why it cannot be read.
pub(crate) fn payload(
    flags: u8,
    payload: &[u8],
    signature: &str,
    limits: &Limits,
) -> Result<Value, String> {
    let signature = match flags & DYNAMIC_PAYLOAD {
        0 => Signature::parse(signature, limits.depth)
            .map_err(|error| format!("its signature {signature:?} cannot be read: {error}"))?,
        _ => Signature::Dynamic,
    };
    decode(payload, &signature, limits).map_err(|error| format!("it cannot be read: {error}"))
}

fn capability_map() -> Signature {
    Signature::Map(Box::new((Signature::Text, Signature::Dynamic)))
}

fn entry<'v>(map: &'v Value, key: &str) -> Option<&'v Value> {
    let Value::Map(entries) = map else {
        return None;
    };
    let found = entries.iter().find(|(name, _)| name.as_text() == Some(key));
    found.map(|(_, value)| value)
}
