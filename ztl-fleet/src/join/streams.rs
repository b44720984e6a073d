//! Passes on what the robot's publisher publishes, to each endpoint that asks for it, while it does.

use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use tracing::{info, warn};
use zenoh::Wait as _;
use zenoh::qos::{CongestionControl, Priority};
use ztl_std::keys::PublicKey;
use ztl_std::publish::Heard;
use ztl_std::relay::RelaySubscriber;
use ztl_std::time::now;

use super::Shared;
use super::asked::Asked;
use crate::random;
use crate::seal;
use crate::session::key;
use crate::streams::{
    Granted, Head, LEASE, LONGEST, LONGEST_TOPIC, MOST_TOPICS, Outgoing, Want, scope_of, within,
};
use crate::wire::{Verdict, from_hex, hex};

/// Most endpoints at a time, and most with one key.
const MOST: usize = 16;
const MOST_OF_KEY: usize = 4;
/// How long a thread waits for messages before it looks whether it is still needed.
const TURN: Duration = Duration::from_millis(50);
/// How often the robot's scopes are looked at.
const SCOPES: Duration = Duration::from_secs(1);

/// Who asks, and the id that it has chosen.
type Endpoint = (Option<[u8; 32]>, String);

/// The endpoints that hear the robot's publisher.
#[derive(Default)]
pub(super) struct Subscriptions(BTreeMap<Endpoint, Arc<Subscription>>);

struct Subscription {
    session: String,
    /// Its key, and how to seal for it.
    sealer: Option<(PublicKey, Arc<seal::Shared>)>,
    wishes: Mutex<Wishes>,
    changed: Condvar,
}

/// What the endpoint wants, and what it gets.
struct Wishes {
    topics: Vec<String>,
    /// Whether it has named the session, so that it takes its messages.
    knows: bool,
    newest: bool,
    until: Instant,
    outgoing: Outgoing,
    problem: Option<String>,
}

impl Subscription {
    fn wishes(&self) -> MutexGuard<'_, Wishes> {
        self.wishes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Shared {
    fn subscriptions(&self) -> MutexGuard<'_, Subscriptions> {
        let subscriptions = self.subscriptions.lock();
        subscriptions.unwrap_or_else(PoisonError::into_inner)
    }

    /// An endpoint wants to hear the robot's publisher.
    pub(super) fn on_streams(self: &Arc<Self>, asked: &Asked) {
        if self.refuse_stale(asked) {
            return;
        }
        asked.reply(&match self.subscribe(asked) {
            Ok(granted) => Verdict::Answer(serde_json::to_vec(&granted).unwrap_or_default()),
            Err(reason) => Verdict::NotStarted(reason),
        });
    }

