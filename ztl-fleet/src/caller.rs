//! Asks robots, in plain queries or in sealed ones, which only the robot's key can answer.

mod stop;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tracing::{error, warn};
use zenoh::handlers::CallbackDrop;
use zenoh::qos::Priority;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};
use zenoh::sample::Locality;
use zenoh::{Session, Wait as _};
use ztl_core::Instant;
use ztl_std::keys::KeyPair;
use ztl_std::time::now;

use crate::config::EndpointConfig;
use crate::lives::Lives;
use crate::random;
use crate::seal::{Request, Shared, agent_of};
use crate::seldom::{SeldomOf, brief};
use crate::session::{ZenohError, key, verdict};
use crate::wire::{AgentQuery, RobotInfo, Verdict, fresh, is_abort};
pub use stop::StopAnswer;

/// How long a question may act after it was sent, by the robot's clock.
const VALID_MS: u64 = 2500;

/// A reply to the question with this index, and the way back for the reply to another one.
struct Told {
    index: usize,
    verdict: Verdict,
    replies: Sender<Self>,
}

/// What asks robots.
#[derive(Clone)]
pub struct Caller {
    session: Session,
    identity: Option<Arc<Identity>>,
    machines: Arc<Machines>,
}

struct Identity {
    own: KeyPair,
    /// The agent that alone has a name, and what its key shares with the own one.
    robots: BTreeMap<String, (String, Shared)>,
    /// Limits what is told of strangers, by robots.
    told: SeldomOf<String>,
}

impl Identity {
    fn new(own: KeyPair, robots: BTreeMap<String, (String, Shared)>) -> Self {
        Self {
            own,
            robots,
            told: SeldomOf::default(),
        }
    }
}

/// The boots that have answered as each agent, by robot and agent.
#[derive(Default)]
struct Machines(Mutex<BTreeMap<(String, String), Lives>>);

impl Machines {
    fn all(&self) -> MutexGuard<'_, BTreeMap<(String, String), Lives>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn are_two(&self, robot: &str, agent: &str) -> bool {
        let mut all = self.all();
        let lives = all.get_mut(&(robot.to_owned(), agent.to_owned()));
        lives.is_some_and(|lives| lives.are_two(now()))
    }

    /// An agent has answered a question that was asked then.
    fn note(&self, robot: &str, agent: &str, has_key: bool, asked: Instant, verdict: &Verdict) {
        let Some(boot) = boot(verdict) else { return };
        let mut all = self.all();
        let lives = all.entry((robot.to_owned(), agent.to_owned()));
        let is_news = lives.or_default().note(now(), boot, asked);
        drop(all);
        if is_news {
            let (what, own) = match has_key {
                true => ("have the key", "key"),
                false => ("have the name and the id", "'state' directory"),
            };
            error!(target: "fleet", "Two agents {what} of robot '{robot}'. It gets only ABORTs and 'stop' until one of them has been silent for a minute; give each robot its own {own}.");
        }
    }
}

impl Caller {
    /// Asks as an endpoint's file says.
    #[must_use]
    pub fn new(session: Session, config: &EndpointConfig) -> Self {
        let identity = config.fleet_key.clone().map(|own| {
            let robots = config.robots.iter();
            let robots = robots.filter_map(|(name, key)| {
                let key = key.as_ref()?;
                Some((name.clone(), (agent_of(key), Shared::new(&own, key))))
            });
            let robots = robots.collect();
            Arc::new(Identity::new(own, robots))
        });
        Self {
            session,
            identity,
            machines: Arc::default(),
        }
    }

    /// Asks in plain queries.
    #[must_use]
    pub fn plain(session: Session) -> Self {
        Self {
            session,
            identity: None,
            machines: Arc::default(),
        }
    }

    /// Asks agents that have a robot's own key: whoever answers is a copy of it.
    #[must_use]
    pub fn of_itself(session: Session, robot: &str, own: &KeyPair) -> Self {
        let public = own.public();
        let itself = (agent_of(&public), Shared::new(own, &public));
        let identity = Identity::new(own.clone(), [(robot.to_owned(), itself)].into());
        Self {
            session,
            identity: Some(Arc::new(identity)),
            machines: Arc::default(),
        }
    }

    /// Its session.
    #[must_use]
    pub const fn session(&self) -> &Session {
        &self.session
    }

    /// The agent whose key a name is bound to.
    #[must_use]
    pub fn bound(&self, robot: &str) -> Option<&str> {
        let (agent, _) = self.identity.as_ref()?.robots.get(robot)?;
        Some(agent)
    }

