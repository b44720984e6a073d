//! The goals of one action, as a state machine without I/O: events and the time go in, effects come out.
//!
//! A goal is sent once, and only when the action server is connected to all five topics. It ends in the state that the
//! server reports, or as unknown if no server can report it any more. A goal that ended as unknown is cancelled when a
//! server still shows it, and so is a goal of a process of `ztl` that was killed.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::foreign::Foreign;
use super::wire::{GoalStatus, Status};
use super::{EndState, GoalEnd, GoalEvent};

/// How long a goal waits for its action server.
const CONNECT: Duration = Duration::from_millis(1500);

/// How long the connections for goals must stay the same before the first goal is sent. When several nodes appear at once,
/// rospy opens a second connection and drops the first with what it holds.
const SETTLE: Duration = Duration::from_millis(250);

/// How long a server may take to show a goal in its status, and to send a result after the final status.
const ANSWER: Duration = Duration::from_secs(5);

/// The longest silence of a server whose connection is closed. Servers send their status five times a second.
const SILENCE_CLOSED: Duration = Duration::from_secs(5);

/// The longest silence of a server whose connection is open.
const SILENCE_OPEN: Duration = Duration::from_secs(15);

/// A cancel is repeated until the server shows it.
const CANCEL_AGAIN: Duration = Duration::from_secs(1);

/// How many goals of unknown outcome are remembered, and for how long.
const MOST_ORPHANS: usize = 256;
const ORPHAN: Duration = Duration::from_secs(600);

/// A goal of this process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct GoalKey(pub(crate) u32);

/// What the owner of the machine does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Effect {
    SendGoal {
        id: String,
        content: Vec<u8>,
    },
    SendCancel {
        id: String,
    },
    Event(GoalKey, GoalEvent),
    /// The server shows this goal of another process of `ztl`: find out whether that process was killed, and then call
    /// [`Machine::adopt`].
    Foreign {
        id: String,
        node: String,
    },
    /// No server was there in time: find out why, and call [`Machine::handle_explanation`].
    Explain(GoalKey),
}

/// Which nodes are connected, by topic.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Links {
    /// Nodes that receive our goals.
    pub(crate) goal: Vec<Arc<str>>,
    /// Nodes that receive our cancels.
    pub(crate) cancel: Vec<Arc<str>>,
    /// Nodes from which we receive.
    pub(crate) status: Vec<Arc<str>>,
    pub(crate) feedback: Vec<Arc<str>>,
    pub(crate) result: Vec<Arc<str>>,
    /// A connection to a publisher of the status is being made: there may be a second server.
    pub(crate) unsettled: bool,
}

impl Links {
    /// The action server, once it is connected to all topics.
    fn server(&self) -> Option<&Arc<str>> {
        let [server] = self.status.as_slice() else {
            return None;
        };
        let others = [&self.goal, &self.cancel, &self.feedback, &self.result];
        others
            .iter()
            .all(|nodes| nodes.contains(server))
            .then_some(server)
    }
}

#[derive(Debug)]
struct Goal {
    id: String,
    phase: Phase,
    /// Whether [`GoalEvent::Accepted`] was reported.
    accepted: bool,
    /// When the cancel that was asked for is sent again.
    cancel_at: Option<Instant>,
    /// The node that the goal was sent to.
    server: Arc<str>,
    /// When the last status or feedback of the server arrived, or the goal was sent.
    heard: Instant,
    /// The server's connection was closed since.
    was_closed: bool,
}

#[derive(Debug)]
enum Phase {
    Waiting {
        until: Instant,
        content: Vec<u8>,
    },
    /// Its end is being explained.
    Explaining,
    Sent {
        until: Instant,
    },
    /// The server has shown it, last with this status.
    Known(Status),
    /// The server has shown this final state. The result is missing.
    Final {
        state: EndState,
        text: String,
        until: Instant,
    },
}

#[derive(Debug)]
struct Orphan {
    until: Instant,
    cancel_at: Instant,
}

