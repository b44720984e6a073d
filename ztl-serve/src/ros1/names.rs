//! Whether the topics, actions and services of a file are there: asked by `--check`, while the robot runs.

use std::sync::Arc;

use ztl_ros1::Survey;
use ztl_yaml::{Diagnostic, Node, closest};

use super::connection::Connection;
use crate::reader::ConfigReader;

/// A name in ROS that the file uses.
#[derive(Debug, Clone)]
pub(crate) struct UsedName {
    /// Where the file has it; its message is still to be written.
    place: Diagnostic,
    name: String,
    kind: NameKind,
}

/// What the name is of.
#[derive(Debug, Clone)]
pub(crate) enum NameKind {
    /// An action of this type.
    Action(String),
    /// A topic of this type.
    Topic(String),
    Service,
}

impl<'d> ConfigReader<'d> {
    /// Notes a name that the file uses.
    pub(crate) fn uses_name(&mut self, node: &'d Node, name: Option<&String>, kind: NameKind) {
        if let Some(name) = name {
            self.ros1.names.push(UsedName {
                place: self.yaml.mistake(node, ""),
                name: name.clone(),
                kind,
            });
        }
    }
}

/// Asks the master for these names. Returns the missing names, or why they cannot be checked; blocks for some seconds if nodes
/// do not answer.
pub(crate) fn missing(connection: &Arc<Connection>, names: &[UsedName]) -> Vec<Diagnostic> {
    let Some(first) = names.first() else {
        return Vec::new();
    };
    let survey = connection.node().and_then(|node| {
        let survey = node.survey();
        survey.map_err(|error| {
            format!(
                "no answer from the master {}: {error}",
                connection.config.master
            )
        })
    });
    match survey {
        Ok(survey) => {
            let wrong = names
                .iter()
                .filter_map(|name| Some((name, name.mistake(&survey)?)));
            wrong
                .map(|(name, (mistake, help))| name.warning(mistake, Some(help)))
                .collect()
        }
        Err(error) => {
            let help = "start the robot's ROS to have its names checked, too".to_owned();
            vec![first.warning(error, Some(help))]
        }
    }
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
        let (there, what, needed) = match &self.kind {
            NameKind::Action(needed) => (survey.actions.get(name), "action", needed.as_str()),
            NameKind::Topic(needed) => (survey.topics.get(name), "topic", needed.as_str()),
            NameKind::Service if survey.services.contains(name) => return None,
            NameKind::Service => (None, "service", ""),
        };
        let Some(there) = there else {
            let known: Vec<&String> = match self.kind {
                NameKind::Action(_) => survey.actions.keys().collect(),
                NameKind::Topic(_) => survey.topics.keys().collect(),
                NameKind::Service => survey.services.iter().collect(),
            };
            let known = known.iter().map(|name| name.as_str());
            let help = match closest(name, known) {
                Some(known) => format!("did you mean '{known}'?"),
                None => "`ztl doctor --ros1` says what is there".to_owned(),
            };
            return Some((format!("the master knows no {what} {name}"), help));
        };
        // A node may subscribe to any type.
        if there == needed || there == "*" {
            return None;
        }
        let help = format!("write type: {there}");
        Some((
            format!("{what} {name} is of the type {there}, not {needed}"),
            help,
        ))
    }
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
        let said = |name: &str, kind| {
            let place = document.mistake(document.root().span, "");
            let used = UsedName {
                place,
                name: name.to_owned(),
                kind,
            };
            let (mistake, help) = used.mistake(&survey)?;
            Some(used.warning(mistake, Some(help)).sentence())
        };
        let twist = || NameKind::Topic("geometry_msgs/Twist".to_owned());
        assert_eq!(said("/cmd_vel", twist()), None);
        assert_eq!(said("/odd", twist()), None);
        assert_eq!(said("/dock", NameKind::Service), None);
        assert_eq!(
            said("/cmdvel", twist()).as_deref(),
            Some(
                "robot.yaml:1:1: warning: the master knows no topic /cmdvel; did you mean '/cmd_vel'?"
            ),
        );
        assert_eq!(
            said("/undock_now", NameKind::Service).as_deref(),
            Some(
                "robot.yaml:1:1: warning: the master knows no service /undock_now; `ztl doctor --ros1` says what is there"
            ),
        );
        assert_eq!(
            said(
                "/move_base",
                NameKind::Action("actionlib/TestAction".to_owned())
            )
            .as_deref(),
            Some(
                "robot.yaml:1:1: warning: action /move_base is of the type move_base_msgs/MoveBaseAction, not actionlib/TestAction; write type: move_base_msgs/MoveBaseAction"
            ),
        );
    }
}
