//! A client of NAOqi, the system of the robots NAO and Pepper, and of its messaging library libqi.
//!
//! [`Session`] is a state machine without I/O; [`Client`] runs one on a thread. [`Limits`] bound the
//! memory that a robot, or another process in its place, can occupy.
//!
//! | a call ends as | what has happened |
//! |---|---|
//! | `Ok` | the method has returned |
//! | [`CallError::NotSent`], [`CallError::Arguments`] | nothing |
//! | [`CallError::Failed`] | the method has failed, with the exception's text |
//! | [`CallError::Canceled`] | it was cancelled, or not sent yet |
//! | [`CallError::Unknown`] | the service, its process or the robot was lost while the call was under way |
//! | [`CallError::Unreadable`] | the method has returned something that cannot be read |
//!
//! A robot that encrypts its connections (`tcps://`) cannot be reached yet.
//!
//! ```no_run
//! use std::time::Duration;
//! use ztl_naoqi::{Call, Client, Endpoint, Limits, Options, Value};
//!
//! let client = Client::start(Options {
//!     directory: Endpoint::parse("tcp://nao.local:9559")?,
//!     credentials: None,
//!     limits: Limits::default(),
//! }, |_event| {})?;
//! let hello = Call::new("ALTextToSpeech", "say", vec![Value::Text("hello".into())]);
//! client.call_and_wait(hello, Duration::from_secs(5))?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod arguments;
mod client;
mod connection;
mod decode;
mod description;
mod encode;
mod endpoint;
mod limits;
mod message;
mod meta_object;
mod session;
mod signature;
mod table;
mod value;

pub use arguments::{ArgumentError, ArgumentErrorKind};
pub use client::{CallHandle, Client, SubscriptionHandle};
pub use connection::Credentials;
pub use decode::{DecodeError, decode};
pub use encode::Mismatch;
pub use endpoint::Endpoint;
pub use limits::Limits;
pub use message::{Address, DYNAMIC_PAYLOAD, Frames, HEADER_LEN, Kind, Message, StreamError};
pub use meta_object::{Member, MetaObject, Method, Object};
pub use session::{
    Action, Call, CallError, CallId, Cancel, Event, LinkId, Options, Session, SignalOf,
    SubscriptionId,
};
pub use signature::{Names, Signature, SignatureError, Tuple};
pub use value::Value;

#[cfg(test)]
mod tests;
