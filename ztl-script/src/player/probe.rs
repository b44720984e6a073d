//! Whether servers are there, asked while the operator is.

use std::time::Duration;

use ztl_core::Instant;

use super::{Ask, Phase, Player};

/// Pause between two probes of a server.
const PAUSE: Duration = Duration::from_secs(3);

impl Player {
    /// When the next server is probed. Only while the operator is asked something: at other times requests
    /// about tasks tell how it is with their servers.
    pub(super) fn probe_wake(&self) -> Option<Instant> {
        let waits = self.question.is_some() && !matches!(self.phase, Phase::Over(_));
        let next = self.probes.values().flatten().min();
        next.filter(|_| waits).copied()
    }

    /// Probes each server whose turn it is.
    pub(super) fn probe(&mut self, now: Instant) {
        if self.probe_wake().is_none_or(|wake| now < wake) {
            return;
        }
        let due = |next: &Option<Instant>| next.is_some_and(|next| next <= now);
        let servers = self.probes.iter().filter(|(_, next)| due(next));
        let servers: Vec<String> = servers.map(|(remote, _)| remote.clone()).collect();
        for remote in servers {
            self.send_to(now, &remote, None, Ask::Probe);
            self.probes.insert(remote, None);
        }
    }

    /// A probe was answered, or not.
    pub(super) fn on_probe(&mut self, now: Instant, remote: &str) {
        if let Some(next) = self.probes.get_mut(remote) {
            *next = Some(now + PAUSE);
        }
    }
}
