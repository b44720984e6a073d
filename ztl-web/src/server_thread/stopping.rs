//! A press of Stop: which tasks of a server are sent an ABORT, and what the server confirms.

use std::collections::HashSet;
use std::time::{Duration, Instant};

use super::{NAMED, ServerThread};
use crate::aborts::{AbortRequest, Key};
use crate::board::{Health, without_id};

/// How long a robot may take to stop its tasks until it counts as not confirmed.
const STOP_LIMIT: Duration = Duration::from_secs(4);

/// A press of Stop for which this server has not decided yet.
pub(super) struct Stopping {
    press: u64,
    /// When this thread heard of it. Only a look that was asked for later counts.
    at: Instant,
    /// Whether it is known since then if the server lists its tasks; a server of the original does not.
    kind_is_known: bool,
    /// The tasks that were sent an ABORT, and those of them that are known to have ended.
    asked: HashSet<Key>,
    ended: HashSet<Key>,
    /// Since when the lists say that nothing runs.
    idle: Option<Instant>,
}

impl Stopping {
    fn new(press: u64, at: Instant) -> Self {
        Self {
            press,
            at,
            kind_is_known: false,
            asked: HashSet::new(),
            ended: HashSet::new(),
            idle: None,
        }
    }

    /// The latest time at which this Stop is decided.
    pub(super) fn limit(&self) -> Instant {
        self.at + STOP_LIMIT
    }

    /// Whether a look that was asked for at this time counts.
    pub(super) fn counts(&self, asked_at: Instant) -> bool {
        asked_at >= self.at
    }

    /// The server has told whether it lists its tasks.
    pub(super) fn note_kind(&mut self, asked_at: Instant) {
        self.kind_is_known |= self.counts(asked_at);
    }

    /// Tasks have ended.
    pub(super) fn note_ended(&mut self, has_ended: impl Fn(&Key) -> bool) {
        let ended = self.asked.iter().filter(|key| has_ended(key));
        self.ended.extend(ended.cloned());
    }
}

