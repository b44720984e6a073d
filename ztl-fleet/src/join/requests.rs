//! Requests to the robot's server, and the rules that decide which INIT acts.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tracing::{error, info, warn};
use ztl_core::Message;
use ztl_core::envelope::Envelope;
use ztl_std::relay::NotRelayed;
use ztl_std::time::now;

use super::asked::Asked;
use super::{LONGEST, Shared, TOO_MANY};
use crate::agent::{Agent, AgentEffect, ServerSaid};
use crate::journal::Journal;
use crate::seldom::brief;
use crate::wire::{InitId, InitRules, Verdict, is_abort, is_early};

/// Longest wait for the server's answer: as long as a client waits.
const ANSWER: Duration = Duration::from_secs(2);
/// Most queries at a time that may wait for the robot's server, except ABORT and `stop`, which no flood of others may hold up.
pub(super) const MOST_WAITING: usize = 128;
/// Most ABORTs at a time that may wait for it. Of one key, at most as many as are free: one has half of them, of two each a third.
pub(super) const MOST_ABORTS: usize = 256;

/// The rules with what they decide about.
pub(super) struct Rules {
    pub(super) agent: Agent,
    pub(super) journal: Journal,
    pub(super) queries: HashMap<u64, Asked>,
    pub(super) next: u64,
}

impl Shared {
    /// A request to the robot's server.
    pub(super) fn on_request(self: &Arc<Self>, asked: Asked) {
        let refuse = |reason: &str| asked.reply(&Verdict::NotStarted(reason.to_owned()));
        if asked.body.len() > LONGEST {
            return refuse("the request is too long");
        }
        let rules = match InitRules::parse(&asked.parameters) {
            Ok(rules) => rules,
            Err(mistake) => return refuse(&mistake),
        };
        let Ok(message) = Message::parse(&asked.body) else {
            return refuse("this is not a request");
        };
        // A server that reads other digits, as the original's, might take it for an INIT.
        let (Ok(code), Ok(_)) = (message.code(), message.number()) else {
            return refuse("its state or its id is not a number of ASCII digits");
        };
        let code = code.value();
        // What the server says of itself is about all scopes.
        let scope = Some(message.scope).filter(|scope| *scope != "$ztl");
        let named = brief(message.scope);
        if !self.may_use(&asked, scope) {
            if self.told.rights.may(&asked.key()) {
                warn!(target: "fleet", "{} may not use scope '{named}'.", asked.who());
            }
            return refuse("the robot's 'client-keys' do not allow this");
        }
        let is_abort = is_abort(&asked.body);
        let key = asked.key();
        let slots = match is_abort {
            true => (None, AbortSlot::take(&self.aborting, key)),
            false => (ServerSlot::take(&self.waiting), None),
        };
        if matches!(slots, (None, None)) {
            return asked.reply(&Verdict::Unknown(TOO_MANY.to_owned()));
        }
        if code == Some(1) {
            let Some(init) = rules else {
                return refuse("an INIT needs client, number, boot and until");
            };
            info!(target: "fleet", "INIT {} for '{named}' by {}.", init.id.number, asked.who());
            let server = self.server_boot();
            let body = asked.body.clone();
            let early_end = is_early(&asked.parameters);
            return self.run_init(early_end, |rules| {
                let number = rules.take(asked);
                let agent = &mut rules.agent;
                agent.handle_init(now(), number, init, &body, server)
            });
        }
        if self.refuse_stale(&asked) {
            return;
        }
        if is_abort {
            info!(target: "fleet", "ABORT of {} at '{named}' by {}.", brief(message.id), asked.who());
        }
        let envelope = rules.map(|rules| Envelope {
            client: rules.id.client,
            number: rules.id.number,
            early_end: false,
        });
        asked.reply(&match self.client.ask(envelope, &asked.body, ANSWER) {
            Ok(answer) => Verdict::Answer(answer),
            Err(reason) => Verdict::Unknown(reason.to_string()),
        });
    }

    /// What became of an INIT.
    pub(super) fn on_outcome(self: &Arc<Self>, asked: Asked) {
        let Some(_slot) = ServerSlot::take(&self.waiting) else {
            return asked.reply(&Verdict::Unknown(TOO_MANY.to_owned()));
        };
        match InitRules::parse(&asked.parameters) {
            Ok(Some(init)) => self.run(|rules| {
                let number = rules.take(asked);
                rules.agent.handle_outcome(now(), number, init)
            }),
            Ok(None) => asked.reply(&Verdict::Unknown("'client' is missing".to_owned())),
            Err(mistake) => asked.reply(&Verdict::Unknown(mistake)),
        }
    }

    /// Carries out what the rules decide, in order.
    pub(super) fn run(&self, decide: impl FnOnce(&mut Rules) -> Vec<AgentEffect>) {
        self.run_init(false, decide);
    }

    /// The same; an INIT is forwarded with this wish for an early outcome.
    fn run_init(&self, early_end: bool, decide: impl FnOnce(&mut Rules) -> Vec<AgentEffect>) {
        let mut effects = self.decide(decide);
        while !effects.is_empty() {
            let mut next = Vec::new();
            for effect in effects {
                next.extend(match effect {
                    AgentEffect::Reply { query, verdict } => {
                        let query = self.rules().queries.remove(&query);
                        if let Some(asked) = query {
                            asked.reply(&verdict);
                        }
                        continue;
                    }
                    // Written when it was decided.
                    AgentEffect::Record(_) => continue,
                    AgentEffect::Forward { id, body, until_ms } => {
                        let said = self.forward(id, &body, until_ms, early_end);
                        self.decide(|rules| rules.agent.handle_server(now(), id, said))
                    }
                    AgentEffect::AskServer(id) => {
                        let answer = self.ask_outcome(id);
                        let answer = answer.as_deref();
                        let agent = |rules: &mut Rules| {
                            rules.agent.handle_server_outcome(now(), id, answer)
                        };
                        self.decide(agent)
                    }
                });
            }
            effects = next;
        }
    }

