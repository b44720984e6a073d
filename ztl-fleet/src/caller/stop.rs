//! Tells robots to stop all tasks, and asks until each has confirmed it.

use std::collections::BTreeMap;
use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use super::{Caller, VALID_MS};
use crate::seal::Request;
use crate::wire::{AgentQuery, Stopped, Verdict, fresh};

/// Pause before a robot that has not confirmed is told again.
const AGAIN: Duration = Duration::from_millis(200);
/// How often a machine is told with the clock that it has told.
const MOST: u32 = 3;

/// What a robot answered that was told to stop.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct StopAnswer {
    /// What each machine says that answered as this robot.
    pub machines: Vec<Stopped>,
    /// Whether an answer is missing: of this machine, or of another one with its name and id.
    pub misses_one: bool,
    /// Whether the robot does not do it.
    pub is_refused: bool,
    /// What it said instead.
    pub reason: Option<String>,
}

/// A robot that is told to stop.
#[derive(Default)]
struct Told {
    /// Questions without an end yet.
    open: u32,
    /// Whether a round has ended, so that no other machine holds up the question.
    was_whole: bool,
    /// How often each boot was told, and what it said.
    machines: BTreeMap<u32, (u32, Option<Stopped>)>,
    is_refused: bool,
    /// Whether an answer of this round was neither a confirmation nor a refusal.
    is_unclear: bool,
    /// The same of the round before, or of an earlier one if nobody answered that.
    was_unclear: bool,
    /// Whether this round has an answer.
    is_heard: bool,
    reason: Option<String>,
    /// When to tell it again.
    again: Option<Instant>,
    is_known: bool,
}

/// News of a question: the robot's index, the boot that the question named, and the answer; `None` when the question ends.
type News = (usize, u32, Option<Verdict>);

impl Told {
    /// Takes an answer to a question that named a boot. Returns whom to tell with which clock.
    fn on_verdict(&mut self, named: u32, verdict: Verdict) -> Option<(u32, u64)> {
        self.is_heard = true;
        match verdict {
            Verdict::Stale { boot, clock_ms } => {
                let (times, _) = self.machines.entry(boot).or_default();
                // A machine answers so, too, if another one was meant.
                let is_meant = *times == 0 || named == boot && *times < MOST;
                *times += u32::from(is_meant);
                return is_meant.then_some((boot, clock_ms.saturating_add(VALID_MS)));
            }
            Verdict::Answer(body) => match serde_json::from_slice::<Stopped>(&body) {
                Ok(mut told) => {
                    let (_, last) = self.machines.entry(told.boot).or_default();
                    if let Some(before) = last.take() {
                        // What ended before it was told again.
                        told.stopped.extend(before.stopped);
                        // A server that has fallen silent has not stopped what it was running.
                        if told.again && told.running.is_empty() {
                            told.running = before.running;
                        }
                    }
                    *last = Some(told);
                }
                Err(error) => {
                    self.is_unclear = true;
                    self.reason = Some(format!("it answers something else: {error}"));
                }
            },
            Verdict::NotStarted(reason) => {
                self.is_refused = true;
                self.reason = Some(reason);
            }
            Verdict::Unknown(reason) => {
                self.is_unclear = true;
                self.reason = Some(reason);
            }
        }
        None
    }

    /// Begins another round.
    fn begin_again(&mut self) {
        self.again = None;
        if std::mem::take(&mut self.is_heard) {
            self.was_unclear = std::mem::take(&mut self.is_unclear);
        }
        for (times, _) in self.machines.values_mut() {
            *times = 0;
        }
    }

    /// Whether all that were heard have confirmed, or it makes no sense to tell it again.
    fn is_over(&self) -> bool {
        let mut told = self.machines.values();
        let has_confirmed = |told: &Option<Stopped>| told.as_ref().is_some_and(|told| !told.again);
        let have_all = !self.machines.is_empty() && told.all(|(_, told)| has_confirmed(told));
        self.is_refused || have_all && !self.leaves_unclear()
    }

