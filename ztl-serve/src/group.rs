//! A program and all that it has started: its process group.

use std::collections::BTreeMap;
#[cfg(target_os = "linux")]
use std::ffi::OsStr;
use std::io;
#[cfg(target_os = "linux")]
use std::path::PathBuf;
use std::process::{Child, Command};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};
use serde::{Deserialize, Serialize};

use super::program::Launch;
use super::watchdog::{Charge, Watchdog};

/// What is known of all programs that run: to be killed when there is no time for more, and by whom
/// when nobody is left to do it.
#[derive(Debug, Clone, Default)]
pub struct Groups(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    /// By the group, the watchdog's number of it.
    groups: Mutex<BTreeMap<i32, u64>>,
    watchdog: Option<Watchdog>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Groups {
    /// With a watchdog: a process that stops all programs when this one is gone without having done so,
    /// killed or crashed. It is started by this command, which must do nothing but call
    /// [`watchdog`](super::watchdog), and restarted when it ends. No task's program starts before a watchdog has
    /// confirmed that it knows of it. Waits until the first one is ready, at most 5 s.
    ///
    /// # Errors
    /// When the system gives no more threads or files.
    pub fn watched(command: Command) -> io::Result<Self> {
        let watchdog = Watchdog::start(command)?;
        Ok(Self(Arc::new(Shared {
            groups: Mutex::default(),
            watchdog: Some(watchdog),
        })))
    }

    /// Kills them all, at once (SIGKILL).
    pub fn kill(&self) {
        for group in lock(&self.0.groups).keys() {
            signal(*group, Signal::KILL);
        }
    }

    /// Tells the watchdog of a program, which may be started once this calls `confirmed`. Returns the number by
    /// which it is [started](Self::start) or [withdrawn](Self::withdraw).
    pub(super) fn announce(
        &self,
        charge: Charge,
        confirmed: impl FnOnce() + Send + 'static,
    ) -> u64 {
        match &self.0.watchdog {
            Some(watchdog) => watchdog.announce(charge, confirmed),
            None => {
                confirmed();
                0
            }
        }
    }

    /// An announced program is not started, or has ended.
    pub(super) fn withdraw(&self, number: u64) {
        if let Some(watchdog) = &self.0.watchdog {
            watchdog.over(number);
        }
    }

    /// Starts an announced program, as [`Launch::spawn`] does.
    pub(super) fn start(&self, number: u64, launch: &Launch, heard: bool) -> Result<Child, String> {
        let started = launch.spawn(heard);
        match &started {
            Ok(child) => {
                let group = of(child);
                lock(&self.0.groups).insert(group, number);
                if let Some(watchdog) = &self.0.watchdog {
                    watchdog.runs(number, group);
                }
            }
            Err(_) => self.withdraw(number),
        }
        started
    }

    /// The group's first process has ended: kills what is left of it, if that is wanted, and lets `reap`
    /// free its number, which may belong to others from then on.
    pub(super) fn end<T>(&self, group: i32, kill: bool, reap: impl FnOnce() -> T) -> T {
        let mut groups = lock(&self.0.groups);
        if kill {
            signal(group, Signal::KILL);
        }
        let number = groups.remove(&group);
        let reaped = reap();
        drop(groups);
        if let Some(number) = number {
            self.withdraw(number);
        }
        reaped
    }
}

/// The group of a program that was started in one of its own.
pub(super) fn of(child: &Child) -> i32 {
    // The system has no greater numbers.
    i32::try_from(child.id()).unwrap_or(i32::MAX)
}

/// A group of somebody else's children, whose number may be another's by now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Group {
    pub(super) number: i32,
    /// When its first process began, as the system counts.
    began: Option<u64>,
}

impl Group {
    /// The group that this process leads.
    pub(super) fn of(leader: i32) -> Self {
        Self {
            number: leader,
            began: began(leader),
        }
    }

    /// Whether its first process is the same, or has ended.
    pub(super) fn is_same(self) -> bool {
        let now = began(self.number);
        now.is_none() || self.began.is_none() || now == self.began
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
    processes().any(|process| {
        let stat = std::fs::read(process.join("stat"));
        stat.is_ok_and(|stat| group_of_living(&stat) == Some(group))
    })
}

/// That cannot be known here.
#[cfg(not(target_os = "linux"))]
pub(super) fn is_alive(_group: i32) -> bool {
    false
}

/// The group of a process that has this in its environment.
#[cfg(target_os = "linux")]
pub(super) fn with_variable(name: &str, value: &str) -> Option<Group> {
    let wanted = format!("{name}={value}");
    let has_it = |process: &PathBuf| {
        let environment = std::fs::read(process.join("environ")).unwrap_or_default();
        let mut variables = environment.split(|byte| *byte == 0);
        variables.any(|variable| variable == wanted.as_bytes())
    };
    let process = processes().find(has_it)?;
    let stat = std::fs::read(process.join("stat")).ok()?;
    group_of_living(&stat).map(Group::of)
}

/// That cannot be known here.
#[cfg(not(target_os = "linux"))]
pub(super) fn with_variable(_name: &str, _value: &str) -> Option<Group> {
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

/// That cannot be known here.
#[cfg(not(target_os = "linux"))]
fn began(_process: i32) -> Option<u64> {
    None
}

/// The group of a process by its `/proc/PID/stat`; `None` when it has ended.
#[cfg(target_os = "linux")]
fn group_of_living(stat: &[u8]) -> Option<i32> {
    let mut words = words_of(stat)?;
    let state = words.next()?;
    let group = words.nth(1)?.parse().ok()?;
    (!matches!(state, "Z" | "X" | "x")).then_some(group)
}

/// What follows the name in `7 (name) S 1 7 …`; the name may contain anything.
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
    fn the_group_is_read_whatever_a_program_calls_itself() {
        assert_eq!(group_of_living(b"7 (a) Z 1 2 (b) S 1 42 7 0"), Some(42));
        assert_eq!(group_of_living(b"7 (sh) Z 1 42 7 0"), None);
        assert_eq!(group_of_living(b"7 (sh"), None);
        assert_eq!(group_of_living(b""), None);
    }
}
