//! The processes of a fleet, connected like those of `ztl-fleet`.

use std::time::Duration;

use ztl_core::dispatcher::TaskEvent;
use ztl_core::envelope::Envelope;
use ztl_core::{Instant, State, TaskId};

use super::super::ends::fleet::agent::{Agent, AgentEffect, Entry, ServerSaid};
use super::super::ends::fleet::endpoint::{Ask, Endpoint, EndpointEffect};
use super::super::ends::fleet::wire::{InitId, RobotInfo, Verdict};
use super::robot::{Disk, Job, Robot, Running, SCOPES, Server, ending};
use super::{EndpointCopy, Event, FromAgent, ROBOTS, Return, World, agent_id, name, running, said};

/// How long an agent waits for its server, in milliseconds.
const ANSWER: u64 = 2000;

impl World {
    pub(super) fn wake(&self) -> Instant {
        let endpoints = self.endpoints.iter().flatten();
        let endpoints =
            endpoints.filter_map(|endpoint| local(endpoint.started, endpoint.rules.poll_timeout()));
        let agents = self.robots.iter().filter_map(|robot| robot.agent.as_ref());
        let agents = agents.filter_map(|agent| local(agent.started, agent.rules.poll_timeout()));
        let servers = self.robots.iter().filter_map(|robot| robot.server.as_ref());
        let servers = servers.filter_map(|server| server.rules.poll_timeout());
        let all = endpoints.chain(agents).chain(servers).min();
        all.unwrap_or(Instant::NEVER)
    }

    pub(super) fn timeouts(&mut self) {
        let now = self.now;
        for endpoint in 0..self.endpoints.len() {
            if let Some(at) = self.endpoints[endpoint]
                .as_ref()
                .map(|endpoint| endpoint.clock(now))
            {
                let effects = self.with_endpoint(endpoint, |rules| rules.handle_timeout(at));
                self.endpoint_effects(endpoint, effects);
            }
        }
        for robot in 0..ROBOTS {
            let effects = self.with_agent(robot, |rules, at| rules.handle_timeout(at));
            self.agent_effects(robot, effects);
            if let Some(server) = &mut self.robots[robot].server {
                server.timeout(now);
            }
            self.flush(robot);
        }
    }

    /// The clock of an endpoint that runs with this boot id.
    pub(super) fn at(&self, endpoint: usize, boot: u32) -> Option<Instant> {
        let endpoint = self.endpoints[endpoint].as_ref()?;
        (endpoint.boot == boot).then(|| endpoint.clock(self.now))
    }

    pub(super) fn with_endpoint(
        &mut self,
        endpoint: usize,
        act: impl FnOnce(&mut Endpoint) -> Vec<EndpointEffect>,
    ) -> Vec<EndpointEffect> {
        let endpoint = self.endpoints[endpoint].as_mut();
        endpoint
            .map(|endpoint| act(&mut endpoint.rules))
            .unwrap_or_default()
    }

    fn with_agent(
        &mut self,
        robot: usize,
        act: impl FnOnce(&mut Agent, Instant) -> Vec<AgentEffect>,
    ) -> Vec<AgentEffect> {
        let now = self.now;
        let agent = self.robots[robot].agent.as_mut();
        let act = |agent: &mut Running| {
            let at = agent.clock(now);
            act(&mut agent.rules, at)
        };
        agent.map(act).unwrap_or_default()
    }