    /// Lets the rules decide, and writes that into the journal before another thread can answer by it.
    fn decide(&self, decide: impl FnOnce(&mut Rules) -> Vec<AgentEffect>) -> Vec<AgentEffect> {
        let mut rules = self.rules();
        let effects = decide(&mut rules);
        rules.write(effects)
    }

    fn forward(&self, id: InitId, body: &[u8], until_ms: u64, early_end: bool) -> ServerSaid {
        if self.server_is_away() {
            // Its client would not wait for so long until that is certain.
            return ServerSaid::NotSent(NotRelayed::NotSent.to_string());
        }
        let envelope = Envelope {
            early_end,
            ..envelope(id)
        };
        // The server may be there again only after that.
        let left = Duration::from_millis(until_ms.saturating_sub(now().as_millis()));
        let asked = self
            .client
            .ask_before(Some(envelope), body, left.min(ANSWER), ANSWER);
        match asked {
            Ok(answer) => {
                self.started().note(&answer);
                let client = crate::wire::hex(&id.client);
                info!(target: "fleet", "INIT {} of client {client} was answered.", id.number);
                ServerSaid::Answer(answer)
            }
            Err(NotRelayed::NotSent) => ServerSaid::NotSent(NotRelayed::NotSent.to_string()),
            Err(_) => ServerSaid::Silence,
        }
    }

    fn ask_outcome(&self, id: InitId) -> Option<Vec<u8>> {
        let body = format!("$ztl;2;-1;outcome {}", id.number);
        let answer = self.client.ask(Some(envelope(id)), body.as_bytes(), ANSWER);
        let answer = answer.ok()?;
        self.started().note(&answer);
        Some(answer)
    }
}

/// Lets a query wait for the robot's server, as one of at most [`MOST_WAITING`].
struct ServerSlot<'a>(&'a AtomicUsize);

impl<'a> ServerSlot<'a> {
    fn take(taken: &'a AtomicUsize) -> Option<Self> {
        let slot = Self(taken);
        // It is given back if there was none.
        (taken.fetch_add(1, Ordering::SeqCst) < MOST_WAITING).then_some(slot)
    }
}

impl Drop for ServerSlot<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
}

/// ABORTs that wait for the robot's server, by the keys that sent them.
#[derive(Debug, Default)]
pub(super) struct Aborting(Mutex<HashMap<Option<[u8; 32]>, usize>>);

impl Aborting {
    fn by_key(&self) -> MutexGuard<'_, HashMap<Option<[u8; 32]>, usize>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Lets an ABORT wait for the robot's server, as one of at most [`MOST_ABORTS`].
struct AbortSlot<'a>(&'a Aborting, Option<[u8; 32]>);

impl<'a> AbortSlot<'a> {
    fn take(all: &'a Aborting, key: Option<[u8; 32]>) -> Option<Self> {
        let mut by_key = all.by_key();
        let free = MOST_ABORTS.saturating_sub(by_key.values().sum());
        let own = by_key.entry(key).or_default();
        if *own >= free {
            return None;
        }
        *own += 1;
        Some(Self(all, key))
    }
}

impl Drop for AbortSlot<'_> {
    fn drop(&mut self) {
        let mut by_key = self.0.by_key();
        if let Some(own) = by_key.get_mut(&self.1) {
            *own = own.saturating_sub(1);
        }
    }
}

impl Rules {
    /// Writes the entries of effects. Returns what to carry out.
    fn write(&mut self, effects: Vec<AgentEffect>) -> Vec<AgentEffect> {
        let mut all = Vec::new();
        let mut effects = effects.into_iter();
        while let Some(effect) = effects.next() {
            if let AgentEffect::Record(entry) = &effect
                && let Err(error) = self.journal.append(entry)
            {
                error!(target: "fleet", "The journal cannot be written: {error}");
                let marked = self.journal.mark();
                if let Err(error) = &marked {
                    error!(target: "fleet", "Nor can it be marked: {error}");
                }
                let following = effects.collect();
                let agent = &mut self.agent;
                effects = agent
                    .handle_unwritten(entry, marked.is_ok(), following)
                    .into_iter();
                continue;
            }
            all.push(effect);
        }
        if self.journal.is_long()
            && let Err(error) = self.journal.rewrite(&self.agent.entries())
        {
            warn!(target: "fleet", "The journal cannot be shortened: {error}");
        }
        all
    }

    /// Keeps a query until it is answered.
    fn take(&mut self, query: Asked) -> u64 {
        self.next += 1;
        self.queries.insert(self.next, query);
        self.next
    }
}

const fn envelope(id: InitId) -> Envelope {
    Envelope {
        client: id.client,
        number: id.number,
        early_end: false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aborts_of_one_key_leave_room_for_those_of_others() {
        let aborting = Aborting::default();
        let take_all = |key: u8| {
            let take = || AbortSlot::take(&aborting, Some([key; 32]));
            let all = std::iter::from_fn(take).take(2 * MOST_ABORTS);
            all.collect::<Vec<_>>()
        };
        let first = take_all(1);
        assert_eq!(first.len(), MOST_ABORTS / 2);
        let second = take_all(2);
        assert_eq!(second.len(), MOST_ABORTS / 4);
        assert!(!take_all(3).is_empty());
        drop((first, second));
        assert_eq!(take_all(2).len(), MOST_ABORTS / 2);
    }
}
