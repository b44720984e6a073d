//! Starts threads.

/// Runs this on a thread of its own.
///
/// # Errors
/// The system has no more threads.
pub(super) fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), String> {
    let thread = std::thread::Builder::new().name(name.to_owned());
    let spawned = thread.spawn(work).map(drop);
    spawned.map_err(|error| format!("cannot start a thread: {error}"))
}
