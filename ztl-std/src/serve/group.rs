//! A program and all that it has started: its process group.

use std::collections::BTreeSet;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};

/// The groups of all programs that run: to be killed when there is no time for more.
#[derive(Debug, Clone, Default)]
pub struct Groups(Arc<Mutex<BTreeSet<i32>>>);

impl Groups {
    fn lock(&self) -> MutexGuard<'_, BTreeSet<i32>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Kills them all, at once (SIGKILL).
    pub fn kill(&self) {
        for group in self.lock().iter() {
            signal(*group, Signal::KILL);
        }
    }

    pub(super) fn add(&self, group: i32) {
        self.lock().insert(group);
    }

    /// The group's first process has ended: kills what is left of it, if that is wanted, and lets `reap`
    /// free its number, which may belong to others from then on.
    pub(super) fn end<T>(&self, group: i32, kill: bool, reap: impl FnOnce() -> T) -> T {
        let mut groups = self.lock();
        if kill {
            signal(group, Signal::KILL);
        }
        groups.remove(&group);
        reap()
    }
}

/// Sends a signal to each process of a group whose first process has not been reaped.
pub(super) fn signal(group: i32, signal: Signal) {
    // It may have ended by itself, or belong to another user by now: nobody is left to tell.
    if let Some(group) = Pid::from_raw(group) {
        let _ = kill_process_group(group, signal);
    }
}

/// Whether the group's first process has ended. It is not reaped, so the number stays its own.
///
/// # Errors
/// Somebody else has reaped it.
pub(super) fn has_ended(group: i32) -> io::Result<bool> {
    let Some(pid) = Pid::from_raw(group) else {
        return Ok(true);
    };
    let options = WaitIdOptions::EXITED | WaitIdOptions::NOWAIT | WaitIdOptions::NOHANG;
    Ok(waitid(WaitId::Pid(pid), options)?.is_some())
}

/// Whether any process of the group still runs; those that have ended and that nobody has reaped do not
/// count.
#[cfg(target_os = "linux")]
pub(super) fn is_alive(group: i32) -> bool {
    let Ok(processes) = std::fs::read_dir("/proc") else {
        return false;
    };
    processes.flatten().any(|process| {
        let name = process.file_name();
        let is_process = name
            .to_str()
            .is_some_and(|name| name.starts_with(|c: char| c.is_ascii_digit()));
        is_process
            && std::fs::read(process.path().join("stat"))
                .is_ok_and(|stat| group_of_living(&stat) == Some(group))
    })
}

/// That cannot be known here.
#[cfg(not(target_os = "linux"))]
pub(super) fn is_alive(_group: i32) -> bool {
    false
}

/// The group of a process by its `/proc/PID/stat`; `None` when it has ended.
#[cfg(target_os = "linux")]
fn group_of_living(stat: &[u8]) -> Option<i32> {
    // `7 (name) S 1 7 …`; the name may contain anything.
    let end = stat.iter().rposition(|byte| *byte == b')')?;
    let rest = std::str::from_utf8(stat.get(end + 1..)?).ok()?;
    let mut words = rest.split_ascii_whitespace();
    let state = words.next()?;
    let group = words.nth(1)?.parse().ok()?;
    (!matches!(state, "Z" | "X" | "x")).then_some(group)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn the_group_is_read_whatever_a_program_calls_itself() {
        assert_eq!(group_of_living(b"7 (a) Z 1 2 (b) S 1 42 7 0"), Some(42));
        assert_eq!(group_of_living(b"7 (sh) Z 1 42 7 0"), None);
        assert_eq!(group_of_living(b"7 (sh"), None);
        assert_eq!(group_of_living(b""), None);
    }
}