/// The goals of one action.
#[derive(Debug)]
pub(crate) struct Machine {
    /// Begins the ids of goals; unique among all clients.
    prefix: String,
    goals: BTreeMap<GoalKey, Goal>,
    orphans: HashMap<String, Orphan>,
    foreign: Foreign,
    links: Links,
    /// Until then the connections for goals are too new.
    settling: Option<Instant>,
}

impl Machine {
    /// A machine whose goals have ids that begin with `prefix`.
    pub(crate) fn new(prefix: String) -> Self {
        Self {
            prefix,
            goals: BTreeMap::new(),
            orphans: HashMap::new(),
            foreign: Foreign::default(),
            links: Links::default(),
            settling: None,
        }
    }

    /// Sends a goal as soon as its server is connected.
    pub(crate) fn send(
        &mut self,
        now: Instant,
        key: GoalKey,
        content: Vec<u8>,
        effects: &mut Vec<Effect>,
    ) {
        let goal = Goal {
            id: format!("{}-{}", self.prefix, key.0),
            phase: Phase::Waiting {
                until: now + CONNECT,
                content,
            },
            accepted: false,
            cancel_at: None,
            server: Arc::from(""),
            heard: now,
            was_closed: false,
        };
        self.goals.insert(key, goal);
        self.send_waiting(now, effects);
    }

    /// Cancels a goal. It ends when the server says so.
    pub(crate) fn cancel(&mut self, now: Instant, key: GoalKey, effects: &mut Vec<Effect>) {
        let Some(goal) = self.goals.get_mut(&key) else {
            return;
        };
        match goal.phase {
            Phase::Waiting { .. } | Phase::Explaining => {
                let text = "cancelled before it was sent".to_owned();
                self.end(key, EndState::NotSent, text, None, effects);
            }
            Phase::Sent { .. } | Phase::Known(_) => {
                goal.cancel_at = Some(now + CANCEL_AGAIN);
                let id = goal.id.clone();
                effects.push(Effect::SendCancel { id });
            }
            Phase::Final { .. } => {}
        }
    }

    /// Connections were opened or closed.
    pub(crate) fn handle_links(&mut self, now: Instant, links: Links, effects: &mut Vec<Effect>) {
        for goal in self.goals.values_mut() {
            goal.was_closed |= !links.status.contains(&goal.server);
        }
        if (&links.goal, &links.cancel) != (&self.links.goal, &self.links.cancel) {
            self.settling = Some(now + SETTLE);
        }
        let before = std::mem::replace(&mut self.links, links);
        self.cancel_again(now, &before.cancel, effects);
        self.send_waiting(now, effects);
    }

    /// Sends cancels to a node that has just connected for them: it may have missed some. `before`: the nodes that were connected.
    fn cancel_again(&mut self, now: Instant, before: &[Arc<str>], effects: &mut Vec<Effect>) {
        let links = &self.links;
        let is_new = |node: &Arc<str>| links.cancel.contains(node) && !before.contains(node);
        for goal in self.goals.values_mut() {
            if goal.cancel_at.is_some() && goal.may_repeat_cancel() && is_new(&goal.server) {
                goal.cancel_at = Some(now + CANCEL_AGAIN);
                let id = goal.id.clone();
                effects.push(Effect::SendCancel { id });
            }
        }
        if links.cancel.iter().any(is_new) {
            let ids = self.orphans.keys().cloned();
            effects.extend(ids.map(|id| Effect::SendCancel { id }));
        }
    }

