//! `ros1-publish`: a message, once or at a rate, and a stop message at the end.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ztl_core::dispatcher::UNKNOWN_OUTCOME;
use ztl_ros1::Publisher;
use ztl_ros1::message::{Count, Element, FieldType, MessageType, Primitive};
use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node, NodeValue};

use super::connection::{Connection, wire};
use super::message::{MessageTemplate, goal_part, rule_of_goals};
use crate::call::Call;
use crate::human::human_time;
use crate::kind::{Effect, Job, JobContext, Kind, Outcome, Services, Start, StopReason};
use crate::program::template::Template;
use crate::reader::{ComponentContext, ConfigReader};

/// The rate where the file gives none.
const INTERVAL: Duration = Duration::from_millis(100);
/// How long a task waits for a subscriber.
const SUBSCRIBE: Duration = Duration::from_millis(1500);
/// How often a task that waits looks for one, and one that runs looks whether any is left.
const LOOK: Duration = Duration::from_millis(50);
/// How often the stop message is sent, and the pause after each.
const STOPS: u32 = 5;
const STOP_PAUSE: Duration = Duration::from_millis(50);
/// The longest time between two messages, where the file does not say it.
const DEAD_MAN: Duration = Duration::from_millis(500);
/// The longest task.
const LONGEST: Duration = Duration::from_hours(24);

/// What is published for a task.
#[derive(Debug)]
pub(crate) struct Publish {
    connection: Arc<Connection>,
    topic: String,
    message_type: Arc<MessageType>,
    message: MessageTemplate,
    stop: Option<MessageTemplate>,
    /// `None`: the message goes out once.
    repeat: Option<Repeat>,
    publisher: Mutex<Option<Arc<Publisher>>>,
}

/// How a message is repeated.
#[derive(Debug, Clone)]
struct Repeat {
    interval: Duration,
    /// `None`: until the task is aborted.
    length: Option<Length>,
    dead_man: Duration,
}

#[derive(Debug, Clone)]
enum Length {
    Fixed(Duration),
    /// The seconds at this path of the goal.
    Goal(Vec<String>),
}

/// Reads what is published.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let fields = fields?;
    let (topic, message_type) = reader.ros1_typed_name::<Arc<MessageType>>(
        node,
        fields,
        "/cmd_vel",
        "type: geometry_msgs/Twist",
    );
    let message = fields.optional("message");
    let stop = fields.optional("stop");
    let rate = fields.optional("rate");
    let length_node = fields.optional("for");
    let dead_man_node = fields.optional("dead-man");
    let interval = rate.and_then(|node| reader.rate(node));
    let length = length_node.map(|node| reader.length(node, context.rule));
    let dead_man = dead_man_node.and_then(|node| reader.time(node, LONGEST));
    let is_repeated = rate.or(length_node).is_some();
    let interval = interval.unwrap_or(INTERVAL);
    if let (Some(node), Some(dead_man)) = (dead_man_node, dead_man) {
        if !is_repeated {
            reader
                .yaml
                .wrong(node, "dead-man has an effect only with a rate");
        } else if dead_man < 2 * interval {
            let least = human_time(2 * interval);
            let mistake = format!("this must be at least {least}, the time of two messages");
            reader.yaml.wrong(node, mistake);
        }
    }
    let message_type = message_type?;
    // Seconds that the message has no field for are only the time.
    let time_alone = match &length {
        Some(Some(Length::Goal(path))) => path
            .first()
            .filter(|name| path.len() == 1 && message_type.field(name).is_none()),
        _ => None,
    };
    let time_alone = time_alone.map(String::as_str);
    let message = reader.message_or_goal(message, &message_type, context.rule, time_alone);
    let stop = stop.map(|node| reader.message_template(node, &message_type, context.rule));
    let repeat = Repeat {
        interval,
        length: match length {
            Some(length) => Some(length?),
            None => None,
        },
        dead_man: dead_man.unwrap_or(DEAD_MAN.max(3 * interval)),
    };
    Some(Arc::new(Publish {
        connection: Arc::clone(&reader.ros1.connection),
        topic: topic?,
        message_type,
        message,
        stop,
        repeat: is_repeated.then_some(repeat),
        publisher: Mutex::new(None),
    }))
}

