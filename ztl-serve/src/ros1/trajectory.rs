//! `ros1-trajectory`: named poses by trajectories on a topic. Also the short forms of goals for actions.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ztl_ros1::message::{Element, MessageType, Value};
use ztl_ros1::{Pace, Publisher, Subscription};
use ztl_std::describe::{GoalField, GoalRule, GoalValue};
use ztl_yaml::{Fields, Node};

use super::Event;
use super::audience::{ACKNOWLEDGE, Outlet as _, Wire};
use super::connection::{Connection, wire};
use super::fit::fit;
use super::motion::{Action, Motion, STOP_TIME, Seen, Target};
use super::used_name::UsedType;
use crate::call::Call;
use crate::kind::{Effect, Job, JobContext, JobEvent, Kind, Outcome, Services, Start, StopReason};
use crate::reader::{ComponentContext, ConfigReader};

/// The action whose goals are trajectories.
pub(super) const TRAJECTORY_ACTION: &str = "control_msgs/FollowJointTrajectoryAction";
/// The action whose goals are places.
pub(super) const MOVE_BASE: &str = "move_base_msgs/MoveBaseAction";
const TRAJECTORY: &str = "trajectory_msgs/JointTrajectory";
const JOINT_STATE: &str = "sensor_msgs/JointState";

/// How long a motion takes, where neither file nor goal says it.
const TIME: Duration = Duration::from_secs(3);
/// How near a joint must be to its position, in rad or m.
const TOLERANCE: f64 = 0.05;
/// How long a motion may take, besides its time.
const MORE: Duration = Duration::from_secs(5);
/// The longest time of a motion.
const LONGEST: Duration = Duration::from_mins(10);
/// How often a motion looks at the joints.
const TICK: Duration = Duration::from_millis(20);

/// Positions of joints, by a goal.
#[derive(Debug, Clone)]
pub(super) struct Trajectory {
    joints: Vec<String>,
    /// If there are any, goals are their names.
    poses: Vec<(Arc<str>, Vec<f64>)>,
    time: Duration,
}

