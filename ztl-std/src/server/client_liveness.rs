//! Client liveness: aborts the tasks of clients that are gone.
//!
//! Silence counts from the moment by which the INIT has been answered, so that a client that dies before its first
//! STATUS is gone, too. The original's clients never identify themselves; an endpoint of a fleet that passes on their
//! INITs gives them the number 0.
//!
//! This rule of the protocol (12.7) is not in `ztl-core`, because it needs a list of tasks per client, which
//! no firmware uses.

use std::collections::HashMap;
use std::time::Duration;

use ztl_core::dispatcher::HOLD;
use ztl_core::envelope::ClientId;
use ztl_core::{Instant, TaskId};

/// How often clients are checked.
const CHECK: Duration = Duration::from_millis(250);

/// The clients whose tasks depend on them.
#[derive(Default)]
pub(super) struct ClientLiveness {
    clients: HashMap<ClientId, Client>,
    /// Next check; `None` without clients.
    next: Option<Instant>,
}

#[derive(Default)]
struct Client {
    /// When it was last heard. Until its INIT is answered, it waits and asks nothing.
    heard: Instant,
    /// Its tasks, and how long it may be silent for each.
    tasks: Vec<(TaskId, Duration)>,
}

impl ClientLiveness {
    /// Aborts a task when its client is silent for so long.
    pub(super) fn watch(&mut self, now: Instant, client: ClientId, id: TaskId, silence: Duration) {
        let client = self.clients.entry(client).or_default();
        client.heard = client.heard.max(now + HOLD);
        client.tasks.retain(|(known, _)| *known != id);
        client.tasks.push((id, silence));
        self.next.get_or_insert(now + CHECK);
    }

    /// A client sent a request.
    pub(super) fn on_heard(&mut self, now: Instant, client: ClientId, is_init: bool) {
        if let Some(client) = self.clients.get_mut(&client) {
            let held = if is_init { HOLD } else { Duration::ZERO };
            client.heard = client.heard.max(now + held);
        }
    }

    /// When [`gone`](Self::gone) is to be called next.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.next
    }

    /// The tasks whose clients are gone, each once; `runs` returns which tasks have not ended.
    pub(super) fn gone(&mut self, now: Instant, runs: impl Fn(TaskId) -> bool) -> Vec<TaskId> {
        let mut gone = Vec::new();
        if self.next.is_none_or(|next| now < next) {
            return gone;
        }
        self.clients.retain(|_, client| {
            let heard = client.heard;
            client.tasks.retain(|(id, silence)| {
                let silent = now.since(heard) >= *silence;
                let runs = runs(*id);
                if silent && runs {
                    gone.push(*id);
                }
                runs && !silent
            });
            !client.tasks.is_empty()
        });
        self.next = (!self.clients.is_empty()).then(|| now + CHECK);
        gone
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_is_gone_when_it_falls_silent_or_never_asks() {
        let at = Instant::from_millis;
        let [a, b] = [1, 2].map(|byte| ClientId([byte; 16]));
        let [one, two, three] = [1, 2, 3].map(|id| TaskId::new(id).unwrap());
        let mut clients = ClientLiveness::default();
        assert_eq!(clients.poll_timeout(), None);
        clients.watch(at(0), a, one, Duration::from_secs(1));
        clients.watch(at(0), a, two, Duration::from_secs(3));
        clients.watch(at(0), b, three, Duration::from_secs(1));
        assert_eq!(
            clients.gone(at(2499), |_| true),
            [],
            "the INIT is answered after 1500 ms"
        );
        clients.on_heard(at(2499), a, false);
        assert_eq!(clients.gone(at(2750), |_| true), [three]);
        // While another INIT is undecided, it asks nothing.
        clients.on_heard(at(3000), a, true);
        assert_eq!(clients.gone(at(5000), |_| true), []);
        clients.watch(at(4500), b, three, Duration::from_secs(3));
        clients.on_heard(at(5000), a, false);
        assert_eq!(clients.gone(at(5900), |_| true), []);
        assert_eq!(
            clients.gone(at(6000), |_| true),
            [],
            "the last check was just before"
        );
        assert_eq!(clients.gone(at(6150), |_| true), [one]);
        assert_eq!(
            clients.gone(at(8150), |id| id != two),
            [],
            "the task has ended"
        );
        assert_eq!(clients.gone(at(9000), |id| id != three), []);
        assert_eq!(clients.poll_timeout(), None, "no client is left");
    }
}
