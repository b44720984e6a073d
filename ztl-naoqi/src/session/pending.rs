//! Answers that are awaited on a connection.

use super::{CallId, SubscriptionId};

/// What an answer is for.
#[derive(Debug, Clone)]
pub(super) enum Pending {
    /// Nothing.
    Ignored,
    DirectoryDescription,
    DirectoryServices,
    Resolved(String),
    Description(String),
    Call(CallId),
    /// The object that has the signal, and the signature in which it is returned.
    SignalObject(SubscriptionId, String),
    /// The subscription, and its handle.
    Registered(SubscriptionId, u64),
}
