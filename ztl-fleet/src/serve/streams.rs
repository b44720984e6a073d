//! Streams of the robots, published at the endpoint. They have a thread and a port of their own: they delay no request.

use std::collections::BTreeMap;
use std::ops::Bound::{Included, Unbounded};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tracing::warn;
use zenoh::Wait as _;
use ztl_std::keys::PublicKey;
use ztl_std::relay::{RelayPublisher, WantedTopic};
use ztl_std::time::now;
use ztl_std::{Access, BindError, Limits};

use super::VALID_MS;
use super::arrivals::{Arrivals, Known, News};
use crate::caller::Caller;
use crate::random;
use crate::seal::Request;
use crate::seldom::{Seldom, brief};
use crate::session::{ZenohError, parts};
use crate::streams::{Granted, Head, Incoming, RENEW, fewest, is_wanted, topics_of, within};
use crate::wire::{AgentQuery, ROOT, Verdict, fresh, hex, millis};

/// How long to wait for an agent's answer.
const LIMIT: Duration = Duration::from_secs(2);
/// Pause while the publisher has no room.
const FULL: Duration = Duration::from_millis(2);

/// A publisher that is bound.
pub(super) struct Bound {
    publisher: RelayPublisher,
    arrivals: Arc<Arrivals>,
}

/// What its thread owns.
struct Relay {
    publisher: RelayPublisher,
    arrivals: Arc<Arrivals>,
    caller: Caller,
    access: Access,
    /// Last chunk of the keys to which agents send.
    id: String,
    wanted: Vec<WantedTopic>,
    robots: BTreeMap<String, Robot>,
    /// Whether messages of other robots are wanted than before.
    has_changed: bool,
    /// The number of the last question.
    last: u64,
    told: Seldom,
}

/// A robot that has streams.
struct Robot {
    known: Known,
    is_there: bool,
    /// How its topics begin that somebody wants.
    topics: Vec<String>,
    incoming: Incoming,
    /// The question under way.
    asking: Option<u64>,
    /// Whether the last answer was that the question was stale.
    was_stale: bool,
    /// Whether the last answer began a session.
    was_new: bool,
    due: Instant,
    problem: Option<String>,
}

impl Bound {
    pub(super) fn bind(endpoint: &str, access: Access, limits: Limits) -> Result<Self, BindError> {
        let arrivals = Arc::new(Arrivals::default());
        let told = Arc::clone(&arrivals);
        let changed = move |wanted| told.put_wanted(wanted);
        Ok(Self {
            publisher: RelayPublisher::bind(endpoint, access, limits, changed)?,
            arrivals,
        })
    }

    pub(super) fn endpoint(&self) -> &str {
        self.publisher.endpoint()
    }

    /// Publishes on a thread of its own, until the process ends. `on_end` is called if it cannot go on.
    pub(super) fn start(
        self,
        caller: Caller,
        access: Access,
        on_end: impl FnOnce() + Send + 'static,
    ) -> Result<Arc<Arrivals>, ZenohError> {
        let Self {
            publisher,
            arrivals,
        } = self;
        let id = hex(&random::id()?);
        let arrived = Arc::clone(&arrivals);
        let subscriber = caller
            .session()
            .declare_subscriber(format!("{ROOT}/*/*/streams/{id}"))
            .callback(move |sample| {
                if let Some((robot, agent)) = parts(sample.key_expr().as_str()) {
                    arrived.put_message(robot, agent, || sample.payload().to_bytes().into_owned());
                }
            });
        subscriber.background().wait()?;
        let relay = Relay {
            publisher,
            arrivals: Arc::clone(&arrivals),
            caller,
            access,
            id,
            wanted: Vec::new(),
            robots: BTreeMap::new(),
            has_changed: false,
            last: 0,
            told: Seldom::default(),
        };
        let thread = std::thread::Builder::new().name("ztl-fleet-streams".to_owned());
        drop(thread.spawn(move || {
            relay.run();
            on_end();
        })?);
        Ok(arrivals)
    }
}

