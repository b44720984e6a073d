//! A motion to a position, without I/O: it ends when joint states say that the joints are there.

use std::time::{Duration, Instant};

use super::audience::EXPLAIN;
use crate::human::human_time;
use crate::kind::{Outcome, StopReason};

/// How long a motion waits for its controller and for joint states before it begins.
pub(super) const BEGIN: Duration = Duration::from_millis(1500);
/// How long the joints must be at their positions: a joint that passes is not there.
const SETTLED: Duration = Duration::from_millis(100);
/// The longest time without joint states.
const SILENCE: Duration = Duration::from_secs(2);
/// How often the controller is told to stop, and the pause between two of these.
const STOPS: u32 = 3;
const STOP_PAUSE: Duration = Duration::from_millis(100);
/// How far two joint states that show no movement must be apart until the joints count as still, and how long that may take:
/// long enough for two states a second apart.
const STILL: Duration = Duration::from_millis(200);
pub(super) const STOP_TIME: Duration = Duration::from_secs(3);
/// Of the tolerance, how far a joint that is still may move.
const STILL_PART: f64 = 0.1;
/// The shortest time between two progress texts.
const PROGRESS: Duration = Duration::from_millis(500);

/// Where a motion goes, and when it is there.
#[derive(Debug, Clone)]
pub(super) struct Target {
    pub(super) joints: Vec<String>,
    /// Of each joint, in rad or m.
    pub(super) positions: Vec<f64>,
    pub(super) tolerance: f64,
    pub(super) limit: Duration,
}

/// The last position of each joint, and when it arrived.
pub(super) type Seen = Vec<Option<(Instant, f64)>>;

/// Says why there are no joint states, if that is known.
pub(super) type Unseen<'u> = &'u dyn Fn() -> Option<String>;

fn why(unseen: Unseen<'_>) -> String {
    unseen()
        .map(|reason| format!(": {reason}"))
        .unwrap_or_default()
}

/// What the owner of the motion does.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Action {
    /// Sends the trajectory: the motion begins.
    Begin,
    /// Sends the empty trajectory.
    Stop,
    /// Finds out why no controller receives the topic, and calls [`Motion::explained`].
    Explain,
    Progress(String),
    End(Outcome),
}

#[derive(Debug)]
enum Phase {
    Waiting {
        until: Instant,
    },
    Explaining {
        until: Instant,
    },
    Moving {
        until: Instant,
        there_since: Option<Instant>,
        next_progress: Instant,
    },
    Stopping {
        outcome: Outcome,
        left: u32,
        next: Instant,
        until: Instant,
        /// When the controller had acknowledged that it is told to stop.
        told: Option<Instant>,
        /// The first joint states after that, or after the last movement.
        rest: Option<Vec<(Instant, f64)>>,
    },
    Ended,
}

/// A motion in progress. Call [`handle`](Self::handle) every few milliseconds.
#[derive(Debug)]
pub(super) struct Motion {
    target: Target,
    phase: Phase,
}

impl Motion {
    pub(super) fn new(now: Instant, target: Target) -> Self {
        Self {
            target,
            phase: Phase::Waiting { until: now + BEGIN },
        }
    }

    /// Ends the motion early.
    pub(super) fn stop(&mut self, now: Instant, why: StopReason, actions: &mut Vec<Action>) {
        match self.phase {
            Phase::Waiting { .. } | Phase::Explaining { .. } => {
                self.end(why.before_start(), actions);
            }
            Phase::Moving { .. } => {
                self.begin_stop(now, Outcome::Aborted(why.to_string()));
            }
            Phase::Stopping { .. } | Phase::Ended => {}
        }
    }

    /// Why no controller receives the topic.
    pub(super) fn explained(&mut self, reason: String, actions: &mut Vec<Action>) {
        if let Phase::Explaining { .. } = self.phase {
            self.end(Outcome::Rejected(reason), actions);
        }
    }

