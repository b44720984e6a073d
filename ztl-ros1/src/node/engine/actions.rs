//! Connects the state machines of actions with topics, and knows the time of ROS.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::Engine;
use super::publications::Manner;
use super::rpc::CallError;
use super::topics::Consumer;
use crate::action::machine::{Effect, GoalKey, Links, Machine};
use crate::action::wire::{self, RosTime};
use crate::action::{GoalEvent, Part};
use crate::graph;
use crate::node::fit::TypeConflict;
use crate::xmlrpc::Value;
use crate::{ActionTypes, WireType};

/// How long the master may take to say what exists, for the reason why a goal was not sent.
const EXPLAIN: Duration = Duration::from_millis(400);

/// How long a server may take to acknowledge a goal. It is shorter than the time after which a goal that the server does not
/// show ends as unknown.
const GOAL_LIMIT: Duration = Duration::from_secs(2);

/// A simulated clock that has not moved for this long stands still.
const PAUSE: Duration = Duration::from_secs(1);

/// Called with the events of a goal.
pub(crate) type OnEvent = Box<dyn FnMut(GoalEvent) + Send>;

/// An action, as its client sees it.
pub(crate) struct Action {
    types: ActionTypes,
    pub(in crate::node) machine: Machine,
    owners: HashMap<GoalKey, OnEvent>,
    seq: u32,
    /// When to look whether cancels are acknowledged.
    pub(in crate::node) cancels_due: Option<Instant>,
    /// The log has said that a message is malformed.
    is_malformed_told: bool,
}

/// The clock of ROS.
#[derive(Debug, Default)]
pub(crate) struct Clock {
    /// Whether it is known which clock it is.
    pub(crate) known: bool,
    /// The time of the topic `/clock`, if that is the clock.
    simulated: Option<RosTime>,
    /// When that time changed last.
    moved: Option<Instant>,
}

impl Clock {
    /// Whether it is simulated and stands still.
    pub(in crate::node) fn is_paused(&self, now: Instant) -> bool {
        let moves = self.moved.is_some_and(|at| now < at + PAUSE);
        self.simulated.is_some() && !moves
    }

    /// The time for goals. Zero if `/clock` has not been received yet.
    fn now(&self) -> RosTime {
        self.simulated.unwrap_or_else(|| {
            let since = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
            RosTime {
                secs: u32::try_from(since.as_secs()).unwrap_or(u32::MAX),
                nsecs: since.subsec_nanos(),
            }
        })
    }
}

/// A topic of an action.
pub(in crate::node) fn topic(action: &str, part: &str) -> Arc<str> {
    Arc::from(format!("{action}/{part}"))
}

impl Engine {
    /// Connects to an action, unless that was done before.
    pub(crate) fn add_action(
        &mut self,
        name: &Arc<str>,
        types: ActionTypes,
    ) -> Result<(), TypeConflict> {
        if let Some(action) = self.actions.get(name) {
            return match action.types == types {
                true => Ok(()),
                false => Err(TypeConflict {
                    topic: name.to_string(),
                    used: action.types.goal.name.clone(),
                    wanted: types.goal.name,
                }),
            };
        }
        let to = |part| topic(name, part);
        let action = || Some(Arc::clone(name));
        let manner = Manner {
            limit: Some(GOAL_LIMIT),
            ..Manner::default()
        };
        // A cancel names one goal, so a late one is better than none.
        let late = Manner::default();
        self.advertise(&to("goal"), types.goal.clone(), manner, action())?;
        self.advertise(&to("cancel"), wire::cancel_type(), late, action())?;
        for (part, ty, kind) in [
            ("status", wire::status_type(), Part::Status),
            ("feedback", types.feedback.clone(), Part::Feedback),
            ("result", types.result.clone(), Part::Result),
        ] {
            let id = self.new_id();
            let consumer = Consumer::Action(Arc::clone(name), kind);
            self.subscribe(&to(part), ty, id, consumer)?;
        }
        let action = Action {
            types,
            // Unique among the actions of the node, too.
            machine: Machine::new(format!("{}{name}", self.name)),
            owners: HashMap::new(),
            seq: 0,
            cancels_due: None,
            is_malformed_told: false,
        };
        self.actions.insert(Arc::clone(name), action);
        Ok(())
    }

    pub(crate) fn send_goal(
        &mut self,
        now: Instant,
        name: &Arc<str>,
        key: GoalKey,
        content: Vec<u8>,
        on_event: OnEvent,
    ) {
        self.with_action(now, name, |action, effects| {
            action.owners.insert(key, on_event);
            action.machine.send(now, key, content, effects);
        });
    }