    /// Whether the last answers were unclear. Those of the round before count until this round has ended with answers.
    fn leaves_unclear(&self) -> bool {
        self.is_unclear || self.was_unclear && (self.open > 0 || !self.is_heard)
    }

    fn answer(&mut self) -> StopAnswer {
        let heard = self.machines.len();
        let told = std::mem::take(&mut self.machines).into_values();
        let machines: Vec<Stopped> = told.filter_map(|(_, told)| told).collect();
        // Whoever holds up or refuses the question may be another machine, also one that an earlier round did not reach.
        let has_confirmed = machines.iter().all(|told| !told.again);
        let is_held = self.open > 0 && (has_confirmed || !self.was_whole) || self.is_refused;
        StopAnswer {
            misses_one: machines.len() < heard
                || matches!(&machines[..], [told] if told.copy)
                || self.leaves_unclear()
                || !machines.is_empty() && is_held,
            machines,
            is_refused: self.is_refused,
            reason: self.reason.take(),
        }
    }
}

impl Caller {
    /// Tells agents to stop all tasks, again and again until they have confirmed it or the limit has passed. `told` is called
    /// for each of them, by its place in the list, as soon as its answer is known. Until `told` returns, no other robot is told again.
    pub fn stop_all(
        &self,
        agents: &[(String, String)],
        limit: Duration,
        mut told: impl FnMut(usize, StopAnswer),
    ) {
        let end = Instant::now() + limit;
        let (sender, news) = channel();
        let mut robots: Vec<Told> = agents.iter().map(|_| Told::default()).collect();
        for (index, robot) in robots.iter_mut().enumerate() {
            self.tell(agents, index, robot, (0, 0), end, &sender);
        }
        while robots.iter().any(|robot| !robot.is_known) {
            let next = robots.iter().filter_map(|robot| robot.again);
            let next = next.min().unwrap_or(end).min(end);
            let first = news.recv_timeout(next - Instant::now().min(next)).ok();
            // What has come counts, also if this process stood still until the limit.
            for (index, named, verdict) in first.into_iter().chain(news.try_iter()) {
                let Some(robot) = robots.get_mut(index) else {
                    continue;
                };
                match verdict {
                    Some(verdict) => {
                        if let Some(clock) = robot.on_verdict(named, verdict) {
                            self.tell(agents, index, robot, clock, end, &sender);
                        }
                    }
                    None => robot.open = robot.open.saturating_sub(1),
                }
            }
            let now = Instant::now();
            for (index, robot) in robots.iter_mut().enumerate() {
                if robot.is_known {
                    continue;
                }
                if now >= end || robot.open == 0 && robot.is_over() {
                    robot.is_known = true;
                    robot.again = None;
                    let mut answer = robot.answer();
                    if robot.open == 0 && answer == StopAnswer::default() {
                        answer.reason = Some(self.why_nobody().to_owned());
                    }
                    told(index, answer);
                } else if robot.again.is_some_and(|again| now >= again) {
                    robot.begin_again();
                    self.tell(agents, index, robot, (0, 0), end, &sender);
                } else if robot.open == 0 && robot.again.is_none() {
                    robot.was_whole = true;
                    robot.again = Some(now + AGAIN);
                }
            }
        }
    }

