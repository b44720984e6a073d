//! The rules of an endpoint, without I/O: a ZTL server whose scopes are those of robots.
//!
//! It keeps no tasks. Answers, ids and final states are the robots' own. What it has to remember is the last INIT of each
//! client, so that `outcome` can be asked of the right robot. While a robot does not answer, neither does the endpoint:
//! silence is what clients take for *unknown*.
//!
//! *Inputs*: `handle_*`; each returns [`EndpointEffect`]s. *Next wake-up*: [`poll_timeout`](Endpoint::poll_timeout).

mod questions;
mod requests;
mod robots;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::envelope::{ClientId, Envelope};

use crate::wire::{ANOTHER_INIT, InitId, InitRules, RobotInfo, Verdict, millis};
use questions::Question;
pub use requests::robot_of;
use robots::Robot;

/// How long a request may take and an INIT may act, less than a client's timeout of 2 s: the original's takes silence for *not started*.
pub(crate) const LONGEST: Duration = Duration::from_millis(1900);
/// How long a robot's server may hold a STATUS, in milliseconds, so that its answer arrives in time.
const LONGEST_HOLD_MS: u64 = 1500;
/// Pause before a query without a reply is repeated.
const AGAIN: Duration = Duration::from_millis(100);
/// How long the last INIT of a client is remembered.
const KEEP: Duration = Duration::from_secs(60);
/// Most clients whose last INIT is remembered, and most requests at a time.
const MOST: usize = 10_000;
/// Most machines that answer as one robot and are told an ABORT one by one.
const MACHINES: usize = 4;
/// How often an INIT is sent again because the agent's boot or clock was another.
const STALE: u32 = 3;

/// What the shell has to do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EndpointEffect {
    /// Answer a client's request.
    Answer {
        /// The request.
        request: u64,
        /// The body.
        body: Vec<u8>,
    },
    /// The request gets no answer.
    Silence {
        /// The request.
        request: u64,
    },
    /// Send a query to a robot's agent; then call [`Endpoint::handle_verdict`] for its reply, and
    /// [`Endpoint::handle_no_reply`] at its end.
    Ask {
        /// The query.
        query: u64,
        /// The robot's name.
        robot: String,
        /// Its agent.
        agent: String,
        /// What to ask.
        what: Ask,
        /// How long to wait for the reply.
        limit: Duration,
    },
    /// Ask an agent what its robot is; then call [`Endpoint::handle_info`].
    AskInfo {
        /// The robot's name.
        robot: String,
        /// Its agent.
        agent: String,
    },
    /// Two agents claim one name.
    Rivals {
        /// The name.
        robot: String,
        /// The agent that is served.
        agent: String,
        /// The agent that is not.
        rival: String,
    },
}

/// A question to an agent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ask {
    /// Pass a request on, with the rules of its INIT or the client's envelope.
    Request {
        /// For an INIT.
        rules: Option<InitRules>,
        /// The client's envelope, for a STATUS or an ABORT.
        envelope: Option<Envelope>,
        /// The request, with the robot's own scope.
        body: Vec<u8>,
    },
    /// What became of an INIT.
    Outcome(InitRules),
}

/// A request of a client.
#[derive(Debug, Clone, Copy)]
pub struct ClientRequest<'a> {
    /// The shell's number for it.
    pub request: u64,
    /// The client and its number, if it sends them.
    pub envelope: Option<Envelope>,
    /// 16 random bytes, which identify the INIT of a client without an envelope.
    pub fresh: ClientId,
    /// The body; `None` if it was not one frame.
    pub body: Option<&'a [u8]>,
}

/// The endpoint's rules.
#[derive(Debug)]
pub struct Endpoint {
    boot: u32,
    robots: BTreeMap<String, Robot>,
    /// Robots that belong to the fleet, whether or not they were ever there.
    expected: BTreeSet<String>,
    inits: BTreeMap<ClientId, LastInit>,
    pending: BTreeMap<u64, Pending>,
    questions: BTreeMap<u64, Question>,
    next: u64,
}

/// The last INIT of a client with envelopes.
#[derive(Debug)]
struct LastInit {
    number: u64,
    robot: String,
    agent: String,
    /// Checksum of its scope and payload; `None` if only the robot knows them.
    hash: Option<u64>,
    rules: Option<InitRules>,
    /// What it was answered; without its scope.
    answer: Option<Vec<u8>>,
    /// Whether it was given up.
    void: bool,
    expires: Instant,
}

