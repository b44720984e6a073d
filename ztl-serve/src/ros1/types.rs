//! Types by their names in the file.

use std::sync::Arc;

use ztl_ros1::message::{ActionType, DefinitionError, Definitions, MessageType, ServiceType};
use ztl_yaml::{Fields, Node, closest};

use super::used_name::UsedType;
use crate::reader::ConfigReader;

/// A type that the file names.
pub(crate) trait NamedType: Sized {
    /// Such as `std_srvs/Trigger`.
    const EXAMPLE: &'static str;

    /// What has such a type.
    const WHAT: &'static str;

    /// All that are known.
    const NAMES: fn(&mut Definitions) -> Vec<String>;

    const FIND: fn(&mut Definitions, &str) -> Result<Self, DefinitionError>;
}

impl NamedType for Arc<MessageType> {
    const EXAMPLE: &'static str = "geometry_msgs/Twist";
    const WHAT: &'static str = "a message";
    const NAMES: fn(&mut Definitions) -> Vec<String> = Definitions::message_names;
    const FIND: fn(&mut Definitions, &str) -> Result<Self, DefinitionError> = Definitions::message;
}

impl NamedType for ServiceType {
    const EXAMPLE: &'static str = "std_srvs/Trigger";
    const WHAT: &'static str = "a service";
    const NAMES: fn(&mut Definitions) -> Vec<String> = Definitions::service_names;
    const FIND: fn(&mut Definitions, &str) -> Result<Self, DefinitionError> = Definitions::service;
}

impl NamedType for ActionType {
    const EXAMPLE: &'static str = "move_base_msgs/MoveBaseAction";
    const WHAT: &'static str = "an action";
    const NAMES: fn(&mut Definitions) -> Vec<String> = Definitions::action_names;
    const FIND: fn(&mut Definitions, &str) -> Result<Self, DefinitionError> = Definitions::action;
}

impl<'d> ConfigReader<'d> {
    /// Reads the name of a topic, a service or an action from `node`, and its `type` from `fields`. `used`
    /// says for what, and both are noted for `--check`.
    pub(crate) fn ros1_typed_name<T: NamedType>(
        &mut self,
        node: &'d Node,
        fields: &mut Fields<'d>,
        name_example: &str,
        type_example: &'static str,
        used: impl FnOnce(&T) -> UsedType,
    ) -> (Option<String>, Option<T>) {
        let name = self.ros1_name(node, name_example);
        let named_type = fields.required("type", type_example);
        let named_type = named_type.and_then(|node| self.ros1_type::<T>(node));
        if let Some(named_type) = &named_type {
            self.uses_name(node, name.as_ref(), used(named_type));
        }
        (name, named_type)
    }

    fn ros1_type<T: NamedType>(&mut self, node: &'d Node) -> Option<T> {
        let text = self
            .yaml
            .text(node, &format!("a type, as {}", T::EXAMPLE))?;
        let definitions = self.ros1.definitions();
        let error = match (T::FIND)(definitions, text) {
            Ok(found) => return Some(found),
            Err(error) => error,
        };
        let is_unknown = matches!(error, DefinitionError::Unknown { .. });
        if is_unknown && let Some(found) = what_has(definitions, text) {
            let mistake = format!(
                "{text} is the type of {found}; expected that of {}",
                T::WHAT
            );
            let help = format!("write the type as {}", T::EXAMPLE);
            self.yaml.wrong_with(node, mistake, Some(help));
            return None;
        }
        let help = is_unknown.then(|| {
            let names = (T::NAMES)(definitions);
            // The name of an action is often written without its ending.
            let whole = format!("{text}Action");
            let whole = names
                .iter()
                .find(|name| **name == whole)
                .map(String::as_str);
            match whole.or_else(|| closest(text, names.iter().map(String::as_str))) {
                Some(name) => format!("did you mean '{name}'?"),
                None => unknown_package(),
            }
        });
        let help = help.or_else(|| as_in_ros2(text));
        self.yaml.wrong_with(node, error.to_string(), help);
        None
    }
}

/// What helps if the type is written as in ROS 2, with the kind of definition in its middle.
fn as_in_ros2(text: &str) -> Option<String> {
    let mut parts = text.split('/');
    let (package, kind, name) = (parts.next()?, parts.next()?, parts.next()?);
    let ending = match kind {
        "msg" | "srv" => "",
        "action" => "Action",
        _ => return None,
    };
    Some(format!("in ROS 1, it is {package}/{name}{ending}"))
}

/// What has a type with this name.
fn what_has(definitions: &mut Definitions, name: &str) -> Option<&'static str> {
    if definitions.service(name).is_ok() {
        return Some(ServiceType::WHAT);
    }
    let is_message = definitions.message(name).is_ok();
    is_message.then_some(<Arc<MessageType>>::WHAT)
}

/// What helps if no type has a similar name.
fn unknown_package() -> String {
    match Definitions::useless_path() {
        Some(path) => format!(
            "'{}' in ROS_PACKAGE_PATH is not the absolute path of a directory",
            path.display()
        ),
        None => "install its package here, or add the directory of its package to ROS_PACKAGE_PATH"
            .to_owned(),
    }
}
