//! Compares [`TaskTable`] with a plain list under the same rules: which tasks are kept, and which is dropped
//! when.

#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a test says what is wrong by panicking"
)]

use core::time::Duration;
use std::collections::BTreeMap;

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::FileFailurePersistence;
use ztl_core::tasks::{NoRoom, StoredText, Task, TaskRules, TaskTable, Tasks};
use ztl_core::{Event, Instant, State};

/// Capacity of the table in tasks, and of each text in bytes.
const TASKS: usize = 3;
const TEXT: usize = 8;

type Table = TaskTable<u32, (), TASKS, TEXT>;

/// An operation on the table; `task` counts back from the newest.
#[derive(Debug, Clone)]
enum Step {
    Admit,
    Apply(u32, Event, Option<String>),
    Progress(u32, String),
    Pass(u64),
    Forget(u64),
}

fn step() -> impl Strategy<Value = Step> {
    let back = 0u32..6;
    let event = prop::sample::select(Event::ALL.to_vec());
    let text = "[a-zü…🤖]{0,6}";
    prop_oneof![
        Just(Step::Admit),
        (back.clone(), event, prop::option::of(text))
            .prop_map(|(back, event, text)| Step::Apply(back, event, text)),
        (back, text).prop_map(|(back, text)| Step::Progress(back, text)),
        (0u64..3).prop_map(Step::Pass),
        (0u64..6).prop_map(Step::Forget),
    ]
}

/// A task in the list.
#[derive(Debug, Clone, PartialEq)]
struct Known {
    state: State,
    text: String,
    ended: Option<Instant>,
}

#[derive(Default)]
struct List(BTreeMap<u32, Known>);

impl List {
    /// When the oldest ended task ended.
    fn oldest_end(&self) -> Option<Instant> {
        self.0.values().filter_map(|task| task.ended).min()
    }

    /// Adds a task. If several tasks ended at the same time, drops the one that the table dropped.
    fn admit(&mut self, id: u32, table: &Table) -> Result<(), NoRoom> {
        if self.0.len() == TASKS {
            let oldest = self.oldest_end().ok_or(NoRoom)?;
            let gone = |(id, task): (&u32, &Known)| {
                (task.ended == Some(oldest) && table.get(*id).is_none()).then_some(*id)
            };
            let gone = self
                .0
                .iter()
                .find_map(gone)
                .expect("one of the oldest was dropped");
            self.0.remove(&gone);
        }
        let (state, text, ended) = (State::Initiated, String::new(), None);
        self.0.insert(id, Known { state, text, ended });
        Ok(())
    }

    fn apply(&mut self, now: Instant, id: u32, event: Event, text: Option<&str>) -> bool {
        let Some(task) = self.0.get_mut(&id) else {
            return false;
        };
        let to = match (task.state, event) {
            (State::Initiated, Event::Accept) => State::Accepted,
            (State::Initiated, Event::Reject) => State::Rejected,
            (State::Accepted, Event::Complete) => State::Completed,
            (State::Initiated | State::Accepted, Event::Fail) => State::Failed,
            (State::Initiated | State::Accepted, Event::Abort) => State::Aborted,
            _ => return false,
        };
        task.state = to;
        if let Some(text) = text {
            task.text = cut(text);
        }
        task.ended = (to != State::Accepted).then_some(now);
        true
    }

    fn progress(&mut self, id: u32, text: &str) -> bool {
        let task = self.0.get_mut(&id).filter(|task| !task.state.is_final());
        task.map(|task| task.text = cut(text)).is_some()
    }
}

/// The text, or as many characters as fit before `…`.
fn cut(text: &str) -> String {
    if text.len() <= TEXT {
        return text.to_owned();
    }
    let most = (0..=TEXT - '…'.len_utf8()).rev();
    let most = most.into_iter().find(|end| text.is_char_boundary(*end));
    let (kept, _) = text.split_at(most.unwrap());
    format!("{kept}…")
}

fn remembered(table: &Table) -> BTreeMap<u32, Known> {
    let mut all = BTreeMap::new();
    for (id, task) in table.iter() {
        let Task {
            state, text, ended, ..
        } = task;
        let (state, text) = (*state, text.as_str().to_owned());
        let known = Known {
            state,
            text,
            ended: (*ended != Instant::NEVER).then_some(*ended),
        };
        assert!(all.insert(id, known).is_none(), "{id} occurs twice");
    }
    all
}

proptest! {
    #![proptest_config(ProptestConfig {
        failure_persistence: Some(Box::new(FileFailurePersistence::WithSource("regressions"))),
        ..ProptestConfig::default()
    })]

    #[test]
    fn the_table_keeps_and_drops_the_same_tasks_as_the_list(steps in vec(step(), 0..80)) {
        let (mut table, mut list) = (Table::new(), List::default());
        let (mut now, mut last) = (Instant::ZERO, 0);
        for step in steps {
            match step {
                Step::Admit => {
                    last += 1;
                    let admitted = table.admit(last, Task::new(())).map(|_| ());
                    prop_assert_eq!(admitted, list.admit(last, &table));
                }
                Step::Apply(back, event, text) => {
                    let (id, text) = (last - back.min(last), text.as_deref());
                    prop_assert_eq!(
                        table.apply(now, id, event, text),
                        list.apply(now, id, event, text)
                    );
                }
                Step::Progress(back, text) => {
                    let id = last - back.min(last);
                    prop_assert_eq!(table.progress(id, &text), list.progress(id, &text));
                }
                Step::Pass(millis) => now = now + Duration::from_millis(millis),
                Step::Forget(millis) => {
                    let end = Instant::from_millis(millis);
                    table.forget_until(end);
                    list.0.retain(|_, task| {
                        task.ended.is_none_or(|ended| ended > end)
                    });
                }
            }
            prop_assert_eq!(remembered(&table), list.0.clone());
            prop_assert_eq!(table.len(), list.0.len());
            prop_assert_eq!(table.oldest_end().map(|(_, end)| end), list.oldest_end());
            if let Some((id, end)) = table.oldest_end() {
                prop_assert_eq!(list.0.get(&id).and_then(|task| task.ended), Some(end));
            }
        }
    }

    #[test]
    fn a_text_is_kept_whole_or_cut_at_a_character_boundary(text: String) {
        let mut kept = heapless::String::<TEXT>::new();
        kept.set(&text);
        prop_assert_eq!(kept.as_str(), cut(&text));
    }
}
