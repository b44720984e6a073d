//! Values that JSON represents completely.

use ztl_pickle::{Kind, Value};

/// Deepest nesting; `serde_json` reads 127 levels.
const DEPTH: usize = 100;

/// Whether the JSON of a value tells all of it, so that reading it gives an equal value. The caller has checked that
/// the JSON is short: this visits shared parts each time, as the JSON has them.
pub(crate) fn is_plain(value: Value<'_>) -> bool {
    is_plain_to(value, DEPTH)
}

fn is_plain_to(value: Value<'_>, depth: usize) -> bool {
    let Some(depth) = depth.checked_sub(1) else {
        return false;
    };
    match value.kind() {
        Kind::None | Kind::Bool(_) | Kind::Int(_) | Kind::Str(_) => true,
        Kind::Float(value) => value.is_finite(),
        Kind::List(items) => items.into_iter().all(|item| is_plain_to(item, depth)),
        Kind::Dict(entries) => entries
            .into_iter()
            .all(|(key, value)| key.as_str().is_some() && is_plain_to(value, depth)),
        _ => false,
    }
}
