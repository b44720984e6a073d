//! Reads what all components of ROS 1 need: `ros1` at the top of the file, and names.

use ztl_ros1::Config;
use ztl_yaml::Node;

use super::connection::{Connection, NAME};
use super::used_name::{UsedName, UsedType};
use crate::reader::ConfigReader;

impl<'d> ConfigReader<'d> {
    /// Reads `ros1`: where the master is, and under which name this machine is reached.
    pub(crate) fn ros1(&mut self, node: &'d Node) {
        let what = "master: \"http://localhost:11311\"";
        let Some(mut fields) = self.yaml.fields(node, what) else {
            return;
        };
        let mut config = Config::from_environment(NAME);
        if let Some(node) = fields.optional("master") {
            let what = "the address of a ROS master, as http://localhost:11311";
            let master = self.yaml.parsed(node, what, |text| {
                let host = text.strip_prefix("http://");
                let host = host.map(|host| host.strip_suffix('/').unwrap_or(host));
                let parts = host.and_then(|host| host.rsplit_once(':'));
                match parts.map(|(host, port)| (host.is_empty(), port.parse::<u16>())) {
                    Some((false, Ok(1..))) => Ok(text.to_owned()),
                    _ => Err(format!("'{text}' is not {what}")),
                }
            });
            config.master = master.unwrap_or(config.master);
        }
        let host_node = fields.optional("host");
        if let Some(node) = host_node {
            let what =
                "the name or address under which the robot reaches this machine, as 10.0.0.4";
            let host = self.yaml.parsed(node, what, |text| {
                let fits = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
                match !text.is_empty() && text.chars().all(fits) {
                    true => Ok(text.to_owned()),
                    false => Err(format!("'{text}' is not {what}")),
                }
            });
            config.host = host;
        }
        fields.finish(&mut self.yaml);
        let place = host_node.map(|node| self.yaml.mistake(node, ""));
        self.ros1.connection = Connection::new(config, place);
    }

    /// The name of a topic, an action or a service.
    pub(crate) fn ros1_name(&mut self, node: &'d Node, example: &str) -> Option<String> {
        let what = format!("a name in ROS, as {example}");
        self.yaml.parsed(node, &what, |text| {
            let name = text.strip_prefix('/').unwrap_or(text);
            let of_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
            let fits = |part: &str| !part.is_empty() && part.chars().all(of_word);
            let begins = text.starts_with(|c: char| c == '/' || c.is_ascii_alphabetic());
            match begins && name.split('/').all(fits) {
                true => Ok(format!("/{name}")),
                false => Err(format!("'{text}' is not {what}")),
            }
        })
    }

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