    /// A message of the topic `status` has arrived from this node.
    pub(crate) fn handle_status(
        &mut self,
        now: Instant,
        from: &str,
        statuses: &[GoalStatus<'_>],
        effects: &mut Vec<Effect>,
    ) {
        for goal in self.goals.values_mut() {
            if *goal.server == *from {
                goal.heard = now;
            }
        }
        let mut shown = Vec::new();
        for status in statuses {
            if let Some(key) = self.find(&status.id) {
                shown.push(key);
                self.on_status(now, from, key, status, effects);
            } else if let Some(orphan) = self.orphans.get_mut(&*status.id) {
                use Status::{Active, Pending};
                if matches!(status.status, Pending | Active) && orphan.cancel_at <= now {
                    orphan.cancel_at = now + CANCEL_AGAIN;
                    let id = status.id.clone().into_owned();
                    effects.push(Effect::SendCancel { id });
                }
            } else if matches!(status.status, Status::Pending | Status::Active)
                && let Some(node) = self.foreign.owner_to_ask(now, &status.id, &self.prefix)
            {
                let (id, node) = (status.id.clone().into_owned(), node.to_owned());
                effects.push(Effect::Foreign { id, node });
            }
        }
        let lost = self.goals.iter().filter(|(key, goal)| {
            let known = matches!(goal.phase, Phase::Known(_));
            known && *goal.server == *from && !shown.contains(key)
        });
        let lost: Vec<(GoalKey, bool)> = lost.map(|(key, goal)| (*key, goal.was_closed)).collect();
        for (key, was_closed) in lost {
            let text = match was_closed {
                true => {
                    format!("the action server {from} was restarted and does not know the goal")
                }
                false => format!("the action server {from} does not know the goal any more"),
            };
            self.end_unknown(now, key, text, effects);
        }
    }

    /// A message of the topic `feedback` has arrived from this node.
    pub(crate) fn handle_feedback(
        &mut self,
        now: Instant,
        from: &str,
        status: &GoalStatus<'_>,
        content: &[u8],
        effects: &mut Vec<Effect>,
    ) {
        let Some((key, goal)) = self.find_at(from, &status.id) else {
            return;
        };
        if matches!(goal.phase, Phase::Final { .. }) {
            return;
        }
        // A status from before the goal may arrive after this.
        if let Phase::Sent { until } = &mut goal.phase {
            *until = now + ANSWER;
        }
        goal.accept(key, effects);
        effects.push(Effect::Event(key, GoalEvent::Feedback(content.to_vec())));
    }

    /// A message of the topic `result` has arrived from this node.
    pub(crate) fn handle_result(
        &mut self,
        now: Instant,
        from: &str,
        status: &GoalStatus<'_>,
        content: &[u8],
        effects: &mut Vec<Effect>,
    ) {
        let Some((key, goal)) = self.find_at(from, &status.id) else {
            return;
        };
        match final_state(status.status) {
            Some(state) => {
                if was_active(state) {
                    goal.accept(key, effects);
                }
                let text = status.text.clone().into_owned();
                self.end(key, state, text, Some(content.to_vec()), effects);
            }
            None => {
                let status = status.status;
                let text =
                    format!("the action server {from} sent a result in the state {status:?}");
                self.end_unknown(now, key, text, effects);
            }
        }
    }

    /// Why a goal could not be sent.
    pub(crate) fn handle_explanation(
        &mut self,
        key: GoalKey,
        text: String,
        effects: &mut Vec<Effect>,
    ) {
        let explaining = |goal: &Goal| matches!(goal.phase, Phase::Explaining);
        if self.goals.get(&key).is_some_and(explaining) {
            self.end(key, EndState::NotSent, text, None, effects);
        }
    }

    /// The simulated time stands still, and so do the statuses of servers: the silence does not count.
    pub(crate) fn handle_pause(&mut self, now: Instant) {
        for goal in self.goals.values_mut() {
            if self.links.status.contains(&goal.server) {
                goal.heard = now;
            }
        }
    }

    /// Call this at [`poll_timeout`](Self::poll_timeout), or more often.
    pub(crate) fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        self.orphans.retain(|_, orphan| orphan.until > now);
        self.settling = self.settling.filter(|until| *until > now);
        self.send_waiting(now, effects);
        let keys: Vec<GoalKey> = self.goals.keys().copied().collect();
        for key in keys {
            let Some(goal) = self.goals.get_mut(&key) else {
                continue;
            };
            if goal.cancel_is_due(now) {
                goal.cancel_at = Some(now + CANCEL_AGAIN);
                let id = goal.id.clone();
                effects.push(Effect::SendCancel { id });
            }
            let server = Arc::clone(&goal.server);
            let silent = goal.silent_at(&self.links) <= now;
            match &mut goal.phase {
                Phase::Waiting { until, .. } if *until <= now => {
                    goal.phase = Phase::Explaining;
                    effects.push(Effect::Explain(key));
                }
                Phase::Final { state, text, until } if *until <= now => {
                    let (state, text) = (*state, std::mem::take(text));
                    self.end(key, state, text, None, effects);
                }
                Phase::Sent { .. } | Phase::Known(_) if silent => {
                    let text = match self.links.status.contains(&server) {
                        true => format!("the action server {server} is silent"),
                        false => format!("the action server {server} is gone"),
                    };
                    self.end_unknown(now, key, text, effects);
                }
                Phase::Sent { until } if *until <= now => {
                    let text = format!(
                        "the action server {server} has not shown the goal in time; a cancel was sent"
                    );
                    let id = goal.id.clone();
                    effects.push(Effect::SendCancel { id });
                    self.end_unknown(now, key, text, effects);
                }
                _ => {}
            }
        }
    }

