//! What the node publishes, and who receives it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Engine, Role};
use crate::WireType;
use crate::graph::is_ztl;
use crate::node::fit::{TypeConflict, conflict, fits};
use crate::node::net::ConnectionId;
use crate::node::net_error::NetError;
use crate::node::unacknowledged;
use crate::tcpros::{Frames, Header, LONGEST_HEADER, frame};

/// Messages that wait for a slow subscriber; then the oldest is dropped.
pub(crate) const QUEUE: usize = 64;

/// The longest text of another node that is shown.
const LONGEST_SHOWN: usize = 512;

/// How often a topic that has lost a node is registered again: while the node's machine may not know it.
const RENEWALS: u32 = 30;
const RENEWALS_AFTER_RESET: u32 = 3;
const RENEWAL: Duration = Duration::from_secs(10);

/// Nodes that are remembered because they were lost or refused, and how long those that were lost.
const MOST_REMEMBERED: usize = 64;
const REMEMBERED: Duration = Duration::from_secs(3600);

/// How often the log says that a node was disconnected.
const TOLD: Duration = Duration::from_secs(60);

/// How messages of a topic are sent.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Manner {
    /// Whether new subscribers get the last message.
    pub(crate) latching: bool,
    /// Whether a message replaces one that was not sent yet.
    pub(crate) newest: bool,
    /// How long a subscriber may take to acknowledge a message. Then it is disconnected.
    pub(crate) limit: Option<Duration>,
}

/// Who receives a topic of this node.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Audience {
    /// The nodes that are connected, without those of `ztl`, which move no robot.
    pub nodes: Vec<Listener>,
    /// Nodes that were disconnected: they have not acknowledged a message in time, the connection was reset, or there are too
    /// many connections.
    pub lost: Vec<Loss>,
}

/// A node that receives a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Listener {
    /// Its name.
    pub node: String,
    /// Whether it has acknowledged all messages.
    pub has_all: bool,
}

/// A node that was disconnected.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Loss {
    /// Its name.
    pub node: String,
    /// When.
    pub at: Instant,
    /// Why.
    pub reason: String,
    /// Whether it has connected again.
    pub(crate) is_back: bool,
}

/// A topic that the node publishes.
pub(crate) struct Publication {
    pub(crate) ty: WireType,
    pub(crate) registered: bool,
    /// How often it is still to be registered again, and when next: nodes that were disconnected connect again.
    renewals: (u32, Option<Instant>),
    /// Nodes that receive it.
    pub(crate) subscribers: BTreeMap<ConnectionId, Arc<str>>,
    manner: Manner,
    /// When a message was published, or a task looked who receives it.
    used: Option<Instant>,
    last: Option<Arc<[u8]>>,
    /// How many owners it has.
    owners: usize,
    action: Option<Arc<str>>,
    lost: Vec<Loss>,
    /// Nodes that get a message first when they connect again.
    owed: Vec<(String, Arc<[u8]>)>,
    /// Nodes that were refused, and why.
    refused: Vec<(String, String)>,
}

impl Engine {
    /// Publishes a topic, for one more owner.
    pub(crate) fn advertise(
        &mut self,
        topic: &Arc<str>,
        ty: WireType,
        manner: Manner,
        action: Option<Arc<str>>,
    ) -> Result<(), TypeConflict> {
        if let Some(publication) = self.publications.get_mut(topic) {
            conflict(topic, &publication.ty, &ty)?;
            publication.owners += 1;
            publication.action = publication.action.take().or(action);
            let before = &mut publication.manner;
            before.latching |= manner.latching;
            before.newest &= manner.newest;
            before.limit = before.limit.into_iter().chain(manner.limit).min();
            if let Some(limit) = before.limit {
                for id in publication.subscribers.keys() {
                    self.net.limit(*id, limit);
                }
            }
            return Ok(());
        }
        let publication = Publication {
            ty,
            registered: false,
            renewals: (0, None),
            subscribers: BTreeMap::new(),
            manner,
            used: None,
            last: None,
            owners: 1,
            action,
            lost: Vec::new(),
            owed: Vec::new(),
            refused: Vec::new(),
        };
        self.publications.insert(Arc::clone(topic), publication);
        Ok(())
    }

