//! The rules of an agent, without I/O: which INIT may act, and what is answered to one that was seen before.
//!
//! An INIT acts only in the boot and before the time that it names, and is written to the journal before it is forwarded. So a
//! copy that was held up, repeated or recorded never acts, also after a restart. STATUS and ABORT may be repeated; they do not
//! pass through here.
//!
//! What the journal does not hold is neither done nor promised: an INIT that cannot be written is not forwarded, and answered
//! *not started* only if the journal tells the next agent that it lacks entries ([`Entry::Lacks`]). That one lets nothing act
//! until all of them would have been forgotten.
//!
//! *Inputs*: [`handle_init`](Agent::handle_init), [`handle_outcome`](Agent::handle_outcome),
//! [`handle_server`](Agent::handle_server), [`handle_server_outcome`](Agent::handle_server_outcome),
//! [`handle_timeout`](Agent::handle_timeout), [`handle_unwritten`](Agent::handle_unwritten). Each returns [`AgentEffect`]s, to be carried out in this order.

mod record;

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use ztl_core::Instant;
use ztl_core::Message;
use ztl_core::envelope::ClientId;

use crate::wire::{ANOTHER_INIT, InitId, InitRules, LONGEST_VALID_MS, Verdict, checksum};
use record::{Record, Stage};

/// How long a decided INIT is remembered after its validity.
const KEEP_MS: u64 = 60_000;
/// How long a query waits for the decision about its INIT.
const HOLD: Duration = Duration::from_millis(1900);
/// Most clients whose last INIT is remembered.
const MOST_CLIENTS: usize = 10_000;
/// Most bytes of remembered answers.
const MOST_BYTES: usize = 64 << 20;
/// Most queries that wait for the same INIT.
const MOST_WAITERS: usize = 8;

/// Most earlier boots that are known.
const MOST_BOOTS: usize = 16;

const GIVEN_UP: &str = "this INIT was given up by its client";
const FULL: &str = "too many clients at a time, try again in a minute";
const UNWRITTEN: &str = "the journal of the robot's agent cannot be written";

/// What the shell has to do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AgentEffect {
    /// Answer a query.
    Reply {
        /// The query.
        query: u64,
        /// The answer.
        verdict: Verdict,
    },
    /// Write to the journal before anything that follows; if that fails, call [`Agent::handle_unwritten`].
    Record(Entry),
    /// Send an INIT to the server, then call [`Agent::handle_server`].
    Forward {
        /// Which INIT.
        id: InitId,
        /// Its body.
        body: Vec<u8>,
        /// When it must have been sent, by the agent's clock in milliseconds.
        until_ms: u64,
    },
    /// Ask the server for the outcome of an INIT, then call [`Agent::handle_server_outcome`].
    AskServer(InitId),
}

/// An entry of the journal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Entry {
    /// The agent started with this boot id; what follows belongs to it.
    Boot(u32),
    /// An INIT is about to be forwarded.
    Asked {
        /// Which INIT.
        id: InitId,
        /// Checksum of its body.
        hash: u64,
        /// Its scope.
        scope: String,
        /// The server's boot id, if it is known.
        server: Option<u32>,
    },
    /// The server answered it.
    Answered {
        /// Which INIT.
        id: InitId,
        /// The body of the answer.
        answer: String,
    },
    /// It was not started, for this reason.
    NotStarted {
        /// Which INIT.
        id: InitId,
        /// Why.
        reason: String,
    },
    /// Its client gave it up before it arrived, or it was refused.
    GivenUp(InitId),
    /// Entries could not be written: some INIT may have been answered *not started* that is not here.
    Lacks,
    /// What it lacked would have been forgotten.
    Whole,
}

/// What the server did with an INIT.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServerSaid {
    /// It answered.
    Answer(Vec<u8>),
    /// It was never sent, for this reason.
    NotSent(String),
    /// It was sent, and not answered.
    Silence,
}

/// The agent's rules.
#[derive(Debug)]
pub struct Agent {
    boot: u32,
    /// Boots whose INITs are all in the journal.
    known_boots: Vec<u32>,
    /// Until when nothing acts, since the journal lacks entries.
    lacks_until: Option<Instant>,
    records: BTreeMap<ClientId, Record>,
    bytes: usize,
}

