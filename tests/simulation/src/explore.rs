//! Explores every reachable state of a system, breadth first.
//!
//! Existing crates store states as values with `Hash` and `Eq`. Here a state is two real state machines with their clocks,
//! and only its fingerprint is stored. The liveness property *every task ends* is checked by following, from each state,
//! the undisturbed execution until it reaches a cycle.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};
use std::hash::{BuildHasherDefault, Hasher};
use std::rc::Rc;

/// A system to explore.
pub trait System: Clone {
    /// A step.
    type Action: Copy + std::fmt::Debug;

    /// The next step of the undisturbed execution.
    fn calm(&self) -> Self::Action;

    /// All other possible steps.
    fn disturbances(&self) -> Vec<Self::Action>;

    /// Takes a step.
    ///
    /// # Errors
    /// The promise that the step breaks.
    fn apply(&mut self, action: Self::Action) -> Result<(), String>;

    /// Equal for equivalent states.
    fn fingerprint(&self) -> u64;

    /// Equal for states that do not even differ in what is overwritten before it is read.
    fn exact(&self) -> u64 {
        self.fingerprint()
    }

    /// Checks a state of an undisturbed cycle.
    ///
    /// # Errors
    /// The promise that it breaks.
    fn settled(&self) -> Result<(), String>;

    /// Checks that the system still works, in an undisturbed cycle.
    ///
    /// # Errors
    /// The violated guarantee.
    fn serves(&self) -> Result<(), String>;

    /// Describes what happens on a path from this state.
    fn trace(&self, path: &[Self::Action]) -> Vec<String>;
}

/// A broken promise, and the path to it.
#[derive(Debug, Clone)]
pub struct Broken<A> {
    /// The promise.
    pub promise: String,
    /// The steps from the first state on.
    pub path: Vec<A>,
}

/// The result of an exploration.
#[derive(Debug, Clone)]
pub struct Explored<A> {
    /// Number of states.
    pub states: usize,
    /// Number of steps taken.
    pub steps: usize,
    /// Largest distance from the first state, in steps.
    pub depth: u32,
    /// Number of cycles in which undisturbed executions end.
    pub circles: usize,
    /// Whether all states were explored; if not, there are more than the limit.
    pub complete: bool,
    /// A broken promise with the shortest path.
    pub broken: Option<Broken<A>>,
}

impl<A> std::fmt::Display for Explored<A> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            states,
            steps,
            depth,
            circles,
            ..
        } = self;
        let all = if self.complete { "all" } else { "the first" };
        write!(
            f,
            "{all} {states} states, {steps} steps, at most {depth} away; calm ends in {circles} circles"
        )
    }
}

/// Uses fingerprints as hashes.
#[derive(Default)]
struct AsItIs(u64);

impl Hasher for AsItIs {
    fn write(&mut self, _: &[u8]) {}

    fn write_u64(&mut self, number: u64) {
        self.0 = number;
    }

    fn finish(&self) -> u64 {
        self.0
    }
}

struct Reached<A> {
    parent: u32,
    action: Option<A>,
    /// Index of the next state of the undisturbed execution.
    calm: u32,
    depth: u32,
    settled: bool,
}

const NOWHERE: u32 = u32::MAX;

struct Step<S: System> {
    from: Rc<S>,
    place: u32,
    action: S::Action,
    calm: bool,
}

struct Explorer<S: System> {
    known: HashMap<u64, u32, BuildHasherDefault<AsItIs>>,
    reached: Vec<Reached<S::Action>>,
    open: VecDeque<Step<S>>,
}

/// Explores the states reachable from `first`, at most `limit`.
pub fn explore<S: System>(first: &S, limit: usize) -> Explored<S::Action> {
    let mut explorer = Explorer {
        known: HashMap::default(),
        reached: Vec::new(),
        open: VecDeque::new(),
    };
    explorer.add(first.clone(), NOWHERE, None);
    let mut explored = Explored {
        states: 1,
        steps: 0,
        depth: 0,
        circles: 0,
        complete: true,
        broken: None,
    };
    while let Some(step) = explorer.open.pop_front() {
        if explorer.reached.len() >= limit {
            explored.complete = false;
            break;
        }
        explored.steps += 1;
        let (place, action, calm) = (step.place, step.action, step.calm);
        let mut state = Rc::try_unwrap(step.from).unwrap_or_else(|shared| (*shared).clone());
        if let Err(promise) = state.apply(action) {
            let mut path = explorer.path(place);
            path.push(action);
            explored.broken = Some(Broken { promise, path });
            break;
        }
        let next = explorer.add(state, place, Some(action));
        if calm {
            explorer.reached[place as usize].calm = next;
        }
    }
    explored.states = explorer.reached.len();
    explored.depth = explorer.reached.last().map_or(0, |last| last.depth);
    if explored.complete && explored.broken.is_none() {
        let (circles, broken) = explorer.circles(first);
        explored.circles = circles;
        explored.broken = broken;
    }
    explored
}