impl Relay {
    /// Runs until nothing can be published any more.
    fn run(mut self) {
        while !self.publisher.has_ended() {
            let due = self.robots.values().filter_map(Robot::due).min();
            let mut limit = due.map_or(RENEW, |due| due.saturating_duration_since(Instant::now()));
            let has_room = self.publisher.has_room();
            if !has_room {
                limit = limit.min(FULL);
            }
            let News {
                wanted,
                robots,
                replies,
                messages,
            } = self.arrivals.next(has_room, limit);
            for (name, (was_gone, known)) in robots {
                if was_gone {
                    self.on_gone(&name);
                }
                if let Some(known) = known {
                    self.on_robot(name, known);
                }
            }
            if let Some(wanted) = wanted {
                self.wanted = wanted;
                self.choose(None);
            }
            if std::mem::take(&mut self.has_changed) {
                self.listen();
            }
            for (name, question, verdict) in replies {
                self.on_reply(&name, question, verdict);
            }
            for (name, payload) in messages {
                self.on_message(&name, &payload);
            }
            let now = Instant::now();
            let due = self.robots.iter().filter(|(_, robot)| {
                let is_due = |due| due <= now || robot.incoming.is_due();
                robot.due().is_some_and(is_due)
            });
            let due: Vec<String> = due.map(|(name, _)| name.clone()).collect();
            for name in due {
                self.ask(&name);
            }
        }
    }

    /// A robot is there, and has streams.
    fn on_robot(&mut self, name: String, known: Known) {
        if let Some(robot) = self.robots.get_mut(&name) {
            let is_new = !robot.is_there || robot.known.scopes != known.scopes;
            robot.is_there = true;
            robot.known = known;
            if !is_new {
                return;
            }
            robot.due = Instant::now();
            robot.asking = None;
        } else {
            let robot = Robot {
                known,
                is_there: true,
                topics: Vec::new(),
                incoming: Incoming::default(),
                asking: None,
                was_stale: false,
                was_new: false,
                due: Instant::now(),
                problem: None,
            };
            self.robots.insert(name.clone(), robot);
        }
        self.choose(Some(&name));
    }

    /// A robot is gone, or another agent has its name.
    fn on_gone(&mut self, name: &str) {
        let Some(robot) = self.robots.get_mut(name) else {
            return;
        };
        robot.is_there = false;
        robot.asking = None;
        // What it had published last is not its state any more.
        robot.incoming.lose_states();
        match robot.topics.is_empty() {
            true => drop(self.robots.remove(name)),
            false => {
                warn!(target: "fleet", "Robot '{name}' has no streams now: it is not connected.");
            }
        }
        self.forget(name);
        self.has_changed = true;
    }

    /// Forgets the states of a robot.
    fn forget(&self, name: &str) {
        let root = format!("/{name}/").into_bytes();
        self.publisher.forget(move |topic| topic.starts_with(&root));
    }

