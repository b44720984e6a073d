//! A fleet on virtual time: clients, endpoints and agents with the real rules, robots' servers with the real dispatcher, and
//! between them a network that loses, repeats, delays and reorders. It compares what clients were told with what the
//! robots really did. A server may be one of the original, and a robot's disk may be full.
//!
//! A client repeats an INIT only at the endpoint that had it first, as long as that runs: ours never repeat one. What was
//! refused because of a full disk is repeated elsewhere, too.

mod client;
mod judge;
mod process;
mod robot;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::time::Duration;

use ztl_core::envelope::ClientId;
use ztl_core::{Instant, State, TaskId};

use self::client::{Asked, Person};
use self::judge::Truth;
use self::robot::{Robot, Server};
use super::ends::fleet::agent::ServerSaid;
use super::ends::fleet::endpoint::{Ask, Endpoint};
use super::ends::fleet::wire::{InitId, RobotInfo, Verdict};
use crate::plan::Dice;

/// Robots of the fleet.
const ROBOTS: usize = 2;
/// Endpoints of the fleet.
const ENDPOINTS: usize = 2;
/// Clients; the last one sends no envelopes.
const PEOPLE: usize = 4;
/// What a run was like.
#[derive(Debug, Clone, Copy, Default)]
pub struct Figures {
    /// INITs of clients.
    pub inits: u64,
    /// Tasks that acted.
    pub starts: u64,
    /// Answers of which a client learned an id.
    pub told: u64,
    /// Answers by which a client learned that nothing acts.
    pub refused: u64,
    /// Requests without an answer.
    pub silent: u64,
    /// Restarts of all processes.
    pub restarts: u64,
}

impl std::ops::AddAssign for Figures {
    fn add_assign(&mut self, other: Self) {
        self.inits += other.inits;
        self.starts += other.starts;
        self.told += other.told;
        self.refused += other.refused;
        self.silent += other.silent;
        self.restarts += other.restarts;
    }
}

/// Where an agent's reply goes: the endpoint, its boot id, and its query.
type Return = (usize, u32, u64);

/// What happens at a time.
enum Event {
    /// A query, or a copy of it, arrives at an agent.
    ToAgent(usize, Return, Ask),
    /// A reply arrives.
    ToEndpoint(Return, Verdict),
    /// A query has ended.
    End(Return),
    /// What an agent says of its robot arrives.
    Info(usize, u32, RobotInfo),
    /// An endpoint learns who is there, and asks what they are.
    Look(usize),
    /// An agent sends to its server what was forwarded.
    Forward(usize, u32, FromAgent, Option<(InitId, bool)>, Vec<u8>),
    /// A request arrives at a server with this boot id.
    ToServer(usize, u32, u64, Option<(InitId, bool)>, Vec<u8>),
    /// A server's answer arrives at its agent; `None` when it has waited long enough.
    FromServer(usize, u64, Option<Vec<u8>>),
    /// A handler decides about a task, and how it ends.
    Decide(usize, u32, TaskId, String),
    /// A task ends.
    EndTask(usize, u32, TaskId, State),
    /// A client does something.
    Act(usize),
    /// A client's request arrives at an endpoint.
    ToFleet(usize, u64),
    /// An answer arrives at a client.
    ToClient(u64, Vec<u8>),
    /// Something breaks.
    Fault,
    StartAgent(usize),
    StartServer(usize),
    StartEndpoint(usize),
    Heal(usize, usize),
    /// A robot's disk has room again.
    Room(usize),
}

/// What an agent asked its server.
#[derive(Debug, Clone)]
enum FromAgent {
    Init(InitId),
    Outcome(InitId),
    Plain(Return),
}

/// A copy of an endpoint that runs.
struct EndpointCopy {
    rules: Endpoint,
    boot: u32,
    started: Instant,
    /// Agents that it believes to be there.
    seen: [bool; ROBOTS],
}

impl EndpointCopy {
    fn clock(&self, now: Instant) -> Instant {
        Instant::ZERO + now.since(self.started)
    }
}

/// How bad everything is.
struct Weather {
    loss: f64,
    double: f64,
    slow: f64,
    replay: f64,
    fault: u64,
    /// Whether disks may be full.
    full: bool,
}

