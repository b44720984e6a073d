//! What a master of ROS 1 knows, and whether this machine can work with it.

use std::sync::mpsc::channel;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde_json::json;
use ztl_ros1::message::{Definitions, Value};
use ztl_ros1::{Config, Node, Pace, Survey, WireType};

use super::finding::Finding;

/// How long to wait for the time of another node. Action servers send it five times a second.
const HEARD: Duration = Duration::from_secs(2);
/// The largest difference of clocks that does no harm.
const CLOCKS: f64 = 0.5;
const STATUS: &str = "actionlib_msgs/GoalStatusArray";
/// Types of commands.
const MOVING: [&str; 3] = [
    "geometry_msgs/Twist",
    "geometry_msgs/TwistStamped",
    "trajectory_msgs/JointTrajectory",
];
const ABOUT: &str = "ros1";

/// Checks a master, its nodes and its actions; without an address, that of `ROS_MASTER_URI` or of this machine.
pub(super) fn master(address: Option<&str>) -> Vec<Finding> {
    let mut config = Config::from_environment("ztl_doctor");
    if let Some(address) = address {
        address.clone_into(&mut config.master);
    }
    let uri = config.master.clone();
    let node = match Node::start(&config) {
        Ok(node) => node,
        Err(error) => {
            let remedy = "give the master's address: --ros1 http://robot:11311";
            return vec![Finding::problem(ABOUT, error.to_string(), remedy)];
        }
    };
    let survey = match node.survey() {
        Ok(survey) => survey,
        Err(error) => {
            let text = format!("no answer from the master {uri}: {error}");
            let remedy =
                "start the robot's ROS, or give another address: --ros1 http://robot:11311";
            return vec![Finding::problem(ABOUT, text, remedy)];
        }
    };
    let counts = json!({
        "nodes": survey.nodes.len(),
        "topics": survey.topics,
        "actions": survey.actions,
        "services": survey.servers.keys().collect::<Vec<_>>(),
        "subscribers": survey.subscribers,
    });
    let text = format!(
        "master {uri}: {} nodes, {} topics, {} services, {} actions",
        survey.nodes.len(),
        survey.topics.len(),
        survey.servers.len(),
        survey.actions.len()
    );
    let mut found = vec![Finding::good(ABOUT, text).with(counts)];
    found.extend(nodes(&survey));
    found.extend(actions(&survey));
    found.extend(commands(&survey));
    found.extend(clock(&node, &survey));
    node.stop();
    found
}

/// The nodes, and those that this machine cannot reach.
fn nodes(survey: &Survey) -> impl Iterator<Item = Finding> {
    survey.nodes.iter().map(|(name, (uri, wrong))| {
        let text = format!("node {name} at {uri}");
        let Some(wrong) = wrong else {
            return Finding::good(ABOUT, text);
        };
        let text = format!("{text}: {wrong}");
        let remedy = "if its host cannot be resolved, start it with ROS_HOSTNAME or ROS_IP, or add the name to \
                      /etc/hosts here; if it is gone: rosnode cleanup";
        Finding::problem(ABOUT, text, remedy)
    })
}

/// The actions, and whether their definitions are known here.
fn actions(survey: &Survey) -> impl Iterator<Item = Finding> {
    let mut definitions = Definitions::of_this_machine();
    survey.actions.iter().map(move |(name, kind)| {
        let text = format!("action {name} ({kind})");
        match definitions.action(kind) {
            Ok(_) => Finding::good(ABOUT, text),
            Err(error) => Finding::note(ABOUT, format!("{text}: {error}")).with_remedy(
                "run `ztl serve` where its package is, or add its directory to ROS_PACKAGE_PATH",
            ),
        }
    })
}

/// Who receives the topics that move a robot.
fn commands(survey: &Survey) -> impl Iterator<Item = Finding> {
    let moves = survey
        .topics
        .iter()
        .filter(|(_, kind)| MOVING.contains(&kind.as_str()));
    moves.map(|(topic, kind)| match survey.subscribers.get(topic) {
        Some(nodes) => {
            let nodes = nodes.join(", ");
            Finding::good(
                ABOUT,
                format!("topic {topic} ({kind}) is received by {nodes}"),
            )
        }
        None => Finding::note(
            ABOUT,
            format!("topic {topic} ({kind}) is received by no node"),
        ),
    })
}

/// How far the clock of an action server's machine is ahead of this one.
fn clock(node: &Node, survey: &Survey) -> Option<Finding> {
    let action = survey.actions.keys().next()?;
    let status = Definitions::carried().message(STATUS).ok()?;
    let wire = WireType {
        name: STATUS.to_owned(),
        md5: status.md5().to_owned(),
        definition: String::new(),
    };
    let (told, heard) = channel();
    let on_message = move |_: &str, bytes: &[u8]| {
        let now = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        let value = status.decode(bytes).ok();
        if let Some(Value::Time { secs, nsecs }) =
            value.as_ref().and_then(|value| value.at("header.stamp"))
        {
            let theirs = f64::from(*secs) + f64::from(*nsecs) / 1e9;
            // Only the first one is used.
            let _ = told.send(theirs - now.as_secs_f64());
        }
    };
    let _subscription = node
        .subscribe(
            &format!("{action}/status"),
            wire,
            Pace::Irregular,
            on_message,
        )
        .ok()?;
    let Ok(ahead) = heard.recv_timeout(HEARD) else {
        let text = format!("no status of {action} within 2 s, so its clock is unknown");
        return Some(Finding::note(ABOUT, text));
    };
    let (apart, side) = (ahead.abs(), if ahead < 0.0 { "behind" } else { "ahead of" });
    let text = format!("the clock of {action} is {apart:.3} s {side} this one");
    Some(match ahead.abs() <= CLOCKS {
        true => Finding::good(ABOUT, text),
        false => {
            let remedy = "synchronize the clocks, for example with chrony; with use_sim_time, the robot uses the clock of the simulation";
            Finding::note(ABOUT, text).with_remedy(remedy)
        }
    })
}