    /// Whether this agent may have this name: with keys, only the bound one.
    #[must_use]
    pub fn accepts(&self, robot: &str, agent: &str) -> bool {
        self.identity.is_none() || self.bound(robot) == Some(agent)
    }

    /// Whether two machines answer as this agent, so that only `info`, `stop` and ABORTs are sent to it.
    #[must_use]
    pub fn is_in_doubt(&self, robot: &str, agent: &str) -> bool {
        self.machines.are_two(robot, agent)
    }

    /// Whether more than one boot has answered as this agent: two machines, or one that was restarted meanwhile.
    #[must_use]
    pub fn hears_several(&self, robot: &str, agent: &str) -> bool {
        let all = self.machines.all();
        let lives = all.get(&(robot.to_owned(), agent.to_owned()));
        lives.is_some_and(|lives| lives.count() > 1)
    }

    /// Sends a question to a robot's agent. Its first true reply, then the end go to the functions. An ABORT while two machines
    /// answer as this agent has all their replies.
    ///
    /// # Errors
    /// Zenoh's, if nothing was sent.
    pub fn ask(
        &self,
        agent: &str,
        request: &Request<'_>,
        limit: Duration,
        on_reply: impl Fn(Verdict) + Send + Sync + 'static,
        on_end: impl FnMut() + Send + Sync + 'static,
    ) -> Result<(), ZenohError> {
        let answered = AtomicBool::new(false);
        let counts_all = is_abort(request.body) && self.is_in_doubt(request.robot, agent);
        let first = move |verdict| {
            if !answered.swap(true, Ordering::Relaxed) || counts_all {
                on_reply(verdict);
            }
        };
        self.ask_each(agent, request, limit, first, on_end)
    }

    /// The same with all true replies: `info`, `stop` and ABORTs go to each machine that has the agent's name and id.
    fn ask_each(
        &self,
        agent: &str,
        request: &Request<'_>,
        limit: Duration,
        on_reply: impl Fn(Verdict) + Send + Sync + 'static,
        on_end: impl FnMut() + Send + Sync + 'static,
    ) -> Result<(), ZenohError> {
        // Routers and links pass it on before what waits there.
        let is_urgent = request.what == AgentQuery::Stop.name() || is_abort(request.body);
        let is_for_all = is_urgent || request.what == AgentQuery::Info.name();
        if !is_for_all && self.is_in_doubt(request.robot, agent) {
            return Err(format!("two machines answer as robot '{}'", request.robot).into());
        }
        let priority = match is_urgent {
            true => Priority::RealTime,
            false => Priority::DEFAULT,
        };
        let (robot, name) = (request.robot.to_owned(), agent.to_owned());
        let (machines, asked_at) = (Arc::clone(&self.machines), now());
        let Some(identity) = &self.identity else {
            let mut selector = key(request.robot, agent, request.what);
            // Without keys, a clock is for INITs only.
            if request.parameters.contains("client=") {
                selector = format!("{selector}?{}", request.parameters);
            }
            let callback = move |reply: Reply| {
                let verdict = verdict(&reply);
                machines.note(&robot, &name, false, asked_at, &verdict);
                on_reply(verdict);
            };
            let handler = CallbackDrop {
                callback,
                drop: on_end,
            };
            let query = self.session.get(selector).priority(priority);
            // "Express": neither the question nor its answer waits for a batch. Without consolidation, the answer does not wait
            // for the end of the query, which follows it through all routers.
            let query = query.express(true).consolidation(ConsolidationMode::None);
            let query = query.target(match is_for_all {
                true => QueryTarget::All,
                false => QueryTarget::BestMatching,
            });
            let query = query.allowed_destination(Locality::Remote);
            let query = query.payload(request.body).timeout(limit);
            return query.with(handler).wait();
        };
        let known = identity.robots.get(&robot);
        let Some((_, shared)) = known.filter(|(bound, _)| bound == agent) else {
            return Err(format!("agent {agent} does not have the key of robot '{robot}'").into());
        };
        let asked = random::nonce()?;
        let sealed = shared.request(&identity.own.public(), &asked, request);
        let sealed = sealed.ok_or("the request's parameters are too long")?;
        let identity = Arc::clone(identity);
        let callback = move |reply: Reply| {
            let (payload, is_refusal) = match reply.result() {
                Ok(sample) => (sample.payload().to_bytes(), false),
                Err(error) => (error.payload().to_bytes(), true),
            };
            // Zenoh says so itself.
            let is_late = is_refusal && *payload == *b"Timeout";
            let shared = identity.robots.get(&robot);
            let opened = shared.and_then(|(_, shared)| shared.open_answer(&asked, &payload));
            if let Some(verdict) = opened {
                machines.note(&robot, &name, true, asked_at, &verdict);
                on_reply(verdict);
            } else if !identity.told.may(&robot) {
                // The log has said so.
            } else if is_late {
                warn!(target: "fleet", "Robot '{robot}' does not answer a request.");
            } else if is_refusal {
                let said = brief(&String::from_utf8_lossy(&payload));
                warn!(target: "fleet", "Robot '{robot}', or somebody for it, refuses a request: {said}.");
            } else {
                warn!(target: "fleet", "An answer for robot '{robot}' does not have its key and is dropped.");
            }
        };
        let handler = CallbackDrop {
            callback,
            drop: on_end,
        };
        // Each reply counts by itself: none may take the place of the robot's.
        let query = self.session.get(key(request.robot, agent, "sealed"));
        let query = query
            .priority(priority)
            .express(true)
            .target(QueryTarget::All)
            .allowed_destination(Locality::Remote)
            .consolidation(ConsolidationMode::None);
        query.payload(sealed).timeout(limit).with(handler).wait()
    }

