//! An explorer of all that can happen: every state of a system, breadth first.
//!
//! The usual crates keep what they explore as values with `Hash` and `Eq`; here a state is two real
//! state machines with their clocks, of which only a fingerprint is kept. And *every task ends* is no
//! property of a state: it is shown by following, from each state, what happens when nobody
//! disturbs any more, until that goes round in a circle.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};
use std::hash::{BuildHasherDefault, Hasher};
use std::rc::Rc;

/// Something that can be explored.
pub trait System: Clone {
    /// What can happen next.
    type Action: Copy + std::fmt::Debug;

    /// What happens next when nobody disturbs.
    fn calm(&self) -> Self::Action;

    /// All else that can happen next.
    fn disturbances(&self) -> Vec<Self::Action>;

    /// Lets it happen.
    ///
    /// # Errors
    /// The promise that is broken by it.
    fn apply(&mut self, action: Self::Action) -> Result<(), String>;

    /// Equal for states of which the same can come.
    fn fingerprint(&self) -> u64;

    /// Whether it is as it has to be when nobody has disturbed for long.
    ///
    /// # Errors
    /// What is missing.
    fn settled(&self) -> Result<(), String>;

    /// Tries whether it still does what it is for. Asked where calm goes round in a circle.
    ///
    /// # Errors
    /// What it does not do.
    fn serves(&self) -> Result<(), String>;
}

/// A promise that is broken, and how that came.
#[derive(Debug, Clone)]
pub struct Broken<A> {
    /// Which.
    pub promise: String,
    /// What happened, from the first state on.
    pub path: Vec<A>,
}

/// What was explored.
#[derive(Debug, Clone)]
pub struct Explored<A> {
    /// Different states.
    pub states: usize,
    /// Steps tried from them.
    pub steps: usize,
    /// How many steps the furthest is away from the first.
    pub depth: u32,
    /// In how many circles everything ends when nobody disturbs.
    pub circles: usize,
    /// Whether that was all; if not, there were more states than allowed.
    pub complete: bool,
    /// The first broken promise; none is away from the first state by fewer steps.
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

/// A fingerprint is a hash already.
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
    /// Where it goes when nobody disturbs.
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

/// Explores what can come of `first`, at most `limit` states.
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
    /// Adds a state if it is new, and says where it is.
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

    /// Follows calm from every state, to the circle where it ends.
    fn circles(&self, first: &S) -> (usize, Option<Broken<S::Action>>) {
        let mut circles = 0;
        let mut walked_in = vec![NOWHERE; self.reached.len()];
        for start in 0..self.reached.len() as u32 {
            let mut place = start;
            while walked_in[place as usize] == NOWHERE {
                walked_in[place as usize] = start;
                place = self.reached[place as usize].calm;
            }
            // Into an earlier walk, or round to this one.
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

    /// Whether all is well in the circle that goes through this place.
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

    /// Counts down to 0 when nobody disturbs; may be thrown up, or for ever off the track.
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
    }

    fn counter(bad: Option<u8>, stuck_at: Option<u8>) -> Explored<i8> {
        let now = 0;
        explore(&Counter { now, bad, stuck_at }, 1000)
    }

    #[test]
    fn every_state_is_reached_and_calm_ends_in_one_circle() {
        let explored = counter(None, None);
        assert_eq!((explored.states, explored.circles), (13, 1));
        assert!(explored.complete && explored.broken.is_none());
    }

    #[test]
    fn a_broken_promise_is_found_by_the_shortest_path() {
        let broken = counter(Some(5), None).broken.unwrap();
        assert_eq!(broken.promise, "5 is reached");
        assert_eq!(broken.path, [3, -1, 3]);
    }

    #[test]
    fn what_never_settles_is_found() {
        let broken = counter(None, Some(2)).broken.unwrap();
        assert_eq!(broken.promise, "stays at 2");
        assert_eq!(broken.path, [3, -1]);
    }

    #[test]
    fn more_states_than_allowed_are_said_to_be_so() {
        let first = Counter {
            now: 0,
            bad: None,
            stuck_at: None,
        };
        assert!(!explore(&first, 5).complete);
    }
}