impl Agent {
    /// An agent with a new boot id, which must not be 0, and what an earlier one wrote into its journal. `complete` tells that
    /// nothing can be missing there: the machine was not restarted since.
    #[must_use]
    pub fn new(now: Instant, boot: u32, journal: &[Entry], complete: bool) -> Self {
        let mut agent = Self {
            boot,
            known_boots: Vec::new(),
            lacks_until: None,
            records: BTreeMap::new(),
            bytes: 0,
        };
        for entry in journal {
            match entry {
                Entry::Boot(boot) if complete => agent.known_boots.push(*boot),
                Entry::Boot(_) => {}
                Entry::Asked {
                    id,
                    hash,
                    scope,
                    server,
                } => {
                    let record = Record::new(id.number, *hash, scope, *server, Stage::Unknown);
                    agent.put(now, id.client, record);
                }
                Entry::Answered { id, answer } => {
                    agent.settle(now, *id, Stage::Answered(answer.clone()));
                }
                Entry::NotStarted { id, reason } => {
                    agent.settle(now, *id, Stage::NotStarted(reason.clone()));
                }
                Entry::GivenUp(id) => agent.put(now, id.client, Record::void(id.number)),
                Entry::Lacks => agent.lacks_until = Some(now + Duration::from_millis(KEEP_MS)),
                Entry::Whole => agent.lacks_until = None,
            }
        }
        let spare = agent.known_boots.len().saturating_sub(MOST_BOOTS);
        agent.known_boots.drain(..spare);
        agent
    }

    /// This boot's id.
    #[must_use]
    pub const fn boot(&self) -> u32 {
        self.boot
    }

    /// What a new journal has to hold.
    #[must_use]
    pub fn entries(&self) -> Vec<Entry> {
        let boots = self.known_boots.iter().chain([&self.boot]);
        let mut entries: Vec<Entry> = boots.map(|boot| Entry::Boot(*boot)).collect();
        for (client, record) in &self.records {
            record.entries(*client, &mut entries);
        }
        entries.extend(self.lacks_until.map(|_| Entry::Lacks));
        entries
    }

    /// An INIT arrives by a query. `server` is the boot id of the robot's server, if it is known.
    pub fn handle_init(
        &mut self,
        now: Instant,
        query: u64,
        rules: InitRules,
        body: &[u8],
        server: Option<u32>,
    ) -> Vec<AgentEffect> {
        self.forget(now);
        let id = rules.id;
        let reply = |verdict| vec![AgentEffect::Reply { query, verdict }];
        let hash = checksum(body);
        if let Some(record) = self.records.get_mut(&id.client)
            && record.number >= id.number
        {
            if record.stage == Stage::Unwritten {
                return reply(record.verdict());
            }
            if record.number > id.number || record.stage == Stage::Void {
                return reply(Verdict::NotStarted(GIVEN_UP.to_owned()));
            }
            if record.hash != hash {
                return reply(Verdict::NotStarted(ANOTHER_INIT.to_owned()));
            }
            return record.tell(now, query, id);
        }
        let Ok(message) = Message::parse(body) else {
            return reply(Verdict::NotStarted("this is not a request".to_owned()));
        };
        let clock = now.as_millis();
        let is_fresh = rules.boot == self.boot && rules.until_ms >= clock;
        if !is_fresh {
            return reply(self.stale(now, &rules));
        }
        if self.is_full(id.client) || self.bytes >= MOST_BYTES {
            // It is not remembered, so that a copy of it may act.
            return reply(Verdict::Unknown(FULL.to_owned()));
        }
        if rules.until_ms > clock.saturating_add(LONGEST_VALID_MS) {
            // A copy of it could come when it is not too far ahead any more.
            let reason = format!(
                "'until' is {} ms ahead of the agent's clock, at most {LONGEST_VALID_MS} ms are allowed",
                rules.until_ms - clock
            );
            return self.refuse(now, query, id, reason);
        }
        if let Some(until) = self.lacks_until.filter(|until| now < *until) {
            let seconds = until.since(now).as_secs() + 1;
            let reason = format!(
                "the journal of the robot's agent could not be written before its restart, try again in {seconds} s"
            );
            return self.refuse(now, query, id, reason);
        }
        let scope = message.scope.to_owned();
        let mut record = Record::new(id.number, hash, &scope, server, Stage::Forwarded);
        record.valid_ms = rules.until_ms;
        record.forwarded = Some(now);
        record.wait(now, query);
        let mut effects = self.replace(now, id.client, record);
        effects.push(AgentEffect::Record(Entry::Asked {
            id,
            hash,
            scope,
            server,
        }));
        let body = body.to_vec();
        let until_ms = rules.until_ms;
        effects.push(AgentEffect::Forward { id, body, until_ms });
        effects
    }