    /// One owner releases the topic. Messages that were published before are still sent.
    pub(crate) fn unadvertise(&mut self, now: Instant, topic: &str) {
        let Some(publication) = self.publications.get_mut(topic) else {
            return;
        };
        publication.owners -= 1;
        if publication.owners == 0 {
            let subscribers = std::mem::take(&mut publication.subscribers);
            self.publications.remove(topic);
            for id in subscribers.into_keys() {
                self.roles.remove(&id);
                self.net.close_when_sent(now, id);
            }
            self.unregister("unregisterPublisher", topic);
        }
    }

    /// Sends a message to all subscribers.
    pub(crate) fn publish(&mut self, topic: &str, content: &[u8]) {
        let Some(publication) = self.publications.get_mut(topic) else {
            return;
        };
        let message: Arc<[u8]> = Arc::from(frame(content));
        publication.used = Some(Instant::now());
        let most = if publication.manner.newest { 1 } else { QUEUE };
        for id in publication.subscribers.keys() {
            self.net.send(*id, Arc::clone(&message), most);
        }
        if publication.manner.latching {
            publication.last = Some(message);
        }
    }

    /// Sends a message to nodes that were lost: now if they are connected again, or else first when they do.
    pub(crate) fn publish_when_back(&mut self, topic: &str, nodes: Vec<String>, content: &[u8]) {
        let Some(publication) = self.publications.get_mut(topic) else {
            return;
        };
        let message: Arc<[u8]> = Arc::from(frame(content));
        for (id, node) in &publication.subscribers {
            if nodes.iter().any(|wanted| **wanted == **node) {
                self.net.send(*id, Arc::clone(&message), QUEUE);
            }
        }
        let is_there = |node: &String| publication.subscribers.values().any(|of| **of == **node);
        let away: Vec<String> = nodes.into_iter().filter(|node| !is_there(node)).collect();
        publication.owed.retain(|(node, _)| !away.contains(node));
        let owed = away.into_iter().map(|node| (node, Arc::clone(&message)));
        publication.owed.extend(owed);
        let surplus = publication.owed.len().saturating_sub(MOST_REMEMBERED);
        publication.owed.drain(..surplus);
    }

    pub(crate) fn on_subscriber_bytes(
        &mut self,
        now: Instant,
        id: ConnectionId,
        mut frames: Frames,
        bytes: &[u8],
    ) -> Option<Role> {
        frames.handle_bytes(bytes);
        let header = match frames.poll_frame(LONGEST_HEADER) {
            Ok(None) => return Some(Role::NewSubscriber(frames)),
            Ok(Some(content)) => Header::parse(content),
            Err(error) => Err(error),
        };
        let accepted = header.map_err(|error| error.to_string());
        match accepted.and_then(|header| self.accept_subscriber(id, &header)) {
            Ok(topic) => {
                self.net.set_deadline(id, None);
                Some(Role::Subscriber(topic))
            }
            Err(error) => {
                tracing::debug!(peer = self.net.peer(id), error, "refused a subscriber");
                let header = Header::new([("error", &error[..])]);
                self.net.send(id, Arc::from(header.encode()), QUEUE);
                self.net.close_when_sent(now, id);
                None
            }
        }
    }

