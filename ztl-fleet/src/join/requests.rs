//! Requests to the robot's server, and the rules that decide which INIT acts.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
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
const MOST_WAITING: usize = 128;

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
        // What the server says of itself is about all scopes.
        let scope = Some(message.scope).filter(|scope| *scope != "$ztl");
        let named = brief(message.scope);
        if !self.may_use(&asked, scope) {
            warn!(target: "fleet", "{} may not use scope '{named}'.", asked.who());
            return refuse("the robot's 'client-keys' do not allow this");
        }
        let code = message.code().ok().and_then(|code| code.value());
        let is_abort = is_abort(&asked.body);
        let slot = (!is_abort).then(|| ServerSlot::take(&self.waiting));
        if matches!(slot, Some(None)) {
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
                    AgentEffect::Forward { id, body } => {
                        let said = self.forward(id, &body, early_end);
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

    fn forward(&self, id: InitId, body: &[u8], early_end: bool) -> ServerSaid {
        let envelope = Envelope {
            early_end,
            ..envelope(id)
        };
        match self.client.ask(Some(envelope), body, ANSWER) {
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
