//! The parts of the integration tests: real processes, ports and files. Each is released when it is dropped.
//!
//! Every wait here is for a condition and has a limit.

mod board;
mod build;
mod debugged_board;
mod fake;
mod keys;
mod original;
mod peers;
mod ports;
mod process;
mod random;
mod remote;
mod server;
mod service_manager;
mod terminal;
mod tools;
mod zmtp;

pub use board::{Board, Pin};
pub use build::{built, installed};
pub use debugged_board::{DebuggedBoard, FLASH, FlashImage, microbit};
pub use fake::FakeServer;
pub use keys::Keys;
pub use original::{
    ABORTED, ACCEPTED, Answer, COMPLETED, FAILED, OriginalClient, REJECTED, original_tool, python,
    run_python,
};
pub use peers::{Peer, javascript_packages, node_packages, python27};
pub use ports::reserve_port;
pub use process::{Ended, Process, process_status, processor_time, signal};
pub use random::{Random, number, seed};
pub use remote::{LIMIT, connect, connect_to, end, outcome, port_of, serve, start, status};
pub use server::{SCOPE, Server, gateway, simulated_gripper};
pub use service_manager::{ServiceManager, verify_unit};
pub use terminal::Terminal;
pub use tools::{ClientOutput, original_client, our_client, our_client_at, ours_named};
pub use zmtp::shake_hands;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Limit for waits that are not themselves measured. The machine may be busy.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Pause between two checks of a condition.
const LOOK_AGAIN: Duration = Duration::from_millis(10);

/// Calls `look` until it returns something.
///
/// # Panics
/// When it returns nothing within `limit`.
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

/// Repeats `attempt` until it takes less than `limit`. A busy machine delays some attempts, a defect delays all.
///
/// # Panics
/// When no attempt within [`PATIENCE`] is quick enough.
#[track_caller]
pub fn in_time<T>(limit: Duration, mut attempt: impl FnMut() -> T) -> T {
    until(&format!("it takes less than {limit:?}"), PATIENCE, || {
        let start = Instant::now();
        let value = attempt();
        (start.elapsed() < limit).then_some(value)
    })
}

/// The `ztl` command that was built beside this test, or the command line in `ZTL_COMMAND`, one word per line: a
/// released program, perhaps on an emulated old kernel.
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

/// Held by a test that keeps a core busy, so that a test binary runs one of these at a time.
pub fn busy() -> MutexGuard<'static, ()> {
    static BUSY: Mutex<()> = Mutex::new(());
    BUSY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A temporary directory, removed with its contents when it is dropped.
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

    /// The path of a file in it.
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
