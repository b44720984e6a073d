//! Whether the topics, actions, services and parameters of a file are there: asked by `--check`, while the robot runs.

use std::sync::Arc;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use ztl_ros1::xmlrpc::Value;
use ztl_ros1::{Node as RosNode, Publisher, Survey};
use ztl_yaml::{Diagnostic, closest};

use super::connection::Connection;
use super::used_name::{Known, NameKind, UsedName};

/// How long nodes may take to connect to what they would receive.
const CONNECT: Duration = Duration::from_secs(2);
const LOOK: Duration = Duration::from_millis(20);
/// How long the reason may take why they do not.
const EXPLAIN: Duration = Duration::from_secs(1);

/// What is wrong with a name, and a remedy.
type Mistake = (String, String);

/// Asks the master for these names. Returns the names that are missing or have another type, or why they cannot be checked;
/// blocks for some seconds if nodes do not answer. For a moment, this machine is a publisher of the topics that tasks
/// publish, since only then nodes show their type; nothing is sent.
pub(crate) fn missing(connection: &Arc<Connection>, names: &[UsedName]) -> Vec<Diagnostic> {
    let Some(first) = names.first() else {
        return Vec::new();
    };
    let surveyed = connection.node().and_then(|node| {
        let survey = node.survey();
        let survey = survey.map_err(|error| {
            format!(
                "no answer from the master {}: {error}",
                connection.config.master
            )
        });
        Ok((survey?, node))
    });
    let mut warnings: Vec<Diagnostic> = connection.unknown_host().into_iter().collect();
    match surveyed {
        Ok((survey, node)) => {
            let wrong = |name: &UsedName| {
                let known = name.mistake(&survey, || missing_parameter(&node, &name.name));
                let known = known.or_else(|| name.unreachable(&survey));
                known.or_else(|| name.other_definition(&survey, &node))
            };
            let wrong: Vec<_> = names.iter().map(wrong).collect();
            let right = names.iter().zip(&wrong);
            let right = right.filter(|(_, wrong)| wrong.is_none());
            let refused = refusals(&node, &survey, right.map(|(name, _)| name));
            let mut refused = refused.into_iter();
            for (name, wrong) in names.iter().zip(wrong) {
                let wrong = wrong.or_else(|| refused.next().flatten());
                warnings.extend(wrong.map(|(mistake, help)| name.warning(mistake, Some(help))));
            }
        }
        Err(error) => {
            let help = "start the robot's ROS to have its names checked, too".to_owned();
            warnings.push(first.warning(error, Some(help)));
        }
    }
    warnings
}

/// Why nodes do not receive what tasks would publish, for each of these names.
fn refusals<'n>(
    node: &RosNode,
    survey: &Survey,
    names: impl Iterator<Item = &'n UsedName>,
) -> Vec<Option<Mistake>> {
    let publish = |name: &UsedName| {
        let Known { suffix, .. } = name.of.published.as_ref()?;
        let topic = format!("{}{suffix}", name.name);
        let wanted = name.awaited(survey, &topic)?;
        let wire = name.of.published.as_ref()?.wire();
        let publisher = node.publisher(&topic, wire, false).ok()?;
        Some((publisher, wanted))
    };
    let published: Vec<_> = names.map(publish).collect();
    let is_there =
        |(publisher, wanted): &(Publisher, String)| publisher.subscribers().contains(wanted);
    let until = Instant::now() + CONNECT;
    while Instant::now() < until && !published.iter().flatten().all(is_there) {
        std::thread::sleep(LOOK);
    }
    let reason = |published: Option<(Publisher, String)>| {
        let (publisher, wanted) = published.filter(|published| !is_there(published))?;
        let (told, reason) = channel();
        publisher.explain(Some(&wanted), move |reason| drop(told.send(reason)));
        let reason = reason.recv_timeout(EXPLAIN).ok()?;
        let help = "a task would be rejected with this reason".to_owned();
        Some((reason, help))
    };
    published.into_iter().map(reason).collect()
}

