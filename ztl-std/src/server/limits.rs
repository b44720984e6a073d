//! Limits of a server, so that no number of clients can exhaust a small machine.

use std::time::Duration;

use ztl_core::dispatcher::Config;

use crate::random;

/// Longest message that clients and servers of this crate accept, in bytes.
pub const MAX_MESSAGE: usize = 1 << 20;

/// How long a server keeps a task after its end, unless [`Limits::keep`] says otherwise.
pub const KEEP: Duration = Config::new(random::FIRST, 0).keep;

/// Files that a process needs besides its connections: programs, ports, logs.
const OTHER_FILES: usize = 128;

/// Connections that are allowed even if the limit on open files leaves fewer.
const FEWEST: usize = 16;

/// Subscribers of a publisher that are allowed even if its server takes all other connections.
#[cfg(feature = "publish")]
const SUBSCRIBERS: usize = 64;

/// Most connections at a time, if the system allows as many.
const CONNECTIONS: usize = 4096;

/// Limits of a [`TaskServer`](super::TaskServer). What exceeds a limit is rejected with the reason, if there
/// is a client to be told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// Longest message in bytes. A longer one ends its connection; clients of this crate learn the limit and
    /// do not send one. Default and maximum: [`MAX_MESSAGE`].
    pub message: usize,
    /// Tasks that have not ended. Default 10,000.
    pub running: usize,
    /// Tasks in the task table, running or ended. A new task replaces the one that ended first. Default
    /// 10,000.
    pub remembered: usize,
    /// Bytes of goals (of running tasks), results (of ended ones) and answers to INITs (for a minute) together. New results replace the
    /// oldest ones. A task is rejected while everything but results takes half of it. Default 64 MiB.
    pub memory: usize,
    /// How long a task is kept after its end. Default 1 h.
    pub keep: Duration,
    /// Requests whose answer is held: undecided INITs, ABORTs, STATUSes that wait. Default 10,000.
    pub held: usize,
    /// Clients whose last INIT is kept, see `docs/protocol.md` 9.1. Default 10,000.
    pub clients: usize,
    /// Messages per connection that wait to be read, and answers that wait to be taken; further answers are
    /// dropped. Default 256.
    pub queue: usize,
    /// Connections at a time, including those that are still shaking hands. Further ones are refused and try
    /// again. Default 4096, and never more than the system's limit on open files leaves. With libzmq, a server open to
    /// everyone leaves the default to the system; with a lower limit, as with networks and keys, libzmq refuses peers
    /// older than ZMTP 3.0 (libzmq 3).
    pub connections: usize,
    /// Longest time for the handshake of a connection. Default 5 s.
    pub handshake: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            message: MAX_MESSAGE,
            running: 10_000,
            remembered: 10_000,
            memory: 64 << 20,
            keep: KEEP,
            held: 10_000,
            clients: 10_000,
            queue: 256,
            connections: connections_of(open_files()).min(CONNECTIONS),
            handshake: Duration::from_secs(5),
        }
    }
}

impl Limits {
    /// These limits, except that those which a running server cannot change are taken from `present`; also
    /// returns the names of the limits that differ there.
    #[must_use]
    pub fn for_running(self, present: &Self) -> (Self, Vec<&'static str>) {
        let fixed = [
            ("message", self.message == present.message),
            ("queue", self.queue == present.queue),
            ("connections", self.connections == present.connections),
            ("handshake", self.handshake == present.handshake),
        ];
        let differ = fixed.iter().filter(|(_, same)| !same);
        let differ = differ.map(|(name, _)| *name).collect();
        let kept = Self {
            message: present.message,
            queue: present.queue,
            connections: present.connections,
            handshake: present.handshake,
            ..self
        };
        (kept, differ)
    }

    /// The longest accepted message in bytes.
    pub(crate) fn longest_message(&self) -> usize {
        self.message.min(MAX_MESSAGE)
    }

