//! Whether the topics, actions and services of a file are there: asked by `--check`, while the robot runs.

use std::sync::Arc;

use ztl_ros1::message::{ActionType, MessageType, ServiceType};
use ztl_ros1::{Node as RosNode, Survey};
use ztl_yaml::{Diagnostic, Node, closest};

use super::connection::Connection;
use crate::reader::ConfigReader;

/// A name in ROS that the file uses.
#[derive(Debug, Clone)]
pub(crate) struct UsedName {
    /// Where the file has it; its message is still to be written.
    place: Diagnostic,
    name: String,
    of: UsedType,
}

/// The type of a used name.
#[derive(Debug, Clone)]
pub(crate) struct UsedType {
    kind: NameKind,
    /// As the file has it.
    ty: String,
    /// The definitions that this machine has for it.
    known: Vec<Known>,
}

/// What a name is of.
#[derive(Debug, Clone, Copy)]
enum NameKind {
    Action,
    Topic,
    Service,
}

/// A definition that this machine has for a topic or service.
#[derive(Debug, Clone)]
struct Known {
    /// What follows the used name.
    suffix: &'static str,
    ty: String,
    md5: String,
}

impl Known {
    fn of(suffix: &'static str, message: &MessageType) -> Self {
        Self {
            suffix,
            ty: message.name().to_owned(),
            md5: message.md5().to_owned(),
        }
    }
}

impl UsedType {
    pub(crate) fn action(ty: &ActionType) -> Self {
        Self {
            kind: NameKind::Action,
            ty: ty.name.clone(),
            known: vec![
                Known::of("/result", &ty.action_result),
                Known::of("/feedback", &ty.action_feedback),
            ],
        }
    }

    pub(crate) fn topic(ty: &MessageType) -> Self {
        Self {
            kind: NameKind::Topic,
            ty: ty.name().to_owned(),
            known: vec![Known::of("", ty)],
        }
    }

    pub(crate) fn service(ty: &ServiceType) -> Self {
        let known = Known {
            suffix: "",
            ty: ty.name.clone(),
            md5: ty.md5.clone(),
        };
        Self {
            kind: NameKind::Service,
            ty: ty.name.clone(),
            known: vec![known],
        }
    }
}

impl<'d> ConfigReader<'d> {
    /// Notes a name that the file uses.
    pub(crate) fn uses_name(&mut self, node: &'d Node, name: Option<&String>, of: UsedType) {
        if let Some(name) = name {
            self.ros1.names.push(UsedName {
                place: self.yaml.mistake(node, ""),
                name: name.clone(),
                of,
            });
        }
    }
}

/// Asks the master for these names. Returns the names that are missing or have another type, or why they cannot be checked;
/// blocks for some seconds if nodes do not answer.
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
                let known = name.mistake(&survey);
                let known = known.or_else(|| name.lost_server(&survey));
                known.or_else(|| name.other_definition(&survey, &node))
            };
            let wrong = names.iter().filter_map(|name| Some((name, wrong(name)?)));
            warnings.extend(wrong.map(|(name, (mistake, help))| name.warning(mistake, Some(help))));
        }
        Err(error) => {
            let help = "start the robot's ROS to have its names checked, too".to_owned();
            warnings.push(first.warning(error, Some(help)));
        }
    }
    warnings
}

impl UsedName {
    fn warning(&self, message: String, help: Option<String>) -> Diagnostic {
        let mut warning = self.place.clone();
        warning.message = format!("warning: {message}");
        warning.help = help;
        warning
    }