    pub(super) fn endpoint_effects(&mut self, endpoint: usize, effects: Vec<EndpointEffect>) {
        let Some(boot) = self.endpoints[endpoint]
            .as_ref()
            .map(|endpoint| endpoint.boot)
        else {
            return;
        };
        for effect in effects {
            match effect {
                EndpointEffect::Answer { request, body } => {
                    for time in self.arrivals().into_iter().take(1) {
                        self.after(time.min(5000), Event::ToClient(request, body.clone()));
                    }
                }
                EndpointEffect::Silence { .. } => self.figures.silent += 1,
                EndpointEffect::Ask {
                    query,
                    robot,
                    what,
                    limit,
                    ..
                } => {
                    let robot = (0..ROBOTS).find(|known| name(*known) == robot);
                    let robot = robot.expect("it was announced");
                    let back = (endpoint, boot, query);
                    self.note(|| {
                        format!("endpoint {endpoint} query {query} to robot {robot}: {what:?}")
                    });
                    let mut limit = u64::try_from(limit.as_millis()).unwrap_or(u64::MAX);
                    if !self.cut[endpoint][robot] {
                        for time in self.arrivals() {
                            self.after(time, Event::ToAgent(robot, back, what.clone()));
                        }
                    }
                    // A router that loses its neighbour ends queries early, whatever became of them.
                    if !self.calm && self.dice.chance(0.5) {
                        limit = self.dice.below(limit + 1);
                    }
                    self.after(limit, Event::End(back));
                }
                EndpointEffect::AskInfo { robot, .. } => {
                    let robot = (0..ROBOTS).find(|known| name(*known) == robot);
                    self.ask_info(endpoint, robot.expect("it was announced"));
                }
                EndpointEffect::Rivals { .. } => {}
            }
        }
    }

    pub(super) fn look(&mut self, endpoint: usize) {
        let wait = match self.calm {
            true => 1000,
            false => 300 + self.dice.below(2500),
        };
        self.after(wait, Event::Look(endpoint));
        for robot in 0..ROBOTS {
            let is_there = self.robots[robot].agent.is_some() && !self.cut[endpoint][robot];
            let Some(known) = &mut self.endpoints[endpoint] else {
                return;
            };
            let was_there = std::mem::replace(&mut known.seen[robot], is_there);
            let (name, id) = (name(robot), agent_id(robot));
            let effects = match (was_there, is_there) {
                (false, true) => known.rules.handle_alive(&name, &id),
                (true, false) => known.rules.handle_gone(&name, &id),
                _ => Vec::new(),
            };
            self.endpoint_effects(endpoint, effects);
            if is_there {
                self.ask_info(endpoint, robot);
            }
        }
    }

    fn ask_info(&mut self, endpoint: usize, robot: usize) {
        let (Some(boot), Some(agent)) = (
            self.endpoints[endpoint]
                .as_ref()
                .map(|endpoint| endpoint.boot),
            &self.robots[robot].agent,
        ) else {
            return;
        };
        if self.cut[endpoint][robot] {
            return;
        }
        let info = RobotInfo {
            ztl_fleet: 1,
            name: name(robot),
            agent: agent_id(robot),
            boot: agent.rules.boot(),
            clock_ms: agent.clock(self.now).as_millis(),
            since: 0,
            held_ms: 0,
            groups: Vec::new(),
            streams: false,
            ready: true,
            problem: None,
            server: None,
            scopes: SCOPES.iter().map(|scope| (*scope).to_owned()).collect(),
        };
        // Nobody waits for a later one.
        for time in self.arrivals().into_iter().filter(|time| *time < 2000) {
            self.after(time, Event::Info(endpoint, boot, info.clone()));
        }
    }

    /// A query arrives at a robot's agent.
    pub(super) fn on_query(&mut self, robot: usize, back: Return, ask: Ask) {
        let server = self.robots[robot].server.as_ref();
        let server = server.filter(|server| !server.original);
        let server = server.map(|server| server.boot);
        let Some(agent) = &mut self.robots[robot].agent else {
            return;
        };
        let boot = agent.rules.boot();
        agent.next += 1;
        let query = agent.next;
        agent.queries.insert(query, back);
        let effects = match ask {
            Ask::Request {
                rules: Some(rules),
                body,
                ..
            } => self.with_agent(robot, |agent, at| {
                agent.handle_init(at, query, rules, &body, server)
            }),
            Ask::Outcome(rules) => {
                self.with_agent(robot, |agent, at| agent.handle_outcome(at, query, rules))
            }
            Ask::Request { envelope, body, .. } => {
                let envelope = envelope.map(|known| {
                    let id = InitId {
                        client: known.client,
                        number: known.number,
                    };
                    (id, known.early_end)
                });
                return self.forward(robot, boot, FromAgent::Plain(back), envelope, body);
            }
        };
        self.agent_effects(robot, effects);
    }

