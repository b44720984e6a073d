//! The agent beside a robot's server: Zenoh on one side, ZeroMQ on the other, and [`Agent`] between them.

mod asked;
mod requests;
mod rivals;
mod server;
mod stop;
mod streams;
mod threads;

use std::collections::HashMap;
use std::sync::atomic::AtomicUsize;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant, UNIX_EPOCH};

use tracing::{info, warn};
use zenoh::query::Query;
use zenoh::{Session, Wait as _};
use ztl_std::relay::RelayClient;
use ztl_std::time::now;

use crate::agent::Agent;
use crate::config::AgentConfig;
use crate::journal::Journal;
use crate::random;
use crate::routers;
use crate::seal;
use crate::seldom::{Seldom, SeldomOf};
use crate::session::{self, ZenohError, key};
use crate::wire::{AgentQuery, RobotInfo, Verdict, millis};
use asked::{Asked, Clients, Seen};
use requests::{Aborting, Rules};
use server::ServerState;
use stop::Started;
use streams::Subscriptions;
use threads::Job;

const TOO_MANY: &str = "too many requests are waiting, try again";
/// How often deadlines are checked.
const TICK: Duration = Duration::from_millis(100);
/// How long others with this name or id may take to answer.
const CLAIM: Duration = Duration::from_secs(1);
/// The same before this agent joins. If there are no others, routers say so at once.
const JOINING: Duration = Duration::from_secs(5);
/// Longest request in bytes, as on ZeroMQ.
const LONGEST: usize = ztl_std::server::MAX_MESSAGE;

/// Why an agent ends.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum JoinEnd {
    /// Another agent has the name.
    NameTaken {
        /// The name.
        robot: String,
        /// The agent that has it.
        by: String,
    },
    /// Another agent has the robot's name and its key, or a copy of its directory.
    Copied {
        /// The robot's name.
        robot: String,
    },
}

impl std::fmt::Display for JoinEnd {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NameTaken { robot, by } => write!(
                f,
                "the name '{robot}' is taken by agent {by}; give this robot another name, or stop that agent"
            ),
            Self::Copied { robot } => write!(
                f,
                "another agent has the name and the key of robot '{robot}', or its id; give each robot its own name, key and 'state' directory, or stop that agent"
            ),
        }
    }
}

impl std::error::Error for JoinEnd {}

/// What the agent's threads share.
struct Shared {
    config: AgentConfig,
    /// The agent's id.
    id: String,
    since: u64,
    /// When it claimed the name.
    claimed: Instant,
    session: Session,
    client: RelayClient,
    /// Who may ask, if the robot has a key.
    clients: Clients,
    seen: Mutex<Seen>,
    told: Told,
    rules: Mutex<Rules>,
    server: Mutex<ServerState>,
    started: Mutex<Started>,
    /// When another machine was heard that has this agent's id.
    copy: Mutex<Option<Instant>>,
    subscriptions: Mutex<Subscriptions>,
    busy: AtomicUsize,
    waiting: AtomicUsize,
    aborting: Aborting,
    /// Threads that wait for a query.
    idle: Mutex<Vec<Sender<Job>>>,
    ends: Mutex<Sender<JoinEnd>>,
}

/// Limits what strangers can make it log.
#[derive(Debug, Default)]
struct Told {
    refusals: Seldom,
    rivals: Seldom,
    claims: Seldom,
    copies: Seldom,
    /// By the keys that ask for what they may not use.
    rights: SeldomOf<Option<[u8; 32]>>,
}

/// A robot's agent, which runs until it is dropped.
pub struct Joined {
    session: Session,
    shared: Arc<Shared>,
    ends: Receiver<JoinEnd>,
}