    /// How many connections are possible, and a warning if the limit on open files leaves fewer than were chosen. Without
    /// a free file, neither a client nor a device could be connected.
    pub(super) fn possible_connections(&self) -> (usize, Option<String>) {
        self.with_files(open_files())
    }

    /// Limits of a publisher beside a server with these limits. Its subscribers have what the server leaves of the files.
    #[cfg(feature = "publish")]
    pub(super) fn of_publisher(&self) -> Self {
        self.beside_with_files(open_files())
    }

    #[cfg(feature = "publish")]
    fn beside_with_files(&self, files: Option<usize>) -> Self {
        let (taken, _) = self.with_files(files);
        let left = connections_of(files).saturating_sub(taken);
        Self {
            connections: left.clamp(SUBSCRIBERS, CONNECTIONS),
            ..Self::default()
        }
    }

    fn with_files(&self, files: Option<usize>) -> (usize, Option<String>) {
        let (wanted, most) = (self.connections, connections_of(files));
        let warning = files.filter(|_| wanted > most).map(|files| {
            let enough = wanted.saturating_add(OTHER_FILES);
            format!(
                "The limit of {wanted} connections is lowered to {most}: this process may open {files} files, and \
                 {OTHER_FILES} of them are for devices, programs and logs. Run `ulimit -n {enough}` first, or choose a \
                 lower limit."
            )
        });
        (wanted.min(most), warning)
    }

    /// Bytes of all requests that are being received and answers that are being sent.
    pub(super) const fn buffers(&self) -> usize {
        let part = self.memory / 4;
        // At least one message each way.
        if part > 4 * MAX_MESSAGE {
            part
        } else {
            4 * MAX_MESSAGE
        }
    }
}

/// How many connections this limit on open files leaves. A few are always possible.
fn connections_of(files: Option<usize>) -> usize {
    files.map_or(usize::MAX, |files| {
        files.saturating_sub(OTHER_FILES).max(FEWEST)
    })
}

/// How many files this process may open, if the system reports it.
fn open_files() -> Option<usize> {
    let limits = std::fs::read_to_string("/proc/self/limits").ok()?;
    soft_limit(&limits)
}

/// The second word behind the name: `Max open files  1024  524288  files`.
fn soft_limit(limits: &str) -> Option<usize> {
    let line = limits
        .lines()
        .find_map(|line| line.strip_prefix("Max open files"))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_on_open_files_is_read_from_proc() {
        let limits = "Limit  Soft Limit  Hard Limit  Units\n\
                      Max processes   31000  31000  processes\n\
                      Max open files            1024                 524288               files\n";
        assert_eq!(soft_limit(limits), Some(1024));
        assert_eq!(
            soft_limit("Max open files  unlimited  unlimited  files"),
            None
        );
        assert_eq!(soft_limit(""), None);
        let limits = Limits::default();
        assert!((FEWEST..=CONNECTIONS).contains(&limits.connections));
    }

    #[test]
    fn connections_never_exceed_what_the_limit_on_open_files_leaves() {
        let with = |connections| Limits {
            connections,
            ..Limits::default()
        };
        let limits = with(10_000);
        let (most, warning) = limits.with_files(Some(256));
        assert_eq!(most, 128);
        let warning = warning.expect("a warning");
        assert!(
            warning.contains("10000 connections is lowered to 128"),
            "{warning}"
        );
        assert!(warning.contains("`ulimit -n 10128`"), "{warning}");
        assert_eq!(limits.with_files(None), (10_000, None));
        assert_eq!(limits.with_files(Some(10)).0, FEWEST);
        assert_eq!(with(128).with_files(Some(256)), (128, None));
        #[cfg(feature = "publish")]
        for (connections, files, left) in [
            (128, Some(256), SUBSCRIBERS),
            (50, Some(256), 78),
            (4096, Some(20_000), CONNECTIONS),
            (4096, None, CONNECTIONS),
        ] {
            let publisher = with(connections).beside_with_files(files);
            assert_eq!(publisher.connections, left);
        }
    }
}
