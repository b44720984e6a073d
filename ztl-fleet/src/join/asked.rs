//! A query, plain or sealed, and the way back for its answer.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, PoisonError};

use tracing::warn;
use zenoh::Wait as _;
use zenoh::query::Query;
use ztl_std::keys::PublicKey;
use ztl_std::time::now;

use super::{LONGEST, Shared};
use crate::config::Identity;
use crate::random;
use crate::seal::{self, Nonce, OVERHEAD, Request};
use crate::seldom::brief;
use crate::wire::{AgentQuery, Verdict, fresh_until};

/// Most nonces that are remembered of a key.
const MOST_SEEN: usize = 100_000;

/// The robot's clients by their keys.
pub(super) type Clients = BTreeMap<[u8; 32], (PublicKey, Arc<seal::Shared>)>;

pub(super) fn clients(identity: &Identity) -> Clients {
    let clients = identity.clients.iter().map(|(_, key)| *key);
    // A copy of this robot asks whether it is alone; it may use nothing.
    let clients = clients.chain([identity.own.public()]);
    let client = |key: PublicKey| {
        let shared = seal::Shared::new(&identity.own, &key);
        (*key.as_bytes(), (key, Arc::new(shared)))
    };
    clients.map(client).collect()
}

/// What a query asks.
pub(super) struct Asked {
    query: Query,
    pub(super) parameters: String,
    pub(super) body: Vec<u8>,
    sender: Option<Sender>,
}

/// Who sealed it.
struct Sender {
    key: PublicKey,
    who: String,
    nonce: Nonce,
    shared: Arc<seal::Shared>,
}

impl Asked {
    pub(super) fn plain(query: Query) -> Self {
        let body = query.payload().map(|body| body.to_bytes().into_owned());
        Self {
            parameters: query.parameters().as_str().to_owned(),
            body: body.unwrap_or_default(),
            query,
            sender: None,
        }
    }

    /// Answers it. That fails only if nobody waits any more.
    pub(super) fn reply(&self, verdict: &Verdict) {
        let (is_answer, payload) = match &self.sender {
            None => verdict.to_payload(),
            Some(sender) => {
                // Without random numbers, there is no answer.
                let Ok(nonce) = random::nonce() else { return };
                match sender.shared.answer(&sender.nonce, &nonce, verdict) {
                    Some(sealed) => (true, sealed),
                    None => return,
                }
            }
        };
        let _ = match is_answer {
            true => {
                let key = self.query.key_expr().clone();
                self.query.reply(key, payload).wait()
            }
            false => self.query.reply_err(payload).wait(),
        };
    }

    /// Who sealed it, and what its key shares with the robot's.
    pub(super) fn sealer(&self) -> Option<(PublicKey, Arc<seal::Shared>)> {
        let sender = self.sender.as_ref()?;
        Some((sender.key, Arc::clone(&sender.shared)))
    }

    /// The key of who sealed it.
    pub(super) fn key(&self) -> Option<[u8; 32]> {
        let sender = self.sender.as_ref()?;
        Some(*sender.key.as_bytes())
    }

    /// Who asks, for the log.
    pub(super) fn who(&self) -> String {
        match &self.sender {
            None => "anybody".to_owned(),
            Some(sender) => format!("{} for {}", sender.key, brief(&sender.who)),
        }
    }
}

impl Shared {
    /// A sealed query.
    pub(super) fn on_sealed(self: &Arc<Self>, query: Query) {
        match self.open(&query) {
            Ok((what, asked)) => match AgentQuery::from_name(&what) {
                Some(known) => self.answer(known, asked),
                None => asked.reply(&Verdict::NotStarted(format!("'{what}' is not known"))),
            },
            Err(mistake) => {
                if self.told.refusals.may() {
                    warn!(target: "fleet", "A sealed request is refused: {mistake}.");
                }
                // Its sender cannot be told so in a way that proves who says it.
                let _ = query.reply_err(mistake).wait();
            }
        }
    }

