//! Other agents that claim the robot's name.

use std::sync::{Arc, PoisonError};

use tracing::{error, warn};
use zenoh::Session;
use zenoh::query::Query;

use super::asked::Asked;
use super::{CLAIM, JoinEnd, Shared};
use crate::caller::Caller;
use crate::wire::{Verdict, from_hex};

impl Shared {
    /// Another agent was refused the name of this one.
    pub(super) fn on_claim(self: &Arc<Self>, query: Query) {
        let parameters = query.parameters().as_str();
        let other = parameters.strip_prefix("agent=").and_then(from_hex);
        let other = other.map_or_else(|| "of unknown id".to_owned(), |id| crate::wire::hex(&id));
        let robot = &self.config.name;
        if self.told.claims.may() {
            let refused = match self.config.identity {
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
        let infos = Caller::plain(session.clone()).infos(&agents, CLAIM);
        let Some(Some(rival)) = infos.into_iter().next() else {
            warn!(target: "fleet", "Agent {other} claims the name '{robot}', too, and does not answer.");
            return;
        };
        if (rival.since, &rival.agent) < (self.since, &self.id) {
            error!(target: "fleet", "Agent {other} has had the name '{robot}' for longer; this one leaves.");
            let ends = self.ends.lock().unwrap_or_else(PoisonError::into_inner);
            // The receiver is gone when this agent ends anyway.
            let _ = ends.send(JoinEnd::NameTaken { robot, by: other });
        } else {
            warn!(target: "fleet", "Agent {other} claims the name '{robot}', too; it has to leave.");
        }
    }
}
