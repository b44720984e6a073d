//! Connections after a cut of the network. TCP sends again what was not acknowledged after ever longer pauses: when
//! the network is back, a message may wait about as long again as the cut was. A new connection does not wait.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::engine::actions::topic;
use super::engine::rpc::CallError;
use super::engine::{Engine, Role};
use super::net::ConnectionId;
use super::net_error::NetError;
use super::unacknowledged;
use crate::xmlrpc::Value;

/// How long a cancel may be unacknowledged until its server is asked whether it can be reached, and how often it is asked.
const CANCEL: Duration = Duration::from_secs(1);

/// How long an open connection may bring nothing, where messages come all the time. By then, the goals of a silent action server
/// have ended as unknown.
const SILENCE: Duration = Duration::from_secs(15);

impl Engine {
    /// Looks for cancels of an action that are not acknowledged.
    pub(super) fn watch_cancels(&mut self, now: Instant, name: &Arc<str>) {
        let Some(action) = self.actions.get_mut(name) else {
            return;
        };
        match action.cancels_due {
            Some(at) if at <= now => action.cancels_due = None,
            Some(at) => return self.net.wake_by(at),
            None => return,
        }
        let cancels = self.publications.get(&topic(name, "cancel"));
        let all = cancels.map(|of| of.subscribers.clone()).unwrap_or_default();
        let mut table = unacknowledged::Table::default();
        for (id, node) in all {
            if self.net.has_unacknowledged(id, &mut table) {
                self.ask_for_cancels(now, name, id, &node);
                self.watch_cancels_later(now, name);
            }
        }
    }

    /// Closes the connection for cancels if the server answers. The server connects again, and then gets the cancels.
    fn ask_for_cancels(&mut self, now: Instant, name: &str, id: ConnectionId, server: &str) {
        let status = self.subscriptions.get(&topic(name, "status"));
        let Some(uri) = status.and_then(|of| of.uri_of(server)) else {
            return;
        };
        let (uri, params) = (uri.to_owned(), [self.name[..].into()]);
        let answered = move |engine: &mut Self, _: Instant, answer: Result<Value, CallError>| {
            let mut table = unacknowledged::Table::default();
            if answer.is_ok() && engine.net.has_unacknowledged(id, &mut table) {
                let peer = engine.net.peer(id);
                engine.net.discard(id, NetError::Stale { peer });
            }
        };
        self.rpc(now, &uri, "getPid", &params, CANCEL, Box::new(answered));
    }

    /// A cancel goes out.
    pub(super) fn watch_cancels_later(&mut self, now: Instant, name: &str) {
        if let Some(action) = self.actions.get_mut(name) {
            let at = *action.cancels_due.get_or_insert(now + CANCEL);
            self.net.wake_by(at);
        }
    }

    /// Replaces connections that bring nothing any more, although messages come all the time.
    pub(super) fn replace_silent(&mut self, now: Instant) {
        let paused = self.clock.is_paused(now);
        let mut silent = Vec::new();
        for subscription in self.subscriptions.values().filter(|of| of.is_steady()) {
            // While the simulated time stands still, so do the statuses of actions.
            let may_rest = paused && subscription.is_status();
            for id in subscription.open() {
                let Some(Role::Source(source)) = self.roles.get_mut(&id) else {
                    continue;
                };
                if may_rest {
                    source.heard = now;
                }
                match source.heard + SILENCE {
                    until if until <= now => silent.push(id),
                    until => self.net.wake_by(until),
                }
            }
        }
        for id in silent {
            self.net.close(id);
            if let Some(Role::Source(source)) = self.roles.remove(&id) {
                let silence = SILENCE.as_secs();
                self.on_source_lost(now, &source, format!("no message for {silence} s"));
            }
        }
    }
}
