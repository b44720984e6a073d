//! What a server allows at most, so that no number of clients takes all of a small machine.

use std::time::Duration;

use ztl_core::dispatcher::Config;

use super::{MAX_MESSAGE, random};

/// Files that a process needs besides its connections: programs, ports, logs.
const OTHER_FILES: usize = 128;

/// Connections at a time, where the system allows as many.
const CONNECTIONS: usize = 4096;

/// What a [`TaskServer`](super::TaskServer) allows at most. What is too much is refused with the
/// reason, where there is somebody to be told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// Longest message, in bytes: a longer one ends its connection; clients of ours are told before they
    /// send one. Default and most: [`MAX_MESSAGE`], which is what clients take.
    pub message: usize,
    /// Tasks that have not ended. Default 10,000.
    pub running: usize,
    /// Tasks that are remembered, whether they run or have ended; for a new one the end that is
    /// longest ago is forgotten. Default 10,000.
    pub remembered: usize,
    /// Bytes of all goals and results together: of goals while their tasks run, of results afterwards, and of
    /// the answers by which an INIT is known again. The ends that are longest ago make room for new ones; a task
    /// is refused when everything else takes half of it. Default 64 MiB.
    pub memory: usize,
    /// How long a task is remembered, counted from its end. Default 1 h.
    pub keep: Duration,
    /// Requests whose answer is held: undecided INITs, ABORTs, STATUSes that wait. Default 10,000.
    pub held: usize,
    /// Clients whose last INIT is remembered, see `docs/protocol.md` 9.1. Default 10,000.
    pub clients: usize,
    /// Messages of one connection that wait to be read, and answers that wait to be taken: of a
    /// client that takes none, what is more is dropped. Default 256.
    pub queue: usize,
    /// Connections at a time, also those that have not shaken hands. One more is not let in, and
    /// tries again. Default 4096, or what the system's limit on open files leaves: a server for
    /// everybody then leaves it to the system, which takes no more when there are no files left. With a
    /// lower one, as with networks and keys, peers older than ZMTP 3.0 (libzmq 3) are not let in.
    pub connections: usize,
    /// How long a connection may take to shake hands. Default 5 s.
    pub handshake: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        let files = open_files().unwrap_or(CONNECTIONS + OTHER_FILES);
        Self {
            message: MAX_MESSAGE,
            running: 10_000,
            remembered: 10_000,
            memory: 64 << 20,
            keep: Config::new(random::FIRST, 0).keep,
            held: 10_000,
            clients: 10_000,
            queue: 256,
            connections: files.saturating_sub(OTHER_FILES).clamp(16, CONNECTIONS),
            handshake: Duration::from_secs(5),
        }
    }
}

/// What a person may choose about [`Limits`]: its name in files and options, and a value as an example.
pub const LIMITS: [(&str, &str); 10] = [
    ("message", "64 KiB"),
    ("running", "100"),
    ("remembered", "1000"),
    ("memory", "16 MiB"),
    ("keep", "10min"),
    ("held", "1000"),
    ("clients", "1000"),
    ("queue", "64"),
    ("connections", "64"),
    ("handshake", "5s"),
];

