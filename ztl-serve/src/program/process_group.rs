//! Process groups: a program and the processes that it has started.

#[cfg(target_os = "linux")]
use std::ffi::OsStr;
use std::io;
#[cfg(target_os = "linux")]
use std::path::PathBuf;
use std::process::Child;

use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};
use serde::{Deserialize, Serialize};

/// The group of a program that was started in a group of its own.
pub(crate) fn led_by(child: &Child) -> i32 {
    // The system has no greater numbers.
    i32::try_from(child.id()).unwrap_or(i32::MAX)
}

/// A group of another process's children, whose number may have been reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ProcessGroup {
    pub(crate) number: i32,
    /// When its first process began, in the system's clock ticks.
    began: Option<u64>,
}

impl ProcessGroup {
    /// The group that a process leads.
    pub(crate) fn of(leader: i32) -> Self {
        Self {
            number: leader,
            began: began(leader),
        }
    }

    /// Whether its first process is the same, or has ended.
    pub(crate) fn is_same(self) -> bool {
        let now = began(self.number);
        now.is_none() || self.began.is_none() || now == self.began
    }
}

/// Sends a signal to each process of a group whose first process has not been reaped.
pub(crate) fn signal(group: i32, signal: Signal) {
    // The group may have ended, or changed its user.
    if let Some(group) = Pid::from_raw(group) {
        let _ = kill_process_group(group, signal);
    }
}

/// Whether the group's first process has ended. Does not reap it, so that the number is not reused. An error means
/// that another part of this process has reaped it.
pub(crate) fn has_ended(group: i32) -> io::Result<bool> {
    let Some(pid) = Pid::from_raw(group) else {
        return Ok(true);
    };
    let options = WaitIdOptions::EXITED | WaitIdOptions::NOWAIT | WaitIdOptions::NOHANG;
    Ok(waitid(WaitId::Pid(pid), options)?.is_some())
}

/// Whether any process of the group runs. Zombies do not count.
#[cfg(target_os = "linux")]
pub(crate) fn is_alive(group: i32) -> bool {
    processes().any(|process| {
        let stat = std::fs::read(process.join("stat"));
        stat.is_ok_and(|stat| group_of_living(&stat) == Some(group))
    })
}

/// Unknown on this system.
#[cfg(not(target_os = "linux"))]
pub(crate) fn is_alive(_group: i32) -> bool {
    false
}

/// The group of a process with this variable in its environment.
#[cfg(target_os = "linux")]
pub(crate) fn with_variable(name: &str, value: &str) -> Option<ProcessGroup> {
    let wanted = format!("{name}={value}");
    let has_it = |process: &PathBuf| {
        let environment = std::fs::read(process.join("environ")).unwrap_or_default();
        let mut variables = environment.split(|byte| *byte == 0);
        variables.any(|variable| variable == wanted.as_bytes())
    };
    let process = processes().find(has_it)?;
    let stat = std::fs::read(process.join("stat")).ok()?;
    group_of_living(&stat).map(ProcessGroup::of)
}

/// Unknown on this system.
#[cfg(not(target_os = "linux"))]
pub(crate) fn with_variable(_name: &str, _value: &str) -> Option<ProcessGroup> {
    None
}

/// The directories of all processes.
#[cfg(target_os = "linux")]
fn processes() -> impl Iterator<Item = PathBuf> {
    let is_process = |path: &PathBuf| {
        let name = path.file_name().and_then(OsStr::to_str);
        name.is_some_and(|name| name.starts_with(|c: char| c.is_ascii_digit()))
    };
    let all = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    all.map(|entry| entry.path()).filter(is_process)
}

/// When a process began.
#[cfg(target_os = "linux")]
fn began(process: i32) -> Option<u64> {
    let stat = std::fs::read(format!("/proc/{process}/stat")).ok()?;
    words_of(&stat)?.nth(19)?.parse().ok()
}

/// Unknown on this system.
#[cfg(not(target_os = "linux"))]
fn began(_process: i32) -> Option<u64> {
    None
}

/// The group of a process by its `/proc/PID/stat`; `None` if the process has ended.
#[cfg(target_os = "linux")]
fn group_of_living(stat: &[u8]) -> Option<i32> {
    let mut words = words_of(stat)?;
    let state = words.next()?;
    let group = words.nth(1)?.parse().ok()?;
    (!matches!(state, "Z" | "X" | "x")).then_some(group)
}

/// The words after the name in `7 (name) S 1 7 …`. The name may contain anything.
#[cfg(target_os = "linux")]
fn words_of(stat: &[u8]) -> Option<impl Iterator<Item = &str>> {
    let end = stat.iter().rposition(|byte| *byte == b')')?;
    let rest = std::str::from_utf8(stat.get(end + 1..)?).ok()?;
    Some(rest.split_ascii_whitespace())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn the_group_is_read_after_any_name() {
        assert_eq!(group_of_living(b"7 (a) Z 1 2 (b) S 1 42 7 0"), Some(42));
        assert_eq!(group_of_living(b"7 (sh) Z 1 42 7 0"), None);
        assert_eq!(group_of_living(b"7 (sh"), None);
        assert_eq!(group_of_living(b""), None);
    }
}
