//! The endpoint: ZeroMQ on one side, Zenoh on the other, and [`Endpoint`] between them, on one thread.

mod arrivals;
mod events;
mod streams;
mod turns;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tracing::{info, warn};
use ztl_std::relay::{RelayAnswers, RelayPath, RelayServer, RelayedRequest};
use ztl_std::time::now;
use ztl_std::{Access, BindError};

use crate::caller::Caller;
use crate::config::EndpointConfig;
use crate::endpoint::{Ask, ClientRequest, Endpoint, EndpointEffect, robot_of};
use crate::random;
use crate::routers;
use crate::seal::Request;
use crate::seldom::SeldomOf;
use crate::session::{self, ZenohError};
use crate::wire::{AgentQuery, InitId, InitRules, RobotInfo, Verdict, fresh, is_abort};
use arrivals::{Arrivals, Known};
use events::{Event, Turn};
use streams::Bound;
use turns::Origin;

/// How often robots are asked what they are.
const INFO: Duration = Duration::from_secs(2);
/// How long a request that is no INIT may act, by the robot's clock.
const VALID_MS: u64 = 2500;

type Events = events::Events<RelayedRequest>;

/// An endpoint that is bound and does not serve yet.
pub struct Serving {
    server: RelayServer,
    streams: Option<Bound>,
    caller: Caller,
    access: Access,
    bind: String,
    /// The robots of the file.
    robots: Vec<String>,
}

impl Serving {
    /// Binds the port, and then connects to a router.
    ///
    /// # Errors
    /// [`BindError`], what is wrong with keys, or Zenoh's.
    pub fn bind(config: &EndpointConfig) -> Result<Self, ZenohError> {
        let access = config.access.clone()?;
        let bind = config.listen.bind.as_deref().unwrap_or("127.0.0.1");
        let port = config.listen.port.unwrap_or_default();
        let endpoint = format!("tcp://{bind}:{port}");
        let limits = config.listen.limits;
        let bound: Result<_, BindError> = RelayServer::bind(&endpoint, access.clone(), limits);
        let server = bound?;
        let streams = config.listen.publish.map(|port| {
            let endpoint = format!("tcp://{bind}:{port}");
            Bound::bind(&endpoint, access.clone(), limits)
        });
        let streams = streams.transpose()?;
        let session = session::open(&config.links)?;
        routers::watch(&session, &config.links)?;
        Ok(Self {
            server,
            streams,
            caller: Caller::new(session, config),
            access,
            bind: bind.to_owned(),
            robots: config.robots.keys().cloned().collect(),
        })
    }

    /// Where it listens, with the port that was chosen.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        self.server.endpoint()
    }

    /// Who can reach it; continues `Reachable for`.
    #[must_use]
    pub fn reachable(&self) -> String {
        self.access.reachable_at(&self.bind)
    }

    /// Where it publishes streams, if it does.
    #[must_use]
    pub fn publishes(&self) -> Option<&str> {
        self.streams.as_ref().map(Bound::endpoint)
    }

    /// Ends [`run`](Self::run).
    #[must_use]
    pub fn stopper(&self) -> RelayAnswers {
        self.server.answers()
    }

    /// Serves until it is stopped.
    ///
    /// # Errors
    /// The system's or Zenoh's; also if the publisher of the streams has ended.
    pub fn run(self) -> Result<(), ZenohError> {
        let events = Arc::new(Events::new());
        let presence = Arc::clone(&events);
        let has_no_publisher = Arc::new(AtomicBool::new(false));
        let streams = self.streams.map(|streams| {
            let (caller, access) = (self.caller.clone(), self.access.clone());
            let (ended, answers) = (Arc::clone(&has_no_publisher), self.server.answers());
            streams.start(caller, access, move || {
                ended.store(true, Ordering::SeqCst);
                answers.stop();
            })
        });
        session::watch_presence(self.caller.session(), "*", move |robot, agent, is_there| {
            presence.put_presence((robot.to_owned(), agent.to_owned()), is_there);
        })?;
        let mut machine = Endpoint::new(random::boot()?);
        machine.expect(self.robots);
        let loops = Loop {
            machine,
            streams: streams.transpose()?,
            caller: self.caller,
            told: SeldomOf::default(),
            answers: self.server.answers(),
            access: self.access,
            events: Arc::clone(&events),
            waiting: HashMap::new(),
            who: HashMap::new(),
            next: 0,
        };
        let thread = std::thread::Builder::new().name("ztl-fleet-rules".to_owned());
        // It ends when the process does.
        drop(thread.spawn(move || loops.run())?);
        self.server.listen(|request| {
            let body = request.body.as_deref().unwrap_or_default();
            let origin = Origin {
                connection: request.connection,
                robot: robot_of(body).to_owned(),
            };
            let is_abort = is_abort(body);
            events.put_request(&origin, request, is_abort);
        })?;
        match has_no_publisher.load(Ordering::SeqCst) {
            true => Err("the publisher of the robots' streams has ended".into()),
            false => Ok(()),
        }
    }
}