    /// When to call [`handle_timeout`](Self::handle_timeout).
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let of_goals = self.goals.values().filter_map(|goal| {
            let phase = match &goal.phase {
                Phase::Waiting { until, .. } | Phase::Final { until, .. } => Some(*until),
                Phase::Explaining => None,
                Phase::Sent { until } => Some(goal.silent_at(&self.links).min(*until)),
                Phase::Known(_) => Some(goal.silent_at(&self.links)),
            };
            let cancel = goal.cancel_at.filter(|_| goal.may_repeat_cancel());
            phase.into_iter().chain(cancel).min()
        });
        of_goals.chain(self.settling).min()
    }

    /// The connections at the last [`handle_links`](Self::handle_links).
    pub(crate) fn links(&self) -> &Links {
        &self.links
    }

    /// The goal with this id. A status may show thousands that are over.
    fn find(&self, id: &str) -> Option<GoalKey> {
        let number = id.strip_prefix(&*self.prefix)?.strip_prefix('-')?;
        let key = GoalKey(number.parse().ok()?);
        self.goals
            .get(&key)
            .filter(|goal| goal.id == id)
            .map(|_| key)
    }

    /// The goal with this id, if this node is its action server.
    fn find_at(&mut self, node: &str, id: &str) -> Option<(GoalKey, &mut Goal)> {
        let key = self.find(id)?;
        let goal = self.goals.get_mut(&key)?;
        (*goal.server == *node).then_some((key, goal))
    }

    fn send_waiting(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        let waits = |goal: &Goal| matches!(goal.phase, Phase::Waiting { .. });
        let waiting = self.goals.iter().filter(|(_, goal)| waits(goal));
        let waiting: Vec<GoalKey> = waiting.map(|(key, _)| *key).collect();
        for key in waiting {
            if let [first, second, ..] = self.links.status.as_slice() {
                let text = format!(
                    "the action has more than one server, {first} and {second}: stop one of them"
                );
                self.end(key, EndState::NotSent, text, None, effects);
                continue;
            }
            let (Some(goal), Some(server)) = (self.goals.get_mut(&key), self.links.server()) else {
                continue;
            };
            let settled = !self.links.unsettled && self.settling.is_none_or(|until| until <= now);
            if let Phase::Waiting { until, content } = &mut goal.phase
                && (settled || *until <= now)
            {
                let content = std::mem::take(content);
                goal.phase = Phase::Sent {
                    until: now + ANSWER,
                };
                goal.server = Arc::clone(server);
                goal.heard = now;
                goal.was_closed = false;
                let id = goal.id.clone();
                effects.push(Effect::SendGoal { id, content });
            }
        }
    }

    fn on_status(
        &mut self,
        now: Instant,
        from: &str,
        key: GoalKey,
        status: &GoalStatus<'_>,
        effects: &mut Vec<Effect>,
    ) {
        let goal = self.goals.get_mut(&key);
        let Some(goal) = goal.filter(|goal| *goal.server == *from) else {
            return;
        };
        if matches!(goal.phase, Phase::Final { .. }) {
            return;
        }
        let is = status.status;
        if let Some(state) = final_state(is) {
            if was_active(state) {
                goal.accept(key, effects);
            }
            goal.phase = Phase::Final {
                state,
                text: status.text.clone().into_owned(),
                until: now + ANSWER,
            };
            return;
        }
        match is {
            Status::Other(number) => {
                let text = format!("the action server {from} shows the goal in the state {number}");
                return self.end_unknown(now, key, text, effects);
            }
            Status::Active | Status::Preempting => goal.accept(key, effects),
            _ => {}
        }
        goal.phase = Phase::Known(is);
    }

    fn end_unknown(&mut self, now: Instant, key: GoalKey, text: String, effects: &mut Vec<Effect>) {
        if let Some(goal) = self.goals.get(&key) {
            self.adopt(now, goal.id.clone());
        }
        self.end(key, EndState::Unknown, text, None, effects);
    }

    /// From now on, cancels this goal whenever the server shows it.
    pub(crate) fn adopt(&mut self, now: Instant, id: String) {
        if self.orphans.len() >= MOST_ORPHANS {
            let oldest = self.orphans.iter().min_by_key(|(_, orphan)| orphan.until);
            let oldest = oldest.map(|(id, _)| id.clone()).unwrap_or_default();
            self.orphans.remove(&oldest);
        }
        let orphan = Orphan {
            until: now + ORPHAN,
            cancel_at: now,
        };
        self.orphans.insert(id, orphan);
    }

    fn end(
        &mut self,
        key: GoalKey,
        state: EndState,
        text: String,
        result: Option<Vec<u8>>,
        effects: &mut Vec<Effect>,
    ) {
        if self.goals.remove(&key).is_some() {
            let end = GoalEnd {
                state,
                text,
                result,
            };
            effects.push(Effect::Event(key, GoalEvent::Ended(end)));
        }
    }
}