    /// A query asks what became of an INIT. If it never arrived, it is refused from now on.
    pub fn handle_outcome(
        &mut self,
        now: Instant,
        query: u64,
        rules: InitRules,
    ) -> Vec<AgentEffect> {
        self.forget(now);
        let id = rules.id;
        let reply = |verdict| AgentEffect::Reply { query, verdict };
        if let Some(record) = self.records.get_mut(&id.client) {
            if record.number > id.number {
                let reason = "settled by a later INIT".to_owned();
                return vec![reply(Verdict::Unknown(reason))];
            }
            if record.number == id.number {
                return record.tell(now, query, id);
            }
        }
        let verdict = self.stale(now, &rules);
        if matches!(verdict, Verdict::Unknown(_)) {
            return vec![reply(verdict)];
        }
        if self.is_full(id.client) {
            return vec![reply(Verdict::Unknown(FULL.to_owned()))];
        }
        self.refuse(now, query, id, "never seen".to_owned())
    }

    /// An [`AgentEffect::Record`] could not be written. `marked` tells that a later agent will read [`Entry::Lacks`] in the
    /// journal; `following` is what followed the effect. Returns what to carry out instead.
    pub fn handle_unwritten(
        &mut self,
        entry: &Entry,
        marked: bool,
        following: Vec<AgentEffect>,
    ) -> Vec<AgentEffect> {
        let (Entry::Asked { id, .. } | Entry::GivenUp(id)) = entry else {
            // A later agent asks the server.
            return following;
        };
        let Some(record) = self.of(*id) else {
            return following;
        };
        let before = record.bytes();
        if !marked {
            record.stage = Stage::Unwritten;
        } else if record.stage != Stage::Void {
            record.stage = Stage::NotStarted(UNWRITTEN.to_owned());
        }
        let told = record.verdict();
        let mut effects = Vec::new();
        record.release(&told, &mut effects);
        let after = record.bytes();
        self.bytes = self.bytes - before + after;
        for effect in following {
            match effect {
                AgentEffect::Reply { query, verdict } => {
                    let verdict = if marked { verdict } else { told.clone() };
                    effects.push(AgentEffect::Reply { query, verdict });
                }
                AgentEffect::Record(_)
                | AgentEffect::Forward { .. }
                | AgentEffect::AskServer(_) => {}
            }
        }
        effects
    }

    /// The server did this with a forwarded INIT.
    pub fn handle_server(
        &mut self,
        now: Instant,
        id: InitId,
        said: ServerSaid,
    ) -> Vec<AgentEffect> {
        match said {
            ServerSaid::Answer(body) => match String::from_utf8(body) {
                Ok(answer) => self.decide(now, id, Stage::Answered(answer)),
                Err(_) => self.decide(now, id, Stage::Unknown),
            },
            ServerSaid::NotSent(reason) => self.decide(now, id, Stage::NotStarted(reason)),
            ServerSaid::Silence => match self.of(id) {
                Some(record) if record.stage == Stage::Forwarded => {
                    record.stage = Stage::Asking;
                    vec![AgentEffect::AskServer(id)]
                }
                _ => Vec::new(),
            },
        }
    }

    /// The server's answer to the question for an INIT's outcome; `None` if there was none.
    pub fn handle_server_outcome(
        &mut self,
        now: Instant,
        id: InitId,
        answer: Option<&[u8]>,
    ) -> Vec<AgentEffect> {
        let Some(record) = self.of(id) else {
            return Vec::new();
        };
        let stage = answer.map_or(Stage::Unknown, |answer| record.learn(now, answer));
        self.decide(now, id, stage)
    }