    /// Finds out what is wanted, of one robot or of all.
    fn choose(&mut self, only: Option<&str>) {
        let mut topics: BTreeMap<String, Vec<String>> = BTreeMap::new();
        // Who wants them.
        let mut keys: BTreeMap<String, Vec<Option<&PublicKey>>> = BTreeMap::new();
        for WantedTopic { key, begin } in &self.wanted {
            let key = key.as_ref();
            let mut chunks = begin.splitn(3, |byte| *byte == b'/');
            let (first, name, rest) = (chunks.next(), chunks.next(), chunks.next());
            if first.is_some_and(|first| !first.is_empty()) {
                continue;
            }
            let name = name.unwrap_or_default();
            let Ok(name) = str::from_utf8(name) else {
                continue;
            };
            let robots = self
                .robots
                .range::<str, _>((Included(name), Unbounded))
                .take_while(|(known, _)| known.starts_with(name));
            for (known, robot) in robots {
                let fits = rest.is_none() || known == name;
                if fits && only.is_none_or(|only| only == known) {
                    let topics = topics.entry(known.clone()).or_default();
                    topics.extend(self.allowed(key, known, robot, begin));
                    let keys = keys.entry(known.clone()).or_default();
                    if keys.last() != Some(&key) {
                        keys.push(key);
                    }
                }
            }
        }
        let names: Vec<String> = match only {
            Some(only) => vec![only.to_owned()],
            None => self.robots.keys().cloned().collect(),
        };
        let mut chosen = Vec::new();
        for name in names {
            let topics = topics.remove(&name).unwrap_or_default();
            let widest = || {
                let robot = self.robots.get(&name);
                let keys = keys.get(&name).into_iter().flatten();
                let all = keys.filter_map(|key| Some(self.allowed(*key, &name, robot?, b"/")));
                all.flatten().collect()
            };
            let topics = fewest(topics, widest);
            chosen.push((name, topics));
        }
        for (name, topics) in chosen {
            self.set_topics(&name, topics);
        }
        self.has_changed = true;
    }

    /// What of the topics of a robot that begin so the owner of a key may hear.
    fn allowed(
        &self,
        key: Option<&PublicKey>,
        name: &str,
        robot: &Robot,
        begin: &[u8],
    ) -> Vec<String> {
        let topics = topics_of(begin, name);
        let may_use = |scope: &str| {
            let scope = format!("/{name}{scope}");
            key.is_none_or(|key| self.access.may_use(key, &scope))
        };
        if may_use("") {
            return topics;
        }
        let scopes = robot.known.scopes.iter().map(String::as_str);
        let (allowed, hidden): (Vec<&str>, Vec<&str>) = scopes.partition(|scope| may_use(scope));
        within(&topics, &allowed, &hidden)
    }

    fn set_topics(&mut self, name: &str, topics: Vec<String>) {
        let Some(robot) = self.robots.get_mut(name) else {
            return;
        };
        if robot.topics == topics {
            return;
        }
        robot.topics = topics;
        robot.due = Instant::now();
        let root = format!("/{name}");
        let kept = robot.topics.clone();
        self.publisher.forget(move |topic| {
            // Nobody keeps these up to date from now on.
            let of_robot = topic.strip_prefix(root.as_bytes());
            let of_robot = of_robot.filter(|topic| topic.starts_with(b"/"));
            of_robot.is_some_and(|topic| !is_wanted(&String::from_utf8_lossy(topic), &kept))
        });
        if robot.topics.is_empty() {
            if robot.is_there {
                self.ask(name);
            }
            if let Some(robot) = self.robots.get_mut(name) {
                robot.incoming = Incoming::default();
                robot.asking = None;
            }
        }
    }

    /// Takes messages only of robots that were asked for some.
    fn listen(&self) {
        let there = self.robots.iter();
        let there = there.filter(|(_, robot)| robot.is_there && !robot.topics.is_empty());
        let there = there.map(|(name, robot)| (name.clone(), robot.known.agent.clone()));
        self.arrivals.listen(there.collect());
    }

    /// Asks a robot's agent for what is wanted.
    fn ask(&mut self, name: &str) {
        let Some(robot) = self.robots.get_mut(name) else {
            return;
        };
        self.last += 1;
        robot.asking = Some(self.last);
        robot.due = Instant::now() + RENEW;
        let want = robot.incoming.want(&self.id, &robot.topics);
        let Ok(body) = serde_json::to_vec(&want) else {
            return;
        };
        let (boot, clock_ms, heard) = robot.known.clock;
        let since = millis(now().since(heard));
        let until = clock_ms.saturating_add(since).saturating_add(VALID_MS);
        let request = Request {
            robot: name,
            what: AgentQuery::Streams.name(),
            parameters: &fresh(boot, until),
            who: "ztl-fleet",
            body: &body,
        };
        let question = (name.to_owned(), self.last);
        let (replies, reply) = (Arc::clone(&self.arrivals), question.clone());
        let on_reply = move |verdict| replies.put_reply(reply.0.clone(), reply.1, Some(verdict));
        let ends = Arc::clone(&self.arrivals);
        let on_end = move || ends.put_reply(question.0.clone(), question.1, None);
        let agent = robot.known.agent.clone();
        let asked = self.caller.ask(&agent, &request, LIMIT, on_reply, on_end);
        if asked.is_err()
            && let Some(robot) = self.robots.get_mut(name)
        {
            robot.asking = None;
        }
    }

