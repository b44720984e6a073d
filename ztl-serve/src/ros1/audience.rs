//! Who receives what a task publishes.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ztl_ros1::Publisher;
use ztl_yaml::Fields;

use super::Event;
use crate::kind::{JobContext, JobEvent};
use crate::reader::ConfigReader;

/// How long a node may take to acknowledge a command that is sent once.
pub(super) const ACKNOWLEDGE: Duration = Duration::from_secs(1);
/// How long a reason may take to be found out.
pub(super) const EXPLAIN: Duration = Duration::from_millis(480);

/// What is known of the nodes that count: all, or the one that the file names.
#[derive(Debug, Clone, Default)]
pub(super) struct Heard {
    /// Those that are connected.
    pub(super) nodes: Vec<String>,
    /// Whether they have acknowledged all messages.
    pub(super) has_all: bool,
    /// Which was disconnected, and why: it has not acknowledged a message in time, or the connection was reset.
    pub(super) lost: Option<String>,
}

/// A topic for a task; a fake in tests.
pub(super) trait Outlet: Send + Sync {
    fn publish(&self, bytes: Vec<u8>);

    /// Which nodes receive it, and which were lost since the task began to publish, if it has.
    fn look(&self, since: Option<Instant>) -> Heard;

    /// Sends this to the nodes that count and were lost since then, first when they connect again.
    fn publish_when_back(&self, since: Instant, bytes: Vec<u8>);

    /// Has the reason why no node that counts receives it sent to the task.
    fn explain(&self);
}

/// A topic of a real node.
pub(super) struct Wire {
    pub(super) publisher: Arc<Publisher>,
    /// The node that must receive it, if the file names one.
    pub(super) subscriber: Option<String>,
    pub(super) task: JobContext,
}

impl Wire {
    fn counts(&self, node: &str) -> bool {
        self.subscriber.as_ref().is_none_or(|name| name == node)
    }
}

impl Outlet for Wire {
    fn publish(&self, bytes: Vec<u8>) {
        self.publisher.publish(bytes);
    }

    fn publish_when_back(&self, since: Instant, bytes: Vec<u8>) {
        let mut lost = self.publisher.audience().lost;
        lost.retain(|loss| loss.at >= since && self.counts(&loss.node));
        let nodes = lost.into_iter().map(|loss| loss.node);
        self.publisher.publish_when_back(nodes.collect(), bytes);
    }

    fn look(&self, since: Option<Instant>) -> Heard {
        let counts = |node: &str| self.counts(node);
        if since.is_some() {
            self.publisher.keep_connections();
        }
        let audience = self.publisher.audience();
        let mut nodes = audience.nodes;
        nodes.retain(|listener| counts(&listener.node));
        let mut lost = audience.lost.into_iter();
        let is_since = |at: Instant| since.is_some_and(|since| at >= since);
        let lost = lost.find(|loss| is_since(loss.at) && counts(&loss.node));
        Heard {
            has_all: nodes.iter().all(|listener| listener.has_all),
            nodes: nodes.into_iter().map(|listener| listener.node).collect(),
            lost: lost.map(|loss| format!("{} was disconnected: {}", loss.node, loss.reason)),
        }
    }

    fn explain(&self) {
        let task = self.task.clone();
        self.publisher
            .explain(self.subscriber.as_deref(), move |reason| {
                task.event(JobEvent::Ros1(Event::Reason(reason)));
            });
    }
}

impl<'d> ConfigReader<'d> {
    /// Reads `subscriber`: the node that must receive the topic.
    pub(super) fn subscriber(&mut self, fields: &mut Fields<'d>) -> Option<String> {
        let node = fields.optional("subscriber")?;
        self.ros1_name(node, "/base_controller")
    }
}