impl<S: System> Explorer<S> {
    /// Adds a state if it is new, and returns its index.
    fn add(&mut self, state: S, parent: u32, action: Option<S::Action>) -> u32 {
        let place = u32::try_from(self.reached.len()).unwrap_or(NOWHERE);
        match self.known.entry(state.fingerprint()) {
            Entry::Occupied(known) => return *known.get(),
            Entry::Vacant(new) => new.insert(place),
        };
        let depth = self
            .reached
            .get(parent as usize)
            .map_or(0, |parent| parent.depth + 1);
        self.reached.push(Reached {
            parent,
            action,
            calm: NOWHERE,
            depth,
            settled: state.settled().is_ok(),
        });
        let from = Rc::new(state);
        let mut open = |action, calm| {
            let from = Rc::clone(&from);
            self.open.push_back(Step {
                from,
                place,
                action,
                calm,
            });
        };
        open(from.calm(), true);
        for action in from.disturbances() {
            open(action, false);
        }
        place
    }

    fn path(&self, mut place: u32) -> Vec<S::Action> {
        let mut path = Vec::new();
        while let Some(reached) = self.reached.get(place as usize) {
            path.extend(reached.action);
            place = reached.parent;
        }
        path.reverse();
        path
    }

    /// Follows the undisturbed execution from every state to its cycle.
    fn circles(&self, first: &S) -> (usize, Option<Broken<S::Action>>) {
        let mut circles = 0;
        let mut walked_in = vec![NOWHERE; self.reached.len()];
        for start in 0..self.reached.len() as u32 {
            let mut place = start;
            while walked_in[place as usize] == NOWHERE {
                walked_in[place as usize] = start;
                place = self.reached[place as usize].calm;
            }
            // Reaches an earlier walk, or closes a cycle.
            if walked_in[place as usize] != start {
                continue;
            }
            circles += 1;
            if let Some(broken) = self.judge(first, place) {
                return (circles, Some(broken));
            }
        }
        (circles, None)
    }

    /// Checks the cycle through this state.
    fn judge(&self, first: &S, entry: u32) -> Option<Broken<S::Action>> {
        let mut place = entry;
        loop {
            let reached = &self.reached[place as usize];
            if !reached.settled {
                break;
            }
            place = reached.calm;
            if place == entry {
                break;
            }
        }
        let path = self.path(place);
        let mut state = first.clone();
        for action in &path {
            if let Err(promise) = state.apply(*action) {
                let path = path.clone();
                return Some(Broken { promise, path });
            }
        }
        let judged = state.settled().and_then(|()| state.serves());
        judged.err().map(|promise| Broken { promise, path })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts down to 0 undisturbed. A disturbance may raise it, or stop it forever.
    #[derive(Clone)]
    struct Counter {
        now: u8,
        bad: Option<u8>,
        stuck_at: Option<u8>,
    }

    impl System for Counter {
        type Action = i8;

        fn calm(&self) -> i8 {
            if self.now == 0 || self.stuck_at == Some(self.now) {
                0
            } else {
                -1
            }
        }

        fn disturbances(&self) -> Vec<i8> {
            if self.now < 10 { vec![3] } else { vec![] }
        }

        fn apply(&mut self, action: i8) -> Result<(), String> {
            self.now = self.now.saturating_add_signed(action);
            match self.bad {
                Some(bad) if bad == self.now => Err(format!("{bad} is reached")),
                _ => Ok(()),
            }
        }

        fn fingerprint(&self) -> u64 {
            u64::from(self.now)
        }

        fn settled(&self) -> Result<(), String> {
            if self.now == 0 {
                Ok(())
            } else {
                Err(format!("stays at {}", self.now))
            }
        }

        fn serves(&self) -> Result<(), String> {
            Ok(())
        }

        fn trace(&self, path: &[i8]) -> Vec<String> {
            path.iter().map(i8::to_string).collect()
        }
    }

    fn counter(bad: Option<u8>, stuck_at: Option<u8>) -> Explored<i8> {
        let now = 0;
        explore(&Counter { now, bad, stuck_at }, 1000)
    }

    #[test]
    fn every_state_is_reached_and_ends_in_one_cycle() {
        let explored = counter(None, None);
        assert_eq!((explored.states, explored.circles), (13, 1));
        assert!(explored.complete && explored.broken.is_none());
    }

    #[test]
    fn a_violation_is_found_by_the_shortest_path() {
        let broken = counter(Some(5), None).broken.unwrap();
        assert_eq!(broken.promise, "5 is reached");
        assert_eq!(broken.path, [3, -1, 3]);
    }

    #[test]
    fn a_system_that_never_settles_is_found() {
        let broken = counter(None, Some(2)).broken.unwrap();
        assert_eq!(broken.promise, "stays at 2");
        assert_eq!(broken.path, [3, -1]);
    }

    #[test]
    fn exceeding_the_state_limit_is_reported() {
        let first = Counter {
            now: 0,
            bad: None,
            stuck_at: None,
        };
        assert!(!explore(&first, 5).complete);
    }
}