/// What the endpoint's thread owns.
struct Loop {
    machine: Endpoint,
    /// What the thread of the streams has to know.
    streams: Option<Arc<Arrivals>>,
    caller: Caller,
    /// Limits how often it is told who claims a name: that of a robot with a known key, and any other.
    told: SeldomOf<Option<String>>,
    answers: RelayAnswers,
    access: Access,
    events: Arc<Events>,
    /// Requests without an answer yet.
    waiting: HashMap<u64, (Turn, RelayPath)>,
    /// The keys of the clients that wait, for the robots' logs.
    who: HashMap<u64, String>,
    next: u64,
}

impl Loop {
    fn run(mut self) {
        let mut ask_infos = now() + INFO;
        loop {
            let wake = self.machine.poll_timeout();
            let wake = wake.map_or(ask_infos, |wake| wake.min(ask_infos));
            if let Some(event) = self.events.next(wake.since(now())) {
                let effects = self.on_event(event);
                self.carry_out(effects);
            }
            let now = now();
            if self.machine.poll_timeout().is_some_and(|at| at <= now) {
                let effects = self.machine.handle_timeout(now);
                self.carry_out(effects);
            }
            if now >= ask_infos {
                ask_infos = now + INFO;
                let robots = self.machine.robots();
                let robots: Vec<(String, String)> = robots
                    .map(|(robot, agent)| (robot.to_owned(), agent.to_owned()))
                    .collect();
                for (robot, agent) in robots {
                    self.ask_info(&robot, &agent);
                }
            }
        }
    }

    fn on_event(&mut self, event: Event<RelayedRequest>) -> Vec<EndpointEffect> {
        match event {
            Event::Request(turn, arrived, request) => {
                self.next += 1;
                let Ok(fresh) = random::id() else {
                    // Without random numbers, an INIT could be taken for another.
                    self.events.end(&turn);
                    return Vec::new();
                };
                let asked = ClientRequest {
                    request: self.next,
                    envelope: request.envelope,
                    fresh,
                    body: request.body.as_deref(),
                };
                self.waiting.insert(self.next, (turn, request.path));
                let (client, access) = (request.client, &self.access);
                if let Some(key) = client {
                    self.who.insert(self.next, key.to_string());
                }
                let may_use = |scope: &str| {
                    // A rule may name a scope of a robot, or the whole robot.
                    let robot = scope.match_indices('/').nth(1);
                    let robot = robot.and_then(|(end, _)| scope.get(..end));
                    let may = |key| {
                        access.may_use(&key, scope)
                            || robot.is_some_and(|robot| access.may_use(&key, robot))
                    };
                    client.is_none_or(may)
                };
                let robot = robot_of(asked.body.unwrap_or_default());
                if let Some(agent) = self.machine.served(robot) {
                    let is_doubted = self.caller.is_in_doubt(robot, agent);
                    self.machine.handle_doubt(robot, is_doubted);
                }
                // Its client has waited since then.
                self.machine.handle_request(arrived, asked, may_use)
            }
            Event::Verdict(query, verdict) => self.machine.handle_verdict(now(), query, verdict),
            Event::NoReply(query) => self.machine.handle_no_reply(now(), query),
            Event::Presence((robot, agent), is_there) if !self.caller.accepts(&robot, &agent) => {
                if is_there {
                    self.refuse(&robot, &agent);
                }
                Vec::new()
            }
            Event::Presence((robot, agent), true) => {
                info!(target: "fleet", "Robot '{robot}' is there (agent {agent}).");
                self.machine.handle_alive(&robot, &agent)
            }
            Event::Presence((robot, agent), false) => {
                info!(target: "fleet", "Robot '{robot}' is gone (agent {agent}).");
                self.tell_streams(&robot, &agent, None);
                self.machine.handle_gone(&robot, &agent)
            }
            Event::Info(info) => {
                let (robot, agent) = (info.name.clone(), info.agent.clone());
                let known = info.streams.then(|| Known {
                    agent: agent.clone(),
                    clock: (info.boot, info.clock_ms, now()),
                    scopes: info.scopes.clone(),
                });
                self.tell_streams(&robot, &agent, known);
                self.machine.handle_info(now(), &robot, &agent, info);
                Vec::new()
            }
        }
    }