    /// Call this when [`poll_timeout`](Self::poll_timeout) has passed.
    pub fn handle_timeout(&mut self, now: Instant) -> Vec<AgentEffect> {
        self.forget(now);
        let mut effects = Vec::new();
        if self.lacks_until.take_if(|until| *until <= now).is_some() {
            effects.push(AgentEffect::Record(Entry::Whole));
        }
        for record in self.records.values_mut() {
            record.release_late(now, &mut effects);
        }
        effects
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let waiters = self.records.values().flat_map(|record| &record.waiters);
        let waiters = waiters.map(|(_, deadline)| *deadline);
        waiters.chain(self.lacks_until).min()
    }

    /// Whether there is no room for another client.
    fn is_full(&self, client: ClientId) -> bool {
        self.records.len() >= MOST_CLIENTS && !self.records.contains_key(&client)
    }

    /// Refuses an INIT that was not seen, from now on.
    fn refuse(&mut self, now: Instant, query: u64, id: InitId, reason: String) -> Vec<AgentEffect> {
        let mut effects = self.replace(now, id.client, Record::void(id.number));
        effects.push(AgentEffect::Record(Entry::GivenUp(id)));
        let verdict = Verdict::NotStarted(reason);
        effects.push(AgentEffect::Reply { query, verdict });
        effects
    }

    /// What is answered about an INIT that does not act and was not seen.
    fn stale(&self, now: Instant, rules: &InitRules) -> Verdict {
        let clock_ms = now.as_millis();
        // A record is kept for so long after the validity, so that it would be here.
        let is_told = match rules.boot {
            0 => true,
            boot if boot == self.boot => rules.until_ms.saturating_add(KEEP_MS) > clock_ms,
            boot => self.known_boots.contains(&boot) && clock_ms < KEEP_MS,
        };
        match is_told {
            true => Verdict::Stale {
                boot: self.boot,
                clock_ms,
            },
            false => Verdict::Unknown("this is too long ago for the robot's agent".to_owned()),
        }
    }

    fn of(&mut self, id: InitId) -> Option<&mut Record> {
        let record = self.records.get_mut(&id.client)?;
        (record.number == id.number).then_some(record)
    }

    /// A record from the journal.
    fn put(&mut self, now: Instant, client: ClientId, record: Record) {
        self.replace(now, client, record);
    }

    fn settle(&mut self, now: Instant, id: InitId, stage: Stage) {
        self.decide(now, id, stage);
    }

    /// A later INIT of a client replaces the record of the earlier one, which nobody may ask for any more.
    fn replace(&mut self, now: Instant, client: ClientId, mut record: Record) -> Vec<AgentEffect> {
        let mut effects = Vec::new();
        record.valid_ms = record.valid_ms.max(now.as_millis());
        self.bytes += record.bytes();
        if let Some(mut earlier) = self.records.insert(client, record) {
            self.bytes -= earlier.bytes();
            let verdict = Verdict::Unknown("settled by a later INIT".to_owned());
            earlier.release(&verdict, &mut effects);
        }
        effects
    }

    /// The first decision about an INIT stays.
    fn decide(&mut self, now: Instant, id: InitId, stage: Stage) -> Vec<AgentEffect> {
        let Some(record) = self.of(id) else {
            return Vec::new();
        };
        if record.is_decided() {
            return Vec::new();
        }
        let before = record.bytes();
        record.stage = stage;
        record.valid_ms = record.valid_ms.max(now.as_millis());
        let mut effects = Vec::new();
        effects.extend(record.decision(id).map(AgentEffect::Record));
        let verdict = record.verdict();
        record.release(&verdict, &mut effects);
        let after = record.bytes();
        self.bytes = self.bytes - before + after;
        effects
    }

    fn forget(&mut self, now: Instant) {
        let clock = now.as_millis();
        if clock >= KEEP_MS {
            // Their INITs are forgotten, too.
            self.known_boots.clear();
        }
        let bytes = &mut self.bytes;
        self.records.retain(|_, record| {
            let stays = record.is_pending() || record.valid_ms.saturating_add(KEEP_MS) > clock;
            if !stays {
                *bytes -= record.bytes();
            }
            stays
        });
    }
}

#[cfg(test)]
mod tests;