impl UsedName {
    /// The node that must receive a topic of this name: that of the file, or the first.
    fn awaited(&self, survey: &Survey, topic: &str) -> Option<String> {
        let subscribers = survey.subscribers.get(topic)?;
        let named = self.of.subscriber.as_ref();
        named.or(subscribers.first()).cloned()
    }

    /// What is wrong with the name. `unset`: whether the parameter of this name is not set.
    fn mistake(&self, survey: &Survey, unset: impl FnOnce() -> Option<Mistake>) -> Option<Mistake> {
        let name = &self.name;
        let what = self.of.kind.what();
        let there = match self.of.kind {
            NameKind::Action => survey.actions.get(name),
            NameKind::Published | NameKind::Received => survey.topics.get(name),
            // The master does not know the types of services.
            NameKind::Service if survey.servers.contains_key(name) => return None,
            NameKind::Parameter => return unset(),
            NameKind::Service => None,
        };
        let Some(there) = there else {
            let known: Vec<&String> = match self.of.kind {
                NameKind::Action => survey.actions.keys().collect(),
                NameKind::Service => survey.servers.keys().collect(),
                _ => survey.topics.keys().collect(),
            };
            let known = known.iter().map(|name| name.as_str());
            let help = match closest(name, known) {
                Some(known) => format!("did you mean '{known}'?"),
                None => match self.of.kind {
                    NameKind::Action => "`ztl doctor --ros1` lists the actions".to_owned(),
                    _ => format!("`ztl doctor --ros1 --json` lists the {what}s"),
                },
            };
            return Some((format!("the master knows no {what} {name}"), help));
        };
        // A node may subscribe to any type.
        let fits = *there == self.of.ty || there == "*";
        match fits {
            true => self.wrong_direction(survey),
            false => Some(other_type(what, name, there, &self.of.ty)),
        }
    }

    /// Whether nobody is at the other end of the topic.
    fn wrong_direction(&self, survey: &Survey) -> Option<Mistake> {
        let name = &self.name;
        let nodes = |of: &std::collections::BTreeMap<String, Vec<String>>| {
            of.get(name).map(|nodes| nodes.join(", "))
        };
        let (publishers, subscribers) = (nodes(&survey.publishers), nodes(&survey.subscribers));
        match (self.of.kind, publishers, subscribers) {
            (NameKind::Published, Some(publishers), None) => Some((
                format!("no node subscribes to {name}, which {publishers} publishes"),
                "to receive a topic, write ros1-topic among the streams".to_owned(),
            )),
            (NameKind::Received, None, Some(subscribers)) => Some((
                format!("no node publishes {name}, to which {subscribers} subscribes"),
                "to publish a topic, write ros1-publish".to_owned(),
            )),
            (NameKind::Published, _, Some(subscribers)) => self.who_receives(survey, &subscribers),
            _ => None,
        }
    }

    /// Whether the node that must receive the topic does, or which it is if several do.
    fn who_receives(&self, survey: &Survey, subscribers: &str) -> Option<Mistake> {
        let (name, nodes) = (&self.name, survey.subscribers.get(&self.name)?);
        match &self.of.subscriber {
            Some(wanted) if !nodes.contains(wanted) => Some((
                format!("{wanted} does not subscribe to {name}; there are: {subscribers}"),
                format!("write subscriber: {}", nodes.first()?),
            )),
            None if nodes.len() > 1 => Some((
                format!(
                    "several nodes receive {name}, and each counts as the robot's: {subscribers}"
                ),
                format!(
                    "name the one that must receive it, such as subscriber: {}",
                    nodes.first()?
                ),
            )),
            _ => None,
        }
    }

