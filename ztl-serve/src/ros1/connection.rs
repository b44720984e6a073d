//! The node of ROS 1 that all components of a file share. It starts with the first that needs it.

use std::net::ToSocketAddrs as _;
use std::sync::{Arc, Mutex, PoisonError};

use ztl_ros1::message::{Definitions, MessageType};
use ztl_ros1::{Config, Node as RosNode};
use ztl_yaml::Diagnostic;

use super::used_name::UsedName;

/// How the node is called in ROS, before what makes its name unique.
pub(super) const NAME: &str = "ztl";

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
    pub(super) fn new(config: Config, host: Option<Diagnostic>) -> Arc<Self> {
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