impl Joined {
    /// Joins the fleet, once a router is reached.
    ///
    /// # Errors
    /// What is wrong with the files or with Zenoh, and [`JoinEnd::NameTaken`].
    pub fn join(config: AgentConfig) -> Result<Self, ZenohError> {
        let keys = config.keys.as_ref().map(|keys| keys.read()).transpose()?;
        let client = RelayClient::new(&config.server, keys)?;
        let (mut journal, found) = Journal::open(&config.state, random::id()?)?;
        let agent = Agent::new(now(), random::boot()?, &found.entries, found.complete);
        if let Err(error) = journal.rewrite(&agent.entries()) {
            // With the mark, nothing acts that cannot be written, and a later agent knows that entries are missing.
            if journal.mark().is_err() {
                return Err(error.into());
            }
            warn!(target: "fleet", "The journal cannot be written, so no task starts until it can: {error}");
        }
        let session = session::open(&config.links)?;
        routers::watch(&session, &config.links)?;
        let robot = config.name.clone();
        let since = UNIX_EPOCH.elapsed().unwrap_or_default().as_secs();
        let (sender, ends) = channel();
        let identity = config.identity.as_ref();
        if identity.is_some_and(|identity| identity.clients.is_empty()) {
            warn!(target: "fleet", "No client may use this robot: 'client-keys' is empty.");
        }
        let shared = Arc::new(Shared {
            client,
            clients: identity.map(asked::clients).unwrap_or_default(),
            seen: Mutex::default(),
            told: Told::default(),
            // With a key, the id belongs to it.
            id: identity.map_or(found.agent, |identity| {
                seal::agent_of(&identity.own.public())
            }),
            since,
            claimed: Instant::now(),
            rules: Mutex::new(Rules {
                agent,
                journal,
                queries: HashMap::new(),
                next: 0,
            }),
            server: Mutex::default(),
            started: Mutex::default(),
            copy: Mutex::default(),
            subscriptions: Mutex::default(),
            session: session.clone(),
            busy: AtomicUsize::new(0),
            waiting: AtomicUsize::new(0),
            aborting: Aborting::default(),
            idle: Mutex::default(),
            ends: Mutex::new(sender),
            config,
        });
        let id = &shared.id;
        let present = session::present(&session, &robot, JOINING)?;
        // With a key, others cannot take the name: endpoints know whose it is.
        let has_key = shared.config.identity.is_some();
        let mut others = present.into_iter().filter(|(_, agent)| agent != id);
        if let Some((_, other)) = others.next().filter(|_| !has_key) {
            shared.tell_refused(&session, &other)?;
            return Err(JoinEnd::NameTaken { robot, by: other }.into());
        }
        if shared.others_with_id(JOINING).is_some() {
            shared.tell_refused(&session, id)?;
            return Err(JoinEnd::Copied { robot }.into());
        }
        shared.probe();
        shared.offer(&session)?;
        shared.spawn("ztl-fleet-tick", TICK, |shared| {
            shared.run(|rules| rules.agent.handle_timeout(now()));
        })?;
        shared.spawn("ztl-fleet-probe", server::AGAIN, Shared::probe)?;
        shared.spawn("ztl-fleet-copies", rivals::AGAIN, Shared::look_for_copy)?;
        let alive = session.liveliness().declare_token(key(&robot, id, "alive"));
        // It lasts as long as the session.
        std::mem::forget(alive.wait()?);
        let weak = (Arc::downgrade(&shared), session.clone());
        session::watch_presence(&session, &robot, move |_, other, is_there| {
            let (shared, session) = &weak;
            if let Some(shared) = shared.upgrade()
                && is_there
                && other != shared.id
            {
                if shared.config.identity.is_some() {
                    shared.warn_of_rival(other);
                    return;
                }
                let (session, other) = (session.clone(), other.to_owned());
                // Zenoh's thread must not wait.
                shared.spawn_busy(move |shared| shared.on_rival(&session, other));
            }
        })?;
        info!(target: "fleet", "Robot '{robot}' has joined as agent {id}.");
        Ok(Self {
            session,
            shared,
            ends,
        })
    }

    /// Waits until the agent has to end, at most for `limit`.
    #[must_use]
    pub fn wait(&self, limit: Duration) -> Option<JoinEnd> {
        self.ends.recv_timeout(limit).ok()
    }
}

impl Drop for Joined {
    fn drop(&mut self) {
        info!(target: "fleet", "Robot '{}' leaves.", self.shared.config.name);
        // The system would close it, too.
        let _ = self.session.close().wait();
    }
}