impl Trajectory {
    /// Reads `joints`, whose value is given, `poses` and `time`.
    pub(super) fn read<'d>(
        reader: &mut ConfigReader<'d>,
        joints: &'d Node,
        fields: &mut Fields<'d>,
    ) -> Option<Self> {
        let what = "the names of joints, as [shoulder_pan_joint, elbow_flex_joint]";
        let nodes = reader.yaml.list(joints, what).unwrap_or_default();
        if nodes.is_empty() {
            reader.yaml.wrong(joints, "there is no joint in this list");
        }
        let mut names: Vec<String> = Vec::new();
        for node in nodes {
            if let Some(name) = reader.yaml.text(node, "the name of a joint") {
                if names.iter().any(|known| known == name) {
                    reader
                        .yaml
                        .wrong(node, format!("the joint {name} is there twice"));
                }
                names.push(name.to_owned());
            }
        }
        let time = fields.optional("time");
        let time = time.and_then(|node| reader.time(node, LONGEST));
        let mut poses = Vec::new();
        if let Some(node) = fields.optional("poses") {
            for (name, node) in reader.non_empty(node, "poses, as {home: [0, 1.5]}") {
                let name = reader.yaml.text(name, "the name of a pose");
                let positions = reader.positions(node, names.len());
                poses.extend(name.map(Arc::from).zip(positions));
            }
        }
        Some(Self {
            joints: names,
            poses,
            time: time.unwrap_or(TIME),
        })
    }

    pub(super) fn goal_rule(&self) -> GoalRule {
        if !self.poses.is_empty() {
            return GoalRule::OneOf(
                self.poses
                    .iter()
                    .map(|(name, _)| Arc::clone(name))
                    .collect(),
            );
        }
        let seconds = self.time.as_secs_f64();
        GoalRule::Fields(
            [
                GoalField {
                    name: "positions".into(),
                    rule: GoalRule::ListOf(Arc::new(number(None, None))),
                    optional: false,
                    default: None,
                },
                GoalField {
                    name: "seconds".into(),
                    rule: number(Some(0.01), Some("s")),
                    optional: true,
                    default: Some(seconds.to_string().into()),
                },
            ]
            .into(),
        )
    }

    /// The positions that a goal means, and how long the motion takes.
    fn positions(&self, call: &Call) -> Result<(Vec<f64>, Duration), String> {
        if !self.poses.is_empty() {
            let text = call.goal.text.as_str();
            let pose = self.poses.iter().find(|(name, _)| **name == *text);
            let pose = pose.ok_or_else(|| format!("there is no pose '{text}'"))?;
            return Ok((pose.1.clone(), self.time));
        }
        let goal = call.goal.fields.as_ref();
        let part = |name| goal.and_then(|goal| goal.part(name));
        let items = match part("positions") {
            Some(GoalValue::List(items)) => items.as_slice(),
            _ => &[],
        };
        if items.len() != self.joints.len() {
            let (found, joints) = (items.len(), self.joints.join(", "));
            let count = self.joints.len();
            return Err(format!(
                "the goal has {found} positions; {count} are needed: {joints}"
            ));
        }
        let positions = items.iter().map(as_float).collect::<Option<Vec<f64>>>();
        let positions = positions.ok_or("a position is not a number")?;
        let seconds = part("seconds").and_then(as_float);
        let time = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
        let time = time.unwrap_or(self.time);
        match time <= LONGEST {
            true => Ok((positions, time)),
            false => Err(format!("a motion takes at most {} s", LONGEST.as_secs())),
        }
    }

    /// The goal of an action with a trajectory.
    pub(super) fn goal(&self, message: &MessageType, call: &Call) -> Result<Vec<u8>, String> {
        let (positions, time) = self.positions(call)?;
        let mut goal = message.zero();
        let trajectory = inner(message, "trajectory")?;
        set(
            &mut goal,
            "trajectory",
            self.value(trajectory, &positions, time)?,
        )?;
        message.encode(&goal).map_err(|error| error.to_string())
    }

    /// A trajectory with a single point.
    fn value(
        &self,
        message: &MessageType,
        positions: &[f64],
        time: Duration,
    ) -> Result<Value, String> {
        let point_type = inner(message, "points")?;
        let mut point = point_type.zero();
        set(
            &mut point,
            "positions",
            Value::List(positions.iter().copied().map(Value::Float).collect()),
        )?;
        let nsecs = i32::try_from(time.subsec_nanos()).unwrap_or_default();
        let secs = i32::try_from(time.as_secs()).unwrap_or_default();
        set(
            &mut point,
            "time_from_start",
            Value::Duration { secs, nsecs },
        )?;
        let mut trajectory = message.zero();
        let names = self.joints.iter().cloned().map(Value::Text);
        set(&mut trajectory, "joint_names", Value::List(names.collect()))?;
        set(&mut trajectory, "points", Value::List(vec![point]))?;
        Ok(trajectory)
    }
}

/// The short form of `move_base`: a place on the map.
#[derive(Debug, Clone)]
pub(super) struct MoveBase {
    frame: String,
}