    /// Why an agent that is there may answer nothing.
    #[must_use]
    pub const fn why_nobody(&self) -> &'static str {
        match self.identity {
            None => "nobody answers there; a robot with a fleet-key answers only files with one",
            Some(_) => {
                "nobody with its key answers; perhaps this file's fleet-key is not among its 'client-keys'"
            }
        }
    }

    /// Tells a robot, with a boot and a clock of it.
    fn tell(
        &self,
        agents: &[(String, String)],
        index: usize,
        told: &mut Told,
        (boot, until_ms): (u32, u64),
        end: Instant,
        sender: &Sender<News>,
    ) {
        let Some((robot, agent)) = agents.get(index) else {
            return;
        };
        let request = Request {
            robot,
            what: AgentQuery::Stop.name(),
            parameters: &fresh(boot, until_ms),
            who: "ztl-fleet",
            body: b"",
        };
        let (replies, ends) = (sender.clone(), sender.clone());
        // The receiver may be gone: then all is known.
        let on_reply = move |verdict| drop(replies.send((index, boot, Some(verdict))));
        let on_end = move || drop(ends.send((index, boot, None)));
        // Zenoh's own end of the question comes after this one's.
        let limit = end.saturating_duration_since(Instant::now()) + AGAIN;
        match self.ask_each(agent, &request, limit, on_reply, on_end) {
            Ok(()) => told.open += 1,
            Err(error) => told.reason = Some(error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What still runs and what has stopped of a robot that gave these answers in turn.
    fn known(answers: &[&str]) -> [Vec<String>; 2] {
        let mut told = Told::default();
        for answer in answers {
            let verdict = Verdict::Answer(answer.as_bytes().to_vec());
            assert_eq!(told.on_verdict(7, verdict), None);
        }
        let machine = told.answer().machines.remove(0);
        [machine.running, machine.stopped]
    }

    #[test]
    fn a_round_without_all_answers_makes_nothing_clear() {
        let stopped = r#"{"boot":7,"stopped":[],"running":[],"unknown":null}"#;
        let stopped = || Verdict::Answer(stopped.as_bytes().to_vec());
        let busy = || Verdict::Unknown("too many requests are waiting".to_owned());
        for has_other in [false, true] {
            let mut told = Told::default();
            let others = has_other.then(stopped);
            for answer in others.into_iter().chain([busy()]) {
                assert_eq!(told.on_verdict(7, answer), None);
            }
            told.was_whole = true;
            for _ in 0..2 {
                assert!(!told.is_over());
                told.begin_again();
            }
            assert!(!told.is_over(), "the new round has no answer yet");
            assert_eq!(told.on_verdict(7, stopped()), None);
            told.open = 1;
            assert!(told.answer().misses_one, "one has not answered again");
        }
        let mut told = Told::default();
        assert_eq!(told.on_verdict(7, busy()), None);
        told.begin_again();
        assert_eq!(told.on_verdict(7, stopped()), None);
        assert!(told.is_over() && !told.answer().misses_one);
        told = Told {
            open: 1,
            was_whole: true,
            ..Told::default()
        };
        assert_eq!(told.on_verdict(7, busy()), None);
        told.begin_again();
        let answer = told.answer();
        assert!(answer.misses_one && answer.reason.is_some(), "{answer:?}");
    }

    #[test]
    fn whoever_holds_up_the_last_round_may_be_a_machine_that_the_first_did_not_reach() {
        for (again, misses_one) in [(false, true), (true, false)] {
            let mut told = Told {
                open: 1,
                was_whole: true,
                ..Told::default()
            };
            let body =
                format!(r#"{{"boot":7,"stopped":[],"running":[],"unknown":null,"again":{again}}}"#);
            assert_eq!(told.on_verdict(7, Verdict::Answer(body.into_bytes())), None);
            let answer = told.answer();
            assert_eq!(answer.misses_one, misses_one, "{answer:?}");
        }
    }

    #[test]
    fn tasks_of_a_server_that_falls_silent_still_run() {
        let runs =
            r#"{"boot":7,"stopped":["/lab 4"],"running":["/lab 5"],"unknown":null,"again":true}"#;
        let silent =
            r#"{"boot":7,"stopped":[],"running":[],"unknown":"it is silent","again":true}"#;
        assert_eq!(known(&[runs, silent]), [["/lab 5"], ["/lab 4"]]);
        let ended = r#"{"boot":7,"stopped":[],"running":[],"unknown":null}"#;
        assert_eq!(known(&[runs, silent, ended]), [vec![], vec!["/lab 4"]]);
    }
}
