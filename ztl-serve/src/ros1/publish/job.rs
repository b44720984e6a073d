//! The messages that go out for a task, without I/O.

use std::time::{Duration, Instant};

use super::super::Event;
use super::super::audience::{EXPLAIN, Heard, Outlet};
use crate::human::human_time;
use crate::kind::{Effect, Job, JobEvent, Outcome, StopReason};

/// How long a task waits for a subscriber.
const SUBSCRIBE: Duration = Duration::from_millis(1500);
/// How often a task that waits looks for one, and one that runs looks whether any is left.
const LOOK: Duration = Duration::from_millis(50);
/// How often the stop message is sent, and the pause after each.
pub(super) const STOPS: u32 = 5;
pub(super) const STOP_PAUSE: Duration = Duration::from_millis(50);
/// How often a task looks whether its last message is acknowledged.
const CONFIRM: Duration = Duration::from_millis(5);

/// What a task sends.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) message: Vec<u8>,
    pub(super) stop: Option<Vec<u8>>,
    pub(super) repeat: Option<(Duration, Duration)>,
    pub(super) length: Option<Duration>,
    pub(super) acknowledge: Duration,
}

/// Messages that go out for a task.
pub(super) struct PublishJob {
    topic: String,
    plan: Plan,
    outlet: Box<dyn Outlet>,
    /// When the task began to publish.
    begun: Instant,
    phase: Phase,
}

enum Phase {
    /// Until a node subscribes.
    Waiting {
        until: Instant,
        next: Instant,
    },
    /// Nobody does; the reason is being found out.
    Explaining {
        until: Instant,
    },
    Running {
        until: Option<Instant>,
        next: Instant,
        last: Instant,
        look: Instant,
    },
    /// The stop message goes out.
    Stopping {
        outcome: Outcome,
        left: u32,
        next: Instant,
    },
    /// Until the last message is acknowledged.
    Confirming {
        outcome: Outcome,
        until: Instant,
        next: Instant,
    },
    Ended,
}

impl PublishJob {
    pub(super) fn new(now: Instant, topic: &str, plan: Plan, outlet: Box<dyn Outlet>) -> Self {
        Self {
            topic: topic.to_owned(),
            plan,
            outlet,
            begun: now,
            phase: Phase::Waiting {
                until: now + SUBSCRIBE,
                next: now,
            },
        }
    }

    fn begin(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        effects.push(Effect::Accept);
        self.begun = now;
        let mut nodes = self.outlet.look(None).nodes;
        nodes.dedup();
        if nodes.len() > 1 {
            let (topic, nodes) = (&self.topic, nodes.join(", "));
            tracing::info!(
                "{topic} goes to {nodes}, and all must receive it; if only one must, name it in the file with `subscriber`"
            );
        }
        self.outlet.publish(self.plan.message.clone());
        let Some((interval, _)) = self.plan.repeat else {
            return self.begin_stop(now, Outcome::Completed("True".to_owned()));
        };
        self.phase = Phase::Running {
            until: self.plan.length.and_then(|length| now.checked_add(length)),
            next: now + interval,
            last: now,
            look: now + LOOK,
        };
    }

    /// Sends the stop message several times, and then ends.
    fn begin_stop(&mut self, now: Instant, outcome: Outcome) {
        let left = if self.plan.stop.is_some() { STOPS } else { 0 };
        self.phase = Phase::Stopping {
            outcome,
            left,
            next: now,
        };
    }

    /// The outcome if a node that counts has left or was disconnected, so that it is unknown what it received.
    fn lost(&self, heard: &Heard) -> Option<Outcome> {
        let reason = match &heard.lost {
            Some(lost) => lost.clone(),
            None if heard.nodes.is_empty() => {
                format!("no node subscribes to {} any more", self.topic)
            }
            None => return None,
        };
        Some(Outcome::Unknown(reason))
    }

    /// Ends once the last message is acknowledged.
    fn confirm(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        let Phase::Confirming {
            outcome,
            until,
            next,
        } = &mut self.phase
        else {
            return;
        };
        if *next > now {
            return;
        }
        *next = now + CONFIRM;
        let (until, outcome) = (*until, outcome.clone());
        let heard = self.outlet.look(Some(self.begun));
        let outcome = match self.lost(&heard) {
            _ if matches!(outcome, Outcome::Unknown(_)) => outcome,
            Some(lost) => lost,
            None if heard.has_all => outcome,
            None if until > now => return,
            None => Outcome::Unknown(format!(
                "a node that subscribes to {} has not acknowledged the last message",
                self.topic
            )),
        };
        if let (Some(_), Some(stop)) = (&heard.lost, &self.plan.stop) {
            self.outlet.publish_when_back(self.begun, stop.clone());
        }
        effects.push(Effect::End(outcome));
        self.phase = Phase::Ended;
    }