    pub(crate) fn cancel_goal(&mut self, now: Instant, name: &Arc<str>, key: GoalKey) {
        self.with_action(now, name, |action, effects| {
            action.machine.cancel(now, key, effects)
        });
    }

    /// A message of an action has arrived.
    pub(crate) fn on_action_message(
        &mut self,
        now: Instant,
        name: &Arc<str>,
        part: Part,
        caller: &str,
        content: &[u8],
    ) {
        self.with_action(now, name, |action, effects| {
            let machine = &mut action.machine;
            let read = match part {
                Part::Status => wire::parse_status(content)
                    .map(|statuses| machine.handle_status(now, caller, &statuses, effects)),
                Part::Feedback => wire::parse_update(content).map(|(status, content)| {
                    machine.handle_feedback(now, caller, &status, content, effects);
                }),
                Part::Result => wire::parse_update(content).map(|(status, content)| {
                    machine.handle_result(now, caller, &status, content, effects);
                }),
            };
            if read.is_none() && !std::mem::replace(&mut action.is_malformed_told, true) {
                tracing::warn!(
                    "ignored a malformed {part:?} of the action {name} from {caller}, and will not say so again"
                );
            }
        });
    }

    /// Tells actions which of their connections are there.
    pub(crate) fn relink(&mut self, now: Instant) {
        let mut names = std::mem::take(&mut self.relinked);
        names.sort_unstable();
        names.dedup();
        for name in names {
            let receivers = |part| {
                let publication = self.publications.get(&topic(&name, part));
                publication
                    .map(|of| of.subscribers.values().cloned().collect())
                    .unwrap_or_default()
            };
            let senders = |part| {
                let subscription = self.subscriptions.get(&topic(&name, part));
                subscription.map(|of| of.callers()).unwrap_or_default()
            };
            let status = self.subscriptions.get(&topic(&name, "status"));
            let links = Links {
                goal: receivers("goal"),
                cancel: receivers("cancel"),
                status: senders("status"),
                feedback: senders("feedback"),
                result: senders("result"),
                unsettled: status.is_some_and(|of| of.is_unsettled()),
            };
            self.with_action(now, &name, |action, effects| {
                action.machine.handle_links(now, links, effects);
            });
        }
    }

    pub(crate) fn time_actions(&mut self, now: Instant) {
        let names: Vec<Arc<str>> = self.actions.keys().cloned().collect();
        let paused = self.clock.is_paused(now);
        for name in names {
            self.with_action(now, &name, |action, effects| {
                if paused {
                    action.machine.handle_pause(now);
                }
                action.machine.handle_timeout(now, effects);
            });
            self.watch_cancels(now, &name);
        }
    }

    /// Has the machine of an action do something, and does what it wants.
    pub(in crate::node) fn with_action(
        &mut self,
        now: Instant,
        name: &Arc<str>,
        handle: impl FnOnce(&mut Action, &mut Vec<Effect>),
    ) {
        let Some(action) = self.actions.get_mut(name) else {
            return;
        };
        let mut effects = Vec::new();
        handle(action, &mut effects);
        if let Some(at) = action.machine.poll_timeout() {
            self.net.wake_by(at);
        }
        for effect in effects {
            self.on_effect(now, name, effect);
        }
    }

    fn on_effect(&mut self, now: Instant, name: &Arc<str>, effect: Effect) {
        let Some(action) = self.actions.get_mut(name) else {
            return;
        };
        match effect {
            Effect::SendGoal { id, content } => {
                action.seq = action.seq.wrapping_add(1);
                let message = wire::goal(action.seq, self.clock.now(), &id, &content);
                self.publish(&topic(name, "goal"), &message);
            }
            Effect::SendCancel { id } => {
                self.watch_cancels_later(now, name);
                self.publish(&topic(name, "cancel"), &wire::cancel(&id));
            }
            Effect::Event(key, event @ GoalEvent::Ended(_)) => {
                if let Some(mut on_event) = action.owners.remove(&key) {
                    on_event(event);
                }
            }
            Effect::Event(key, event) => {
                if let Some(on_event) = action.owners.get_mut(&key) {
                    on_event(event);
                }
            }
            Effect::Foreign { id, node } => self.look_for_owner(now, name, id, node),
            Effect::Explain(key) => self.explain(now, name, key),
        }
    }

