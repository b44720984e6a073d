//! The topics of the socket, each with its newest value.

use axum::extract::ws::Utf8Bytes;
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::rosbridge;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Topic {
    Robots,
    Tasks,
    Stop,
    Show,
}

impl Topic {
    /// The topic with this name.
    ///
    /// # Errors
    /// If no topic has this name.
    pub(crate) fn of(name: &str) -> Result<Self, String> {
        match name {
            "/ztl/robots" => Ok(Self::Robots),
            "/ztl/tasks" => Ok(Self::Tasks),
            "/ztl/stop" => Ok(Self::Stop),
            "/ztl/show" => Ok(Self::Show),
            _ => Err(format!(
                "no topic '{name}': there are /ztl/robots, /ztl/tasks, /ztl/stop, /ztl/show, /ztl/streams/PUBLISHER and /ztl/streams/PUBLISHER/TOPIC"
            )),
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Robots => "/ztl/robots",
            Self::Tasks => "/ztl/tasks",
            Self::Stop => "/ztl/stop",
            Self::Show => "/ztl/show",
        }
    }
}

/// The newest value of each topic, as the message that tells it: written once for all sockets. Empty until there is one.
#[derive(Default)]
pub(crate) struct Topics {
    robots: watch::Sender<Utf8Bytes>,
    tasks: watch::Sender<Utf8Bytes>,
    stop: watch::Sender<Utf8Bytes>,
    show: watch::Sender<Utf8Bytes>,
}

impl Topics {
    const fn sender(&self, topic: Topic) -> &watch::Sender<Utf8Bytes> {
        match topic {
            Topic::Robots => &self.robots,
            Topic::Tasks => &self.tasks,
            Topic::Stop => &self.stop,
            Topic::Show => &self.show,
        }
    }

    /// Replaces the value of a topic. An equal value wakes no socket.
    pub(crate) fn set(&self, topic: Topic, value: &Value) {
        let message = rosbridge::publish(topic.name(), &value.to_string());
        self.sender(topic).send_if_modified(|known| {
            let changed = known.as_str() != message;
            if changed {
                *known = message.into();
            }
            changed
        });
    }

    /// The messages that tell the values of a topic.
    pub(crate) fn subscribe(&self, topic: Topic) -> watch::Receiver<Utf8Bytes> {
        self.sender(topic).subscribe()
    }

    /// The newest value of a topic; empty if there is none.
    ///
    /// # Errors
    /// If the value is no JSON.
    pub(crate) fn newest(&self, topic: Topic) -> Result<Value, String> {
        let message = self.sender(topic).borrow().clone();
        if message.is_empty() {
            return Ok(json!({}));
        }
        let message: Value = serde_json::from_str(&message).map_err(|error| error.to_string())?;
        Ok(message.get("msg").cloned().unwrap_or_default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_written_once_for_all_sockets_and_only_if_it_has_changed() {
        let topics = Topics::default();
        let [mut one, other] = [(); 2].map(|()| topics.subscribe(Topic::Stop));
        assert_eq!(topics.newest(Topic::Stop), Ok(json!({})));
        topics.set(Topic::Stop, &json!({ "by": "x" }));
        let message = one.borrow_and_update().clone();
        assert_eq!(
            message.as_str(),
            r#"{"op":"publish","topic":"/ztl/stop","msg":{"by":"x"}}"#
        );
        assert_eq!(message.as_str().as_ptr(), other.borrow().as_str().as_ptr());
        topics.set(Topic::Stop, &json!({ "by": "x" }));
        assert_eq!(one.has_changed().ok(), Some(false));
        assert_eq!(topics.newest(Topic::Stop), Ok(json!({ "by": "x" })));
    }
}
