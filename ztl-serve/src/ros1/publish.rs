//! `ros1-publish`: a message, once or at a rate, and a stop message at the end.

mod job;

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ztl_ros1::Publisher;
use ztl_ros1::message::{Count, Element, FieldType, MessageType, Primitive};
use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node, NodeValue};

use self::job::{Plan, PublishJob};
use super::audience::{ACKNOWLEDGE, Wire};
use super::connection::{Connection, wire};
use super::message::{MessageTemplate, goal_part, rule_of_goals};
use super::used_name::UsedType;
use crate::call::Call;
use crate::human::human_time;
use crate::kind::{JobContext, Kind, Outcome, STOP_TIME, Services, Start};
use crate::program::template::Template;
use crate::reader::{ComponentContext, ConfigReader};

/// The rate where the file gives none.
const INTERVAL: Duration = Duration::from_millis(100);
/// The longest time between two messages, where the file does not say it.
const DEAD_MAN: Duration = Duration::from_millis(500);
/// The shortest and the longest time that a node may take to acknowledge one of many messages. A healthy node takes up to
/// 200 ms.
const ACKNOWLEDGE_AT_LEAST: Duration = Duration::from_millis(250);
const ACKNOWLEDGE_AT_MOST: Duration = Duration::from_secs(2);
/// The longest task.
const LONGEST: Duration = Duration::from_hours(24);

/// What is published for a task.
#[derive(Debug)]
pub(crate) struct Publish {
    connection: Arc<Connection>,
    topic: String,
    subscriber: Option<String>,
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
    let subscriber = reader.subscriber(fields);
    let used = |ty: &Arc<MessageType>| UsedType::published(ty, subscriber.clone());
    let (topic, message_type) =
        reader.ros1_typed_name(node, fields, "/cmd_vel", "type: geometry_msgs/Twist", used);
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
        subscriber,
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
        let (limit, newest) = (self.acknowledge(), self.repeat.is_some());
        let made = node.command_publisher(&self.topic, wire(&self.message_type), limit, newest);
        let made = Arc::new(made.map_err(|error| error.to_string())?);
        Ok(Arc::clone(publisher.insert(made)))
    }

    /// How long a node may take to acknowledge a message: one that comes later than `dead-man` is too late.
    fn acknowledge(&self) -> Duration {
        let dead_man = self.repeat.as_ref().map(|repeat| repeat.dead_man);
        dead_man.map_or(ACKNOWLEDGE, |dead_man| {
            dead_man.clamp(ACKNOWLEDGE_AT_LEAST, ACKNOWLEDGE_AT_MOST)
        })
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
            acknowledge: self.acknowledge(),
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

    fn stop_time(&self) -> Duration {
        self.acknowledge() + STOP_TIME
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        let prepared = self
            .plan(&call)
            .and_then(|plan| Ok((plan, self.publisher()?)));
        match prepared {
            Ok((plan, publisher)) => Start::Running(Box::new(PublishJob::new(
                Instant::now(),
                &self.topic,
                plan,
                Box::new(Wire {
                    publisher,
                    subscriber: self.subscriber.clone(),
                    task,
                }),
            ))),
            Err(reason) => Start::Ended(Outcome::Rejected(reason)),
        }
    }
}

#[cfg(test)]
mod tests;
