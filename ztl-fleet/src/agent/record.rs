//! What an agent remembers of a client's last INIT.

use ztl_core::client::is_no_scope;
use ztl_core::dispatcher::{KEEP_INIT, NEVER_SEEN};
use ztl_core::envelope::ClientId;
use ztl_core::integer::Integer;
use ztl_core::{Instant, Message, State};

use super::{AgentEffect, Entry, HOLD, MOST_WAITERS, UNWRITTEN};
use crate::wire::{InitId, Verdict};

/// How far an INIT has come.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Stage {
    /// The server has it and has not answered.
    Forwarded,
    /// The server did not answer, and is asked for the outcome.
    Asking,
    /// The server's answer.
    Answered(String),
    /// Nothing was started.
    NotStarted(String),
    /// Nobody can tell.
    Unknown,
    /// Given up before it arrived.
    Void,
    /// It was not sent, and nothing tells a later agent so.
    Unwritten,
}

/// A client's last INIT.
#[derive(Debug)]
pub(super) struct Record {
    pub(super) number: u64,
    pub(super) hash: u64,
    scope: String,
    /// The server's boot id when the INIT was forwarded.
    server: Option<u32>,
    /// When it was forwarded; `None` if an earlier agent did that.
    pub(super) forwarded: Option<Instant>,
    pub(super) stage: Stage,
    /// Until when it may arrive or was decided, by the agent's clock.
    pub(super) valid_ms: u64,
    /// Queries that wait for the decision, and until when.
    pub(super) waiters: Vec<(u64, Instant)>,
}

impl Record {
    pub(super) fn new(
        number: u64,
        hash: u64,
        scope: &str,
        server: Option<u32>,
        stage: Stage,
    ) -> Self {
        Self {
            number,
            hash,
            scope: scope.to_owned(),
            server,
            forwarded: None,
            stage,
            valid_ms: 0,
            waiters: Vec::new(),
        }
    }

    pub(super) fn void(number: u64) -> Self {
        Self::new(number, 0, "", None, Stage::Void)
    }

    pub(super) const fn is_pending(&self) -> bool {
        matches!(self.stage, Stage::Forwarded | Stage::Asking)
    }

    pub(super) const fn is_decided(&self) -> bool {
        !self.is_pending() && !matches!(self.stage, Stage::Unknown)
    }

    /// Bytes that it takes.
    pub(super) fn bytes(&self) -> usize {
        let text = match &self.stage {
            Stage::Answered(text) | Stage::NotStarted(text) => text.len(),
            _ => 0,
        };
        200 + self.scope.len() + text
    }

    pub(super) fn verdict(&self) -> Verdict {
        match &self.stage {
            Stage::Answered(answer) => Verdict::Answer(answer.clone().into_bytes()),
            Stage::NotStarted(reason) => Verdict::NotStarted(reason.clone()),
            Stage::Void => Verdict::NotStarted("never seen".to_owned()),
            Stage::Unwritten => Verdict::Unknown(UNWRITTEN.to_owned()),
            Stage::Unknown => Verdict::Unknown("whether it was started".to_owned()),
            Stage::Forwarded | Stage::Asking => {
                Verdict::Unknown("it is not decided yet".to_owned())
            }
        }
    }

    /// Answers a query about it, now or when it is decided.
    pub(super) fn tell(&mut self, now: Instant, query: u64, id: InitId) -> Vec<AgentEffect> {
        if self.is_decided() {
            let verdict = self.verdict();
            return vec![AgentEffect::Reply { query, verdict }];
        }
        if !self.wait(now, query) {
            let verdict = self.verdict();
            return vec![AgentEffect::Reply { query, verdict }];
        }
        match self.stage {
            Stage::Unknown => {
                self.stage = Stage::Asking;
                vec![AgentEffect::AskServer(id)]
            }
            _ => Vec::new(),
        }
    }

    /// Lets a query wait, if there is room.
    pub(super) fn wait(&mut self, now: Instant, query: u64) -> bool {
        let has_room = self.waiters.len() < MOST_WAITERS;
        if has_room {
            self.waiters.push((query, now + HOLD));
        }
        has_room
    }

    /// Answers all queries that wait.
    pub(super) fn release(&mut self, verdict: &Verdict, effects: &mut Vec<AgentEffect>) {
        for (query, _) in self.waiters.drain(..) {
            let verdict = verdict.clone();
            effects.push(AgentEffect::Reply { query, verdict });
        }
    }

    /// Answers those that have waited long enough.
    pub(super) fn release_late(&mut self, now: Instant, effects: &mut Vec<AgentEffect>) {
        let verdict = self.verdict();
        self.waiters.retain(|(query, deadline)| {
            let waits = now < *deadline;
            if !waits {
                effects.push(AgentEffect::Reply {
                    query: *query,
                    verdict: verdict.clone(),
                });
            }
            waits
        });
    }

    /// What the server's answer to `outcome` says.
    pub(super) fn learn(&self, now: Instant, answer: &[u8]) -> Stage {
        let Ok(message) = Message::parse(answer) else {
            return Stage::Unknown;
        };
        let id = message.number().ok();
        if message.scope != "$ztl" || is_no_scope(State::Rejected, message.payload) {
            return Stage::Unknown;
        }
        if id == Some(Integer::ZERO) {
            let boot = message.payload.strip_prefix(NEVER_SEEN);
            let boot = boot.and_then(|boot| boot.parse().ok());
            // Another boot is another server, which cannot know, and a server forgets an INIT in time.
            let remembers = self
                .forwarded
                .is_some_and(|forwarded| now.since(forwarded) < KEEP_INIT);
            return match remembers && boot.is_some() && boot == self.server {
                true => Stage::NotStarted("the robot's server did not get it".to_owned()),
                false => Stage::Unknown,
            };
        }
        let Message {
            state, id, payload, ..
        } = message;
        Stage::Answered(format!("{};{state};{id};{payload}", self.scope))
    }

    /// The entry of its decision, if it has one.
    pub(super) fn decision(&self, id: InitId) -> Option<Entry> {
        match &self.stage {
            Stage::Answered(answer) => Some(Entry::Answered {
                id,
                answer: answer.clone(),
            }),
            Stage::NotStarted(reason) => Some(Entry::NotStarted {
                id,
                reason: reason.clone(),
            }),
            Stage::Void => Some(Entry::GivenUp(id)),
            Stage::Forwarded | Stage::Asking | Stage::Unknown | Stage::Unwritten => None,
        }
    }

    /// All its entries.
    pub(super) fn entries(&self, client: ClientId, entries: &mut Vec<Entry>) {
        let id = InitId {
            client,
            number: self.number,
        };
        if self.stage != Stage::Void {
            entries.push(Entry::Asked {
                id,
                hash: self.hash,
                scope: self.scope.clone(),
                server: self.server,
            });
        }
        entries.extend(self.decision(id));
    }
}