    fn subscribe(self: &Arc<Self>, asked: &Asked) -> Result<Granted, String> {
        if self.config.publish.is_none() {
            return Err("this robot has no publisher".to_owned());
        }
        let want: Want = serde_json::from_slice(&asked.body)
            .map_err(|error| format!("this does not say what is wanted: {error}"))?;
        let is_odd = from_hex(&want.id).is_none();
        if is_odd || want.id.bytes().any(|byte| byte.is_ascii_uppercase()) {
            return Err("'id' is not 32 hexadecimal digits in lower case".to_owned());
        }
        let mut topics = want.topics.iter();
        if want.topics.len() > MOST_TOPICS || topics.any(|topic| topic.len() > LONGEST_TOPIC) {
            return Err(format!(
                "more than {MOST_TOPICS} topics, or one of more than {LONGEST_TOPIC} bytes"
            ));
        }
        let sealer = asked.sealer();
        let key = sealer.as_ref().map(|(key, _)| *key.as_bytes());
        let endpoint = (key, want.id.clone());
        let mut all = self.subscriptions();
        if want.topics.is_empty() {
            let ended = all.0.remove(&endpoint);
            drop(all);
            if let Some(ended) = &ended {
                ended.wishes().until = Instant::now();
                ended.changed.notify_all();
            }
            return Ok(Granted {
                session: ended.map_or_else(String::new, |ended| ended.session.clone()),
                sent: 0,
                window: 0,
                problem: None,
            });
        }
        let subscription = match all.0.get(&endpoint) {
            Some(known) => Arc::clone(known),
            None => {
                let of_key = all.0.keys().filter(|(known, _)| *known == key).count();
                if all.0.len() >= MOST || key.is_some() && of_key >= MOST_OF_KEY {
                    return Err("too many endpoints hear this robot".to_owned());
                }
                let session = random::id().map_err(|error| error.to_string())?;
                let new = Arc::new(Subscription {
                    session: hex(&session),
                    sealer,
                    wishes: Mutex::new(Wishes {
                        topics: Vec::new(),
                        knows: false,
                        newest: false,
                        until: Instant::now() + LEASE,
                        outgoing: Outgoing::default(),
                        problem: None,
                    }),
                    changed: Condvar::new(),
                });
                self.start(&endpoint, &new)
                    .map_err(|error| error.to_string())?;
                info!(target: "fleet", "The robot's publisher is heard by {}.", asked.who());
                all.0.insert(endpoint, Arc::clone(&new));
                new
            }
        };
        drop(all);
        let mut wishes = subscription.wishes();
        wishes.topics = want.topics;
        wishes.until = Instant::now() + LEASE;
        if want.session.as_ref() == Some(&subscription.session) {
            wishes.knows = true;
            wishes.newest |= want.newest;
            wishes.outgoing.on_heard(now(), want.heard);
        }
        let granted = Granted {
            session: subscription.session.clone(),
            sent: wishes.outgoing.sent(),
            window: wishes.outgoing.window(),
            problem: wishes.problem.clone(),
        };
        drop(wishes);
        subscription.changed.notify_all();
        Ok(granted)
    }

    fn start(
        self: &Arc<Self>,
        endpoint: &Endpoint,
        subscription: &Arc<Subscription>,
    ) -> io::Result<()> {
        let weak = Arc::downgrade(self);
        let (endpoint, subscription) = (endpoint.clone(), Arc::clone(subscription));
        let thread = std::thread::Builder::new().name("ztl-fleet-stream".to_owned());
        thread.spawn(move || {
            if let Err(problem) = pass_on(&weak, &endpoint.1, &subscription) {
                warn!(target: "fleet", "The robot's publisher cannot be heard: {problem}.");
            }
            if let Some(shared) = weak.upgrade() {
                let mut all = shared.subscriptions();
                // Another one may have taken its place.
                if let Some(known) = all.0.get(&endpoint)
                    && Arc::ptr_eq(known, &subscription)
                {
                    all.0.remove(&endpoint);
                }
            }
        })?;
        Ok(())
    }

    /// The scope of a message, if this endpoint may hear it; nothing else is passed on.
    fn may_hear(
        &self,
        subscription: &Subscription,
        topic: &str,
        scopes: &[String],
    ) -> Option<Option<String>> {
        let scope = scope_of(topic, scopes);
        let may = match (&self.config.identity, &subscription.sealer) {
            (None, _) => true,
            (Some(identity), Some((key, _))) => {
                identity.may_use_all(key) || scope.is_some_and(|scope| identity.may_use(key, scope))
            }
            (Some(_), None) => false,
        };
        may.then(|| scope.map(str::to_owned))
    }

    /// What of these topics this endpoint may hear. Nothing else is asked for: a stream may run only while somebody hears it.
    fn allowed(
        &self,
        subscription: &Subscription,
        topics: &[String],
        scopes: &[String],
    ) -> Vec<String> {
        let Some(identity) = &self.config.identity else {
            return topics.to_vec();
        };
        let Some((key, _)) = &subscription.sealer else {
            return Vec::new();
        };
        if identity.may_use_all(key) {
            return topics.to_vec();
        }
        let scopes = scopes.iter().map(String::as_str);
        let (allowed, hidden): (Vec<&str>, Vec<&str>) =
            scopes.partition(|scope| identity.may_use(key, scope));
        within(topics, &allowed, &hidden)
    }
}