    fn on_reply(&mut self, name: &str, question: u64, verdict: Option<Verdict>) {
        let Some(robot) = self.robots.get_mut(name) else {
            return;
        };
        if robot.asking != Some(question) {
            return;
        }
        robot.asking = None;
        let was_stale = std::mem::take(&mut robot.was_stale);
        let problem = match verdict {
            Some(Verdict::Answer(body)) => {
                let Ok(granted) = serde_json::from_slice::<Granted>(&body) else {
                    return;
                };
                let (missed, is_new) = robot.incoming.on_answer(now(), &granted);
                // Who changes it in each answer is asked no more often for that.
                let was_new = std::mem::replace(&mut robot.was_new, is_new);
                if is_new && !was_new {
                    robot.due = Instant::now();
                }
                if is_new {
                    // What was published in the session before may not be a state any more.
                    self.forget(name);
                }
                self.tell_missed(name, missed);
                granted.problem
            }
            Some(Verdict::Stale { boot, clock_ms }) => {
                robot.known.clock = (boot, clock_ms, now());
                robot.was_stale = true;
                robot.incoming.lose_states();
                if !was_stale {
                    robot.due = Instant::now();
                }
                return;
            }
            Some(Verdict::NotStarted(reason) | Verdict::Unknown(reason)) => Some(reason),
            None => {
                // It may not have been told that the newest states are needed.
                robot.incoming.lose_states();
                return;
            }
        };
        if let Some(robot) = self.robots.get_mut(name)
            && robot.problem != problem
        {
            if let Some(problem) = &problem {
                warn!(target: "fleet", "Robot '{name}' has no streams now: {}.", brief(problem));
            }
            robot.problem = problem;
        }
    }

    fn on_message(&mut self, name: &str, payload: &[u8]) {
        let Some(robot) = self.robots.get_mut(name) else {
            return;
        };
        let Some(clear) = self.caller.open_stream(name, payload) else {
            if self.told.may() {
                warn!(target: "fleet", "A message of a stream for robot '{name}' does not have its key and is dropped.");
            }
            return;
        };
        let Some((head, body)) = Head::parse(&clear) else {
            return;
        };
        let Some(mut missed) = robot.incoming.on_message(&head, payload.len()) else {
            // It came late, or again.
            return;
        };
        if is_wanted(&head.topic, &robot.topics)
            && let Some((scope, path)) = head.place(name)
        {
            let root = format!("/{name}");
            if !self
                .publisher
                .publish(&root, &scope, &path, body, head.state)
            {
                missed = missed.saturating_add(1);
                robot.incoming.lose_states();
            }
        }
        self.tell_missed(name, missed);
    }

    fn tell_missed(&self, name: &str, missed: u64) {
        if let Some(robot) = self.robots.get(name)
            && missed > 0
        {
            let root = format!("/{name}");
            let scopes = robot.known.scopes.iter();
            let scopes = scopes.map(|scope| format!("{root}{scope}")).collect();
            self.publisher.tell_missed(&root, scopes, missed);
        }
    }
}

impl Robot {
    /// When to ask it, if anything is wanted and no question is open.
    fn due(&self) -> Option<Instant> {
        let asks = self.is_there && self.asking.is_none() && !self.topics.is_empty();
        asks.then_some(self.due)
    }
}
