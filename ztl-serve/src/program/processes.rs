//! The processes of all programs. A watchdog knows of each before it starts.

use std::io;
use std::process::{Child, ChildStderr, ChildStdout, Command, ExitStatus};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustix::process::Signal;

use super::launch::Launch;
use super::process_group as group;
use super::watchdog::Watchdog;
use super::watchdog::protocol::Charge;

/// All processes that programs run in, and the watchdog that stops them when this process is killed.
#[derive(Debug, Clone, Default)]
pub struct ProcessRegistry(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    /// Process groups that run.
    groups: Mutex<Vec<i32>>,
    watchdog: Option<Watchdog>,
}

impl ProcessRegistry {
    /// Starts a watchdog: a process that stops all programs when this process is killed or crashes.
    ///
    /// `command` starts it and must only call [`watchdog`](crate::watchdog). The watchdog is restarted when it
    /// ends. No task's program starts before a watchdog has confirmed that it knows of it. Waits until the
    /// first one is ready, at most 5 s.
    ///
    /// # Errors
    /// If the system has no more threads or files.
    pub fn watched(command: Command) -> io::Result<Self> {
        let watchdog = Watchdog::start(command)?;
        Ok(Self(Arc::new(Shared {
            groups: Mutex::default(),
            watchdog: Some(watchdog),
        })))
    }

    /// A function that kills all processes at once (SIGKILL). It does not keep the watchdog running, which closes
    /// with the last copy of this registry and the last program.
    pub fn killer(&self) -> impl Fn() + Send + 'static {
        let shared = Arc::downgrade(&self.0);
        move || {
            if let Some(shared) = shared.upgrade() {
                for group in Self(shared).groups().iter() {
                    group::signal(*group, Signal::KILL);
                }
            }
        }
    }

    /// Announces a program to the watchdog. The program may start once `confirmed` is called.
    pub(crate) fn announce(
        &self,
        charge: Charge,
        confirmed: impl FnOnce() + Send + 'static,
    ) -> Announcement {
        let number = match &self.0.watchdog {
            Some(watchdog) => watchdog.announce(charge, confirmed),
            None => {
                confirmed();
                0
            }
        };
        Announcement {
            registry: self.clone(),
            number,
        }
    }

    fn groups(&self) -> MutexGuard<'_, Vec<i32>> {
        self.0.groups.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A program that was announced to the watchdog. Dropping it removes it from the watchdog.
pub(crate) struct Announcement {
    registry: ProcessRegistry,
    number: u64,
}

impl Announcement {
    /// Starts the program, as [`Launch::spawn`] does.
    pub(crate) fn start(self, launch: &Launch, piped: bool) -> Result<Process, String> {
        let child = launch.spawn(piped)?;
        let group = group::led_by(&child);
        self.registry.groups().push(group);
        if let Some(watchdog) = &self.registry.0.watchdog {
            watchdog.runs(self.number, group);
        }
        Ok(Process {
            child,
            group,
            announcement: self,
            reaped: false,
        })
    }
}

impl Drop for Announcement {
    fn drop(&mut self) {
        if let Some(watchdog) = &self.registry.0.watchdog {
            watchdog.over(self.number);
        }
    }
}

/// A program in a process group of its own. Dropped, the group is killed.
pub(crate) struct Process {
    child: Child,
    group: i32,
    announcement: Announcement,
    reaped: bool,
}

impl Process {
    pub(crate) fn take_pipes(&mut self) -> (Option<ChildStdout>, Option<ChildStderr>) {
        (self.child.stdout.take(), self.child.stderr.take())
    }

    /// Sends a signal to the whole group.
    pub(crate) fn signal(&self, signal: Signal) {
        group::signal(self.group, signal);
    }

    /// Whether the first process has ended. True if another part of this process has reaped it.
    pub(crate) fn has_ended(&self) -> bool {
        group::has_ended(self.group).unwrap_or(true)
    }

    /// Whether any process of the group still runs.
    pub(crate) fn is_alive(&self) -> bool {
        group::is_alive(self.group)
    }

    /// Reaps the first process, which has ended or is killed. `kill`: kills the whole group first.
    pub(crate) fn reap(&mut self, kill: bool) -> io::Result<ExitStatus> {
        self.reaped = true;
        // Once reaped, the group's number may be reused, so holding the lock prevents signals in between.
        let mut groups = self.announcement.registry.groups();
        if kill {
            group::signal(self.group, Signal::KILL);
        }
        groups.retain(|group| *group != self.group);
        self.child.wait()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if !self.reaped {
            let _ = self.reap(true);
        }
    }
}