struct World {
    dice: Dice,
    now: Instant,
    end: Instant,
    weather: Weather,
    calm: bool,
    events: BinaryHeap<Reverse<(Instant, u64)>>,
    waiting: BTreeMap<u64, Event>,
    next: u64,
    robots: [Robot; ROBOTS],
    endpoints: [Option<EndpointCopy>; ENDPOINTS],
    /// Whether an endpoint does not reach a robot.
    cut: [[bool; ROBOTS]; ENDPOINTS],
    people: Vec<Person>,
    /// Clients' requests.
    asked: BTreeMap<u64, Asked>,
    /// Agents' requests to servers, and of which run of the agent.
    asks: BTreeMap<u64, (u32, FromAgent)>,
    truths: BTreeMap<String, Truth>,
    figures: Figures,
    traced: bool,
    trace: Vec<String>,
}

/// Plays a seed. Returns what the run was like, or the broken promise and the trace if `traced`.
///
/// # Errors
/// The first broken promise.
pub fn play(seed: u64, traced: bool) -> Result<Figures, (String, Vec<String>)> {
    let mut world = World::new(seed, traced);
    match world.run() {
        Ok(()) => Ok(world.figures),
        Err(complaint) => Err((complaint, world.trace)),
    }
}

impl World {
    fn new(seed: u64, traced: bool) -> Self {
        let mut dice = Dice::new(seed);
        let long = dice.chance(0.1);
        let rate = |dice: &mut Dice| [0.0, 0.02, 0.1, 0.3][dice.below(4) as usize];
        let weather = Weather {
            loss: rate(&mut dice),
            double: rate(&mut dice),
            slow: rate(&mut dice),
            replay: if long { 0.1 } else { 0.0 },
            fault: [900, 2500, 6000][dice.below(3) as usize],
            full: dice.chance(0.3),
        };
        let begin = Instant::from_millis(1000);
        let millis = if long { 150_000 } else { 12_000 };
        let mut world = Self {
            dice,
            now: begin,
            end: begin + Duration::from_millis(millis),
            weather,
            calm: false,
            events: BinaryHeap::new(),
            waiting: BTreeMap::new(),
            next: 0,
            robots: Default::default(),
            endpoints: [None, None],
            cut: Default::default(),
            people: (0..PEOPLE).map(|_| Person::default()).collect(),
            asked: BTreeMap::new(),
            asks: BTreeMap::new(),
            truths: BTreeMap::new(),
            figures: Figures::default(),
            traced,
            trace: Vec::new(),
        };
        for robot in 0..ROBOTS {
            world.robots[robot].original = world.dice.chance(0.2);
            world.start_server(robot);
            world.start_agent(robot);
        }
        for endpoint in 0..ENDPOINTS {
            world.start_endpoint(endpoint);
            world.after(0, Event::Look(endpoint));
        }
        for person in 0..PEOPLE {
            let millis = 100 + world.dice.below(1500);
            world.after(millis, Event::Act(person));
        }
        world.after(500, Event::Fault);
        world
    }