/// Passes messages on until the endpoint does not want them any more, or what was published before does not count any more.
fn pass_on(weak: &Weak<Shared>, id: &str, subscription: &Subscription) -> Result<(), String> {
    let mut publisher = None;
    let (mut wanted, mut topics, mut scopes) = (Vec::new(), Vec::new(), Vec::new());
    let mut looked: Option<Instant> = None;
    let mut missed = 0;
    let mut warned = false;
    loop {
        let Some(shared) = weak.upgrade() else {
            return Ok(());
        };
        let mut wishes = subscription.wishes();
        if Instant::now() >= wishes.until {
            return Ok(());
        }
        if !wishes.knows || !wishes.outgoing.may_send(now()) {
            drop(shared);
            let waited = subscription.changed.wait_timeout(wishes, TURN);
            drop(waited);
            continue;
        }
        let wants_newest = std::mem::take(&mut wishes.newest);
        let mut may_differ = wanted != wishes.topics;
        if may_differ {
            wanted.clone_from(&wishes.topics);
        }
        drop(wishes);
        let publisher = match &mut publisher {
            Some(publisher) => publisher,
            none => {
                let keys = shared.config.keys.as_ref().map(|keys| keys.read());
                let keys = keys.transpose().map_err(|error| error.to_string())?;
                let address = shared.config.publish.as_deref().unwrap_or_default();
                let connected = RelaySubscriber::connect(address, keys);
                none.insert(connected.map_err(|error| error.to_string())?)
            }
        };
        if looked.is_none_or(|looked| looked.elapsed() >= SCOPES) {
            looked = Some(Instant::now());
            let server = shared.server.lock().unwrap_or_else(PoisonError::into_inner);
            scopes = shared.scopes(&server);
            may_differ = true;
        }
        if may_differ {
            let allowed = shared.allowed(subscription, &wanted, &scopes);
            if topics != allowed {
                publisher.set_topics(&allowed);
                topics = allowed;
            }
        }
        if wants_newest {
            publisher.ask_newest();
        }
        // While it waits, it does not keep the agent.
        drop(shared);
        let heard = publisher.next_within(TURN);
        let heard = heard.map_err(|error| error.to_string())?;
        let problem = match (publisher.is_connected(), publisher.advice()) {
            (true, _) => None,
            (false, Some(advice)) => Some(advice),
            (false, None) => Some("the publisher is not connected".to_owned()),
        };
        if publisher.lost() > 0 {
            // It may have been restarted, so its states do not count any more: those of a new session do.
            return Ok(());
        }
        let gap = publisher.missed().saturating_sub(missed);
        missed = publisher.missed();
        let mut wishes = subscription.wishes();
        wishes.problem = problem;
        wishes.outgoing.skip(gap);
        let Some((Heard { topic, body, .. }, is_state)) = heard else {
            continue;
        };
        let Some(shared) = weak.upgrade() else {
            return Ok(());
        };
        let Some(scope) = shared.may_hear(subscription, &topic, &scopes) else {
            continue;
        };
        if body.len() > LONGEST {
            wishes.outgoing.skip(1);
            drop(wishes);
            if !std::mem::replace(&mut warned, true) {
                warn!(target: "fleet", "A message of {} bytes at '{}' is not passed on: at most {LONGEST} are.", body.len(), crate::seldom::brief(&topic));
            }
            continue;
        }
        let number = wishes.outgoing.send(now(), body.len() + topic.len());
        drop(wishes);
        let message = Head {
            session: subscription.session.clone(),
            number,
            topic,
            scope,
            state: is_state,
        }
        .with(&body);
        shared.send(id, subscription, message);
    }
}

impl Shared {
    /// Sends a message, which may be lost on the way, and which everything else overtakes.
    fn send(&self, id: &str, subscription: &Subscription, message: Vec<u8>) {
        let payload = match &subscription.sealer {
            None => message,
            Some((_, shared)) => {
                // Without random numbers, nothing is sent, and its number is missing.
                let Ok(nonce) = random::nonce() else { return };
                match shared.stream(&nonce, &message) {
                    Some(sealed) => sealed,
                    None => return,
                }
            }
        };
        let key = format!("{}/{id}", key(&self.config.name, &self.id, "streams"));
        let put = self.session.put(key, payload);
        let put = put
            .priority(Priority::DataLow)
            .congestion_control(CongestionControl::Drop);
        // The endpoint counts what does not arrive.
        let _ = put.wait();
    }
}