impl ServerThread<'_> {
    /// Stop was pressed: everything that is known to run is sent an ABORT at once.
    pub(super) fn begin_stop(&mut self) {
        let press = self.board.stops.undecided(self.index);
        let begins = self.stop.is_none() && press.is_some();
        if begins && let Some(press) = press {
            let now = Instant::now();
            self.stop = Some(Stopping::new(press, now));
            self.next_look = now;
        }
        self.stop_goals();
        if begins {
            self.stop_running();
        }
    }

    /// During a Stop, sends an ABORT to the task of every goal of this console, also if its final state could not be learnt: a
    /// list need not have shown it yet.
    fn stop_goals(&mut self) {
        if self.stop.is_none() {
            return;
        }
        let mut goals = self.board.goals_at(self.index);
        goals.extend(self.board.lost_at(self.index));
        for goal in goals {
            if let Some(id) = goal.id() {
                let key = (goal.target.scope.clone(), id.clone());
                let request = AbortRequest::of_stop(key.clone(), Some(&goal));
                self.stop_task(key, request);
            }
        }
    }

    /// During a Stop, sends an ABORT to every task that is known to run.
    pub(super) fn stop_running(&mut self) {
        if self.stop.is_none() {
            return;
        }
        let running: Vec<Key> = self.running.iter().map(|(key, _)| key.clone()).collect();
        for key in running {
            self.stop_task(key.clone(), AbortRequest::of_stop(key, None));
        }
    }

    /// Sends an ABORT to a task that this Stop has not asked yet.
    fn stop_task(&mut self, key: Key, request: AbortRequest) {
        if let Some(stop) = &mut self.stop
            && stop.asked.insert(key)
        {
            self.aborts.add(request, Instant::now());
        }
    }

    /// A server confirms a Stop by a list without running tasks that was asked for after the press, and after every goal of
    /// this console had an answer: such a goal can start nothing later.
    pub(super) fn note_idle(&mut self, asked_at: Instant, settled: bool) {
        let is_complete = self.board.seen(self.index).gaps.is_empty();
        if is_complete {
            self.board.forget_without_id(self.index, asked_at);
        }
        let settled = settled && self.board.lost_without_id(self.index) == 0;
        let is_idle = settled && self.running.is_empty() && is_complete;
        let Some(stop) = &mut self.stop else {
            return;
        };
        let idle = stop.idle.unwrap_or_else(Instant::now);
        stop.idle = (is_idle && stop.counts(asked_at)).then_some(idle);
        if stop.idle.is_some() {
            self.ask_devices();
        }
    }

    /// A gateway must also have said, after that list, that its devices answer. It reports the tasks of a device that does not
    /// answer as FAILED, but such a device may still move.
    pub(super) fn confirm(&mut self) {
        let Some(stop) = &self.stop else {
            return;
        };
        let is_newer = stop.idle.is_some_and(|idle| self.devices_at >= Some(idle));
        if is_newer && self.board.seen(self.index).devices.unknown.is_empty() {
            let text = match (stop.asked.len(), stop.ended.len()) {
                (0, _) => "nothing ran".to_owned(),
                (1, 1) => "1 task has ended".to_owned(),
                (asked, ended) if asked == ended => format!("{ended} tasks have ended"),
                // The server does not know the others, for example because it was restarted.
                (asked, ended) => {
                    format!("nothing runs; {ended} of {asked} tasks are known to have ended")
                }
            };
            self.decide(Ok(text));
        }
    }

    /// Decides what cannot be confirmed: by a server of the original when each ABORT is answered, by others at the limit.
    pub(super) fn end_stop(&mut self) {
        if self.stop.is_none() {
            return;
        }
        let goals = self.board.goals_at(self.index);
        let settled = goals.iter().all(|goal| goal.is_settled());
        // A goal may have got its id since the last look.
        self.stop_goals();
        let Some(stop) = &self.stop else {
            return;
        };
        let waits = stop.asked.iter().any(|key| self.aborts.contains(key));
        let is_known = self.is_original && stop.kind_is_known && settled && !waits;
        if !is_known && Instant::now() < stop.limit() {
            return;
        }
        let seen = self.board.seen(self.index);
        let mut why = Vec::new();
        if seen.health != Health::There {
            why.push(seen.text);
        } else if self.is_original {
            let known = match stop.kind_is_known {
                true => "a server of the original lists no tasks",
                false => "it did not tell in time whether it lists its tasks",
            };
            why.push(known.to_owned());
        }
        if self.is_original {
            why.push(format!(
                "{} of this console were asked to stop, {} of them have ended",
                stop.asked.len(),
                stop.ended.len()
            ));
        }
        if !settled {
            why.push("a goal of this console has no answer: it may still start".to_owned());
        }
        why.extend(without_id(self.board.lost_without_id(self.index)));
        if !self.running.is_empty() {
            let names = self.running.iter().take(NAMED);
            let names: Vec<String> = names
                .map(|((_, id), task)| format!("{id} {task}"))
                .collect();
            why.push(format!(
                "{} may still run: {}",
                self.running.len(),
                names.join(", ")
            ));
        }
        if !self.is_original {
            why.extend(seen.gaps);
            why.extend(seen.devices.unknown.iter().take(NAMED).cloned());
        }
        if why.is_empty() {
            why.push("its list of tasks came too late".to_owned());
        }
        self.decide(Err(why.join("; ")));
    }

    fn decide(&mut self, told: Result<String, String>) {
        if let Some(stop) = self.stop.take() {
            self.board.stops.decide(self.index, stop.press, told);
            if self.board.stops.undecided(self.index).is_some() {
                self.next_look = Instant::now();
            }
            self.board.publish_stop();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::Arc;

    use super::*;
    use crate::board::Board;
    use crate::robots::{Robot, group};
    use crate::streams::Streams;

    /// A stop of a server of the original wakes its thread at the limit, not with the next look after it.
    #[test]
    fn a_stop_is_decided_at_its_limit() {
        let robot = Robot {
            name: "a".to_owned(),
            endpoint: "tcp://a:1".to_owned(),
            scope: "/lab".to_owned(),
            keys: None,
            connect: Arc::new(|_| Err(String::new())),
        };
        let streams = Streams::new(Vec::new(), BTreeSet::new());
        let (board, _woken) = Board::new(group(vec![robot]), streams);
        let mut thread = ServerThread::new(&board, 0, &board.servers[0]);
        board.stops.press("one");
        let pressed = Instant::now();
        thread.begin_stop();
        assert!(thread.next_work() <= Instant::now());
        thread.next_look = pressed + Duration::from_secs(60);
        let heard = Instant::now();
        let limit = thread.next_work();
        assert!((pressed + STOP_LIMIT..=heard + STOP_LIMIT).contains(&limit));
    }
}