/// A query under way, or about to be repeated.
#[derive(Debug, Clone)]
struct Pending {
    /// The client's request, or the question of several robots that it belongs to.
    request: u64,
    robot: String,
    agent: String,
    what: Ask,
    purpose: Purpose,
    deadline: Instant,
    /// When to send it again; `None` while it is under way.
    again: Option<Instant>,
    stale: u32,
}

/// Machines that are told an ABORT.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
struct EachTold {
    /// Boots that said that it was not meant for them, and got one of their own.
    told: BTreeSet<u32>,
    /// How many answers have come to the last query.
    answers: u32,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Purpose {
    /// The answer goes back with this scope instead of the robot's.
    Request { scope: String },
    /// The answer tells what became of the client's INIT.
    Outcome(InitId),
    /// The answer is a part of a [`Question`]'s.
    Part,
    /// An ABORT for each machine that answers as the robot, whose answers are not passed on.
    AbortEach(EachTold),
    /// An ABORT for one of these machines, by its boot.
    AbortOne(u32),
}

impl Endpoint {
    /// An endpoint with a random boot id, which must not be 0.
    #[must_use]
    pub const fn new(boot: u32) -> Self {
        Self {
            boot,
            robots: BTreeMap::new(),
            expected: BTreeSet::new(),
            inits: BTreeMap::new(),
            pending: BTreeMap::new(),
            questions: BTreeMap::new(),
            next: 0,
        }
    }

    /// The first reply to a query; of an ABORT that goes to several machines, each reply.
    pub fn handle_verdict(
        &mut self,
        now: Instant,
        query: u64,
        verdict: Verdict,
    ) -> Vec<EndpointEffect> {
        let Some(mut pending) = self.pending.remove(&query) else {
            return Vec::new();
        };
        if let Purpose::AbortEach(each) = &mut pending.purpose {
            each.answers += 1;
            let mut again = None;
            if let Verdict::Stale { boot, clock_ms } = verdict
                && each.told.len() < MACHINES
                && each.told.insert(boot)
            {
                again = Some(Pending {
                    purpose: Purpose::AbortOne(boot),
                    ..pending.clone()
                });
                self.on_clock(now, &pending.robot, &pending.agent, boot, clock_ms);
            }
            // Others may say so, too.
            self.pending.insert(query, pending);
            return again
                .map(|again| self.ask(now, again))
                .into_iter()
                .collect();
        }
        if let (Purpose::AbortOne(meant), Verdict::Stale { boot, .. }) =
            (&pending.purpose, &verdict)
            && meant != boot
        {
            // It was told itself.
            self.pending.insert(query, pending);
            return Vec::new();
        }
        if let Verdict::Stale { boot, clock_ms } = verdict {
            self.on_clock(now, &pending.robot, &pending.agent, boot, clock_ms);
            pending.stale += 1;
            if pending.stale <= STALE
                && now < pending.deadline
                && let Ask::Request { rules, .. } = &mut pending.what
            {
                // The robot says that it did not act on it, and never will.
                if let Some(rules) = rules {
                    let new = InitRules {
                        id: rules.id,
                        boot,
                        until_ms: clock_ms.saturating_add(millis(pending.deadline.since(now))),
                    };
                    *rules = self.note_rules(*rules, new);
                }
                return vec![self.ask(now, pending)];
            }
        }
        let request = pending.request;
        match pending.purpose {
            Purpose::Request { scope } => {
                let id = match &pending.what {
                    Ask::Request {
                        rules: Some(rules), ..
                    } => Some(rules.id),
                    _ => None,
                };
                // Another copy of it may have been sent with other rules meanwhile.
                let is_latest = id.is_some_and(|id| self.is_latest(id, &pending.what));
                let is_refused = !matches!(verdict, Verdict::Answer(_));
                let is_another =
                    matches!(&verdict, Verdict::NotStarted(why) if why == ANOTHER_INIT);
                if let Some(id) = id.filter(|_| is_another) {
                    self.forget_hash(id);
                }
                let body = match verdict {
                    // A server repeats the scope of a request. Another one could name another robot.
                    Verdict::Answer(body) => with_scope(&body, &scope),
                    // Only an INIT can be known not to have acted.
                    Verdict::NotStarted(reason) if id.is_some() => rejection(&scope, &reason),
                    Verdict::Stale { .. } if is_latest => rejection(
                        &scope,
                        "the robot's agent was restarted, or it came too late there; try again",
                    ),
                    _ => return vec![EndpointEffect::Silence { request }],
                };
                if let Some(id) = id.filter(|_| !is_another) {
                    self.note_answer(now, id, &body);
                    if is_refused {
                        self.give_up(id);
                    }
                }
                vec![EndpointEffect::Answer { request, body }]
            }
            Purpose::Outcome(id) => {
                let body = match verdict {
                    Verdict::Answer(body) => with_scope(&body, "$ztl"),
                    Verdict::NotStarted(_) | Verdict::Stale { .. } => {
                        self.give_up(id);
                        self.never_seen()
                    }
                    Verdict::Unknown(reason) => about_server(2, &format!("unknown: {reason}")),
                };
                vec![EndpointEffect::Answer { request, body }]
            }
            // The client gets no answer.
            Purpose::AbortEach(_) | Purpose::AbortOne(_) => Vec::new(),
            Purpose::Part => {
                let body = match verdict {
                    Verdict::Answer(body) => Some(body),
                    _ => None,
                };
                self.on_part(request, &pending.robot, body.as_deref())
            }
        }
    }