impl<'d> ConfigReader<'d> {
    /// How long messages are repeated: a time, or seconds of the goal.
    fn length(&mut self, node: &'d Node, rule: &GoalRule) -> Option<Length> {
        let NodeValue::Scalar { text, .. } = &node.value else {
            return self.time(node, LONGEST).map(Length::Fixed);
        };
        let template = match Template::parse(text) {
            Ok(template) if template.is_fixed() => {
                return self.time(node, LONGEST).map(Length::Fixed);
            }
            Ok(template) => template,
            Err(mistake) => {
                self.yaml.wrong(node, mistake);
                return None;
            }
        };
        let path = template.goal_alone().map(<[String]>::to_vec);
        let part = path.as_deref().and_then(|path| rule.part(path));
        match part {
            Some(GoalRule::Any | GoalRule::Number { .. }) => path.map(Length::Goal),
            Some(other) => {
                let mistake =
                    format!("seconds are needed here, and this part of the goal is {other}");
                self.yaml.wrong(node, mistake);
                None
            }
            None => {
                let mistake = "expected a time, such as 2 s, or a part of the goal in seconds, such as '{goal.seconds}'";
                self.yaml.wrong(node, mistake);
                None
            }
        }
    }
}

/// What a task sends.
#[derive(Debug)]
struct Plan {
    message: Vec<u8>,
    stop: Option<Vec<u8>>,
    repeat: Option<(Duration, Duration)>,
    length: Option<Duration>,
}

impl Publish {
    fn publisher(&self) -> Result<Arc<Publisher>, String> {
        let mut publisher = self
            .publisher
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if let Some(publisher) = &*publisher {
            return Ok(Arc::clone(publisher));
        }
        let node = self.connection.node()?;
        let made = node.publisher(&self.topic, wire(&self.message_type), false);
        let made = Arc::new(made.map_err(|error| error.to_string())?);
        Ok(Arc::clone(publisher.insert(made)))
    }

    fn plan(&self, call: &Call) -> Result<Plan, String> {
        let length = match self
            .repeat
            .as_ref()
            .and_then(|repeat| repeat.length.as_ref())
        {
            None => None,
            Some(Length::Fixed(time)) => Some(*time),
            Some(Length::Goal(path)) => {
                let seconds = goal_part(call, path, None, &seconds())?;
                let seconds = seconds.as_float().unwrap_or_default();
                let time = Duration::try_from_secs_f64(seconds).ok();
                let time = time.filter(|time| !time.is_zero() && *time <= LONGEST);
                Some(time.ok_or_else(|| {
                    let most = LONGEST.as_secs();
                    format!(
                        "'{seconds}' is not a number of seconds greater than 0 and at most {most}"
                    )
                })?)
            }
        };
        Ok(Plan {
            message: self.message.fill(call)?,
            stop: self.stop.as_ref().map(|stop| stop.fill(call)).transpose()?,
            repeat: self
                .repeat
                .as_ref()
                .map(|repeat| (repeat.interval, repeat.dead_man)),
            length,
        })
    }
}

/// The type of a number of seconds.
const fn seconds() -> FieldType {
    FieldType {
        element: Element::Primitive(Primitive::Float64),
        count: Count::One,
    }
}

impl Kind for Publish {
    fn goal_rule(&self) -> GoalRule {
        let mut goals = self.message.goals();
        goals.extend(self.stop.iter().flat_map(MessageTemplate::goals));
        let length = self
            .repeat
            .as_ref()
            .and_then(|repeat| repeat.length.as_ref());
        if let Some(Length::Goal(path)) = length {
            let seconds = GoalRule::Number {
                whole: false,
                least: Some(0.0),
                most: Some(LONGEST.as_secs_f64()),
                step: None,
                unit: Some("s".into()),
            };
            goals.push((path.clone(), seconds));
        }
        rule_of_goals(&goals)
    }

