//! What an agent knows of its robot's server: it asks again and again.

use std::sync::PoisonError;
use std::time::Duration;

use tracing::{info, warn};
use ztl_core::Message;
use ztl_std::relay::NotRelayed;
use ztl_std::{Description, State};

use super::Shared;

/// Pause between two questions.
pub(super) const AGAIN: Duration = Duration::from_secs(1);
const LIMIT: Duration = Duration::from_secs(2);

/// The robot's server.
#[derive(Debug)]
pub(super) struct ServerState {
    /// Why it cannot be used.
    pub(super) problem: Option<String>,
    /// Whether there was no connection to it at the last question.
    pub(super) is_away: bool,
    /// Its answer to `probe`, if it is a server of this project.
    pub(super) probed: Option<String>,
    pub(super) boot: Option<u32>,
    pub(super) scopes: Vec<String>,
}

impl Default for ServerState {
    fn default() -> Self {
        Self {
            problem: Some("its server was not asked yet".to_owned()),
            is_away: false,
            probed: None,
            boot: None,
            scopes: Vec::new(),
        }
    }
}

impl Shared {
    /// Asks the server what it is.
    pub(super) fn probe(&self) {
        let answer = self.client.ask(None, b"$ztl;2;-1;probe", LIMIT);
        let mut server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        let before = server.problem.clone();
        server.is_away = answer == Err(NotRelayed::NotSent);
        match answer {
            Ok(answer) => {
                server.problem = None;
                let message = Message::parse(&answer).ok();
                let completed = State::Completed.code().to_string();
                let told = message.filter(|message| message.state == completed);
                server.probed = told.map(|message| message.payload.to_owned());
                let told = server.probed.clone();
                let told = told.and_then(|told| Description::read(told).ok());
                server.boot = told.as_ref().map(|told| told.boot);
                let scopes = told.into_iter().flat_map(|told| told.scopes.into_keys());
                server.scopes = scopes.filter(|scope| scope.starts_with('/')).collect();
            }
            Err(error) => {
                server.problem = Some(error.to_string());
                server.boot = None;
            }
        }
        if server.problem != before {
            match &server.problem {
                Some(problem) => warn!(target: "fleet", "Not ready: {problem}."),
                None => info!(target: "fleet", "Ready: the robot's server answers."),
            }
        }
    }

    /// Whether there is no connection to it, so that nothing can be sent soon.
    pub(super) fn server_is_away(&self) -> bool {
        let server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        server.is_away
    }

    /// The server's boot id, if it is known.
    pub(super) fn server_boot(&self) -> Option<u32> {
        let server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        server.boot
    }
}
