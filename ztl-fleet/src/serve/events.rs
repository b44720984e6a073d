//! What waits for the endpoint's rules, in bounds.
//!
//! There are four kinds, of which each has its turn: no flood of one of them holds up another. Nor does one connection hold up
//! another ([`Turns`]). A request for which there is no room gets no answer, which its client takes for *unknown*.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Bound::{Excluded, Unbounded};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ztl_core::Instant;
use ztl_std::time::now;

use super::turns::{Origin, Taken, Turns};
use crate::wire::{RobotInfo, Verdict};

/// Most requests that are under way to one robot, and most ABORTs: as many as the robot's agent takes of one endpoint
/// (`join/requests.rs`).
const REQUESTS: usize = 128;
const ABORTS: usize = 128;
/// Most agents that came or went.
const MOST_AGENTS: usize = 20_000;
const KINDS: usize = 4;

/// What happens.
#[derive(Debug)]
pub(super) enum Event<R> {
    /// A request whose turn it is; [`Events::end`] must follow.
    Request(Turn, Instant, R),
    Verdict(u64, Verdict),
    NoReply(u64),
    Info(RobotInfo),
    /// A robot's agent is there, or gone.
    Presence(Agent, bool),
}

/// The turn of a request.
#[derive(Debug)]
pub(super) struct Turn {
    origin: Origin,
    is_abort: bool,
}

/// A robot, and the id of its agent.
type Agent = (String, String);

#[derive(Debug)]
struct Waiting<R> {
    aborts: Turns<R>,
    requests: Turns<R>,
    /// At most two for each query. The rules have few under way.
    replies: VecDeque<Event<R>>,
    /// Only the newest of an agent counts.
    presence: BTreeMap<Agent, bool>,
    /// The agent whose event was taken last.
    last: Agent,
    /// The kind that had its turn last.
    turn: usize,
}

/// What waits, with requests of the type `R`.
#[derive(Debug)]
pub(super) struct Events<R> {
    waiting: Mutex<Waiting<R>>,
    some: Condvar,
}

impl<R> Events<R> {
    pub(super) fn new() -> Self {
        Self {
            waiting: Mutex::new(Waiting {
                aborts: Turns::new(ABORTS),
                requests: Turns::new(REQUESTS),
                replies: VecDeque::new(),
                presence: BTreeMap::new(),
                last: (String::new(), String::new()),
                turn: 0,
            }),
            some: Condvar::new(),
        }
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting<R>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a request, unless too many of its kind wait.
    pub(super) fn put_request(&self, origin: &Origin, request: R, is_abort: bool) {
        let mut waiting = self.waiting();
        waiting.turns(is_abort).put(now(), origin, request);
        drop(waiting);
        self.some.notify_one();
    }

    /// A request was answered, or gets no answer.
    pub(super) fn end(&self, turn: &Turn) {
        self.waiting().turns(turn.is_abort).end(&turn.origin);
        self.some.notify_one();
    }

    /// Tells that an agent is there or gone, unless too many others did.
    pub(super) fn put_presence(&self, agent: Agent, is_there: bool) {
        let mut waiting = self.waiting();
        if waiting.presence.len() < MOST_AGENTS || waiting.presence.contains_key(&agent) {
            waiting.presence.insert(agent, is_there);
        }
        drop(waiting);
        self.some.notify_one();
    }

    /// Adds what belongs to a query.
    pub(super) fn put_reply(&self, event: Event<R>) {
        self.waiting().replies.push_back(event);
        self.some.notify_one();
    }

    /// The next event, if there is one within `limit`.
    pub(super) fn next(&self, limit: Duration) -> Option<Event<R>> {
        let waiting = self.waiting();
        let waiting = self.some.wait_timeout_while(waiting, limit, |waiting| {
            waiting.aborts.is_quiet()
                && waiting.requests.is_quiet()
                && waiting.replies.is_empty()
                && waiting.presence.is_empty()
        });
        let (mut waiting, _) = waiting.unwrap_or_else(PoisonError::into_inner);
        waiting.take()
    }
}

impl<R> Waiting<R> {
    const fn turns(&mut self, is_abort: bool) -> &mut Turns<R> {
        match is_abort {
            true => &mut self.aborts,
            false => &mut self.requests,
        }
    }

