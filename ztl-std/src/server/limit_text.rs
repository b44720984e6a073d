//! Limits as people write them, in files and options.

use super::limits::{Limits, MAX_MESSAGE};

/// The name of each limit in files and options, with a value as an example.
pub(crate) const LIMITS: [(&str, &str); 10] = [
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
    /// Sets a limit by its name in `LIMITS` to a value as people write it.
    ///
    /// # Errors
    /// What is wrong, and what is expected.
    pub fn choose(&mut self, name: &str, value: &str) -> Result<(), String> {
        let count = || match value.parse::<usize>() {
            Ok(count) if count > 0 => Ok(count),
            _ => Err(format!("'{value}' is not a whole number above 0")),
        };
        let time = || match humantime::parse_duration(value) {
            Ok(time) if !time.is_zero() => Ok(time),
            Ok(_) => Err(format!(
                "'{value}' is too short: expected more than no time, as 1s"
            )),
            Err(_) => Err(format!("'{value}' is not a duration; write 10min or 1h")),
        };
        let size = || match bytes(value) {
            Some(size) if (1..=MAX_MESSAGE).contains(&size) => Ok(size),
            _ => Err(format!(
                "'{value}' is not a size from 1 byte to 1 MiB, the most that clients take; write 64 KiB"
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
}

/// Reads a size such as `64 KiB`; returns bytes.
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
    use std::time::Duration;

    use super::*;

    #[test]
    fn every_limit_can_be_set_by_its_name() {
        let usual = Limits::default();
        for (name, example) in LIMITS {
            let mut limits = usual;
            limits.choose(name, example).expect(name);
            if name != "handshake" {
                assert_ne!(limits, usual, "{name}");
            }
            for wrong in ["", "0", "-1", "many", "0s"] {
                let mistake = limits.choose(name, wrong).expect_err(name);
                assert!(mistake.contains(wrong), "{name}: {mistake}");
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
}
