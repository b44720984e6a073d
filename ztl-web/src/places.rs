//! How many connections there may be, in total and for each address.

use std::collections::{HashMap, VecDeque};
use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use tokio::task::AbortHandle;

use crate::board::locked;

/// Places for connections.
#[derive(Clone)]
pub(crate) struct Places {
    most: usize,
    most_of_one: usize,
    taken: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

/// A place that is free again when it is dropped.
pub(crate) struct Place {
    places: Places,
    address: IpAddr,
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
    pub(crate) fn take(&self, address: IpAddr) -> Option<Place> {
        let mut taken = locked(&self.taken);
        let all: usize = taken.values().sum();
        let own = taken.get(&address).copied().unwrap_or(0);
        if all >= self.most || own >= self.most_of_one {
            return None;
        }
        taken.insert(address, own + 1);
        drop(taken);
        Some(Place {
            places: self.clone(),
            address,
        })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = locked(&self.places.taken);
        if let Some(own) = taken.get_mut(&self.address) {
            *own -= 1;
            if *own == 0 {
                taken.remove(&self.address);
            }
        }
    }
}

/// Connections of which nobody knows yet whether they may do anything. A new one takes the place of the oldest, so that
/// strangers who do nothing keep nobody out.
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

/// A place among the strangers, which ends when it is dropped.
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
        let places = Places::new(3, 2);
        let [a, b] = [IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2])];
        let (first, second) = (places.take(a), places.take(a));
        assert!(first.is_some() && second.is_some() && places.take(a).is_none());
        let other = places.take(b);
        assert!(other.is_some() && places.take(b).is_none());
        drop((first, second, other));
        assert!(locked(&places.taken).is_empty());
    }
}