impl Limits {
    /// Sets one by its name in [`LIMITS`], to a value that a person has written.
    ///
    /// # Errors
    /// What is wrong, and what would be right.
    pub fn choose(&mut self, name: &str, value: &str) -> Result<(), String> {
        let count = || match value.parse::<usize>() {
            Ok(count) if count > 0 => Ok(count),
            _ => Err(format!("'{value}' is no whole number above 0")),
        };
        let time = || match humantime::parse_duration(value) {
            Ok(time) if !time.is_zero() => Ok(time),
            Ok(_) => Err("no time at all lets nothing happen; write 1s".to_owned()),
            Err(_) => Err(format!("'{value}' is no time; write 10min or 1h")),
        };
        let size = || match bytes(value) {
            Some(size) if (1..=MAX_MESSAGE).contains(&size) => Ok(size),
            _ => Err(format!(
                "'{value}' is no size from 1 byte to 1 MiB, which is what clients take; write 64 KiB"
            )),
        };
        let room = || match bytes(value) {
            Some(size) if size > 0 => Ok(size),
            _ => Err(format!("'{value}' is not a size; write 16 MiB")),
        };
        match name {
            "message" => self.message = size()?,
            "running" => self.running = count()?,
            "remembered" => self.remembered = count()?,
            "memory" => self.memory = room()?,
            "keep" => self.keep = time()?,
            "held" => self.held = count()?,
            "clients" => self.clients = count()?,
            "queue" => self.queue = count()?,
            "connections" => self.connections = count()?,
            "handshake" => self.handshake = time()?,
            _ => {
                let names = LIMITS.map(|(name, _)| name).join(", ");
                return Err(format!("there is no limit '{name}'; there are: {names}"));
            }
        }
        Ok(())
    }

    /// These, but with what a server that runs cannot change as in `present`; with the names of what differs
    /// there.
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

    /// The longest message that is taken, in bytes.
    pub(super) fn longest_message(&self) -> usize {
        self.message.min(MAX_MESSAGE)
    }

    /// Sets what ZeroMQ sees to, on a socket that is to be bound afterwards.
    pub(super) fn set(&self, socket: &zmq::Socket) -> Result<(), zmq::Error> {
        let message = self.longest_message();
        socket.set_maxmsgsize(i64::try_from(message).unwrap_or(i64::MAX))?;
        let queue = i32::try_from(self.queue.max(1)).unwrap_or(i32::MAX);
        socket.set_rcvhwm(queue)?;
        socket.set_sndhwm(queue)?;
        let handshake = i32::try_from(self.handshake.as_millis()).unwrap_or(i32::MAX);
        // ZeroMQ takes 0 for no limit at all.
        socket.set_handshake_ivl(handshake.max(1))
    }
}

/// How many files this process may open, where that can be read.
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

/// A size as a person writes it, in bytes: `64 KiB`.
#[must_use]
pub fn bytes(text: &str) -> Option<usize> {
    let split = text.find(|c: char| !c.is_ascii_digit())?;
    let (number, unit) = text.split_at(split);
    let unit = match unit.trim() {
        "B" | "bytes" | "byte" => 1,
        "KiB" | "kB" | "KB" | "K" => 1024,
        "MiB" => 1024 * 1024,
        "GiB" => 1024 * 1024 * 1024,
        _ => return None,
    };
    number.parse::<usize>().ok()?.checked_mul(unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_limit_is_chosen_by_its_name() {
        let usual = Limits::default();
        for (name, example) in LIMITS {
            let mut limits = usual;
            limits.choose(name, example).expect(name);
            if name != "handshake" {
                assert_ne!(limits, usual, "{name}");
            }
            for wrong in ["", "0", "-1", "many", "0s"] {
                let mistake = limits.choose(name, wrong).expect_err(name);
                let named = mistake.contains(wrong) || mistake.starts_with("no time at all");
                assert!(named, "{name}: {mistake}");
            }
        }
        let mut limits = usual;
        limits.choose("message", "64 KiB").unwrap();
        limits.choose("keep", "10min").unwrap();
        assert_eq!(
            (limits.message, limits.keep),
            (65_536, Duration::from_secs(600))
        );
        assert!(limits.choose("message", "2 MiB").is_err());
        let unknown = limits.choose("tasks", "3").unwrap_err();
        assert!(unknown.ends_with(
            "message, running, remembered, memory, keep, held, clients, queue, connections, handshake"
        ));
    }

    #[test]
    fn the_systems_limit_is_read_where_it_tells_one() {
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
        assert!((16..=CONNECTIONS).contains(&limits.connections));
    }
}
