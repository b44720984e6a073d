//! Types by their names in the file.

use std::sync::Arc;

use ztl_ros1::message::{ActionType, DefinitionError, Definitions, MessageType, ServiceType};
use ztl_yaml::{Node, closest};

use crate::reader::ConfigReader;

impl<'d> ConfigReader<'d> {
    /// A message's type, by its name in `node`.
    pub(crate) fn ros1_message(&mut self, node: &'d Node) -> Option<Arc<MessageType>> {
        let names = Definitions::message_names;
        self.ros1_type(node, "geometry_msgs/Twist", names, Definitions::message)
    }

    pub(crate) fn ros1_service(&mut self, node: &'d Node) -> Option<ServiceType> {
        let names = Definitions::service_names;
        self.ros1_type(node, "std_srvs/Trigger", names, Definitions::service)
    }

    pub(crate) fn ros1_action(&mut self, node: &'d Node) -> Option<ActionType> {
        let example = "move_base_msgs/MoveBaseAction";
        let names = Definitions::action_names;
        self.ros1_type(node, example, names, Definitions::action)
    }

    fn ros1_type<T>(
        &mut self,
        node: &'d Node,
        example: &str,
        names: impl FnOnce(&mut Definitions) -> Vec<String>,
        find: impl FnOnce(&mut Definitions, &str) -> Result<T, DefinitionError>,
    ) -> Option<T> {
        let text = self.yaml.text(node, &format!("a type, as {example}"))?;
        let definitions = self.ros1.definitions();
        let error = match find(definitions, text) {
            Ok(found) => return Some(found),
            Err(error) => error,
        };
        let help = matches!(error, DefinitionError::Unknown { .. }).then(|| {
            let names = names(definitions);
            // The name of an action is often written without its ending.
            let whole = format!("{text}Action");
            let whole = names
                .iter()
                .find(|name| **name == whole)
                .map(String::as_str);
            match whole.or_else(|| closest(text, names.iter().map(String::as_str))) {
                Some(name) => format!("did you mean '{name}'?"),
                None => "install its package here, or add the directory of its package to \
                         ROS_PACKAGE_PATH"
                    .to_owned(),
            }
        });
        self.yaml.wrong_with(node, error.to_string(), help);
        None
    }
}