    /// A query ended: the robot or a router is not reached, or all replies have come.
    pub fn handle_no_reply(&mut self, now: Instant, query: u64) -> Vec<EndpointEffect> {
        let Some(pending) = self.pending.get_mut(&query) else {
            return Vec::new();
        };
        pending.again = Some(now + AGAIN);
        if let Purpose::AbortEach(each) = &mut pending.purpose
            && std::mem::take(&mut each.answers) >= 2
        {
            let request = pending.request;
            self.pending.remove(&query);
            return vec![EndpointEffect::Silence { request }];
        }
        Vec::new()
    }

    /// Call this when [`poll_timeout`](Self::poll_timeout) has passed.
    pub fn handle_timeout(&mut self, now: Instant) -> Vec<EndpointEffect> {
        let mut effects = Vec::new();
        let is_due = |pending: &Pending| {
            now >= pending.deadline || pending.again.is_some_and(|again| now >= again)
        };
        let due = self.pending.iter().filter(|(_, pending)| is_due(pending));
        let due: Vec<u64> = due.map(|(query, _)| *query).collect();
        for query in due {
            let Some(pending) = self.pending.remove(&query) else {
                continue;
            };
            if now < pending.deadline {
                effects.push(self.ask(now, pending));
            } else if pending.purpose == Purpose::Part {
                effects.extend(self.on_part(pending.request, &pending.robot, None));
            } else {
                let request = pending.request;
                effects.push(EndpointEffect::Silence { request });
            }
        }
        self.inits.retain(|_, init| now < init.expires);
        effects
    }

    /// The client's request that a query under way belongs to.
    #[must_use]
    pub fn request_of(&self, query: u64) -> Option<u64> {
        self.pending.get(&query).map(|pending| pending.request)
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let times = self.pending.values();
        let times = times.map(|pending| {
            pending
                .again
                .unwrap_or(Instant::NEVER)
                .min(pending.deadline)
        });
        let inits = self.inits.values().map(|init| init.expires);
        times.chain(inits).min()
    }

    /// Sends a query, perhaps again: an agent knows an INIT by its id, and everything else may be repeated.
    fn ask(&mut self, now: Instant, mut pending: Pending) -> EndpointEffect {
        // A reply to an earlier query would be as good, but nobody waits for it any more.
        self.next += 1;
        let query = self.next;
        pending.again = None;
        let effect = EndpointEffect::Ask {
            query,
            robot: pending.robot.clone(),
            agent: pending.agent.clone(),
            what: pending.what.clone(),
            limit: pending.deadline.since(now),
        };
        self.pending.insert(query, pending);
        effect
    }

    fn never_seen(&self) -> Vec<u8> {
        about_server(2, &format!("never seen since boot {}", self.boot))
    }
}

/// An answer about the server itself.
fn about_server(state: u8, text: &str) -> Vec<u8> {
    format!("$ztl;{state};0;{text}").into_bytes()
}

/// The answer to an INIT that starts nothing.
fn rejection(scope: &str, reason: &str) -> Vec<u8> {
    format!("{scope};2;-1;{reason}").into_bytes()
}

/// An answer with another scope.
fn with_scope(body: &[u8], scope: &str) -> Vec<u8> {
    let rest = body.iter().position(|byte| *byte == b';');
    match rest.and_then(|rest| body.get(rest..)) {
        Some(rest) => [scope.as_bytes(), rest].concat(),
        None => body.to_vec(),
    }
}

#[cfg(test)]
mod tests;
