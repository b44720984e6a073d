//! The ABORTs for a server that are under way or have to be sent again.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tokio::sync::oneshot;
use ztl_std::{RemoteId, RequestError, Status};

use crate::cut;
use crate::goal::Goal;

/// How long an unanswered ABORT is repeated while a client waits for the answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// The same after a Stop. By then the page says that the Stop is not confirmed, but the task may still run.
const PATIENCE_OF_STOP: Duration = Duration::from_secs(60);
/// Between an ABORT that has failed and the next one.
const AGAIN: Duration = Duration::from_millis(100);
/// After this time an ABORT counts as lost: a server holds its answer for up to 1.5 s.
const LOST: Duration = Duration::from_millis(1700);

/// A task by scope and id.
pub(crate) type Key = (String, RemoteId);

/// What became of an ABORT.
pub(crate) type Told = Result<Value, String>;

/// A task that is to be aborted.
pub(crate) struct AbortRequest {
    key: Key,
    patience: Duration,
    /// Its goal, if a client of this console started it: the ABORT is repeated until that has ended.
    goal: Option<Arc<Goal>>,
    told: Option<oneshot::Sender<Told>>,
}

impl AbortRequest {
    /// Aborts the task of a goal.
    pub(crate) fn of_goal(goal: &Arc<Goal>, id: &RemoteId) -> Self {
        Self {
            key: (goal.target.scope.clone(), id.clone()),
            patience: PATIENCE,
            goal: Some(Arc::clone(goal)),
            told: None,
        }
    }

    /// Aborts a task, and tells what became of that.
    pub(crate) fn told(key: Key, told: oneshot::Sender<Told>) -> Self {
        Self {
            key,
            patience: PATIENCE,
            goal: None,
            told: Some(told),
        }
    }

    /// Aborts a task because of a Stop. It has this time also if its goal has ended: the task of a lost goal may still run.
    pub(crate) fn of_stop(key: Key, goal: Option<&Arc<Goal>>) -> Self {
        Self {
            key,
            patience: PATIENCE_OF_STOP,
            goal: goal.cloned(),
            told: None,
        }
    }
}

#[derive(Default)]
pub(crate) struct Aborts {
    open: HashMap<Key, Abort>,
}

struct Abort {
    /// When it is to be sent, or sent again.
    due: Instant,
    is_under_way: bool,
    /// Until when it is repeated.
    until: Instant,
    goals: Vec<Arc<Goal>>,
    told: Vec<oneshot::Sender<Told>>,
}

impl Aborts {
    /// Aborts a task now, unless an ABORT is under way to it.
    pub(crate) fn add(&mut self, request: AbortRequest, now: Instant) {
        let AbortRequest {
            key,
            patience,
            goal,
            told,
        } = request;
        let abort = self.open.entry(key).or_insert_with(|| Abort {
            due: now,
            is_under_way: false,
            until: now,
            goals: Vec::new(),
            told: Vec::new(),
        });
        if !abort.is_under_way {
            abort.due = now;
        }
        abort.until = abort.until.max(now + patience);
        abort.goals.extend(goal);
        abort.told.extend(told);
    }

    /// The tasks to send an ABORT to; it is under way from now on.
    pub(crate) fn take_due(&mut self, now: Instant) -> Vec<Key> {
        let due = self.open.iter_mut().filter(|(_, abort)| abort.due <= now);
        due.map(|(key, abort)| {
            abort.is_under_way = true;
            abort.due = now + LOST;
            key.clone()
        })
        .collect()
    }

    pub(crate) fn next_due(&self) -> Option<Instant> {
        self.open.values().map(|abort| abort.due).min()
    }

    pub(crate) fn are_under_way(&self) -> bool {
        self.open.values().any(|abort| abort.is_under_way)
    }

    pub(crate) fn contains(&self, key: &Key) -> bool {
        self.open.contains_key(key)
    }

    /// An ABORT was answered, or was not: then it is sent again for as long as that is wanted. Returns the answer.
    pub(crate) fn on_answer(
        &mut self,
        key: &Key,
        answer: Result<Status, RequestError>,
        now: Instant,
    ) -> Option<Result<Status, String>> {
        let abort = self.open.get_mut(key)?;
        abort.goals.retain(|goal| !goal.has_ended());
        let answer = match answer {
            Err(error)
                if !error.was_answered() && (now < abort.until || !abort.goals.is_empty()) =>
            {
                abort.is_under_way = false;
                abort.due = now + AGAIN;
                return None;
            }
            Err(error) => Err(format!(
                "it may still run: {}",
                cut::text(&error.to_string(), cut::LINE)
            )),
            Ok(status) => Ok(status),
        };
        for told in self.open.remove(key)?.told {
            // Fails if the client is gone.
            let _ = told.send(answer.clone().map(|status| shown(&status)));
        }
        Some(answer)
    }
}

