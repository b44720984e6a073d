//! The node of ROS 1 that all components of a file share. It starts with the first that needs it.

use std::net::ToSocketAddrs as _;
use std::sync::{Arc, Mutex, PoisonError};

use ztl_ros1::message::{Definitions, MessageType};
use ztl_ros1::{Config, Node as RosNode};
use ztl_yaml::{Diagnostic, Node};

use super::used_name::UsedName;
use crate::reader::ConfigReader;

/// How the node is called in ROS, before what makes its name unique.
const NAME: &str = "ztl";

/// The node, once it is needed.
#[derive(Debug)]
pub(crate) struct Connection {
    pub(crate) config: Config,
    /// Where the file says `host`.
    host: Option<Diagnostic>,
    node: Mutex<Option<RosNode>>,
}

/// What is needed to read the components of ROS 1.
#[derive(Debug)]
pub(crate) struct Ros1 {
    pub(crate) connection: Arc<Connection>,
    definitions: Option<Definitions>,
    /// The names that the file uses.
    pub(crate) names: Vec<UsedName>,
}

impl Default for Ros1 {
    fn default() -> Self {
        Self {
            connection: Connection::new(Config::from_environment(NAME), None),
            definitions: None,
            names: Vec::new(),
        }
    }
}

impl Ros1 {
    /// The definitions of messages. The robot's files are searched when they are first needed.
    pub(crate) fn definitions(&mut self) -> &mut Definitions {
        self.definitions
            .get_or_insert_with(Definitions::of_this_machine)
    }
}

impl Connection {
    fn new(config: Config, host: Option<Diagnostic>) -> Arc<Self> {
        Arc::new(Self {
            config,
            host,
            node: Mutex::new(None),
        })
    }

    /// A warning if this machine cannot resolve the `host` of the file. May block.
    pub(crate) fn unknown_host(&self) -> Option<Diagnostic> {
        let (place, host) = (self.host.as_ref()?, self.config.host.as_ref()?);
        let known = (host.as_str(), 0).to_socket_addrs().is_ok();
        (!known).then(|| {
            let mut warning = place.clone();
            warning.message = format!("warning: this machine cannot resolve its own name '{host}'");
            warning.help = Some("write a name or address that the robot can reach".to_owned());
            warning
        })
    }

    /// The node. It works also while there is no master.
    ///
    /// # Errors
    /// Why the node cannot start.
    pub(crate) fn node(&self) -> Result<RosNode, String> {
        let mut node = self.node.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(node) = &*node {
            return Ok(node.clone());
        }
        let started = RosNode::start(&self.config).map_err(|error| error.to_string())?;
        Ok(node.insert(started).clone())
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        let node = self.node.get_mut().unwrap_or_else(PoisonError::into_inner);
        if let Some(node) = node.take() {
            // The master forgets what this node has registered.
            node.stop();
        }
    }
}

/// The type as the wire needs it.
pub(crate) fn wire(message: &MessageType) -> ztl_ros1::WireType {
    ztl_ros1::WireType {
        name: message.name().to_owned(),
        md5: message.md5().to_owned(),
        definition: message.full_text(),
    }
}

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
}