    fn accept_subscriber(&mut self, id: ConnectionId, header: &Header) -> Result<Arc<str>, String> {
        let topic: Arc<str> = Arc::from(header.get("topic"));
        let Some(publication) = self.publications.get_mut(&topic) else {
            return Err(format!("{} does not publish '{topic}'", self.name));
        };
        let (ty, theirs) = (&publication.ty, header.get("md5sum"));
        if !fits(&ty.md5, theirs) {
            let error = format!(
                "{topic} is {} with MD5 sum {}, and not {} with {theirs}",
                ty.name,
                ty.md5,
                header.get("type")
            );
            publication.refuse(header, &error);
            return Err(error);
        }
        let answer = Header::new([
            ("callerid", &self.name[..]),
            ("topic", &topic),
            ("type", &ty.name),
            ("md5sum", &ty.md5),
            ("message_definition", &ty.definition),
            (
                "latching",
                if publication.manner.latching {
                    "1"
                } else {
                    "0"
                },
            ),
        ]);
        if let Some(limit) = publication.manner.limit {
            self.net.limit(id, limit);
        }
        self.net.send(id, Arc::from(answer.encode()), QUEUE);
        let caller = header.get("callerid");
        let owed = publication.owed.iter().position(|(node, _)| node == caller);
        if let Some(index) = owed {
            let (node, message) = publication.owed.swap_remove(index);
            tracing::info!("sends {node} the stop message of {topic} that it has missed");
            self.net.send(id, message, QUEUE);
        }
        if let Some(last) = &publication.last {
            self.net.send(id, Arc::clone(last), QUEUE);
        }
        publication.refused.retain(|(node, _)| node != caller);
        let lost = publication.lost.iter_mut();
        lost.filter(|loss| loss.node == caller)
            .for_each(|loss| loss.is_back = true);
        publication.subscribers.insert(id, Arc::from(caller));
        self.relinked.extend(publication.action.clone());
        Ok(topic)
    }

    pub(crate) fn on_subscriber_closed(&mut self, id: ConnectionId, topic: &str, error: &NetError) {
        let Some(publication) = self.publications.get_mut(topic) else {
            return;
        };
        self.relinked.extend(publication.action.clone());
        let Some(node) = publication.subscribers.remove(&id) else {
            return;
        };
        use NetError::{Broken, Crowded, Silent, Stale};
        if matches!(
            error,
            Silent { .. } | Crowded { .. } | Broken { .. } | Stale { .. }
        ) {
            publication.lose(topic, &node, error);
        }
    }

    /// A task relies on those that are connected.
    pub(crate) fn keep_connections(&mut self, topic: &str) {
        if let Some(publication) = self.publications.get_mut(topic) {
            publication.used = Some(Instant::now());
        }
    }

    /// Who receives a topic.
    pub(crate) fn audience(&mut self, topic: &str) -> Audience {
        let Some(publication) = self.publications.get(topic) else {
            return Audience::default();
        };
        let mut table = unacknowledged::Table::default();
        let others = publication.subscribers.iter();
        let others = others.filter(|(_, node)| !is_ztl(node));
        let listener = |(id, node): (&ConnectionId, &Arc<str>)| Listener {
            node: node.to_string(),
            has_all: self.net.is_settled(*id, &mut table),
        };
        Audience {
            nodes: others.map(listener).collect(),
            lost: publication.lost.clone(),
        }
    }
}

impl Publication {
    fn refuse(&mut self, header: &Header, error: &str) {
        let (node, error) = (shown(header.get("callerid")), shown(error));
        if self
            .refused
            .iter()
            .any(|(known, why)| *known == node && *why == error)
        {
            return;
        }
        self.refused.retain(|(known, _)| *known != node);
        // Who comes under ever new names does not fill the log.
        if self.refused.len() < MOST_REMEMBERED {
            tracing::warn!("refused the subscriber {node}: {error}");
        }
        self.refused.truncate(MOST_REMEMBERED - 1);
        self.refused.push((node, error));
    }

    /// A node was disconnected.
    fn lose(&mut self, topic: &str, node: &str, error: &NetError) {
        let now = Instant::now();
        self.lost.retain(|loss| now < loss.at + REMEMBERED);
        let before = self.lost.iter().find(|loss| loss.node == node);
        // A node that comes and goes does not fill the log, nor do many.
        let is_told = match before {
            Some(before) => now < before.at + TOLD,
            None => self.lost.len() >= MOST_REMEMBERED,
        };
        if !is_told {
            tracing::warn!("disconnected {node} from {topic}: {error}");
        }
        self.lost.retain(|loss| loss.node != node);
        self.lost.truncate(MOST_REMEMBERED - 1);
        self.lost.push(Loss {
            node: node.to_owned(),
            at: now,
            reason: error.to_string(),
            is_back: false,
        });
        // Where the connection was reset, the node's machine most likely knows it.
        let (count, at) = match error {
            NetError::Broken { .. } => (RENEWALS_AFTER_RESET, now + RENEWAL),
            _ => (RENEWALS, now),
        };
        self.renewals = (self.renewals.0.max(count), Some(at));
    }

