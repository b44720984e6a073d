//! Logging.

/// The target of this crate's log lines.
pub(crate) const LOG: &str = "serve";
