//! The agent beside a robot's server: Zenoh on one side, ZeroMQ on the other, and [`Agent`] between them.

mod asked;
mod server;
mod stop;
mod threads;

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, UNIX_EPOCH};

use tracing::{error, info, warn};
use zenoh::query::Query;
use zenoh::{Session, Wait as _};
use ztl_core::Message;
use ztl_core::envelope::Envelope;
use ztl_std::relay::{NotRelayed, RelayClient};
use ztl_std::time::now;

use crate::agent::{Agent, AgentEffect, ServerSaid};
use crate::caller::Caller;
use crate::config::AgentConfig;
use crate::journal::Journal;
use crate::random;
use crate::seal;
use crate::seldom::{Seldom, brief};
use crate::session::{self, ZenohError, key};
use crate::wire::{InitId, InitRules, RobotInfo, Verdict, from_hex, is_abort, is_early};
use asked::{Asked, Clients, Seen};
use server::ServerState;
use stop::Started;
pub use stop::Stopped;
use threads::Job;

/// Longest wait for the server's answer: as long as a client waits.
const ANSWER: Duration = Duration::from_secs(2);
/// Most queries at a time that may wait for the robot's server, except ABORT and `stop`, which no flood of others may hold up.
const MOST_WAITING: usize = 128;
const TOO_MANY: &str = "too many requests are waiting, try again";
/// How often deadlines are checked.
const TICK: Duration = Duration::from_millis(100);
/// How long the fleet is asked who has the name.
const CLAIM: Duration = Duration::from_secs(1);
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
    /// Another agent has the robot's key.
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
                "another agent has the name and the key of robot '{robot}'; give each robot its own, or stop that agent"
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
    client: RelayClient,
    /// Who may ask, if the robot has a key.
    clients: Clients,
    seen: Mutex<Seen>,
    told: Told,
    rules: Mutex<Rules>,
    server: Mutex<ServerState>,
    started: Mutex<Started>,
    busy: AtomicUsize,
    waiting: AtomicUsize,
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
}

/// The rules with what they decide about.
struct Rules {
    agent: Agent,
    journal: Journal,
    queries: HashMap<u64, Asked>,
    next: u64,
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
        journal.rewrite(&agent.entries())?;
        let session = session::open(&config.links, false)?;
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
            rules: Mutex::new(Rules {
                agent,
                journal,
                queries: HashMap::new(),
                next: 0,
            }),
            server: Mutex::default(),
            started: Mutex::default(),
            busy: AtomicUsize::new(0),
            waiting: AtomicUsize::new(0),
            idle: Mutex::default(),
            ends: Mutex::new(sender),
            config,
        });
        let id = &shared.id;
        let present = session::present(&session, &robot, CLAIM)?;
        // With a key, others cannot take the name: endpoints know whose it is.
        let has_key = shared.config.identity.is_some();
        let mut others = present.into_iter().filter(|(_, agent)| agent != id);
        if let Some((_, other)) = others.next().filter(|_| !has_key) {
            // That one is told, too.
            let (told, end) = channel();
            let on_end = move || {
                let _ = told.send(());
            };
            session::claim(&session, &robot, &other, id, CLAIM, on_end)?;
            let _ = end.recv();
            return Err(JoinEnd::NameTaken { robot, by: other }.into());
        }
        if let Some(identity) = &shared.config.identity {
            let caller = Caller::of_itself(session.clone(), &robot, &identity.own);
            let copies = caller.infos(&[(robot.clone(), id.clone())], CLAIM);
            if copies.iter().any(Option::is_some) {
                return Err(JoinEnd::Copied { robot }.into());
            }
        }
        shared.probe();
        shared.offer(&session)?;
        shared.spawn("ztl-fleet-tick", TICK, |shared| {
            shared.run(|rules| rules.agent.handle_timeout(now()));
        })?;
        shared.spawn("ztl-fleet-probe", server::AGAIN, Shared::probe)?;
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
        type Answerer = fn(&Arc<Shared>, Query);
        let plain: [(&str, Answerer); 4] = [
            ("request", |shared, query| {
                shared.on_request(Asked::plain(query))
            }),
            ("outcome", |shared, query| {
                shared.on_outcome(Asked::plain(query))
            }),
            ("info", |shared, query| shared.on_info(Asked::plain(query))),
            ("stop", |shared, query| shared.on_stop(Asked::plain(query))),
        ];
        let sealed: [(&str, Answerer); 1] = [("sealed", Shared::on_sealed)];
        let offered = match self.config.identity {
            None => &plain[..],
            Some(_) => &sealed[..],
        };
        let claim: (&str, Answerer) = ("claim", Shared::on_claim);
        for &(what, answer) in offered.iter().chain([&claim]) {
            let weak = Arc::downgrade(self);
            let key = key(&self.config.name, &self.id, what);
            let queryable = session.declare_queryable(key).complete(true);
            let queryable = queryable.callback(move |query| {
                let Some(shared) = weak.upgrade() else {
                    return;
                };
                let refused = query.clone();
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

    /// A request to the robot's server.
    fn on_request(self: &Arc<Self>, asked: Asked) {
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
        let place = Place::take(&self.waiting);
        if place.is_none() && !is_abort {
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
    fn on_outcome(self: &Arc<Self>, asked: Asked) {
        let Some(_place) = Place::take(&self.waiting) else {
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

    fn on_info(self: &Arc<Self>, asked: Asked) {
        let mut info = self.info();
        info.scopes
            .retain(|scope| self.may_use(&asked, Some(scope)));
        if !self.may_use(&asked, None) {
            info.server = None;
        }
        if let Ok(body) = serde_json::to_vec(&info) {
            asked.reply(&Verdict::Answer(body));
        }
    }

    /// Another agent was refused the name of this one.
    fn on_claim(self: &Arc<Self>, query: Query) {
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
    fn warn_of_rival(&self, other: &str) {
        let robot = &self.config.name;
        if self.told.rivals.may() {
            warn!(target: "fleet", "Agent {other} claims the name '{robot}', too; endpoints serve the one whose key they know.");
        }
    }

    /// Another agent has the same name: of two networks that met. The older claim stays.
    fn on_rival(&self, session: &Session, other: String) {
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

    /// What the robot is.
    fn info(&self) -> RobotInfo {
        let server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        let rules = self.rules();
        RobotInfo {
            ztl_fleet: 1,
            name: self.config.name.clone(),
            agent: self.id.clone(),
            boot: rules.agent.boot(),
            clock_ms: now().as_millis(),
            since: self.since,
            groups: self.config.groups.clone(),
            ready: server.problem.is_none(),
            problem: server.problem.clone(),
            server: server.probed.clone(),
            scopes: match server.scopes.is_empty() {
                true => self.config.scopes.clone(),
                false => server.scopes.clone(),
            },
        }
    }

    /// Carries out what the rules decide, in order.
    fn run(&self, decide: impl FnOnce(&mut Rules) -> Vec<AgentEffect>) {
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

/// The place of a query that may wait for the robot's server.
struct Place<'a>(&'a AtomicUsize);

impl<'a> Place<'a> {
    fn take(taken: &'a AtomicUsize) -> Option<Self> {
        let place = Self(taken);
        // It is given back if there was none.
        (taken.fetch_add(1, Ordering::SeqCst) < MOST_WAITING).then_some(place)
    }
}

impl Drop for Place<'_> {
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