    /// What is wrong with the name, and a remedy.
    fn mistake(&self, survey: &Survey) -> Option<(String, String)> {
        let name = &self.name;
        let (there, what) = match self.of.kind {
            NameKind::Action => (survey.actions.get(name), "action"),
            NameKind::Topic => (survey.topics.get(name), "topic"),
            // The master does not know the types of services.
            NameKind::Service if survey.services.contains(name) => return None,
            NameKind::Service => (None, "service"),
        };
        let Some(there) = there else {
            let known: Vec<&String> = match self.of.kind {
                NameKind::Action => survey.actions.keys().collect(),
                NameKind::Topic => survey.topics.keys().collect(),
                NameKind::Service => survey.services.iter().collect(),
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
        (!fits).then(|| other_type(what, name, there, &self.of.ty))
    }

    /// Why no node that serves the action can be reached, and a remedy. The master also names nodes that were killed.
    fn lost_server(&self, survey: &Survey) -> Option<(String, String)> {
        let NameKind::Action = self.of.kind else {
            return None;
        };
        let servers = survey.publishers.get(&format!("{}/status", self.name))?;
        let obstacle = |node: &String| {
            let (_, wrong) = survey.nodes.get(node)?;
            Some((node.clone(), wrong.clone()?))
        };
        let obstacles: Option<Vec<_>> = servers.iter().map(obstacle).collect();
        let (node, wrong) = obstacles?.into_iter().next()?;
        Some((
            format!(
                "the action server {node} of {} cannot be reached: {wrong}",
                self.name
            ),
            "if it was killed, start it again".to_owned(),
        ))
    }

    /// Whether the robot has another definition of its type, and a remedy. Asks the nodes that publish or serve it.
    fn other_definition(&self, survey: &Survey, node: &RosNode) -> Option<(String, String)> {
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

/// A name is of a type that the file does not expect.
fn other_type(what: &str, name: &str, there: &str, needed: &str) -> (String, String) {
    (
        format!("{what} {name} is of the type {there}, not {needed}"),
        format!("write type: {there}"),
    )
}

#[cfg(test)]
mod tests {
    use ztl_yaml::Document;

    use super::*;

    #[test]
    fn a_name_that_is_not_there_and_another_type_are_told() {
        let survey = Survey {
            topics: [("/cmd_vel", "geometry_msgs/Twist"), ("/odd", "*")]
                .map(|(name, kind)| (name.to_owned(), kind.to_owned()))
                .into(),
            actions: [(
                "/move_base".to_owned(),
                "move_base_msgs/MoveBaseAction".to_owned(),
            )]
            .into(),
            services: vec!["/dock".to_owned()],
            ..Survey::default()
        };
        let document = Document::parse("robot.yaml", b"x: 1").expect("YAML");
        let said = |name: &str, kind, ty: &str| {
            let place = document.mistake(document.root().span, "");
            let used = UsedName {
                place,
                name: name.to_owned(),
                of: UsedType {
                    kind,
                    ty: ty.to_owned(),
                    known: Vec::new(),
                },
            };
            let (mistake, help) = used.mistake(&survey)?;
            Some(used.warning(mistake, Some(help)).sentence())
        };
        let twist = "geometry_msgs/Twist";
        let trigger = "std_srvs/Trigger";
        assert_eq!(said("/cmd_vel", NameKind::Topic, twist), None);
        assert_eq!(said("/odd", NameKind::Topic, twist), None);
        assert_eq!(said("/dock", NameKind::Service, trigger), None);
        assert_eq!(
            said("/cmdvel", NameKind::Topic, twist).as_deref(),
            Some(
                "robot.yaml:1:1: warning: the master knows no topic /cmdvel; did you mean '/cmd_vel'?"
            ),
        );
        assert_eq!(
            said("/undock_now", NameKind::Service, trigger).as_deref(),
            Some(
                "robot.yaml:1:1: warning: the master knows no service /undock_now; `ztl doctor --ros1 --json` lists the services"
            ),
        );
        assert_eq!(
            said("/move_base", NameKind::Action, "actionlib/TestAction").as_deref(),
            Some(
                "robot.yaml:1:1: warning: action /move_base is of the type move_base_msgs/MoveBaseAction, not actionlib/TestAction; write type: move_base_msgs/MoveBaseAction"
            ),
        );
    }
}
