//! Probes: whether servers are there, while the operator is asked.

use std::time::Duration;

use ztl_core::Instant;

use super::state::{Phase, Player};
use crate::server::ServerRequest;

/// Pause between two probes of a server.
const PAUSE: Duration = Duration::from_secs(3);

impl Player {
    /// When the next server is probed: only while a question is open. At other times, requests about tasks
    /// show the state of their servers.
    pub(super) fn probe_wake(&self) -> Option<Instant> {
        let waits = self.question.is_some() && !matches!(self.phase, Phase::Over);
        let next = self.probes.values().flatten().min();
        next.filter(|_| waits).copied()
    }

    /// Probes each server whose turn has come.
    pub(super) fn probe(&mut self, now: Instant) {
        if self.probe_wake().is_none_or(|wake| now < wake) {
            return;
        }
        let due = |next: &Option<Instant>| next.is_some_and(|next| next <= now);
        let servers = self.probes.iter().filter(|(_, next)| due(next));
        let servers: Vec<String> = servers.map(|(remote, _)| remote.clone()).collect();
        for remote in servers {
            self.send_to(now, remote.clone(), None, ServerRequest::Probe);
            self.probes.insert(remote, None);
        }
    }

    /// A probe was answered, or timed out.
    pub(super) fn on_probe(&mut self, now: Instant, remote: &str) {
        if let Some(next) = self.probes.get_mut(remote) {
            *next = Some(now + PAUSE);
        }
    }
}