impl Goal {
    fn accept(&mut self, key: GoalKey, effects: &mut Vec<Effect>) {
        if !std::mem::replace(&mut self.accepted, true) {
            effects.push(Effect::Event(key, GoalEvent::Accepted));
        }
    }

    /// Whether the server has not shown yet that it knows of the cancel.
    fn may_repeat_cancel(&self) -> bool {
        matches!(
            self.phase,
            Phase::Sent { .. } | Phase::Known(Status::Pending | Status::Active)
        )
    }

    fn cancel_is_due(&self, now: Instant) -> bool {
        self.may_repeat_cancel() && self.cancel_at.is_some_and(|at| at <= now)
    }

    /// When the server has been silent for too long.
    fn silent_at(&self, links: &Links) -> Instant {
        let limit = match links.status.contains(&self.server) {
            true => SILENCE_OPEN,
            false => SILENCE_CLOSED,
        };
        self.heard + limit
    }
}

fn final_state(status: Status) -> Option<EndState> {
    Some(match status {
        Status::Succeeded => EndState::Succeeded,
        Status::Aborted => EndState::Aborted,
        Status::Preempted => EndState::Preempted,
        Status::Recalled => EndState::Recalled,
        Status::Rejected => EndState::Rejected,
        _ => return None,
    })
}

/// Whether a goal that ends so was accepted before.
fn was_active(state: EndState) -> bool {
    use EndState::{Aborted, Preempted, Succeeded};
    matches!(state, Succeeded | Aborted | Preempted)
}

#[cfg(test)]
mod tests;
