//! Checks that states with the same fingerprint behave alike, although they differ in what is overwritten before it is read.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};
use std::fmt::{self, Display};
use std::rc::Rc;

use crate::explore::System;

/// What was compared.
#[derive(Debug, Clone, Copy)]
pub struct Merged {
    /// Number of states that differ in anything.
    pub exact: usize,
    /// Number of their fingerprints.
    pub prints: usize,
}

impl Display for Merged {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { exact, prints } = self;
        write!(f, "{exact} states behave like {prints}")
    }
}

/// Every step of a state by name, with the fingerprint of the next state, or `None` if it breaks a promise; the undisturbed step;
/// and whether it is settled.
type Behaviour = (Vec<(String, Option<u64>)>, String, bool);

/// Explores the states reachable from `first` by their exact fingerprints. In two states with the same fingerprint, the
/// same steps must be possible, and each must lead to the same fingerprint. Then a search that merges them finds every
/// broken promise.
///
/// # Errors
/// Two states that behave differently.
pub fn check_merging<S: System>(first: &S) -> Result<Merged, String> {
    let mut known: HashMap<u64, Vec<S::Action>> = HashMap::from([(first.exact(), Vec::new())]);
    let mut behaviours: HashMap<u64, (Behaviour, u64)> = HashMap::new();
    let mut open = VecDeque::from([(first.exact(), Rc::new(first.clone()))]);
    while let Some((exact, state)) = open.pop_front() {
        let calm = state.calm();
        let mut steps = Vec::new();
        for action in std::iter::once(calm).chain(state.disturbances()) {
            let mut next = (*state).clone();
            let kept = next.apply(action).is_ok();
            let print = kept.then(|| next.fingerprint());
            steps.push((format!("{action:?}"), print));
            if !kept {
                continue;
            }
            let mut path = known[&exact].clone();
            if let Entry::Vacant(new) = known.entry(next.exact()) {
                path.push(action);
                open.push_back((*new.key(), Rc::new(next)));
                new.insert(path);
            }
        }
        steps.sort_unstable();
        let behaviour = (steps, format!("{calm:?}"), state.settled().is_ok());
        match behaviours.entry(state.fingerprint()) {
            Entry::Vacant(new) => {
                new.insert((behaviour, exact));
            }
            Entry::Occupied(alike) => {
                let (other, place) = alike.get();
                if *other != behaviour {
                    let (one, two) = (&known[place], &known[&exact]);
                    return Err(format!(
                        "after {one:?}:\n{other:?}\nafter {two:?}:\n{behaviour:?}"
                    ));
                }
            }
        }
    }
    Ok(Merged {
        exact: known.len(),
        prints: behaviours.len(),
    })
}