impl Shared {
    fn rules(&self) -> MutexGuard<'_, Rules> {
        self.rules.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Calls `act` at this interval for as long as the agent is there.
    fn spawn(
        self: &Arc<Self>,
        name: &str,
        interval: Duration,
        act: impl Fn(&Self) + Send + 'static,
    ) -> std::io::Result<()> {
        let weak: Weak<Self> = Arc::downgrade(self);
        let thread = std::thread::Builder::new().name(name.to_owned());
        thread.spawn(move || {
            while let Some(shared) = weak.upgrade() {
                act(&shared);
                drop(shared);
                std::thread::sleep(interval);
            }
        })?;
        Ok(())
    }

    /// Declares what the agent answers.
    fn offer(self: &Arc<Self>, session: &Session) -> Result<(), ZenohError> {
        type Answerer = Box<dyn Fn(&Arc<Shared>, Query) + Send + Sync>;
        let plain = |what: AgentQuery| -> (&str, Answerer) {
            let answer = move |shared: &Arc<Self>, query| shared.answer(what, Asked::plain(query));
            (what.name(), Box::new(answer))
        };
        let mut offered: Vec<(&str, Answerer)> = match self.config.identity {
            None => AgentQuery::ALL.map(plain).into(),
            Some(_) => vec![("sealed", Box::new(Self::on_sealed))],
        };
        offered.push(("claim", Box::new(Self::on_claim)));
        for (what, answer) in offered {
            let answer = Arc::new(answer);
            let weak = Arc::downgrade(self);
            let key = key(&self.config.name, &self.id, what);
            let queryable = session.declare_queryable(key.clone()).complete(true);
            let queryable = queryable.callback(move |query| {
                let Some(shared) = weak.upgrade() else {
                    return;
                };
                if query.key_expr().as_str() != key {
                    // Who looks at everything, as with `ztl/**`, does not mean to stop or to start anything.
                    let reason = format!("ask exactly {key}");
                    let _ = query
                        .reply_err(Verdict::NotStarted(reason).to_string())
                        .wait();
                    return;
                }
                let (refused, answer) = (query.clone(), Arc::clone(&answer));
                if !shared.spawn_busy(move |shared| answer(shared, query)) {
                    // An earlier copy may have acted. (A client with a key believes a sealed answer only.)
                    let reason = Verdict::Unknown(TOO_MANY.to_owned()).to_string();
                    let _ = refused.reply_err(reason).wait();
                }
            });
            queryable.background().wait()?;
        }
        Ok(())
    }

    fn answer(self: &Arc<Self>, what: AgentQuery, asked: Asked) {
        match what {
            AgentQuery::Request => self.on_request(asked),
            AgentQuery::Outcome => self.on_outcome(asked),
            AgentQuery::Info => self.on_info(&asked),
            AgentQuery::Stop => self.on_stop(&asked),
            AgentQuery::Streams => self.on_streams(&asked),
        }
    }

    fn on_info(self: &Arc<Self>, asked: &Asked) {
        let mut info = self.info();
        info.scopes.retain(|scope| self.may_use(asked, Some(scope)));
        if !self.may_use(asked, None) {
            info.server = None;
        }
        if let Ok(body) = serde_json::to_vec(&info) {
            asked.reply(&Verdict::Answer(body));
        }
    }

    /// The robot's scopes, as far as they are known.
    fn scopes(&self, server: &ServerState) -> Vec<String> {
        match server.scopes.is_empty() {
            true => self.config.scopes.clone(),
            false => server.scopes.clone(),
        }
    }

    /// What the robot is.
    fn info(&self) -> RobotInfo {
        let server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        let rules = self.rules();
        let problem = server.problem.clone();
        let problem = problem.or_else(|| self.has_copy().then(|| rivals::COPY.to_owned()));
        RobotInfo {
            ztl_fleet: 1,
            name: self.config.name.clone(),
            agent: self.id.clone(),
            boot: rules.agent.boot(),
            clock_ms: now().as_millis(),
            since: self.since,
            held_ms: millis(self.claimed.elapsed()),
            groups: self.config.groups.clone(),
            streams: self.config.publish.is_some(),
            ready: problem.is_none(),
            problem,
            server: server.probed.clone(),
            scopes: self.scopes(&server),
        }
    }
}
