//! Topics of published messages: the scope of the publisher, directly followed by a path.

/// Whether a topic is the one of this scope, or below it. ZeroMQ compares only how topics begin, so that `/arm` also
/// gets what `/arm2` publishes.
///
/// ```
/// use ztl_core::topic::is_below;
///
/// assert!(is_below(b"/arm/", b"/arm") && is_below(b"/arm/left", b"/arm") && is_below(b"/arm", b"/arm"));
/// assert!(!is_below(b"/arm2/", b"/arm"));
/// assert!(is_below(b"/arm2/", b"") && is_below(b"/arm/left", b"/arm/"));
/// ```
#[must_use]
pub fn is_below(topic: &[u8], scope: &[u8]) -> bool {
    let Some(rest) = topic.strip_prefix(scope) else {
        return false;
    };
    rest.is_empty() || rest.starts_with(b"/") || scope.is_empty() || scope.ends_with(b"/")
}
