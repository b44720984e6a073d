//! Streams: programs whose output is published, frame by frame, topics of ROS 1, signals of NAOqi, and events over HTTP.

mod outlet;
pub(crate) mod read;
pub(crate) mod received;
mod source;
pub(crate) mod splitter;
mod worker;

use std::sync::Arc;
use std::time::Duration;

pub use worker::Streams;

use crate::http::stream::EventStream;
use crate::naoqi::signal::Signal;
use crate::program::settings::Program;
use crate::ros1::topic::Topic;
use splitter::Framing;

/// A stream as the file describes it.
#[derive(Debug, Clone)]
pub(crate) struct StreamConfig {
    pub(crate) scope: String,
    /// What follows the scope in the topic, as `/microphone`.
    pub(crate) path: String,
    pub(crate) origin: Origin,
    pub(crate) framing: Framing,
    /// Most bytes of a frame.
    pub(crate) longest: usize,
    /// Whether only the newest frame counts.
    pub(crate) latest: bool,
    /// The shortest time between two frames.
    pub(crate) interval: Option<Duration>,
    /// The program runs only while anyone subscribes, and for this time after that.
    pub(crate) when_watched: Option<Duration>,
}

/// What writes a stream.
#[derive(Debug, Clone)]
pub(crate) enum Origin {
    Program(Arc<Program>),
    /// A topic of ROS 1.
    Topic(Arc<Topic>),
    /// A signal of NAOqi.
    Signal(Arc<Signal>),
    /// Events over a WebSocket, or Server-Sent Events.
    Event(Arc<EventStream>),
}

impl StreamConfig {
    pub(crate) fn topic(&self) -> String {
        format!("{}{}", self.scope, self.path)
    }
}
