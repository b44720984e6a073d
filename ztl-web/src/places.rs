//! How many connections there may be, in total and for each address.

use std::collections::{HashMap, VecDeque};
use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use tokio::task::AbortHandle;

use crate::gate::Role;
use crate::lock::locked;

/// Limits the connections. Watchers may take three quarters of the places, so that an operator always finds one.
#[derive(Clone)]
pub(crate) struct Places {
    most: usize,
    most_of_one: usize,
    taken: Arc<Mutex<HashMap<(IpAddr, Role), usize>>>,
}

/// A place for one connection. Dropping it frees it.
pub(crate) struct Place {
    places: Places,
    holder: (IpAddr, Role),
}

impl Places {
    pub(crate) fn new(most: usize, most_of_one: usize) -> Self {
        Self {
            most,
            most_of_one,
            taken: Arc::default(),
        }
    }

    /// A place for this address; `None` if there are too many.
    pub(crate) fn take(&self, address: IpAddr, role: Role) -> Option<Place> {
        let mut taken = locked(&self.taken);
        let roles = match role {
            Role::Watcher => &[Role::Watcher][..],
            Role::Operator => &[Role::Watcher, Role::Operator],
        };
        let counted = || taken.iter().filter(|((_, role), _)| roles.contains(role));
        let all: usize = counted().map(|(_, count)| count).sum();
        let own = counted().filter(|((of, _), _)| *of == address);
        let own: usize = own.map(|(_, count)| count).sum();
        let limit = |most: usize| match role {
            Role::Watcher => most * 3 / 4,
            Role::Operator => most,
        };
        if all >= limit(self.most) || own >= limit(self.most_of_one) {
            return None;
        }
        let holder = (address, role);
        *taken.entry(holder).or_default() += 1;
        drop(taken);
        Some(Place {
            places: self.clone(),
            holder,
        })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = locked(&self.places.taken);
        if let Some(own) = taken.get_mut(&self.holder) {
            *own -= 1;
            if *own == 0 {
                taken.remove(&self.holder);
            }
        }
    }
}

/// Connections that have not shown yet what they may do. If there are too many, a new one closes the oldest, so that
/// idle strangers keep nobody out.
#[derive(Clone)]
pub(crate) struct Strangers {
    most: usize,
    most_of_one: usize,
    open: Arc<Mutex<Connections>>,
}

#[derive(Default)]
struct Connections {
    next: u64,
    oldest_first: VecDeque<(u64, IpAddr, AbortHandle)>,
}

/// A place among the strangers. Dropping it frees it.
pub(crate) struct Stranger {
    among: Strangers,
    number: u64,
}

impl Strangers {
    pub(crate) fn new(most: usize, most_of_one: usize) -> Self {
        Self {
            most,
            most_of_one,
            open: Arc::default(),
        }
    }

    /// A place for a connection of this address, which `spawn` starts.
    pub(crate) fn add(&self, address: IpAddr, spawn: impl FnOnce(Stranger) -> AbortHandle) {
        let mut open = locked(&self.open);
        let own = open.oldest_first.iter().filter(|(_, of, _)| *of == address);
        let oldest = match own.count() >= self.most_of_one {
            true => open
                .oldest_first
                .iter()
                .position(|(_, of, _)| *of == address),
            false if open.oldest_first.len() >= self.most => Some(0),
            false => None,
        };
        if let Some((_, _, connection)) = oldest.and_then(|at| open.oldest_first.remove(at)) {
            connection.abort();
        }
        let number = open.next;
        open.next += 1;
        drop(open);
        let connection = spawn(Stranger {
            among: self.clone(),
            number,
        });
        if !connection.is_finished() {
            let entry = (number, address, connection);
            locked(&self.open).oldest_first.push_back(entry);
        }
    }
}

impl Drop for Stranger {
    fn drop(&mut self) {
        let mut open = locked(&self.among.open);
        open.oldest_first
            .retain(|(number, _, _)| *number != self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_limited_by_address_and_free_again() {
        let places = Places::new(6, 4);
        let [a, b] = [IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2])];
        let take = |address, role| places.take(address, role);
        let mut held: Vec<_> = (0..4).map_while(|_| take(a, Role::Operator)).collect();
        assert!(held.len() == 4 && take(a, Role::Operator).is_none());
        held.extend((0..4).map_while(|_| take(b, Role::Operator)));
        assert_eq!(held.len(), 6);
        drop(held);
        assert!(locked(&places.taken).is_empty());
    }

    #[test]
    fn watchers_leave_places_to_operators() {
        let places = Places::new(12, 8);
        let [a, b] = [IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2])];
        let take = |address, role| places.take(address, role);
        let mut watchers: Vec<_> = (0..12).map_while(|_| take(a, Role::Watcher)).collect();
        assert_eq!(watchers.len(), 6);
        watchers.extend((0..12).map_while(|_| take(b, Role::Watcher)));
        assert_eq!(watchers.len(), 9);
        let operators: Vec<_> = (0..12).map_while(|_| take(a, Role::Operator)).collect();
        assert_eq!(operators.len(), 2);
        assert!(take(b, Role::Operator).is_some());
    }
}