    fn reply(&mut self, robot: usize, back: Return, verdict: &Verdict) {
        if self.cut[back.0][robot] {
            return;
        }
        for time in self.arrivals() {
            // As it is on the network.
            let (is_answer, payload) = verdict.to_payload();
            let verdict = match is_answer {
                true => Verdict::Answer(payload),
                false => Verdict::of_error(&payload),
            };
            self.after(time, Event::ToEndpoint(back, verdict));
        }
    }

    fn agent_effects(&mut self, robot: usize, effects: Vec<AgentEffect>) {
        let mut effects = effects.into_iter();
        while let Some(effect) = effects.next() {
            if let Some(fuse) = &mut self.robots[robot].fuse {
                if *fuse == 0 {
                    return self.kill_agent(robot);
                }
                *fuse -= 1;
            }
            let Some(agent) = &mut self.robots[robot].agent else {
                return;
            };
            let boot = agent.rules.boot();
            match effect {
                AgentEffect::Reply { query, verdict } => {
                    if let Some(back) = agent.queries.remove(&query) {
                        self.reply(robot, back, &verdict);
                    }
                }
                AgentEffect::Record(entry) if self.robots[robot].disk.full => {
                    let marked = self.dice.chance(0.7);
                    self.note(|| {
                        format!("agent {robot} cannot record {entry:?}, marked: {marked}")
                    });
                    self.robots[robot].disk.marked |= marked;
                    let following = effects.collect();
                    let instead = self.with_agent(robot, |agent, _| {
                        agent.handle_unwritten(&entry, marked, following)
                    });
                    effects = instead.into_iter();
                }
                AgentEffect::Record(entry) => {
                    self.note(|| format!("agent {robot} records {entry:?}"));
                    let known = &mut self.robots[robot];
                    known.disk.entries.push(entry);
                    if known.disk.marked {
                        rewrite(known);
                    }
                }
                AgentEffect::Forward { id, body, .. } => {
                    self.forward(robot, boot, FromAgent::Init(id), Some((id, false)), body);
                }
                AgentEffect::AskServer(id) => {
                    let body = format!("$ztl;2;-1;outcome {}", id.number).into_bytes();
                    let from = FromAgent::Outcome(id);
                    self.after(
                        0,
                        Event::Forward(robot, boot, from, Some((id, false)), body),
                    );
                }
            }
        }
    }

    /// An agent sends something to its server.
    pub(super) fn forward(
        &mut self,
        robot: usize,
        boot: u32,
        from: FromAgent,
        envelope: Option<(InitId, bool)>,
        body: Vec<u8>,
    ) {
        let agent = self.robots[robot].agent.as_ref();
        if agent.is_none_or(|agent| agent.rules.boot() != boot) {
            return;
        }
        let text = String::from_utf8_lossy(&body).into_owned();
        self.note(|| format!("agent {robot} to its server: {from:?} {text}"));
        let Some(server) = &self.robots[robot].server else {
            return self.on_server_said(robot, from, None, false);
        };
        let server = server.boot;
        let token = self.number();
        self.asks.insert(token, (boot, from));
        // One copy at most, but perhaps after the agent waits no more.
        for time in self.arrivals().into_iter().take(1) {
            let time = time.min(5000);
            self.after(
                time,
                Event::ToServer(robot, server, token, envelope, body.clone()),
            );
        }
        self.after(ANSWER, Event::FromServer(robot, token, None));
    }

