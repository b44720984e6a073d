//! What clients were told, compared with what the devices recorded.

use std::collections::BTreeMap;
use std::fmt::Write;

use ztl_std::State;

/// The result that a client received for its task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Told {
    Rejected(String),
    Ended(State, String),
}

/// What a device did for a goal.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Done {
    begun: u32,
    /// `completed`, `aborted`, `made-safe`; empty when its power went.
    ended: Vec<String>,
}

/// All tasks of a device, by their unique goals.
#[derive(Debug, Default)]
pub struct Ledger(BTreeMap<String, Told>);

impl Ledger {
    #[track_caller]
    pub fn note(&mut self, goal: String, told: Told) {
        let before = self.0.insert(goal, told);
        assert_eq!(before, None, "two tasks with the same goal");
    }

    #[track_caller]
    pub fn add(&mut self, other: Self) {
        for (goal, told) in other.0 {
            self.note(goal, told);
        }
    }

    /// Compares with the device's record; with `resets`, a task may have been lost with its power.
    #[track_caller]
    pub fn check(&self, record: &str, resets: bool) {
        let done = read(record);
        let mut wrong = String::new();
        for (goal, told) in &self.0 {
            let done = done.get(goal).cloned().unwrap_or_default();
            let right = match told {
                Told::Rejected(_) | Told::Ended(State::Rejected, _) => done.begun == 0,
                Told::Ended(State::Completed, _) => done.begun == 1 && done.ended == ["completed"],
                Told::Ended(..) if resets => done.begun <= 1,
                Told::Ended(..) => done.begun == 1,
            };
            if !right {
                let _ = writeln!(wrong, "{goal}: told {told:?}, the device {done:?}");
            }
        }
        for goal in done.keys().filter(|goal| !self.0.contains_key(*goal)) {
            let _ = writeln!(wrong, "{goal}: begun, and no client was told about it");
        }
        assert!(wrong.is_empty(), "{wrong}");
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// How many tasks were taken.
    pub fn taken(&self) -> usize {
        let taken = |told: &&Told| matches!(told, Told::Ended(..));
        self.0.values().filter(taken).count()
    }

    /// How many tasks came to which end, for people.
    pub fn summary(&self) -> String {
        let mut ends = BTreeMap::<String, usize>::new();
        for told in self.0.values() {
            let end = match told {
                Told::Rejected(_) => "REJECTED".to_owned(),
                Told::Ended(state, _) => state.to_string(),
            };
            *ends.entry(end).or_default() += 1;
        }
        let ends: Vec<String> = ends.iter().map(|(end, n)| format!("{n} {end}")).collect();
        ends.join(", ")
    }

    /// The reasons of those that did not complete, and how often each.
    pub fn reasons(&self) -> BTreeMap<&str, usize> {
        let mut reasons = BTreeMap::new();
        for told in self.0.values() {
            let text = match told {
                Told::Ended(State::Completed, _) => continue,
                Told::Rejected(text) => text.rsplit(" refused: ").next().unwrap_or(text),
                Told::Ended(_, text) => text.as_str(),
            };
            *reasons.entry(text).or_default() += 1;
        }
        reasons
    }
}

/// `12.345678 finger begins '40'`
#[track_caller]
fn read(record: &str) -> BTreeMap<String, Done> {
    let mut all = BTreeMap::<String, Done>::new();
    for line in record.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let [_time, _component, what, goal] = words[..] else {
            panic!("no line of a record: {line}");
        };
        let goal = goal.trim_matches('\'').to_owned();
        match what {
            "reset" => {}
            "begins" => all.entry(goal).or_default().begun += 1,
            end => all.entry(goal).or_default().ended.push(end.to_owned()),
        }
    }
    all
}