    /// Why no node that is needed can be reached. The master also names nodes that were killed.
    fn unreachable(&self, survey: &Survey) -> Option<Mistake> {
        let name = &self.name;
        let (nodes, what) = match self.of.kind {
            NameKind::Action => {
                let nodes = survey.publishers.get(&format!("{name}/status"));
                (nodes, format!("the action server of {name}"))
            }
            NameKind::Published => (
                survey.subscribers.get(name),
                format!("the subscriber of {name}"),
            ),
            NameKind::Received => (
                survey.publishers.get(name),
                format!("the publisher of {name}"),
            ),
            NameKind::Service => (survey.servers.get(name), format!("the server of {name}")),
            NameKind::Parameter => return None,
        };
        let counts = |node: &&String| self.of.subscriber.as_ref().is_none_or(|of| of == *node);
        let obstacle = |node: &String| {
            let (_, wrong) = survey.nodes.get(node)?;
            Some((node.clone(), wrong.clone()?))
        };
        let obstacles: Option<Vec<_>> = nodes?.iter().filter(counts).map(obstacle).collect();
        let (node, wrong) = obstacles?.into_iter().next()?;
        Some((
            format!("{what}, {node}, cannot be reached: {wrong}"),
            "if it hangs or was killed, start it again".to_owned(),
        ))
    }

    /// Whether the robot has another definition of its type. Asks the nodes that publish or serve it.
    fn other_definition(&self, survey: &Survey, node: &RosNode) -> Option<Mistake> {
        self.of.known.iter().find_map(|known| {
            let name = format!("{}{}", self.name, known.suffix);
            let (what, there) = match self.of.kind {
                NameKind::Service => ("service", node.service_type(&name)?),
                _ => ("topic", node.topic_type(survey, &name)?),
            };
            let Known { ty, md5, .. } = known;
            if there.name != *ty {
                return Some(other_type(what, &name, &there.name, ty));
            }
            let mistake = format!(
                "{what} {name} has another definition of {ty} than this machine: its MD5 sum is {}, not {md5}",
                there.md5
            );
            let help = format!(
                "copy the robot's {} package to a directory of ROS_PACKAGE_PATH",
                ty.split('/').next().unwrap_or(ty)
            );
            (there.md5 != *md5).then_some((mistake, help))
        })
    }
}

/// Whether the parameter is not set.
fn missing_parameter(node: &RosNode, name: &str) -> Option<Mistake> {
    let is_set = node.ask_master("hasParam", &[name.into()]).ok()?;
    if is_set != Value::Bool(false) {
        return None;
    }
    let names = node.ask_master("getParamNames", &[]).ok();
    let names = names.as_ref().and_then(Value::as_array).unwrap_or_default();
    let names = names.iter().filter_map(Value::as_str);
    let help = match closest(name, names) {
        Some(known) => format!("did you mean '{known}'?"),
        None => "it may be set later, since each task reads it again".to_owned(),
    };
    Some((format!("the parameter {name} is not set"), help))
}