    pub(super) fn on_server(
        &mut self,
        robot: usize,
        boot: u32,
        token: u64,
        envelope: Option<(InitId, bool)>,
        body: &[u8],
    ) {
        let now = self.now;
        // With a server, its connections end.
        let Some(server) = running(self.robots[robot].server.as_mut(), boot) else {
            return;
        };
        let envelope = envelope.map(|(id, early_end)| Envelope {
            client: id.client,
            number: id.number,
            early_end,
        });
        match server.request(now, token, envelope, body) {
            Some(Job::Start { id, payload }) => {
                let slow = !self.calm && self.dice.chance(0.1);
                let time = if slow { self.dice.below(2500) } else { 0 };
                self.after(time, Event::Decide(robot, boot, id, payload));
            }
            Some(Job::Abort { id }) => {
                let time = self.dice.below(100);
                self.after(time, Event::EndTask(robot, boot, id, State::Aborted));
            }
            None => {}
        }
        self.flush(robot);
    }

    /// A handler starts a task, or rejects it.
    pub(super) fn decide(
        &mut self,
        robot: usize,
        boot: u32,
        id: TaskId,
        payload: &str,
    ) -> Result<(), String> {
        let now = self.now;
        let Some(server) = running(self.robots[robot].server.as_mut(), boot) else {
            return Ok(());
        };
        if self.dice.chance(0.1) {
            server.event(now, id, TaskEvent::Rejected { reason: "no" });
        } else {
            let truth = self.truths.get_mut(payload);
            let truth = truth.ok_or("a task that nobody asked for")?;
            self.figures.starts += 1;
            truth.start(robot, boot, id.get())?;
            server.event(now, id, TaskEvent::Accepted { reply: "on it" });
            let time = [20, 800, 3000, 9000][self.dice.below(4) as usize];
            let state = match self.dice.below(3) {
                0 => State::Failed,
                _ => State::Completed,
            };
            self.after(time, Event::EndTask(robot, boot, id, state));
            self.note(|| format!("robot {robot} starts {payload} as {id:?}"));
        }
        self.flush(robot);
        Ok(())
    }

    pub(super) fn end_task(&mut self, robot: usize, boot: u32, id: TaskId, state: State) {
        let now = self.now;
        if let Some(server) = running(self.robots[robot].server.as_mut(), boot) {
            let mut truths = self.truths.values_mut();
            let truth = truths.find(|truth| {
                truth.robot == robot && truth.id == id.get() && truth.state == Some(State::Accepted)
            });
            if let Some(truth) = truth {
                truth.state = Some(state);
                server.event(now, id, ending(state));
            }
            self.flush(robot);
        }
    }

    /// Sends a server's answers.
    fn flush(&mut self, robot: usize) {
        let server = self.robots[robot].server.as_mut();
        let out = server.map(|server| std::mem::take(&mut server.out));
        for (token, body) in out.unwrap_or_default() {
            for time in self.arrivals().into_iter().take(1) {
                self.after(time, Event::FromServer(robot, token, Some(body.clone())));
            }
        }
    }

    pub(super) fn on_answer(&mut self, robot: usize, token: u64, body: Option<Vec<u8>>) {
        let Some((boot, from)) = self.asks.remove(&token) else {
            return;
        };
        let agent = self.robots[robot].agent.as_ref();
        if agent.is_some_and(|agent| agent.rules.boot() == boot) {
            self.on_server_said(robot, from, body, true);
        }
    }

    fn on_server_said(&mut self, robot: usize, from: FromAgent, body: Option<Vec<u8>>, sent: bool) {
        let effects = match from {
            FromAgent::Init(id) => {
                let said = match sent {
                    true => said(body),
                    false => ServerSaid::NotSent("its server is not connected".to_owned()),
                };
                self.with_agent(robot, |agent, at| agent.handle_server(at, id, said))
            }
            FromAgent::Outcome(id) => self.with_agent(robot, |agent, at| {
                agent.handle_server_outcome(at, id, body.as_deref())
            }),
            FromAgent::Plain(back) => {
                let silent = || Verdict::Unknown("silent".to_owned());
                let verdict = body.map_or_else(silent, Verdict::Answer);
                return self.reply(robot, back, &verdict);
            }
        };
        self.agent_effects(robot, effects);
    }

