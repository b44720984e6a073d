//! What the handlers of a scope offer to clients.

use std::collections::BTreeMap;

/// The handlers of a scope and their components. An empty list means that the server does not report the
/// components; the name `*` stands for every other name.
pub type Offers = BTreeMap<String, Vec<String>>;

/// Handlers and their components in YAML flow style: `{gripper: [finger]}`.
pub fn offered<'n, C>(handlers: impl IntoIterator<Item = (&'n str, C)>) -> String
where
    C: IntoIterator<Item = &'n str>,
{
    let handlers = handlers.into_iter().map(|(handler, components)| {
        let names: Vec<String> = components.into_iter().map(quoted).collect();
        format!("{}: [{}]", quoted(handler), names.join(", "))
    });
    format!("{{{}}}", handlers.collect::<Vec<_>>().join(", "))
}

/// A text in quotes, as YAML reads it.
pub(crate) fn quoted(text: &str) -> String {
    let mut bytes = Vec::new();
    ztl_core::repr::put_yaml(text, &mut |part: &[u8]| bytes.extend_from_slice(part));
    String::from_utf8_lossy(&bytes).into_owned()
}
