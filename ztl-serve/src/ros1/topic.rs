//! `ros1-topic`: the messages of a topic as a stream.

use std::sync::Arc;

use ztl_ros1::Pace;
use ztl_ros1::message::{MessageType, Value};
use ztl_yaml::{Fields, Node};

use super::connection::{Connection, wire};
use super::shown::has;
use super::used_name::UsedType;
use crate::kind::{Job, JobContext};
use crate::reader::ConfigReader;
use crate::stream::received::{Inbox, MOST, ReceivingJob};
use crate::stream::splitter::Framing;

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
        let (name, message) = self.ros1_typed_name(
            node,
            fields,
            "/joint_states",
            example,
            |ty: &Arc<MessageType>| UsedType::received(ty),
        );
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
    /// The job that receives it.
    pub(crate) fn job(self: &Arc<Self>, context: JobContext) -> Box<dyn Job> {
        let (node, wire) = (self.connection.node(), wire(&self.message));
        let subscribe = |inbox: Inbox| {
            let (name, mut is_told) = (self.name.clone(), false);
            let on_message = move |_: &str, bytes: &[u8]| {
                let found = bytes.len();
                if found < MOST {
                    inbox.push(bytes.to_vec());
                } else if !std::mem::replace(&mut is_told, true) {
                    let most = MOST >> 20;
                    tracing::warn!(
                        "messages of {name} are not published: one has {found} bytes, and a stream takes {most} MiB"
                    );
                }
            };
            let subscription = node?.subscribe(&self.name, wire, Pace::Irregular, on_message);
            subscription.map_err(|error| error.to_string())
        };
        let topic = Arc::clone(self);
        let output = move |message: Vec<u8>| topic.output(&message);
        Box::new(ReceivingJob::new(context, subscribe, output))
    }

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