fn shown(status: &Status) -> Value {
    let text = match status.is_abort_rejected() {
        true => "its handler cannot stop it".to_owned(),
        false => cut::text(&status.text, cut::RESULT),
    };
    json!({ "state": status.state.name(), "text": text })
}

#[cfg(test)]
mod tests {
    use ztl_std::State;

    use super::*;
    use crate::robots::Target;

    fn key(id: i64) -> Key {
        ("/lab".to_owned(), RemoteId::from(id))
    }

    fn lost() -> RequestError {
        RequestError::NoAnswer {
            endpoint: "tcp://robot:1".to_owned(),
            waited: Duration::from_secs(1),
        }
    }

    #[test]
    fn a_lost_abort_is_repeated_until_its_time_is_over() {
        let (mut aborts, start) = (Aborts::default(), Instant::now());
        let (told, mut telling) = oneshot::channel();
        aborts.add(AbortRequest::told(key(1), told), start);
        assert_eq!(aborts.take_due(start), [key(1)]);
        assert!(aborts.take_due(start).is_empty() && aborts.are_under_way());
        assert_eq!(aborts.on_answer(&key(1), Err(lost()), start), None);
        assert!(aborts.take_due(start).is_empty() && !aborts.are_under_way());
        assert_eq!(aborts.take_due(start + AGAIN), [key(1)]);
        assert!(aborts.take_due(start + 2 * AGAIN).is_empty());
        // Without any answer it counts as lost.
        assert_eq!(aborts.take_due(start + AGAIN + LOST), [key(1)]);
        assert_eq!(
            aborts.on_answer(&key(1), Err(lost()), start + AGAIN + LOST),
            None
        );
        // A Stop waits longer.
        aborts.add(AbortRequest::of_stop(key(1), None), start + PATIENCE);
        assert_eq!(aborts.take_due(start + PATIENCE), [key(1)]);
        assert_eq!(
            aborts.on_answer(&key(1), Err(lost()), start + PATIENCE),
            None
        );
        let later = start + PATIENCE + PATIENCE_OF_STOP;
        assert_eq!(aborts.take_due(later), [key(1)]);
        assert!(telling.try_recv().is_err());
        let gone = aborts.on_answer(&key(1), Err(lost()), later);
        assert!(
            gone.expect("an end")
                .expect_err("lost")
                .starts_with("it may still run")
        );
        assert!(telling.try_recv().expect("told").is_err());
        assert!(!aborts.contains(&key(1)));
    }

    #[test]
    fn a_stop_repeats_the_abort_of_a_lost_goal() {
        let target = Target {
            server: 0,
            scope: "/lab".to_owned(),
            handler: "arm".to_owned(),
            component: "left".to_owned(),
        };
        let goal = Arc::new(Goal::new(target, String::new(), String::new(), 0));
        goal.end();
        let (mut aborts, start) = (Aborts::default(), Instant::now());
        aborts.add(AbortRequest::of_stop(key(1), Some(&goal)), start);
        assert_eq!(aborts.take_due(start), [key(1)]);
        let later = start + 2 * PATIENCE;
        assert_eq!(aborts.on_answer(&key(1), Err(lost()), later), None);
        assert_eq!(aborts.take_due(later + AGAIN), [key(1)]);
    }

    #[test]
    fn every_client_is_told_the_answer() {
        let (mut aborts, now) = (Aborts::default(), Instant::now());
        let [mut one, mut two] = [(); 2].map(|()| {
            let (told, telling) = oneshot::channel();
            aborts.add(AbortRequest::told(key(1), told), now);
            telling
        });
        aborts.take_due(now);
        let status = Status {
            state: State::Aborted,
            text: "at 40".to_owned(),
        };
        assert!(aborts.on_answer(&key(1), Ok(status), now).is_some());
        for telling in [&mut one, &mut two] {
            let told = telling.try_recv().expect("told");
            assert_eq!(told, Ok(json!({ "state": "ABORTED", "text": "at 40" })));
        }
    }
}
