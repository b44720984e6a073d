//! How long a dispatcher holds replies and keeps tasks.

use core::time::Duration;

use crate::TaskId;

/// How long the reply to an INIT or ABORT is held at most: less than the 2 s timeout of the original's
/// client.
pub const HOLD: Duration = Duration::from_millis(1500);

/// How long a STATUS may ask its reply to be held, for the same reason.
pub const LONGEST_WAIT: Duration = Duration::from_millis(LONGEST_WAIT_MS);
pub(super) const LONGEST_WAIT_MS: u64 = 1999;

/// Default for [`Config::early`]: about one round trip.
pub const EARLY: Duration = Duration::from_millis(3);

/// Default for [`Config::keep`].
pub const KEEP: Duration = Duration::from_secs(3600);

/// How long the reply to an INIT is kept for deduplication, from the moment it is sent.
pub const KEEP_INIT: Duration = Duration::from_secs(60);

/// The settings of a dispatcher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Config {
    /// The first task id. Choose it at random (1 to 2^30), so that an id from before a restart does not name
    /// another task.
    pub first: TaskId,
    /// Changes with each start, so that clients detect a restart; reported by `$ztl`.
    pub boot: u32,
    /// How long a reply is held at most. Defaults to [`HOLD`].
    pub hold: Duration,
    /// How long the reply to an INIT waits for a final state if the client asks for it. Defaults to
    /// [`EARLY`].
    pub early: Duration,
    /// How long an ended task is kept, from its end, if [ended tasks expire](crate::memory::Memory::ENDS_EXPIRE). Defaults
    /// to [`KEEP`].
    pub keep: Duration,
}

impl Config {
    /// The default settings.
    #[must_use]
    pub const fn new(first: TaskId, boot: u32) -> Self {
        Self {
            first,
            boot,
            hold: HOLD,
            early: EARLY,
            keep: KEEP,
        }
    }
}
