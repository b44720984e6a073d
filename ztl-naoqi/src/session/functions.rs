//! Functions that every object has: their numbers and arguments, and what their answers bring.

use crate::connection::payload;
use crate::message::{Address, Message};
use crate::meta_object::MetaObject;
use crate::value::Value;

use super::CallError;

/// The number of the object that a service is.
pub(super) const MAIN: u32 = 1;

/// The function with which an object describes itself.
pub(super) const META_OBJECT: u32 = 2;
/// The function that begins a subscription.
pub(super) const REGISTER_EVENT: u32 = 0;
/// The function that ends it.
pub(super) const UNREGISTER_EVENT: u32 = 1;

/// A function of a service.
pub(super) const fn function(service: u32, action: u32) -> Address {
    Address {
        service,
        object: MAIN,
        action,
    }
}

/// The arguments that begin or end a subscription.
pub(super) fn registration(service: u32, signal: u32, handle: u64) -> Vec<u8> {
    let mut payload = Vec::with_capacity(16);
    payload.extend(service.to_le_bytes());
    payload.extend(signal.to_le_bytes());
    payload.extend(handle.to_le_bytes());
    payload
}

/// What an answer brings.
pub(super) fn value(
    answer: Result<Message, CallError>,
    signature: &str,
    limits: &crate::Limits,
) -> Result<Value, String> {
    let message = answer.map_err(|error| error.to_string())?;
    payload(message.flags, &message.payload, signature, limits)
}

/// The description that an answer brings.
pub(super) fn description(
    answer: Result<Message, CallError>,
    limits: &crate::Limits,
) -> Result<MetaObject, String> {
    let message = answer.map_err(|error| error.to_string())?;
    let value = crate::decode(&message.payload, &MetaObject::signature(), limits);
    let value = value.map_err(|error| format!("its description cannot be read: {error}"))?;
    MetaObject::from_value(&value).ok_or_else(|| "its description cannot be read".to_owned())
}