    /// A message of a stream of a robot, in the clear. `None` if it does not have the robot's key, or two agents have that.
    #[must_use]
    pub fn open_stream<'a>(&self, robot: &str, payload: &'a [u8]) -> Option<Cow<'a, [u8]>> {
        let Some(identity) = &self.identity else {
            return Some(Cow::Borrowed(payload));
        };
        let (agent, shared) = identity.robots.get(robot)?;
        if self.is_in_doubt(robot, agent) {
            return None;
        }
        shared.open_stream(payload).map(Cow::Owned)
    }

    /// Asks several agents at once, and waits for their replies; `None` where there is none within the limit. A robot that has
    /// to tell its clock first is asked again at once, whether or not the others have answered.
    #[must_use]
    pub fn ask_all(
        &self,
        agents: &[(String, String)],
        what: AgentQuery,
        body: &[u8],
        limit: Duration,
    ) -> Vec<Option<Verdict>> {
        let ask = |index: usize, parameters: &str, replies: Sender<Told>| {
            let Some((robot, agent)) = agents.get(index) else {
                return;
            };
            let request = Request {
                robot,
                what: what.name(),
                parameters,
                who: "ztl-fleet",
                body,
            };
            let on_reply = move |verdict| {
                let told = Told {
                    index,
                    verdict,
                    replies: replies.clone(),
                };
                // The receiver is there as long as this function.
                let _ = replies.send(told);
            };
            // Without an answer, the slot stays empty.
            let _ = self.ask(agent, &request, limit, on_reply, || {});
        };
        let (sender, receiver) = channel();
        for index in 0..agents.len() {
            ask(index, &fresh(0, 0), sender.clone());
        }
        // It ends when no question is open, as each holds a sender.
        drop(sender);
        let mut all = vec![None; agents.len()];
        for told in receiver {
            let Told {
                index,
                verdict,
                replies,
            } = told;
            match (all.get_mut(index), &verdict) {
                (Some(slot @ None), Verdict::Stale { boot, clock_ms }) => {
                    let again = fresh(*boot, clock_ms.saturating_add(VALID_MS));
                    *slot = Some(verdict);
                    ask(index, &again, replies);
                }
                (Some(slot @ (None | Some(Verdict::Stale { .. }))), _) => *slot = Some(verdict),
                _ => {}
            }
        }
        all
    }

    /// What agents say of their robots.
    #[must_use]
    pub fn infos(&self, agents: &[(String, String)], limit: Duration) -> Vec<Option<RobotInfo>> {
        let all = self.ask_all(agents, AgentQuery::Info, b"", limit);
        let read = |verdict: Option<Verdict>| match verdict {
            Some(Verdict::Answer(body)) => serde_json::from_slice(&body).ok(),
            _ => None,
        };
        all.into_iter().map(read).collect()
    }
}

/// The boot of the agent that answers, where it tells it.
fn boot(verdict: &Verdict) -> Option<u32> {
    match verdict {
        Verdict::Answer(body) if body.first() == Some(&b'{') => {
            let info: Option<RobotInfo> = serde_json::from_slice(body).ok();
            info.map(|info| info.boot)
        }
        Verdict::Stale { boot, .. } => Some(*boot),
        _ => None,
    }
}