    fn open(&self, query: &Query) -> Result<(String, Asked), &'static str> {
        let payload = query.payload().map(|payload| payload.to_bytes());
        let payload = payload.unwrap_or_default().into_owned();
        if payload.len() > LONGEST + OVERHEAD {
            return Err("it is too long");
        }
        let Some((key, nonce, sealed)) = seal::parts(&payload) else {
            return Err("it is too short");
        };
        let Some((key, shared)) = self.clients.get(key) else {
            return Err("its key is not among the robot's 'client-keys'");
        };
        let Some(clear) = shared.open(&nonce, sealed) else {
            return Err("it was not sealed with its key for this robot's key");
        };
        let request = Request::parse(&clear);
        let Some(request) = request.filter(|request| request.robot == self.config.name) else {
            return Err("it is for another robot or another version");
        };
        let asked = Asked {
            query: query.clone(),
            parameters: request.parameters.to_owned(),
            body: request.body.to_vec(),
            sender: Some(Sender {
                key: *key,
                who: request.who.to_owned(),
                nonce,
                shared: Arc::clone(shared),
            }),
        };
        Ok((request.what.to_owned(), asked))
    }

    /// Whether who asks may use a scope; `None` stands for the whole robot.
    pub(super) fn may_use(&self, asked: &Asked, scope: Option<&str>) -> bool {
        let Some(identity) = &self.config.identity else {
            return true;
        };
        let sender = asked.sender.as_ref();
        sender.is_some_and(|sender| match scope {
            Some(scope) => identity.may_use(&sender.key, scope),
            None => identity.may_use_all(&sender.key),
        })
    }

    /// Refuses a copy from a recording: a sealed query acts only in the boot and before the time that it names, and once.
    pub(super) fn refuse_stale(&self, asked: &Asked) -> bool {
        let Some(sender) = &asked.sender else {
            return false;
        };
        let clock_ms = now().as_millis();
        let boot = self.rules().agent.boot();
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let until = fresh_until(&asked.parameters, boot, clock_ms);
        let is_new = until
            .is_some_and(|until| seen.note(sender.key.as_bytes(), sender.nonce, until, clock_ms));
        drop(seen);
        if !is_new {
            asked.reply(&Verdict::Stale { boot, clock_ms });
        }
        !is_new
    }
}

/// Nonces of sealed queries that may come again, by the keys that have sent them: a flood with one key leaves room for others.
#[derive(Debug, Default)]
pub(super) struct Seen(BTreeMap<[u8; 32], BTreeSet<(u64, Nonce)>>);

impl Seen {
    /// Whether it is the first of its kind, and there is room to remember it.
    fn note(&mut self, key: &[u8; 32], nonce: Nonce, until: u64, clock_ms: u64) -> bool {
        let seen = self.0.entry(*key).or_default();
        while seen.first().is_some_and(|(until, _)| *until < clock_ms) {
            seen.pop_first();
        }
        seen.len() < MOST_SEEN && seen.insert((until, nonce))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_with_one_key_leaves_room_for_others() {
        let (flooder, other) = ([1; 32], [2; 32]);
        let mut seen = Seen::default();
        let nonce = |number: usize| {
            let mut nonce = Nonce::default();
            nonce[..8].copy_from_slice(&(number as u64).to_le_bytes());
            nonce
        };
        for number in 0..MOST_SEEN {
            assert!(seen.note(&flooder, nonce(number), 60_000, 0));
        }
        assert!(!seen.note(&flooder, nonce(MOST_SEEN), 60_000, 0));
        assert!(seen.note(&other, nonce(0), 60_000, 0));
        assert!(!seen.note(&other, nonce(0), 60_000, 0), "a copy");
        assert!(seen.note(&flooder, nonce(MOST_SEEN), 120_001, 60_001));
    }
}
