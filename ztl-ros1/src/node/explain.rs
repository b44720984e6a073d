//! Why a topic of this node is not received.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::engine::Engine;
use super::engine::registrar::uris;
use super::engine::rpc::CallError;
use crate::graph::is_ztl;
use crate::xmlrpc::Value;

/// How long the master and then a node may take to answer.
const LIMIT: Duration = Duration::from_millis(400);

/// Called once with the reason.
pub(crate) type Then = Box<dyn FnOnce(String) + Send>;

/// What is being explained.
struct Question {
    topic: Arc<str>,
    /// The node that should receive it. Without one, any should.
    wanted: Option<String>,
    /// When the answer is due.
    until: Instant,
    then: Then,
}

impl Question {
    fn concerns(&self, node: &str) -> bool {
        self.wanted.as_ref().is_none_or(|wanted| wanted == node)
    }

    fn left(&self, now: Instant) -> Duration {
        self.until.saturating_duration_since(now)
    }
}

impl Engine {
    /// Finds out why nobody, or not this node, receives a topic.
    pub(crate) fn explain_audience(
        &mut self,
        now: Instant,
        topic: Arc<str>,
        wanted: Option<String>,
        then: Then,
    ) {
        let question = Question {
            topic,
            wanted,
            until: now + LIMIT,
            then,
        };
        let params = [self.name[..].into()];
        let master = self.master.clone();
        let found = move |engine: &mut Self, now: Instant, answer| {
            engine.on_state(now, question, answer);
        };
        self.rpc(
            now,
            &master,
            "getSystemState",
            &params,
            LIMIT,
            Box::new(found),
        );
    }

    /// Why nothing is received under a topic, as far as this node knows.
    pub(crate) fn why_silent(&self, topic: &str) -> Option<String> {
        let subscription = self.subscriptions.get(topic)?;
        if let Some(error) = self.registrar.obstacle() {
            return Some(format!(
                "the ROS master {} does not answer: {error}",
                self.master
            ));
        }
        if subscription.has_publishers() {
            return subscription.obstacles().next().map(str::to_owned);
        }
        Some(format!("no node publishes {topic}"))
    }

    /// The master says who subscribes to what.
    fn on_state(&mut self, now: Instant, question: Question, answer: Result<Value, CallError>) {
        let topic = &question.topic;
        let publication = self.publications.get(topic);
        let loss = publication.and_then(|of| of.loss(question.wanted.as_deref()));
        let state = match (answer, loss) {
            (Ok(state), _) => state,
            // The network may be cut.
            (Err(_), Some(loss)) => return (question.then)(loss.may_return()),
            (Err(error), None) => {
                let reason = format!("the ROS master {} does not answer: {error}", self.master);
                return (question.then)(reason);
            }
        };
        let subscribed = state.as_array().and_then(|parts| parts.get(1)?.as_array());
        let mut rows = subscribed.unwrap_or_default().iter();
        let nodes = rows.find_map(|row| match row.as_array()? {
            [name, nodes] => (name.as_str() == Some(topic)).then(|| uris(nodes)),
            _ => None,
        });
        let mut nodes = nodes.unwrap_or_default();
        nodes.retain(|node| !is_ztl(node));
        if let Some(loss) = loss {
            let reason = match nodes.contains(&loss.node) {
                true => loss.may_return(),
                false => loss.must_be_restarted(),
            };
            return (question.then)(reason);
        }
        let mut concerned = nodes.iter().filter(|node| question.concerns(node));
        let known = publication.and_then(|of| concerned.clone().find_map(|node| of.obstacle(node)));
        if let Some(reason) = known {
            return (question.then)(reason);
        }
        let node = concerned.next();
        let reason = match (node, &question.wanted) {
            (Some(node), _) => return self.ask_where(now, question, node.clone()),
            (None, None) => format!("no node subscribes to {topic}"),
            (None, Some(wanted)) if nodes.is_empty() => {
                format!("{wanted} does not subscribe to {topic}, and no other node does")
            }
            (None, Some(wanted)) => {
                format!(
                    "{wanted} does not subscribe to {topic}; there are: {}",
                    nodes.join(", ")
                )
            }
        };
        (question.then)(reason);
    }

    /// Asks a node that subscribes, and is not connected, whether it lives.
    fn ask_where(&mut self, now: Instant, question: Question, node: String) {
        let params = [self.name[..].into(), node[..].into()];
        let master = self.master.clone();
        let left = question.left(now);
        let found = move |engine: &mut Self, now: Instant, answer: Result<Value, CallError>| {
            let uri = answer.ok().and_then(|uri| uri.as_str().map(str::to_owned));
            let Some(uri) = uri else {
                let topic = &question.topic;
                let reason = format!(
                    "{node} subscribes to {topic}, but the ROS master does not know where it is"
                );
                return (question.then)(reason);
            };
            let params = [engine.name[..].into()];
            let left = question.left(now);
            let answered = move |engine: &mut Self,
                                 _: Instant,
                                 answer: Result<Value, CallError>| {
                let topic = &question.topic;
                let reason = match answer {
                    Err(error) => {
                        format!("{node} subscribes to {topic}, but cannot be reached: {error}")
                    }
                    Ok(_) if engine.net.is_full() => format!(
                        "{node} subscribes to {topic}, but cannot connect: others hold too many connections to this node open"
                    ),
                    Ok(_) => format!(
                        "{node} subscribes to {topic}, but has not connected: can it resolve '{}', the host name of this \
                         node? Set ROS_HOSTNAME or ROS_IP, or `host`, to what it can reach",
                        engine.host
                    ),
                };
                (question.then)(reason);
            };
            engine.rpc(now, &uri, "getPid", &params, left, Box::new(answered));
        };
        self.rpc(now, &master, "lookupNode", &params, left, Box::new(found));
    }
}