impl MoveBase {
    pub(super) fn read<'d>(reader: &mut ConfigReader<'d>, frame: Option<&'d Node>) -> Option<Self> {
        let frame = match frame {
            Some(node) => reader.yaml.text(node, "a frame, as map")?,
            None => "map",
        };
        Some(Self {
            frame: frame.to_owned(),
        })
    }

    pub(super) fn goal_rule() -> GoalRule {
        let field = |name: &str, unit, default: Option<&str>| GoalField {
            name: name.into(),
            rule: number(None, Some(unit)),
            optional: default.is_some(),
            default: default.map(Arc::from),
        };
        let fields = [
            field("x", "m", None),
            field("y", "m", None),
            field("yaw", "rad", Some("0")),
        ];
        GoalRule::Fields(fields.into())
    }

    pub(super) fn goal(&self, message: &MessageType, call: &Call) -> Result<Vec<u8>, String> {
        let part = |name: &str| {
            let value = call.goal.fields.as_ref().and_then(|goal| goal.part(name));
            let value = value.and_then(as_float);
            value.ok_or_else(|| format!("the goal has no number {name}"))
        };
        let half = part("yaw").unwrap_or_default() / 2.0;
        let number = GoalValue::Float;
        let map = |pairs: Vec<(&str, GoalValue)>| {
            let pairs = pairs.into_iter();
            GoalValue::Map(
                pairs
                    .map(|(name, value)| (GoalValue::Text(name.to_owned()), value))
                    .collect(),
            )
        };
        let position = map(vec![("x", number(part("x")?)), ("y", number(part("y")?))]);
        let orientation = map(vec![("z", number(half.sin())), ("w", number(half.cos()))]);
        let frame = GoalValue::Text(self.frame.clone());
        let target = map(vec![
            // Without a time: the newest position of the map's frame.
            ("header", map(vec![("frame_id", frame)])),
            (
                "pose",
                map(vec![("position", position), ("orientation", orientation)]),
            ),
        ]);
        let field = message.field("target_pose");
        let field = field.ok_or("the goal of this action has no target_pose")?;
        let mut goal = message.zero();
        set(
            &mut goal,
            "target_pose",
            fit(&target, field, "target_pose")?,
        )?;
        message.encode(&goal).map_err(|error| error.to_string())
    }
}

fn number(least: Option<f64>, unit: Option<&str>) -> GoalRule {
    GoalRule::Number {
        whole: false,
        least,
        most: None,
        step: None,
        unit: unit.map(Arc::from),
    }
}

#[expect(clippy::cast_precision_loss, reason = "positions are small")]
pub(super) fn as_float(value: &GoalValue) -> Option<f64> {
    match value {
        GoalValue::Integer(number) => Some(*number as f64),
        GoalValue::Float(number) => Some(*number),
        _ => None,
    }
}

/// The message type of a field.
fn inner<'m>(message: &'m MessageType, name: &str) -> Result<&'m MessageType, String> {
    match message.field(name).map(|field| &field.element) {
        Some(Element::Message(inner)) => Ok(inner),
        _ => Err(format!("{} has no message {name}", message.name())),
    }
}

fn set(message: &mut Value, name: &str, value: Value) -> Result<(), String> {
    match message.field_mut(name) {
        Some(field) => {
            *field = value;
            Ok(())
        }
        None => Err(format!("the message has no field {name}")),
    }
}

/// A controller that takes trajectories from a topic.
#[derive(Debug)]
pub(crate) struct Controller {
    connection: Arc<Connection>,
    topic: String,
    subscriber: Option<String>,
    joint_states: String,
    trajectory: Trajectory,
    message: Arc<MessageType>,
    joint_state: Arc<MessageType>,
    tolerance: f64,
    limit: Option<Duration>,
    link: Mutex<Option<Arc<Link>>>,
}

/// The topics of a controller.
#[derive(Debug)]
struct Link {
    publisher: Arc<Publisher>,
    /// What was heard of the joints.
    seen: Arc<Mutex<Seen>>,
    subscription: Subscription,
}

