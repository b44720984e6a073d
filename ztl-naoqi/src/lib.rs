//! A client of NAOqi, the system of the robots NAO and Pepper, and of its messaging library libqi.

mod decode;
mod encode;
mod limits;
mod message;
mod meta_object;
mod signature;
mod value;

pub use decode::{DecodeError, decode};
pub use encode::Mismatch;
pub use limits::Limits;
pub use message::{Address, DYNAMIC_PAYLOAD, Frames, HEADER_LEN, Kind, Message, StreamError};
pub use meta_object::{ArgumentError, ArgumentErrorKind, Member, MetaObject, Method, Object};
pub use signature::{Names, Signature, SignatureError, Tuple};
pub use value::Value;

#[cfg(test)]
mod tests;