    fn at_once(&self) -> usize {
        1
    }

    fn needs_fields(&self) -> bool {
        let length = self
            .repeat
            .as_ref()
            .and_then(|repeat| repeat.length.as_ref());
        matches!(length, Some(Length::Goal(path)) if !path.is_empty())
            || self.message.needs_fields()
            || self
                .stop
                .as_ref()
                .is_some_and(MessageTemplate::needs_fields)
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.plan(call).map(drop)
    }

    fn prepare(&self) {
        // Lets subscribers connect before the first task. If that fails, each task says why.
        let _ = self.publisher();
    }

    fn start(self: Arc<Self>, call: Arc<Call>, _: JobContext, _: &Services) -> Start {
        let prepared = self
            .plan(&call)
            .and_then(|plan| Ok((plan, self.publisher()?)));
        match prepared {
            Ok((plan, publisher)) => Start::Running(Box::new(PublishJob::new(
                Instant::now(),
                &self.topic,
                plan,
                publisher,
            ))),
            Err(reason) => Start::Ended(Outcome::Rejected(reason)),
        }
    }
}

/// Where messages go; a fake in tests.
trait Outlet: Send + Sync {
    fn publish(&self, bytes: Vec<u8>);
    fn is_heard(&self) -> bool;
}

impl Outlet for Publisher {
    fn publish(&self, bytes: Vec<u8>) {
        Self::publish(self, bytes);
    }

    fn is_heard(&self) -> bool {
        !self.subscribers().is_empty()
    }
}

/// Messages that go out for a task.
struct PublishJob {
    topic: String,
    plan: Plan,
    outlet: Arc<dyn Outlet>,
    phase: Phase,
}

enum Phase {
    /// Until a node subscribes.
    Waiting {
        until: Instant,
        next: Instant,
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
    Ended,
}

impl PublishJob {
    fn new(now: Instant, topic: &str, plan: Plan, outlet: Arc<dyn Outlet>) -> Self {
        Self {
            topic: topic.to_owned(),
            plan,
            outlet,
            phase: Phase::Waiting {
                until: now + SUBSCRIBE,
                next: now,
            },
        }
    }

    fn begin(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        effects.push(Effect::Accept);
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
        if *look <= now {
            *look = now + LOOK;
            if !self.outlet.is_heard() {
                let topic = &self.topic;
                let reason = format!("{UNKNOWN_OUTCOME}no node subscribes to {topic} any more");
                return self.begin_stop(now, Outcome::Failed(reason));
            }
        }
        if *next <= now {
            self.outlet.publish(self.plan.message.clone());
            *last = now;
            // A message that goes out late is not made up for.
            *next = (*next + interval).max(now + interval / 2);
        }
    }
}

impl Job for PublishJob {
    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>) {
        match self.phase {
            Phase::Waiting { .. } => {
                self.phase = Phase::Ended;
                effects.push(Effect::End(why.before_start()));
            }
            Phase::Running { .. } => self.begin_stop(now, Outcome::Aborted(why.to_string())),
            Phase::Stopping { .. } | Phase::Ended => {}
        }
        self.handle_timeout(now, effects);
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.phase {
            Phase::Waiting { next, .. } | Phase::Stopping { next, .. } => Some(*next),
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
            if self.outlet.is_heard() {
                self.begin(now, effects);
            } else if is_over {
                self.phase = Phase::Ended;
                let (topic, waited) = (&self.topic, human_time(SUBSCRIBE));
                let reason = format!("no node subscribes to {topic} within {waited}");
                effects.push(Effect::End(Outcome::Rejected(reason)));
            }
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
                    effects.push(Effect::End(outcome.clone()));
                    self.phase = Phase::Ended;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