    /// Does what is due. `heard`: whether the controller has acknowledged all that was sent to it, or why none is there.
    pub(super) fn handle(
        &mut self,
        now: Instant,
        heard: Result<bool, &str>,
        seen: &Seen,
        unseen: Unseen<'_>,
        actions: &mut Vec<Action>,
    ) {
        match &self.phase {
            Phase::Waiting { until } => {
                let until = *until;
                self.wait(now, until, heard.is_ok(), seen, unseen, actions);
            }
            Phase::Explaining { until } if *until <= now => {
                let waited = human_time(BEGIN);
                let reason = format!("no controller receives the topic within {waited}");
                self.explained(reason, actions);
            }
            Phase::Explaining { .. } => {}
            Phase::Moving { .. } => self.watch(now, heard, seen, unseen, actions),
            Phase::Stopping { .. } | Phase::Ended => {}
        }
        self.settle(now, heard, seen, unseen, actions);
    }

    fn wait(
        &mut self,
        now: Instant,
        until: Instant,
        is_heard: bool,
        seen: &Seen,
        unseen: Unseen<'_>,
        actions: &mut Vec<Action>,
    ) {
        let missing = self.missing(now, seen);
        if is_heard && missing.is_none() {
            actions.push(Action::Begin);
            self.phase = Phase::Moving {
                until: now + self.target.limit,
                there_since: None,
                next_progress: now + PROGRESS,
            };
        } else if until <= now {
            let Some(joint) = missing.filter(|_| is_heard) else {
                let until = now + EXPLAIN;
                self.phase = Phase::Explaining { until };
                return actions.push(Action::Explain);
            };
            let waited = human_time(BEGIN);
            let reason = format!(
                "no joint state of {joint} within {waited}, so nothing was moved{}",
                why(unseen)
            );
            self.end(Outcome::Rejected(reason), actions);
        }
    }

    fn watch(
        &mut self,
        now: Instant,
        heard: Result<bool, &str>,
        seen: &Seen,
        unseen: Unseen<'_>,
        actions: &mut Vec<Action>,
    ) {
        let missing = self.missing(now, seen);
        let (joint, distance) = self.farthest(seen);
        let tolerance = self.target.tolerance;
        let limit = self.target.limit;
        let Phase::Moving {
            until,
            there_since,
            next_progress,
        } = &mut self.phase
        else {
            return;
        };
        let failed = if let Some(joint) = missing {
            let silence = human_time(SILENCE);
            Some(Outcome::Unknown(format!(
                "no joint state of {joint} for {silence}{}",
                why(unseen)
            )))
        } else if let Err(reason) = heard {
            Some(Outcome::Unknown(reason.to_owned()))
        } else if *until <= now {
            let limit = human_time(limit);
            Some(Outcome::Failed(format!(
                "{joint} is {distance:.3} from its position after {limit}"
            )))
        } else {
            None
        };
        if let Some(outcome) = failed {
            return self.begin_stop(now, outcome);
        }
        if distance <= tolerance {
            // What counts is when joint states arrived: one alone may be of a joint that passes.
            let times = seen.iter().flatten().map(|(at, _)| *at);
            let since = *there_since.get_or_insert(times.clone().max().unwrap_or(now));
            let stays = times.min().is_some_and(|oldest| oldest >= since + SETTLED);
            // Else the trajectory is still on its way.
            if stays && heard == Ok(true) {
                let positions = positions(seen)
                    .iter()
                    .map(|it| format!("{it:.4}"))
                    .collect::<Vec<_>>();
                let text = format!("[{}]", positions.join(", "));
                return self.end(Outcome::Completed(text), actions);
            }
        } else {
            *there_since = None;
        }
        if *next_progress <= now {
            *next_progress = now + PROGRESS;
            actions.push(Action::Progress(format!(
                "{joint} is {distance:.3} from its position"
            )));
        }
    }