/// A name is of a type that the file does not expect.
fn other_type(what: &str, name: &str, there: &str, needed: &str) -> Mistake {
    (
        format!("{what} {name} is of the type {there}, not {needed}"),
        format!("write type: {there}"),
    )
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use ztl_yaml::Document;

    use super::super::used_name::UsedType;
    use super::*;

    fn map<T: Clone>(pairs: &[(&str, T)]) -> BTreeMap<String, T> {
        let pairs = pairs.iter().cloned();
        pairs
            .map(|(name, value)| (name.to_owned(), value))
            .collect()
    }

    fn nodes(rows: &[(&str, &[&str])]) -> BTreeMap<String, Vec<String>> {
        let row = |nodes: &[&str]| nodes.iter().map(|node| (*node).to_owned()).collect();
        rows.iter()
            .map(|(name, of)| ((*name).to_owned(), row(of)))
            .collect()
    }

    /// A robot that hangs in parts.
    fn survey() -> Survey {
        let twist = "geometry_msgs/Twist".to_owned();
        let frozen = || {
            (
                "http://base:1/".to_owned(),
                Some("no answer from base:1 in time".to_owned()),
            )
        };
        let topics = ["/cmd_vel", "/odom", "/frozen", "/many"];
        let mut topics = map(&topics.map(|name| (name, twist.clone())));
        topics.insert("/odd".to_owned(), "*".to_owned());
        Survey {
            topics,
            actions: map(&[("/move_base", "move_base_msgs/MoveBaseAction".to_owned())]),
            publishers: nodes(&[("/odom", &["/base"])]),
            subscribers: nodes(&[
                ("/cmd_vel", &["/base"]),
                ("/odd", &["/base"]),
                ("/frozen", &["/lidar"]),
                ("/many", &["/rostopic", "/base"]),
            ]),
            servers: nodes(&[("/dock", &["/base"]), ("/scan", &["/lidar"])]),
            nodes: map(&[
                ("/lidar", frozen()),
                ("/base", ("http://base:2/".to_owned(), None)),
            ]),
        }
    }

    #[track_caller]
    fn said(kind: NameKind, name: &str, ty: &str, subscriber: Option<&str>, expected: &str) {
        let document = Document::parse("robot.yaml", b"x: 1").expect("YAML");
        let used = UsedName {
            place: document.mistake(document.root().span, ""),
            name: name.to_owned(),
            of: UsedType {
                kind,
                ty: ty.to_owned(),
                known: Vec::new(),
                published: None,
                subscriber: subscriber.map(str::to_owned),
            },
        };
        let survey = survey();
        let found = used.mistake(&survey, || None);
        let found = found.or_else(|| used.unreachable(&survey));
        let found = found.map(|(mistake, help)| used.warning(mistake, Some(help)).sentence());
        let found = found.unwrap_or_default();
        assert_eq!(
            found.trim_start_matches("robot.yaml:1:1: warning: "),
            expected
        );
    }

    #[test]
    fn what_is_right_is_not_told() {
        let twist = "geometry_msgs/Twist";
        said(NameKind::Published, "/cmd_vel", twist, None, "");
        said(NameKind::Published, "/cmd_vel", twist, Some("/base"), "");
        said(NameKind::Published, "/odd", twist, None, "");
        said(NameKind::Published, "/many", twist, Some("/base"), "");
        said(NameKind::Received, "/odom", twist, None, "");
        said(NameKind::Service, "/dock", "std_srvs/Trigger", None, "");
    }

    #[test]
    fn a_name_that_is_not_there_and_another_type_are_told() {
        let twist = "geometry_msgs/Twist";
        said(
            NameKind::Published,
            "/cmdvel",
            twist,
            None,
            "the master knows no topic /cmdvel; did you mean '/cmd_vel'?",
        );
        said(
            NameKind::Service,
            "/undock_now",
            "std_srvs/Trigger",
            None,
            "the master knows no service /undock_now; `ztl doctor --ros1 --json` lists the services",
        );
        said(
            NameKind::Action,
            "/move_base",
            "actionlib/TestAction",
            None,
            "action /move_base is of the type move_base_msgs/MoveBaseAction, not actionlib/TestAction; write type: move_base_msgs/MoveBaseAction",
        );
    }

    #[test]
    fn a_topic_without_another_end_is_told_and_who_receives_one() {
        let twist = "geometry_msgs/Twist";
        said(
            NameKind::Published,
            "/odom",
            twist,
            None,
            "no node subscribes to /odom, which /base publishes; to receive a topic, write ros1-topic among the streams",
        );
        said(
            NameKind::Received,
            "/cmd_vel",
            twist,
            None,
            "no node publishes /cmd_vel, to which /base subscribes; to publish a topic, write ros1-publish",
        );
        said(
            NameKind::Published,
            "/many",
            twist,
            None,
            "several nodes receive /many, and each counts as the robot's: /rostopic, /base; name the one that must receive it, such as subscriber: /rostopic",
        );
        said(
            NameKind::Published,
            "/cmd_vel",
            twist,
            Some("/arm"),
            "/arm does not subscribe to /cmd_vel; there are: /base; write subscriber: /base",
        );
    }

    #[test]
    fn a_node_that_hangs_is_told() {
        let help = "cannot be reached: no answer from base:1 in time; if it hangs or was killed, start it again";
        said(
            NameKind::Published,
            "/frozen",
            "geometry_msgs/Twist",
            None,
            &format!("the subscriber of /frozen, /lidar, {help}"),
        );
        said(
            NameKind::Service,
            "/scan",
            "std_srvs/Trigger",
            None,
            &format!("the server of /scan, /lidar, {help}"),
        );
    }
}
