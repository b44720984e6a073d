//! Tells two machines that answer as one robot, such as copies of an SD card, from one that was restarted.
//!
//! Each start of an agent has a boot id of its own. A boot surely lived from the first moment at which an answer of it was heard
//! to the last moment at which a question was asked that it answered. One machine has one boot after another; if two boots
//! surely lived at the same time, there are two machines. An answer that somebody holds back or a question that he repeats
//! makes no boot live longer.

use std::collections::BTreeMap;
use std::time::Duration;

use ztl_core::Instant;

/// How long a boot counts after the last question that it answered.
const KEEP: Duration = Duration::from_secs(60);
/// Most boots of a robot that are known.
const MOST: usize = 16;

/// The boots that answered as a robot.
#[derive(Debug, Default)]
pub(crate) struct Lives {
    of: BTreeMap<u32, Life>,
    was_told: bool,
}

#[derive(Debug, Clone, Copy)]
struct Life {
    /// When its first answer was heard.
    heard: Instant,
    /// When the last question was asked that it answered.
    asked: Instant,
}

impl Lives {
    /// A boot has answered a question that was asked then. Returns whether it is news that there are two machines.
    pub(crate) fn note(&mut self, now: Instant, boot: u32, asked: Instant) -> bool {
        self.forget(now);
        let life = self.of.entry(boot).or_insert(Life { heard: now, asked });
        life.asked = life.asked.max(asked);
        if self.of.len() > MOST {
            let oldest = self.of.iter().min_by_key(|(_, life)| life.asked);
            let oldest = oldest.map(|(boot, _)| *boot);
            oldest.and_then(|boot| self.of.remove(&boot));
        }
        let are_two = self.are_two(now);
        are_two && !std::mem::replace(&mut self.was_told, are_two)
    }

    /// Whether two machines answered within the last minute.
    pub(crate) fn are_two(&mut self, now: Instant) -> bool {
        self.forget(now);
        let lives = self.of.values();
        let overlap = |a: &Life, b: &Life| a.heard.max(b.heard) < a.asked.min(b.asked);
        let mut pairs = lives.enumerate().flat_map(|(index, a)| {
            let others = self.of.values().skip(index + 1);
            others.map(move |b| (a, b))
        });
        let are_two = pairs.any(|(a, b)| overlap(a, b));
        self.was_told &= are_two;
        are_two
    }

    /// How many boots have answered.
    pub(crate) fn count(&self) -> usize {
        self.of.len()
    }

    fn forget(&mut self, now: Instant) {
        self.of.retain(|_, life| now.since(life.asked) < KEEP);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    /// Answers: when each arrived, of which boot, and when it was asked.
    fn told(answers: &[(u64, u32, u64)]) -> Vec<bool> {
        let mut lives = Lives::default();
        let note = |(now, boot, asked): &(u64, u32, u64)| lives.note(at(*now), *boot, at(*asked));
        answers.iter().map(note).collect()
    }

    #[test]
    fn two_that_answer_two_questions_are_two_and_that_is_told_once() {
        let both = [(10, 1, 5), (12, 2, 5), (30, 1, 20), (31, 2, 20)];
        assert_eq!(told(&both), [false, false, false, true]);
        let again = [&both[..], &[(50, 1, 40), (51, 2, 40)]].concat();
        assert_eq!(told(&again).iter().filter(|told| **told).count(), 1);
    }

    #[test]
    fn a_restart_is_not_a_second_machine_also_if_answers_and_questions_are_held_back() {
        // The first question is answered by the boot before and, repeated by a stranger, by the one behind.
        let mut answers = vec![(10, 1, 5), (900, 2, 5)];
        answers.extend((1..20).map(|number| (1000 * number + 10, 2, 1000 * number)));
        // The first one's answer comes once more, late.
        answers.push((20_000, 1, 5));
        assert_eq!(told(&answers), vec![false; answers.len()]);
    }

    #[test]
    fn a_machine_that_is_gone_is_forgotten_in_a_minute() {
        let mut lives = Lives::default();
        for (now, boot, asked) in [(10, 1, 5), (12, 2, 5), (30, 1, 20), (31, 2, 20)] {
            lives.note(at(now), boot, at(asked));
        }
        assert!(lives.are_two(at(60_000)));
        lives.note(at(60_010), 1, at(60_005));
        assert!(!lives.are_two(at(60_021)));
        // If it comes back, that is told again.
        let back = [
            (70_010, 1, 70_000),
            (70_010, 2, 70_000),
            (70_030, 2, 70_020),
        ];
        let back = back.map(|(now, boot, asked)| lives.note(at(now), boot, at(asked)));
        assert_eq!(back, [false, false, false]);
        assert!(lives.note(at(70_030), 1, at(70_020)));
        for boot in 3..1000 {
            lives.note(at(70_040), boot, at(70_035));
        }
        assert_eq!(lives.count(), MOST);
    }
}