/// Reads a controller.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    _: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let fields = fields?;
    let topic = reader.ros1_name(node, "/arm_controller/command");
    let joints = fields.required("joints", "joints: [shoulder_pan_joint, elbow_flex_joint]");
    let trajectory = joints.and_then(|node| Trajectory::read(reader, node, fields));
    let subscriber = reader.subscriber(fields);
    let states_node = fields.optional("joint-states");
    let states = states_node.map(|node| reader.ros1_name(node, "/joint_states"));
    let states = states.unwrap_or_else(|| Some("/joint_states".to_owned()));
    let tolerance = fields.optional("tolerance");
    let tolerance = tolerance.and_then(|node| {
        let what = "a tolerance in rad or m from 0.0001 to 10, as 0.05";
        reader.yaml.parsed(node, what, |text| {
            let number = text
                .parse()
                .ok()
                .filter(|number| (0.0001..=10.0).contains(number));
            number.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    });
    let limit = fields.optional("limit");
    let limit = limit.and_then(|node| reader.time(node, LONGEST));
    let mut known = |name| reader.ros1.definitions().message(name);
    let types = [known(TRAJECTORY), known(JOINT_STATE)];
    let [message, joint_state] = types.map(|found| match found {
        Ok(message) => Some(message),
        Err(error) => {
            reader.yaml.wrong(node, error.to_string());
            None
        }
    });
    if let Some(message) = &message {
        let used = UsedType::published(message, subscriber.clone());
        reader.uses_name(node, topic.as_ref(), used);
    }
    if let Some(joint_state) = &joint_state {
        let node = states_node.unwrap_or(node);
        reader.uses_name(node, states.as_ref(), UsedType::received(joint_state));
    }
    Some(Arc::new(Controller {
        connection: Arc::clone(&reader.ros1.connection),
        topic: topic?,
        subscriber,
        joint_states: states?,
        trajectory: trajectory?,
        message: message?,
        joint_state: joint_state?,
        tolerance: tolerance.unwrap_or(TOLERANCE),
        limit,
        link: Mutex::new(None),
    }))
}

impl<'d> ConfigReader<'d> {
    /// The positions of a pose, one for each joint.
    fn positions(&mut self, node: &'d Node, joints: usize) -> Option<Vec<f64>> {
        let nodes = self
            .yaml
            .list(node, "a position for each joint, as [0, 1.5]")?;
        if nodes.len() != joints {
            let found = nodes.len();
            self.yaml.wrong(
                node,
                format!("found {found} positions; there are {joints} joints"),
            );
        }
        let numbers = nodes.iter().map(|node| {
            let what = "a position in rad or m";
            self.yaml.parsed(node, what, |text| {
                let number = text.parse().ok().filter(|number: &f64| number.is_finite());
                number.ok_or_else(|| format!("'{text}' is not {what}"))
            })
        });
        // All, so that each mistake is reported.
        let numbers: Vec<Option<f64>> = numbers.collect();
        numbers.into_iter().collect()
    }
}

impl Controller {
    fn link(&self) -> Result<Arc<Link>, String> {
        let mut link = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(link) = &*link {
            return Ok(Arc::clone(link));
        }
        let node = self.connection.node()?;
        let publisher = node.command_publisher(&self.topic, wire(&self.message), ACKNOWLEDGE, true);
        let publisher = Arc::new(publisher.map_err(|error| error.to_string())?);
        let joints = self.trajectory.joints.clone();
        let seen = Arc::new(Mutex::new(vec![None; joints.len()]));
        let (shared, message) = (Arc::clone(&seen), Arc::clone(&self.joint_state));
        let on_message = move |_: &str, bytes: &[u8]| {
            if let Ok(state) = message.decode(bytes) {
                let mut seen = shared.lock().unwrap_or_else(PoisonError::into_inner);
                hear(Instant::now(), &state, &joints, &mut seen);
            }
        };
        let subscription = node.subscribe(
            &self.joint_states,
            wire(&self.joint_state),
            Pace::Steady,
            on_message,
        );
        let made = Arc::new(Link {
            publisher,
            seen,
            subscription: subscription.map_err(|error| error.to_string())?,
        });
        Ok(Arc::clone(link.insert(made)))
    }
}

/// Takes the positions of our joints from a joint state, which may have others alone.
fn hear(now: Instant, state: &Value, joints: &[String], seen: &mut Seen) {
    let part = |name| state.field(name).map(Value::items).unwrap_or_default();
    for (name, position) in part("name").iter().zip(part("position")) {
        let index = joints
            .iter()
            .position(|joint| name.as_text() == Some(joint));
        let slot = index.and_then(|index| seen.get_mut(index));
        if let (Some(slot), Some(position)) = (slot, position.as_float()) {
            *slot = Some((now, position));
        }
    }
}

impl Kind for Controller {
    fn goal_rule(&self) -> GoalRule {
        self.trajectory.goal_rule()
    }

    fn at_once(&self) -> usize {
        1
    }

    fn stop_time(&self) -> Duration {
        STOP_TIME + crate::kind::STOP_TIME
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.trajectory.positions(call).map(drop)
    }

    fn prepare(&self) {
        // Subscribes, so that a motion need not wait for joint states. If that fails, each task says why.
        let _ = self.link();
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        let prepared = self
            .trajectory
            .positions(&call)
            .and_then(|(positions, time)| {
                let value = self.trajectory.value(&self.message, &positions, time)?;
                let bytes = self
                    .message
                    .encode(&value)
                    .map_err(|error| error.to_string())?;
                let stop = self
                    .message
                    .encode(&self.message.zero())
                    .map_err(|error| error.to_string())?;
                let target = Target {
                    joints: self.trajectory.joints.clone(),
                    positions,
                    tolerance: self.tolerance,
                    limit: self.limit.unwrap_or(time + MORE),
                };
                Ok((target, bytes, stop, self.link()?))
            });
        match prepared {
            Ok((target, bytes, stop, link)) => Start::Running(Box::new(MotionJob {
                motion: Motion::new(Instant::now(), target),
                outlet: Wire {
                    publisher: Arc::clone(&link.publisher),
                    subscriber: self.subscriber.clone(),
                    task,
                },
                begun: None,
                link,
                bytes,
                stop,
                next: Instant::now(),
            })),
            Err(reason) => Start::Ended(Outcome::Rejected(reason)),
        }
    }
}

/// A motion with its topics.
struct MotionJob {
    motion: Motion,
    outlet: Wire,
    /// When the motion began, if it has.
    begun: Option<Instant>,
    link: Arc<Link>,
    /// The trajectory, and the empty one.
    bytes: Vec<u8>,
    stop: Vec<u8>,
    next: Instant,
}

impl Job for MotionJob {
    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>) {
        let mut actions = Vec::new();
        self.motion.stop(now, why, &mut actions);
        self.next = now;
        self.act(actions, effects);
    }

    fn handle_event(&mut self, _: Instant, event: JobEvent, effects: &mut Vec<Effect>) {
        if let JobEvent::Ros1(Event::Reason(reason)) = event {
            let mut actions = Vec::new();
            self.motion.explained(reason, &mut actions);
            self.act(actions, effects);
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Some(self.next)
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if now < self.next {
            return;
        }
        self.next = now + TICK;
        let heard = self.outlet.look(self.begun);
        let heard = match &heard.lost {
            Some(lost) => Err(lost.as_str()),
            None if heard.nodes.is_empty() => Err("the controller has left the topic"),
            None => Ok(heard.has_all),
        };
        let seen = self.link.seen.lock();
        let seen = seen.unwrap_or_else(PoisonError::into_inner).clone();
        let mut actions = Vec::new();
        let unseen = || self.link.subscription.obstacle();
        self.motion.handle(now, heard, &seen, &unseen, &mut actions);
        self.act(actions, effects);
    }
}

impl MotionJob {
    fn act(&mut self, actions: Vec<Action>, effects: &mut Vec<Effect>) {
        for action in actions {
            match action {
                Action::Begin => {
                    self.begun = Some(Instant::now());
                    self.outlet.publish(self.bytes.clone());
                    effects.push(Effect::Accept);
                }
                Action::Stop => self.outlet.publish(self.stop.clone()),
                Action::Explain => self.outlet.explain(),
                Action::Progress(text) => effects.push(Effect::Progress(text)),
                Action::End(outcome) => {
                    // A controller that was disconnected may still follow the trajectory.
                    if let (Some(begun), Outcome::Unknown(_)) = (self.begun, &outcome) {
                        self.outlet.publish_when_back(begun, self.stop.clone());
                    }
                    effects.push(Effect::End(outcome));
                }
            }
        }
    }
}