    fn take_request(&mut self, is_abort: bool) -> Option<Event<R>> {
        let Taken {
            origin,
            arrived,
            request,
        } = self.turns(is_abort).take(now())?;
        Some(Event::Request(Turn { origin, is_abort }, arrived, request))
    }

    fn take(&mut self) -> Option<Event<R>> {
        for _ in 0..KINDS {
            self.turn = (self.turn + 1) % KINDS;
            let event = match self.turn {
                0 => self.take_request(true),
                1 => self.replies.pop_front(),
                2 => self.take_presence(),
                _ => self.take_request(false),
            };
            if event.is_some() {
                return event;
            }
        }
        None
    }

    /// Agents have turns, too.
    fn take_presence(&mut self) -> Option<Event<R>> {
        let mut later = self.presence.range((Excluded(&self.last), Unbounded));
        let next = later.next().or_else(|| self.presence.first_key_value());
        self.last = next?.0.clone();
        let (agent, is_there) = self.presence.remove_entry(&self.last)?;
        Some(Event::Presence(agent, is_there))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn agent(name: &str) -> Agent {
        (name.to_owned(), "7".to_owned())
    }

    fn origin() -> Origin {
        Origin {
            connection: 1,
            robot: "arm".to_owned(),
        }
    }

    /// Takes everything that waits.
    fn all(events: &Events<&'static str>) -> Vec<String> {
        let told = |event: Event<&str>| match event {
            Event::Request(_, _, request) => request.to_owned(),
            Event::Presence((name, _), is_there) => format!("{name} {is_there}"),
            other => format!("{other:?}"),
        };
        std::iter::from_fn(|| events.next(Duration::ZERO))
            .map(told)
            .collect()
    }

    #[test]
    fn each_kind_has_its_turn_and_the_newest_presence_counts() {
        let events = Events::new();
        for _ in 0..2 {
            events.put_request(&origin(), "STATUS", false);
            events.put_presence(agent("arm"), false);
        }
        for is_there in [false, true] {
            events.put_presence(agent("leg"), is_there);
        }
        events.put_reply(Event::NoReply(1));
        events.put_request(&origin(), "ABORT", true);
        let first = ["NoReply(1)", "arm false", "STATUS", "ABORT"];
        assert_eq!(all(&events), [&first[..], &["leg true", "STATUS"]].concat());
    }

    #[test]
    fn a_flood_is_bounded_and_holds_up_neither_aborts_nor_presence() {
        let events = Events::new();
        for number in 0..10 * MOST_AGENTS {
            events.put_presence(agent(&format!("a{number}")), true);
        }
        // They are dropped when they have waited for too long, also on a busy machine.
        for _ in 0..10 * REQUESTS {
            events.put_request(&origin(), "INIT", false);
        }
        events.put_request(&origin(), "ABORT", true);
        // Whoever is known may go.
        events.put_presence(agent("a7"), false);
        let soon: Vec<_> = (0..KINDS)
            .filter_map(|_| events.next(Duration::ZERO))
            .collect();
        let is_abort = |event: &Event<&str>| matches!(event, Event::Request(_, _, "ABORT"));
        assert!(soon.iter().any(is_abort), "{soon:?}");
        let rest = all(&events);
        assert_eq!(KINDS + rest.len(), REQUESTS / 2 + 1 + MOST_AGENTS);
        assert!(rest.contains(&"a7 false".to_owned()));
    }

    #[test]
    fn an_agent_is_not_held_up_by_others_that_come_and_go() {
        let events = Events::<&str>::new();
        events.put_presence(agent("z"), true);
        let mut taken = Vec::new();
        for number in 0..3 {
            events.put_presence(agent("a"), number % 2 == 0);
            events.put_presence(agent("b"), number % 2 == 0);
            taken.push(events.next(Duration::ZERO));
        }
        let is_it =
            |event: &Option<_>| matches!(event, Some(Event::Presence((name, _), _)) if name == "z");
        assert!(taken.iter().any(is_it), "{taken:?}");
    }
}
