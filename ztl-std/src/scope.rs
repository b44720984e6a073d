//! Which scopes are valid.

use ztl_core::Message;

/// Why a server cannot serve a scope; `None` if it can.
#[must_use]
pub fn cannot_be_served(scope: &str) -> Option<String> {
    let wrong = match scope {
        "" => "is empty",
        "$ztl" => "belongs to the protocol itself",
        scope if !Message::is_scope(scope) => "contains ';', so no client can reach it",
        _ => return None,
    };
    Some(format!("the scope '{scope}' {wrong}; write it as /lab"))
}

/// Why a client cannot use a scope; `None` if it can.
#[must_use]
pub fn cannot_be_asked(scope: &str) -> Option<String> {
    let wrong = "contains ';', which would end it; write it as /lab";
    (!Message::is_scope(scope)).then(|| format!("the scope '{scope}' {wrong}"))
}
