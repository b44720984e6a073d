//! What the integration tests are made of: real processes, ports and files, each given back when
//! its guard is dropped.
//!
//! Whatever waits here waits for a condition, and for no longer than it says.

#[cfg(unix)]
mod board;
mod build;
mod fake;
#[cfg(unix)]
mod manager;
mod original;
mod peers;
mod ports;
mod process;
mod server;
#[cfg(unix)]
mod terminal;
mod tools;
mod zmtp;

#[cfg(unix)]
pub use board::{Board, Pin};
pub use build::{built, installed};
pub use fake::FakeServer;
#[cfg(unix)]
pub use manager::{Manager, verify_unit};
pub use original::{
    ABORTED, ACCEPTED, Answer, COMPLETED, FAILED, OriginalClient, REJECTED, original_tool, python,
};
pub use peers::{Peer, javascript_packages, python27};
pub use ports::reserve_port;
pub use process::{Ended, Process};
pub use server::{SCOPE, Server};
#[cfg(unix)]
pub use terminal::Terminal;
pub use tools::{Told, original_client, our_client, ours_named};
pub use zmtp::shake_hands;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// Longest time for what is not itself measured: the machine may be busy with other things.
pub const PATIENCE: Duration = Duration::from_secs(20);

/// Pause between two looks at a condition.
const LOOK_AGAIN: Duration = Duration::from_millis(10);

/// Looks again and again until there is something.
///
/// # Panics
/// When there is nothing within `limit`.
#[track_caller]
pub fn until<T>(what: &str, limit: Duration, mut look: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(start.elapsed() < limit, "not within {limit:?}: {what}");
        std::thread::sleep(LOOK_AGAIN);
    }
}

/// Repeats something until it takes less than `limit`: a busy machine delays some tries, a fault delays all.
///
/// # Panics
/// When no try within [`PATIENCE`] is quick enough.
#[track_caller]
pub fn in_time<T>(limit: Duration, mut attempt: impl FnMut() -> T) -> T {
    until(&format!("it takes less than {limit:?}"), PATIENCE, || {
        let start = Instant::now();
        let value = attempt();
        (start.elapsed() < limit).then_some(value)
    })
}

/// The `ztl` command that was built beside this test; or what `ZTL_COMMAND` says, a word in each line: a
/// released file, perhaps as on an old kernel.
#[track_caller]
pub fn ztl() -> Command {
    let told = std::env::var("ZTL_COMMAND").unwrap_or_default();
    let mut words = told.lines();
    match words.next() {
        Some(program) => {
            let mut command = Command::new(program);
            command.args(words);
            command
        }
        None => Command::new(built("ztl")),
    }
}

/// One of the examples that were built beside this test.
#[track_caller]
pub fn example(name: &str) -> Command {
    Command::new(built(&format!("examples/{name}")))
}

/// A directory of a test's own, removed with all that is in it when it is dropped.
#[derive(Debug)]
pub struct Scratch(PathBuf);

impl Scratch {
    /// An empty directory.
    pub fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("ztl-tests-{}-{number}", std::process::id());
        let path = std::env::temp_dir().join(name);
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).expect("a directory for the test");
        Self(path)
    }

    /// The path of something in it.
    pub fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        self.0.join(name)
    }
}

impl Default for Scratch {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
