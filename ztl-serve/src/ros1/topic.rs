//! `ros1-topic`: the messages of a topic as a stream.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use ztl_ros1::Subscription;
use ztl_ros1::message::{MessageType, Value};
use ztl_yaml::{Fields, Node};

use super::connection::{Connection, wire};
use super::shown::has;
use crate::kind::{Effect, Job, JobContext, Outcome, StopReason};
use crate::reader::ConfigReader;
use crate::stream::splitter::Framing;
use crate::stream::waiting::Waiting;

/// A topic of a robot.
#[derive(Debug)]
pub(crate) struct Topic {
    connection: Arc<Connection>,
    name: String,
    message: Arc<MessageType>,
    /// The path of what is published; empty for the whole message.
    field: String,
    framing: Framing,
}

impl<'d> ConfigReader<'d> {
    /// Reads a topic as a stream: its name, `type` and `field`.
    pub(crate) fn ros1_topic(&mut self, node: &'d Node, fields: &mut Fields<'d>) -> Option<Topic> {
        let example = "type: sensor_msgs/JointState";
        let (name, message) =
            self.ros1_typed_name::<Arc<MessageType>>(node, fields, "/joint_states", example);
        let field = fields.optional("field");
        let path = field.and_then(|node| self.yaml.text(node, "a field, as data"));
        let message = message?;
        if let (Some(node), Some(path)) = (field, path)
            && let Err(mistake) = has(&message, path)
        {
            self.yaml.wrong(node, mistake);
        }
        let path = path.unwrap_or_default();
        // Such as the image in a CompressedImage.
        let is_bytes = matches!(message.zero().at(path), Some(Value::Bytes(_)));
        Some(Topic {
            connection: Arc::clone(&self.ros1.connection),
            name: name?,
            message,
            field: path.to_owned(),
            framing: match is_bytes {
                true => Framing::Length,
                false => Framing::Json,
            },
        })
    }
}

impl Topic {
    /// How the output of its job is split.
    pub(crate) const fn framing(&self) -> Framing {
        self.framing
    }

    /// The output for a message, as a frame; nothing if the message lacks the field.
    fn output(&self, bytes: &[u8]) -> Vec<u8> {
        let Ok(value) = self.message.decode(bytes) else {
            // Its type has the same md5 sum, so this happens only to damaged messages.
            return Vec::new();
        };
        let part = match self.field.as_str() {
            "" => Some(&value),
            path => value.at(path),
        };
        match (self.framing, part) {
            (Framing::Length, Some(Value::Bytes(bytes))) => {
                let length = u32::try_from(bytes.len()).unwrap_or_default();
                [&length.to_be_bytes(), bytes.as_slice()].concat()
            }
            (Framing::Json, Some(part)) => {
                let mut line = serde_json::to_vec(part).unwrap_or_default();
                line.push(b'\n');
                line
            }
            _ => Vec::new(),
        }
    }
}

/// A subscription for a stream.
pub(crate) struct TopicJob {
    topic: Arc<Topic>,
    waiting: Arc<Mutex<Waiting>>,
    /// `Err`: why there is no value.
    subscription: Result<Subscription, String>,
    is_accepted: bool,
}

impl TopicJob {
    pub(crate) fn new(topic: &Arc<Topic>, context: JobContext) -> Self {
        let waiting = Arc::new(Mutex::new(Waiting::default()));
        let shared = Arc::clone(&waiting);
        let subscription = topic.connection.node().and_then(|node| {
            let on_message = move |_: &str, bytes: &[u8]| {
                let mut waiting = shared.lock().unwrap_or_else(PoisonError::into_inner);
                if waiting.push(bytes.to_vec()) {
                    context.mailbox.wake();
                }
            };
            let subscription = node.subscribe(&topic.name, wire(&topic.message), on_message);
            subscription.map_err(|error| error.to_string())
        });
        Self {
            topic: Arc::clone(topic),
            waiting,
            subscription,
            is_accepted: false,
        }
    }
}

impl Job for TopicJob {
    fn stop(&mut self, _: Instant, _: StopReason, effects: &mut Vec<Effect>) {
        effects.push(Effect::End(Outcome::Aborted(String::new())));
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let is_due = !self.is_accepted || self.subscription.is_err();
        is_due.then(Instant::now)
    }

    fn handle_timeout(&mut self, _: Instant, effects: &mut Vec<Effect>) {
        if !std::mem::replace(&mut self.is_accepted, true) {
            effects.push(Effect::Accept);
        }
        if let Err(reason) = &self.subscription {
            return effects.push(Effect::End(Outcome::Failed(reason.clone())));
        }
        let waiting = self.waiting.lock();
        let messages = waiting.unwrap_or_else(PoisonError::into_inner).take();
        for message in messages {
            effects.push(Effect::Output(self.topic.output(&message)));
        }
    }
}