    /// When to register the topic again, if a node was lost. Others that are connected connect again, too, so it happens only
    /// while nothing is published to them and no task relies on them. A node in C++ connects again at the first time, one in Python after its own end of
    /// the connection has been closed.
    pub(crate) fn renewal(&self) -> Option<Instant> {
        let (left, at) = self.renewals;
        let at = match self.subscribers.is_empty() {
            true => at,
            false => at.max(self.used.map(|used| used + RENEWAL)),
        };
        let is_useful = left > 0 && self.losses().next().is_some();
        is_useful.then_some(at?)
    }

    /// It is not registered any more.
    pub(crate) fn on_unregistered(&mut self, now: Instant) {
        self.registered = false;
        self.renewals = (self.renewals.0.saturating_sub(1), Some(now + RENEWAL));
    }

    /// Nodes that were disconnected and are not connected again.
    fn losses(&self) -> impl Iterator<Item = &Loss> {
        self.lost.iter().filter(|loss| !loss.is_back)
    }

    /// Why a node does not receive the topic, as far as this node knows.
    pub(crate) fn obstacle(&self, node: &str) -> Option<String> {
        let mut refused = self.refused.iter();
        let refused = refused.find(|(known, _)| known == node);
        let refused = refused
            .map(|(node, error)| format!("{node} has another definition of the type: {error}"));
        refused.or_else(|| self.loss(Some(node)).map(Loss::may_return))
    }

    /// A node, or this one, that was disconnected and is not connected again.
    pub(crate) fn loss(&self, node: Option<&str>) -> Option<&Loss> {
        let mut losses = self.losses();
        losses.find(|loss| node.is_none_or(|node| node == loss.node))
    }
}

impl Loss {
    /// The reason, if the node may connect again by itself.
    pub(crate) fn may_return(&self) -> String {
        let Self { node, reason, .. } = self;
        format!(
            "{node} was disconnected: {reason}. It connects again when its network is back, after up to two minutes, or when it \
             is restarted"
        )
    }

    /// The reason, if the master does not name the node as a subscriber.
    pub(crate) fn must_be_restarted(&self) -> String {
        let Self { node, reason, .. } = self;
        format!(
            "{node} was disconnected: {reason}. The ROS master no longer knows that it subscribes: start {node} again, since it \
             has ended, or the master was restarted"
        )
    }
}

/// A text of another node, for messages.
fn shown(text: &str) -> String {
    text.get(..text.floor_char_boundary(LONGEST_SHOWN))
        .unwrap_or_default()
        .to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_that_has_lost_a_node_is_registered_again_only_while_no_task_relies_on_the_others() {
        let mut publication = Publication {
            ty: crate::action::wire::cancel_type(),
            registered: true,
            renewals: (0, None),
            subscribers: BTreeMap::new(),
            manner: Manner::default(),
            used: None,
            last: None,
            owners: 1,
            action: None,
            lost: Vec::new(),
            owed: Vec::new(),
            refused: Vec::new(),
        };
        let peer = "base:1".to_owned();
        publication.lose(
            "/drive",
            "/base",
            &NetError::Broken {
                peer: peer.clone(),
                error: "connection reset by peer".to_owned(),
            },
        );
        let later = Instant::now() + RENEWAL / 2;
        assert!(publication.renewal().is_some_and(|at| at > later));
        publication.lose("/drive", "/base", &NetError::Silent { peer });
        let now = Instant::now();
        assert!(publication.renewal().is_some_and(|at| at <= now));
        publication
            .subscribers
            .insert(ConnectionId::default(), Arc::from("/rosbag"));
        assert!(publication.renewal().is_some_and(|at| at <= now));
        publication.used = Some(now);
        assert_eq!(publication.renewal(), Some(now + RENEWAL));
        publication.lost[0].is_back = true;
        assert_eq!(publication.renewal(), None);
        assert_eq!(publication.loss(None), None);
    }
}
