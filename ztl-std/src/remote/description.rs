//! What a server of ours says of itself.

#[cfg(feature = "config")]
mod parse;

use std::collections::BTreeMap;

use serde::{Serialize, Serializer};

use super::RemoteId;

/// The handlers of a scope and their components. Without components the server does not tell them; a
/// name `*` stands for every other.
pub type Offers = BTreeMap<String, Vec<String>>;

/// What a server of ours says of itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Description {
    /// Its version.
    pub version: String,
    /// Differs from start to start of the server.
    pub boot: u32,
    /// What each scope offers; an empty map where the server does not tell it.
    pub scopes: BTreeMap<String, Offers>,
    /// The tasks that have not ended, by id, with their scopes; `None` where the server does not tell them.
    #[serde(serialize_with = "as_map")]
    pub running: Option<Vec<(RemoteId, String)>>,
    /// How many more have not ended, but have no id or scope that can be read.
    #[serde(skip)]
    pub unread: usize,
}

/// Pairs as JSON has them.
fn as_map<S: Serializer>(
    pairs: &Option<Vec<(RemoteId, String)>>,
    to: S,
) -> Result<S::Ok, S::Error> {
    match pairs {
        Some(pairs) => to.collect_map(pairs.iter().map(|(id, scope)| (id.as_str(), scope))),
        None => to.serialize_none(),
    }
}