    pub(super) fn start_agent(&mut self, robot: usize) {
        if self.robots[robot].agent.is_some() {
            return;
        }
        if self.robots[robot].disk.full {
            // It cannot rewrite its journal, and is started again.
            return self.after(500, Event::StartAgent(robot));
        }
        let boot = self.boot();
        let known = &mut self.robots[robot];
        let disk = &mut known.disk;
        let complete = disk.machine == known.machine && !disk.entries.is_empty() && !disk.marked;
        disk.entries.extend(disk.marked.then_some(Entry::Lacks));
        let rules = Agent::new(Instant::ZERO, boot, &disk.entries, complete);
        known.agent = Some(Running {
            rules,
            started: self.now,
            queries: Default::default(),
            next: 0,
        });
        rewrite(known);
        self.note(|| format!("> agent {robot} starts as {boot}, complete: {complete}"));
    }

    pub(super) fn start_server(&mut self, robot: usize) {
        if self.robots[robot].server.is_none() {
            let boot = self.boot();
            let original = self.robots[robot].original;
            self.robots[robot].server = Some(Server::new(boot, original));
            self.note(|| format!("> server {robot} starts as {boot}"));
        }
    }

    pub(super) fn start_endpoint(&mut self, endpoint: usize) {
        if self.endpoints[endpoint].is_none() {
            let boot = self.boot();
            self.endpoints[endpoint] = Some(EndpointCopy {
                rules: Endpoint::new(boot),
                boot,
                started: self.now,
                seen: [false; ROBOTS],
            });
            self.note(|| format!("> endpoint {endpoint} starts as {boot}"));
        }
    }

    pub(super) fn kill_agent(&mut self, robot: usize) {
        self.note(|| format!("> agent {robot} is killed"));
        self.figures.restarts += 1;
        self.robots[robot].agent = None;
        self.robots[robot].fuse = None;
        let wait = self.dice.below(4000);
        self.after(wait, Event::StartAgent(robot));
    }

    pub(super) fn kill_server(&mut self, robot: usize) {
        self.note(|| format!("> server {robot} is killed"));
        self.figures.restarts += 1;
        self.robots[robot].server = None;
        let wait = self.dice.below(4000);
        self.after(wait, Event::StartServer(robot));
    }

    /// The machine is off, and the end of the journal is lost.
    pub(super) fn cut_power(&mut self, robot: usize) {
        self.note(|| format!("> robot {robot} loses its power"));
        let disk = &self.robots[robot].disk;
        let (synced, all) = (disk.synced, disk.entries.len());
        let stays = synced + self.dice.below((all - synced + 1) as u64) as usize;
        self.robots[robot].disk.entries.truncate(stays);
        self.robots[robot].machine += 1;
        self.kill_server(robot);
        self.kill_agent(robot);
    }

    pub(super) fn kill_endpoint(&mut self, endpoint: usize) {
        self.note(|| format!("> endpoint {endpoint} is killed"));
        self.figures.restarts += 1;
        self.endpoints[endpoint] = None;
        let wait = self.dice.below(3000);
        self.after(wait, Event::StartEndpoint(endpoint));
    }
}

/// The agent writes its journal anew.
fn rewrite(robot: &mut Robot) {
    if let Some(agent) = &robot.agent {
        robot.disk = Disk {
            entries: agent.rules.entries(),
            synced: agent.rules.entries().len(),
            machine: robot.machine,
            full: false,
            marked: false,
        };
    }
}

/// A time by the clock of a process.
fn local(started: Instant, at: Option<Instant>) -> Option<Instant> {
    at.filter(|at| *at != Instant::NEVER)
        .map(|at| started + Duration::from_micros(at.as_micros()))
}