    /// A number that no other thing has.
    fn number(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    fn boot(&mut self) -> u32 {
        self.number() as u32
    }

    fn random_id(&mut self) -> ClientId {
        ClientId(u128::from(self.dice.throw()).to_be_bytes())
    }

    fn after(&mut self, millis: u64, event: Event) {
        let number = self.number();
        let at = self.now + Duration::from_millis(millis);
        self.events.push(Reverse((at, number)));
        self.waiting.insert(number, event);
    }

    fn note(&mut self, text: impl FnOnce() -> String) {
        if self.traced {
            self.trace
                .push(format!("{:>8} ms  {}", self.now.as_millis(), text()));
        }
    }

    /// When a message arrives: never, once, or more than once.
    fn arrivals(&mut self) -> Vec<u64> {
        let delay = |world: &mut Self| match world.calm {
            true => 1 + world.dice.below(10),
            false if world.dice.chance(world.weather.replay) => 61_000 + world.dice.below(30_000),
            false if world.dice.chance(world.weather.slow) => world.dice.below(5000),
            false => 1 + world.dice.below(30),
        };
        let mut times = Vec::new();
        if self.calm || !self.dice.chance(self.weather.loss) {
            times.push(delay(self));
        }
        while !self.calm && times.len() < 3 && self.dice.chance(self.weather.double) {
            times.push(delay(self));
        }
        times
    }

    fn run(&mut self) -> Result<(), String> {
        self.pass(self.end)?;
        self.calm = true;
        self.note(|| "> calm".to_owned());
        self.cut = Default::default();
        for robot in &mut self.robots {
            robot.fuse = None;
            robot.disk.full = false;
        }
        self.pass(self.end + Duration::from_secs(6))?;
        self.finish()
    }

    /// Everything that happens until then.
    fn pass(&mut self, end: Instant) -> Result<(), String> {
        loop {
            let event = self.events.peek().map(|Reverse(first)| *first);
            let wake = self.wake();
            let at = event.map_or(Instant::NEVER, |(at, _)| at);
            if at.min(wake) > end {
                self.now = end;
                return Ok(());
            }
            if wake < at {
                self.now = wake.max(self.now);
                self.timeouts();
                continue;
            }
            self.events.pop();
            self.now = at;
            if let Some(event) = event.and_then(|(_, number)| self.waiting.remove(&number)) {
                self.happen(event)?;
            }
        }
    }

    fn happen(&mut self, event: Event) -> Result<(), String> {
        match event {
            Event::ToAgent(robot, back, ask) => self.on_query(robot, back, ask),
            Event::ToEndpoint((endpoint, boot, query), verdict) => {
                if let Some(at) = self.at(endpoint, boot) {
                    self.note(|| format!("endpoint {endpoint} query {query}: {verdict:?}"));
                    let effects = self
                        .with_endpoint(endpoint, |rules| rules.handle_verdict(at, query, verdict));
                    self.endpoint_effects(endpoint, effects);
                }
            }
            Event::End((endpoint, boot, query)) => {
                if let Some(at) = self.at(endpoint, boot) {
                    let effects =
                        self.with_endpoint(endpoint, |rules| rules.handle_no_reply(at, query));
                    self.endpoint_effects(endpoint, effects);
                }
            }
            Event::Info(endpoint, boot, info) => {
                if let Some(at) = self.at(endpoint, boot) {
                    let (name, agent) = (info.name.clone(), info.agent.clone());
                    self.with_endpoint(endpoint, |rules| {
                        rules.handle_info(at, &name, &agent, info);
                        Vec::new()
                    });
                }
            }
            Event::Look(endpoint) => self.look(endpoint),
            Event::Forward(robot, boot, from, envelope, body) => {
                self.forward(robot, boot, from, envelope, body);
            }
            Event::ToServer(robot, boot, token, envelope, body) => {
                self.on_server(robot, boot, token, envelope, &body);
            }
            Event::FromServer(robot, token, body) => self.on_answer(robot, token, body),
            Event::Decide(robot, boot, id, payload) => self.decide(robot, boot, id, &payload)?,
            Event::EndTask(robot, boot, id, state) => self.end_task(robot, boot, id, state),
            Event::Act(person) => self.act(person),
            Event::ToFleet(endpoint, request) => self.on_request(endpoint, request),
            Event::ToClient(request, body) => self.on_told(request, &body)?,
            Event::Fault => self.fault(),
            Event::StartAgent(robot) => self.start_agent(robot),
            Event::StartServer(robot) => self.start_server(robot),
            Event::StartEndpoint(endpoint) => self.start_endpoint(endpoint),
            Event::Heal(endpoint, robot) => self.cut[endpoint][robot] = false,
            Event::Room(robot) => self.robots[robot].disk.full = false,
        }
        Ok(())
    }

    fn fault(&mut self) {
        if self.calm {
            return;
        }
        let wait = self.dice.below(2 * self.weather.fault);
        self.after(wait, Event::Fault);
        let robot = self.dice.below(ROBOTS as u64) as usize;
        let endpoint = self.dice.below(ENDPOINTS as u64) as usize;
        match self.dice.below(10) {
            0 | 1 => {
                let effects = self.dice.below(5) as u32;
                self.note(|| format!("> agent {robot} is killed after {effects} effects"));
                self.robots[robot].fuse = Some(effects);
            }
            2 => self.kill_agent(robot),
            3 => self.kill_server(robot),
            4 => self.cut_power(robot),
            5 => self.kill_endpoint(endpoint),
            6 | 7 if self.weather.full => {
                self.note(|| format!("> the disk of robot {robot} is full"));
                self.robots[robot].disk.full = true;
                let wait = self.dice.below(4000);
                self.after(wait, Event::Room(robot));
            }
            _ => {
                self.note(|| format!("> endpoint {endpoint} does not reach robot {robot}"));
                self.cut[endpoint][robot] = true;
                let wait = self.dice.below(6000);
                self.after(wait, Event::Heal(endpoint, robot));
            }
        }
    }
}

/// The name of a robot.
fn name(robot: usize) -> String {
    format!("robot-{robot}")
}

/// The id of a robot's agent.
fn agent_id(robot: usize) -> String {
    format!("{robot:032x}")
}

/// What became of an INIT that an agent sent to its server.
fn said(answer: Option<Vec<u8>>) -> ServerSaid {
    answer.map_or(ServerSaid::Silence, ServerSaid::Answer)
}

/// A server that runs, with this boot id.
fn running(server: Option<&mut Server>, boot: u32) -> Option<&mut Server> {
    server.filter(|server| server.boot == boot)
}
