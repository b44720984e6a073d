//! Whose turn it is: peers with something to read, without I/O.

use std::collections::VecDeque;

/// Peers with something to read, by slot. Time is divided into rounds, from one wait for events to the next.
///
/// A step of an encrypted handshake takes as long as ten requests. So in each round, those that have finished the handshake
/// have a turn first, then one stranger has. If a round ends before, the stranger is the first of the next one.
#[derive(Debug, Default)]
pub(super) struct Ready {
    known: VecDeque<usize>,
    strangers: VecDeque<usize>,
    /// Turns that those that are known have left in this round, so that those that send only commands stop nobody.
    turns: usize,
    /// A stranger has a turn in this round.
    stranger_is_due: bool,
    /// It was due in the last one.
    is_late: bool,
}

impl Ready {
    /// This peer has something to read.
    pub(super) fn push(&mut self, slot: usize, is_known: bool) {
        match is_known {
            true => self.known.push_back(slot),
            false => self.strangers.push_back(slot),
        }
    }

    /// Begins a round.
    pub(super) fn begin_round(&mut self) {
        self.turns = self.known.len();
        self.is_late = self.stranger_is_due;
        self.stranger_is_due = !self.strangers.is_empty();
    }

    /// Whose turn is next; `None` when the round is over.
    pub(super) fn next(&mut self) -> Option<usize> {
        let late = self.stranger_is_due && self.is_late;
        if !late && let Some(left) = self.turns.checked_sub(1) {
            self.turns = left;
            return self.known.pop_front();
        }
        match std::mem::take(&mut self.stranger_is_due) {
            true => self.strangers.pop_front(),
            false => None,
        }
    }

    /// Whether nobody has something to read.
    pub(super) fn is_empty(&self) -> bool {
        self.known.is_empty() && self.strangers.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round(ready: &mut Ready, most: usize) -> Vec<usize> {
        ready.begin_round();
        std::iter::from_fn(|| ready.next()).take(most).collect()
    }

    #[test]
    fn known_peers_go_first_and_one_stranger_has_a_turn() {
        let mut ready = Ready::default();
        for (slot, is_known) in [(0, false), (1, true), (2, false), (3, true)] {
            ready.push(slot, is_known);
        }
        assert_eq!(round(&mut ready, 9), [1, 3, 0]);
        ready.push(1, true);
        assert_eq!(round(&mut ready, 9), [1, 2]);
        assert!(ready.is_empty());
        assert!(round(&mut ready, 9).is_empty());
    }

    #[test]
    fn a_stranger_whose_round_ended_before_its_turn_is_first_in_the_next() {
        let mut ready = Ready::default();
        for slot in 0..10 {
            ready.push(slot, true);
        }
        for slot in 10..13 {
            ready.push(slot, false);
        }
        assert_eq!(round(&mut ready, 3), [0, 1, 2]);
        assert_eq!(round(&mut ready, 3), [10, 3, 4]);
        // Known peers without end keep no stranger waiting.
        for _ in 0..10 {
            ready.push(0, true);
        }
        assert_eq!(round(&mut ready, 3), [5, 6, 7]);
        assert_eq!(round(&mut ready, 3), [11, 8, 9]);
    }

    #[test]
    fn who_comes_back_during_a_round_waits_for_the_next() {
        let mut ready = Ready::default();
        ready.push(1, true);
        ready.begin_round();
        assert_eq!(ready.next(), Some(1));
        ready.push(1, true);
        ready.push(2, false);
        assert_eq!(ready.next(), None);
        assert_eq!(round(&mut ready, 9), [1, 2]);
    }
}
