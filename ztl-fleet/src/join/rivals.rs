//! Other agents that claim the robot's name.

use std::sync::mpsc::channel;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use tracing::{error, warn};
use zenoh::Session;
use zenoh::query::Query;

use super::asked::Asked;
use super::{CLAIM, JoinEnd, Shared};
use crate::caller::Caller;
use crate::session::{self, ZenohError};
use crate::wire::{Verdict, from_hex, millis};

/// How often an agent looks whether another one has its id.
pub(super) const AGAIN: Duration = Duration::from_secs(2);
/// How long another machine counts after it was heard.
const KEEP: Duration = Duration::from_secs(60);
/// What an agent says while another one counts.
pub(super) const COPY: &str = "another machine has answered as this robot within the last minute";

impl Shared {
    /// The boot of another agent with the same name and id that answers within `limit`: with a key, one that has this
    /// key.
    pub(super) fn others_with_id(&self, limit: Duration) -> Option<u32> {
        let (robot, session) = (&self.config.name, self.session.clone());
        let caller = match &self.config.identity {
            None => Caller::plain(session),
            Some(identity) => Caller::of_itself(session, robot, &identity.own),
        };
        let infos = caller.infos(&[(robot.clone(), self.id.clone())], limit);
        infos.into_iter().flatten().map(|info| info.boot).next()
    }

    /// Tells an agent that this one claimed its name, and was refused.
    pub(super) fn tell_refused(&self, session: &Session, other: &str) -> Result<(), ZenohError> {
        let (told, end) = channel();
        let on_end = move || {
            let _ = told.send(());
        };
        session::claim(session, &self.config.name, other, &self.id, CLAIM, on_end)?;
        let _ = end.recv();
        Ok(())
    }

    /// Tells that another agent has the same id, as a copy of an SD card. Both stay, so that both can be stopped.
    pub(super) fn look_for_copy(&self) {
        let robot = &self.config.name;
        let other = self.others_with_id(CLAIM);
        if other.is_none_or(|boot| boot == self.rules().agent.boot()) {
            return;
        }
        *self.copy.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
        if self.told.copies.may() {
            error!(target: "fleet", "Another agent has the name '{robot}' and this one's key or id: endpoints send nothing but ABORTs and 'stop' to both. Give each robot its own name, key and 'state' directory.");
        }
    }

    /// Whether another machine has answered as this robot lately. It may be silent by now, and move.
    pub(super) fn has_copy(&self) -> bool {
        let heard = self.copy.lock().unwrap_or_else(PoisonError::into_inner);
        heard.is_some_and(|heard| heard.elapsed() < KEEP)
    }

    /// Another agent was refused the name of this one.
    pub(super) fn on_claim(self: &Arc<Self>, query: Query) {
        let parameters = query.parameters().as_str();
        let Some(other) = parameters.strip_prefix("agent=").and_then(from_hex) else {
            let reason = "a claim names its agent, as ?agent=0123456789abcdef0123456789abcdef";
            return Asked::plain(query).reply(&Verdict::NotStarted(reason.to_owned()));
        };
        let other = crate::wire::hex(&other);
        let robot = &self.config.name;
        if self.told.claims.may() {
            let refused = match self.config.identity {
                _ if other == self.id => {
                    "with a copy of this one's directory or key, and was refused: nobody but its own server can stop what runs there"
                }
                None => "and was refused",
                Some(_) => "and an endpoint knows the key of one of the two and refuses the other",
            };
            warn!(target: "fleet", "Agent {other} claims the name '{robot}', too, {refused}.");
        }
        Asked::plain(query).reply(&Verdict::Answer(b"{}".to_vec()));
    }

    /// Another agent claims the name of this one, which belongs to a key.
    pub(super) fn warn_of_rival(&self, other: &str) {
        let robot = &self.config.name;
        if self.told.rivals.may() {
            warn!(target: "fleet", "Agent {other} claims the name '{robot}', too; endpoints serve the one whose key they know.");
        }
    }

    /// Another agent has the same name: of two networks that met. The older claim stays.
    pub(super) fn on_rival(&self, session: &Session, other: String) {
        let robot = self.config.name.clone();
        let agents = [(robot.clone(), other.clone())];
        let asked = Instant::now();
        let infos = Caller::plain(session.clone()).infos(&agents, CLAIM);
        let Some(Some(rival)) = infos.into_iter().next() else {
            warn!(target: "fleet", "Agent {other} claims the name '{robot}', too, and does not answer.");
            return;
        };
        // Half of the way is back. The time of day may be wrong on a robot.
        let held = self.claimed.elapsed().saturating_sub(asked.elapsed() / 2);
        if has_it_for_longer((rival.held_ms, &rival.agent), (millis(held), &self.id)) {
            error!(target: "fleet", "Agent {other} has had the name '{robot}' for longer; this one leaves.");
            let ends = self.ends.lock().unwrap_or_else(PoisonError::into_inner);
            // The receiver is gone when this agent ends anyway.
            let _ = ends.send(JoinEnd::NameTaken { robot, by: other });
        } else {
            warn!(target: "fleet", "Agent {other} claims the name '{robot}', too; it has to leave.");
        }
    }
}

/// Whether a rival has had the name for longer: milliseconds and id, of the rival and of this agent.
fn has_it_for_longer(rival: (u64, &str), own: (u64, &str)) -> bool {
    // Of two that began at the same time, one has to leave.
    (rival.0, own.1) > (own.0, rival.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_agents_the_one_that_has_the_name_for_longer_stays() {
        assert!(has_it_for_longer((2000, "b"), (1000, "a")));
        assert!(!has_it_for_longer((1000, "a"), (2000, "b")));
        assert!(has_it_for_longer((1000, "a"), (1000, "b")));
        assert!(!has_it_for_longer((1000, "b"), (1000, "a")));
    }
}