    /// Tells the thread of the streams that the agent of a robot has some, or has none.
    fn tell_streams(&self, robot: &str, agent: &str, known: Option<Known>) {
        if let Some(streams) = &self.streams
            && self.machine.served(robot) == Some(agent)
        {
            streams.put_robot(robot, known);
        }
    }

    fn carry_out(&mut self, effects: Vec<EndpointEffect>) {
        for effect in effects {
            match effect {
                EndpointEffect::Answer { request, body } => {
                    if let Some(path) = self.end(request) {
                        self.answers.send(path, body);
                    }
                }
                EndpointEffect::Silence { request } => drop(self.end(request)),
                EndpointEffect::Ask {
                    query,
                    robot,
                    agent,
                    what,
                    limit,
                } => self.ask(query, &robot, &agent, what, limit),
                EndpointEffect::AskInfo { robot, agent } => self.ask_info(&robot, &agent),
                EndpointEffect::Rivals {
                    robot,
                    agent,
                    rival,
                } => {
                    warn!(target: "fleet", "Agents {agent} and {rival} claim the name '{robot}'; the first one is served.");
                }
            }
        }
    }

    /// A request is not under way any more. Returns the way back for its answer.
    fn end(&mut self, request: u64) -> Option<RelayPath> {
        self.who.remove(&request);
        let (turn, path) = self.waiting.remove(&request)?;
        self.events.end(&turn);
        Some(path)
    }

    /// Tells who claims a name that is bound to another key, and who has it.
    fn refuse(&self, robot: &str, agent: &str) {
        let bound = self.caller.bound(robot);
        if !self.told.may(&bound.map(|_| robot.to_owned())) {
            return;
        }
        let Some(bound) = bound else {
            warn!(target: "fleet", "Agent {agent} claims the name '{robot}', for which no key is known here; it is not served.");
            return;
        };
        warn!(target: "fleet", "Agent {agent} claims the name '{robot}', which belongs to the key of agent {bound}; it is not served.");
        for (agent, other) in [(agent, bound), (bound, agent)] {
            // Whoever does not hear it is not served either.
            let _ = session::claim(self.caller.session(), robot, agent, other, INFO, || {});
        }
    }

    fn ask(&self, query: u64, robot: &str, agent: &str, what: Ask, limit: Duration) {
        let (boot, clock_ms) = self.machine.clock(now(), robot);
        let until_ms = clock_ms.saturating_add(VALID_MS);
        let mut early = "";
        let (what, rules, body) = match what {
            Ask::Request {
                rules,
                envelope,
                body,
            } => {
                let plain = envelope.map(|envelope| InitRules {
                    id: InitId {
                        client: envelope.client,
                        number: envelope.number,
                    },
                    boot,
                    until_ms,
                });
                if rules.is_some() && envelope.is_some_and(|envelope| envelope.early_end) {
                    early = ";early=1";
                }
                (AgentQuery::Request, rules.or(plain), body)
            }
            Ask::Outcome(rules) => (AgentQuery::Outcome, Some(rules), Vec::new()),
        };
        let parameters = rules.map_or_else(|| fresh(boot, until_ms), |rules| rules.to_parameters());
        let who = self.machine.request_of(query);
        let who = who.and_then(|request| self.who.get(&request));
        let request = Request {
            robot,
            what: what.name(),
            parameters: &(parameters + early),
            who: who.map_or("anybody", String::as_str),
            body: &body,
        };
        let (replies, ends) = (Arc::clone(&self.events), Arc::clone(&self.events));
        let on_reply = move |verdict| replies.put_reply(Event::Verdict(query, verdict));
        let on_end = move || ends.put_reply(Event::NoReply(query));
        let asked = self.caller.ask(agent, &request, limit, on_reply, on_end);
        if asked.is_err() {
            self.events.put_reply(Event::NoReply(query));
        }
    }

    fn ask_info(&self, robot: &str, agent: &str) {
        let events = Arc::clone(&self.events);
        let names = (robot.to_owned(), agent.to_owned());
        let on_reply = move |verdict| {
            // A robot may speak for itself only.
            if let Verdict::Answer(body) = verdict
                && let Ok(info) = serde_json::from_slice::<RobotInfo>(&body)
                && (&info.name, &info.agent) == (&names.0, &names.1)
            {
                events.put_reply(Event::Info(info));
            }
        };
        let request = Request {
            robot,
            what: AgentQuery::Info.name(),
            parameters: "",
            who: "ztl-fleet",
            body: b"",
        };
        // It is asked again soon.
        let _ = self.caller.ask(agent, &request, INFO, on_reply, || {});
    }
}