    /// Finds out why no action server is there.
    fn explain(&mut self, now: Instant, name: &Arc<str>, key: GoalKey) {
        // Of all topics, as a subscriber this node would be among the actions itself.
        let params = [self.name[..].into(), "".into()];
        let name = Arc::clone(name);
        let then = move |engine: &mut Self, now: Instant, answer: Result<Value, CallError>| {
            let text = engine.reason(&name, answer);
            engine.with_action(now, &name, |action, effects| {
                action.machine.handle_explanation(key, text, effects);
            });
        };
        let master = self.master.clone();
        self.rpc(
            now,
            &master,
            "getPublishedTopics",
            &params,
            EXPLAIN,
            Box::new(then),
        );
    }

    fn reason(&self, name: &Arc<str>, types: Result<Value, CallError>) -> String {
        let types = match types {
            Ok(types) => graph::pairs(&types),
            Err(error) => {
                return format!("the ROS master {} does not answer: {error}", self.master);
            }
        };
        let Some(action) = self.actions.get(name) else {
            return String::new();
        };
        let links = action.machine.links();
        if let [server] = links.status.as_slice() {
            let parts = [
                ("goal", &links.goal),
                ("cancel", &links.cancel),
                ("feedback", &links.feedback),
                ("result", &links.result),
            ];
            let missing = parts.iter().filter(|(_, nodes)| !nodes.contains(server));
            let missing: Vec<&str> = missing.map(|(part, _)| *part).collect();
            let mut text = format!(
                "the action server {server} of {name} is not connected to {}",
                missing.join(", ")
            );
            let obstacles = ["feedback", "result"].map(|part| topic(name, part));
            let obstacles = obstacles
                .iter()
                .filter_map(|topic| self.subscriptions.get(topic));
            let sent = ["goal", "cancel"].map(|part| topic(name, part));
            let mut sent = sent.iter().filter_map(|topic| self.publications.get(topic));
            if let Some(obstacle) = obstacles.flat_map(|of| of.obstacles()).next() {
                text.push_str(": ");
                text.push_str(obstacle);
            } else if let Some(obstacle) = sent.find_map(|of| of.obstacle(server)) {
                text.push_str(": ");
                text.push_str(&obstacle);
            } else if missing.iter().any(|part| ["goal", "cancel"].contains(part)) {
                text.push_str(&format!(
                    ": can it resolve '{}', the host name of this node? Set ROS_HOSTNAME or ROS_IP, or `host`, to what \
                     it can reach",
                    self.host
                ));
            }
            return text;
        }
        let status = self.subscriptions.get(&topic(name, "status"));
        if let Some(obstacle) = status.and_then(|of| of.obstacles().next()) {
            return format!("the action server of {name} cannot be reached: {obstacle}");
        }
        let there = graph::action_names(&types);
        match there.is_empty() {
            true => format!("no action server has the name {name}, and there are no others"),
            false => format!(
                "no action server has the name {name}; there are: {}",
                there.join(", ")
            ),
        }
    }

    /// Asks the master which clock it is, if that is not known.
    pub(crate) fn refresh_clock(&mut self, now: Instant) {
        if self.clock.known {
            return;
        }
        self.clock.known = true;
        let params = [self.name[..].into(), "/use_sim_time".into()];
        let then = |engine: &mut Self, _: Instant, answer: Result<Value, CallError>| {
            match answer {
                Ok(Value::Bool(true)) => engine.use_simulated_clock(),
                // Without the parameter, it is the wall clock.
                Ok(_) | Err(CallError::Refused { .. }) => engine.clock.simulated = None,
                Err(_) => engine.clock.known = false,
            }
        };
        let master = self.master.clone();
        self.rpc(
            now,
            &master,
            "getParam",
            &params,
            super::registrar::LIMIT,
            Box::new(then),
        );
    }

    fn use_simulated_clock(&mut self) {
        if self.clock.simulated.is_some() {
            return;
        }
        self.clock.simulated = Some(RosTime::default());
        let topic: Arc<str> = Arc::from("/clock");
        let ty = WireType {
            name: "rosgraph_msgs/Clock".to_owned(),
            md5: "a9c97c1d230cfc112e270351a944ee47".to_owned(),
            definition: "time clock\n".to_owned(),
        };
        let id = self.new_id();
        if let Err(error) = self.subscribe(&topic, ty, id, Consumer::Clock) {
            tracing::warn!("the simulated clock is not used: {error}");
        }
    }

    pub(crate) fn on_clock(&mut self, now: Instant, content: &[u8]) {
        if let (Some(time), Some(before)) = (wire::parse_clock(content), &mut self.clock.simulated)
            && std::mem::replace(before, time) != time
        {
            self.clock.moved = Some(now);
        }
    }
}