    /// Tells the controller to stop, several times, and waits until joint states show that the joints are still.
    fn settle(
        &mut self,
        now: Instant,
        heard: Result<bool, &str>,
        seen: &Seen,
        unseen: Unseen<'_>,
        actions: &mut Vec<Action>,
    ) {
        let still = self.target.tolerance * STILL_PART;
        let Phase::Stopping {
            outcome,
            left,
            next,
            until,
            told,
            rest,
        } = &mut self.phase
        else {
            return;
        };
        if *left > 0 {
            if *next <= now {
                *left -= 1;
                *next = now + STOP_PAUSE;
                actions.push(Action::Stop);
            }
            // Whether this one is acknowledged is known later.
            return;
        }
        if heard == Ok(true) {
            told.get_or_insert(now);
        }
        let fresh = |(at, _): &&(Instant, f64)| told.is_some_and(|told| *at > told);
        let fresh: Vec<(Instant, f64)> = seen.iter().flatten().filter(fresh).copied().collect();
        let is_complete = fresh.len() == seen.len();
        let mut is_still = false;
        if is_complete {
            let rest = rest.get_or_insert_with(|| fresh.clone());
            let pairs = || rest.iter().zip(&fresh);
            // NaN is a movement.
            let rests = pairs().all(|(before, after)| (after.1 - before.1).abs() <= still);
            is_still = rests && pairs().all(|(before, after)| after.0 >= before.0 + STILL);
            if !rests {
                *rest = fresh;
            }
        }
        let is_over = heard.is_err() || *until <= now;
        let ended = match (&*outcome, heard) {
            (Outcome::Unknown(text), Ok(_)) if is_still => Outcome::Unknown(format!(
                "{text}; the controller was told to stop, and the joints are still"
            )),
            (known, Ok(_)) if is_still => known.clone(),
            (Outcome::Unknown(text), _) if is_over => Outcome::Unknown(match (told, heard) {
                (Some(_), _) => format!("{text}; the controller was told to stop"),
                (None, Err(reason)) if reason == text => reason.to_owned(),
                (None, Err(reason)) => format!("{text}; the controller was not stopped: {reason}"),
                (None, Ok(_)) => {
                    format!("{text}; the controller has not acknowledged that it must stop")
                }
            }),
            (_, Err(reason)) => {
                Outcome::Unknown(format!("the controller was told to stop, but {reason}"))
            }
            _ if *until > now => return,
            _ => {
                let time = human_time(STOP_TIME);
                let reason = match (told, &rest) {
                    (None, _) => format!("it has not acknowledged that within {time}"),
                    (_, None) => {
                        format!("no states of all joints came within {time}{}", why(unseen))
                    }
                    _ => format!("after {time} joint states do not show that the joints are still"),
                };
                Outcome::Unknown(format!("the controller was told to stop, and {reason}"))
            }
        };
        self.end(ended, actions);
    }

    fn begin_stop(&mut self, now: Instant, outcome: Outcome) {
        self.phase = Phase::Stopping {
            outcome,
            left: STOPS,
            next: now,
            until: now + STOP_TIME,
            told: None,
            rest: None,
        };
    }

    fn end(&mut self, outcome: Outcome, actions: &mut Vec<Action>) {
        self.phase = Phase::Ended;
        actions.push(Action::End(outcome));
    }

    /// A joint without a position for too long.
    fn missing(&self, now: Instant, seen: &Seen) -> Option<String> {
        let is_old = |seen: &Option<(Instant, f64)>| seen.is_none_or(|(at, _)| now >= at + SILENCE);
        let mut joints = self.target.joints.iter().zip(seen);
        joints
            .find(|(_, seen)| is_old(seen))
            .map(|(joint, _)| joint.clone())
    }

    /// The joint that is farthest from its position, and its distance.
    fn farthest(&self, seen: &Seen) -> (String, f64) {
        let mut farthest = (String::new(), -1.0);
        let target = self.target.joints.iter().zip(&self.target.positions);
        for ((joint, position), (_, here)) in target.zip(seen.iter().flatten()) {
            let distance = (here - position).abs();
            // NaN is outside of the tolerance.
            if distance.is_nan() || distance > farthest.1 {
                farthest = (joint.clone(), distance);
            }
        }
        farthest
    }
}

fn positions(seen: &Seen) -> Vec<f64> {
    seen.iter()
        .flatten()
        .map(|(_, position)| *position)
        .collect()
}

#[cfg(test)]
mod tests;
