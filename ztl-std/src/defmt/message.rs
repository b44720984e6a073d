//! A decoded message.

/// Severity of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// `defmt::trace!`
    Trace,
    /// `defmt::debug!`
    Debug,
    /// `defmt::info!`
    Info,
    /// `defmt::warn!`
    Warn,
    /// `defmt::error!`
    Error,
}

/// A message logged by firmware.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// `None` for `defmt::println!`.
    pub level: Option<Level>,
    /// Time by the firmware's clock, if its log has one.
    pub timestamp: Option<String>,
    /// The text.
    pub text: String,
    /// Source position such as `src/main.rs:42`, if the file has debug information.
    pub place: Option<String>,
}