    fn run(&mut self, now: Instant) {
        let Some((interval, dead_man)) = self.plan.repeat else {
            return;
        };
        let Phase::Running {
            until,
            next,
            last,
            look,
        } = &mut self.phase
        else {
            return;
        };
        let pause = now.saturating_duration_since(*last);
        if pause > dead_man {
            let (pause, limit) = (pause.as_millis(), human_time(dead_man));
            return self.begin_stop(now, Outcome::Failed(format!(
                "no message went out for {pause} ms, longer than dead-man: {limit}; this machine was suspended or overloaded"
            )));
        }
        if until.is_some_and(|until| until <= now) {
            return self.begin_stop(now, Outcome::Completed("True".to_owned()));
        }
        let is_look = *look <= now;
        if is_look {
            *look = now + LOOK;
        }
        if *next <= now {
            self.outlet.publish(self.plan.message.clone());
            *last = now;
            // A message that goes out late is not made up for.
            *next = (*next + interval).max(now + interval / 2);
        }
        if is_look && let Some(outcome) = self.lost(&self.outlet.look(Some(self.begun))) {
            self.begin_stop(now, outcome);
        }
    }
}

impl PublishJob {
    fn reject(&mut self, reason: String, effects: &mut Vec<Effect>) {
        self.phase = Phase::Ended;
        effects.push(Effect::End(Outcome::Rejected(reason)));
    }
}

impl Job for PublishJob {
    fn handle_event(&mut self, _: Instant, event: JobEvent, effects: &mut Vec<Effect>) {
        if let (JobEvent::Ros1(Event::Reason(reason)), Phase::Explaining { .. }) =
            (event, &self.phase)
        {
            self.reject(reason, effects);
        }
    }

    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>) {
        match self.phase {
            Phase::Waiting { .. } | Phase::Explaining { .. } => {
                self.phase = Phase::Ended;
                effects.push(Effect::End(why.before_start()));
            }
            Phase::Running { .. } => self.begin_stop(now, Outcome::Aborted(why.to_string())),
            Phase::Stopping { .. } | Phase::Confirming { .. } | Phase::Ended => {}
        }
        self.handle_timeout(now, effects);
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.phase {
            Phase::Waiting { next, .. }
            | Phase::Stopping { next, .. }
            | Phase::Confirming { next, .. } => Some(*next),
            Phase::Explaining { until } => Some(*until),
            Phase::Running {
                until, next, look, ..
            } => until.iter().chain([next, look]).min().copied(),
            Phase::Ended => None,
        }
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if let Phase::Waiting { until, next } = &mut self.phase
            && *next <= now
        {
            *next = now + LOOK;
            let is_over = *until <= now;
            if !self.outlet.look(None).nodes.is_empty() {
                self.begin(now, effects);
            } else if is_over {
                let until = now + EXPLAIN;
                self.phase = Phase::Explaining { until };
                self.outlet.explain();
            }
        }
        if let Phase::Explaining { until } = self.phase
            && until <= now
        {
            let (topic, waited) = (&self.topic, human_time(SUBSCRIBE));
            self.reject(
                format!("no node subscribes to {topic} within {waited}"),
                effects,
            );
        }
        self.run(now);
        if let Phase::Stopping {
            outcome,
            left,
            next,
        } = &mut self.phase
            && *next <= now
        {
            match (left.checked_sub(1), &self.plan.stop) {
                (Some(fewer), Some(stop)) => {
                    *left = fewer;
                    *next = now + STOP_PAUSE;
                    self.outlet.publish(stop.clone());
                }
                _ => {
                    let outcome = outcome.clone();
                    let millis = u64::try_from(self.plan.message.len() / 1024).unwrap_or(u64::MAX);
                    let large = Duration::from_millis(millis);
                    self.phase = Phase::Confirming {
                        outcome,
                        until: now + self.plan.acknowledge + large + EXPLAIN,
                        next: now,
                    };
                }
            }
        }
        self.confirm(now, effects);
    }
}
