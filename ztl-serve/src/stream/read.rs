//! Reads the streams of a file.

use std::collections::BTreeMap;
use std::sync::Arc;

use ztl_std::scope;
use ztl_std::server::bytes;
use ztl_yaml::Node;

use super::splitter::Framing;
use super::{Origin, StreamConfig};
use crate::program;
use crate::reader::ConfigReader;

/// The longest frame, where the file does not say it.
const LONGEST: usize = 4 << 20;
/// The most that it may say: as text, this is what the publisher's queue takes.
const MOST: usize = 16 << 20;

const FRAMINGS: [(&str, Framing); 4] = [
    ("line", Framing::Line),
    ("json", Framing::Json),
    ("jpeg", Framing::Jpeg),
    ("length", Framing::Length),
];

/// Why streams cannot have this scope, which can be served; `None` if they can. Topics with `$` are the server's own,
/// such as events of tasks.
pub(crate) fn cannot_have_streams(scope: &str) -> Option<String> {
    let mut parts = scope.strip_prefix('/').unwrap_or(scope).split('/');
    let wrong = match parts.find(|part| part.is_empty() || part.starts_with('$'))? {
        "" => "contains an empty part",
        _ => "contains a part that begins with '$', as only the server's own topics do",
    };
    Some(format!(
        "the scope '{scope}' {wrong}, so it cannot have streams; write it as /lab"
    ))
}

impl<'d> ConfigReader<'d> {
    /// Reads all streams, by their scopes.
    pub(crate) fn streams(&mut self, node: &'d Node) -> Vec<Arc<StreamConfig>> {
        let mut streams = Vec::new();
        let mut topics: BTreeMap<String, &Node> = BTreeMap::new();
        for (scope, node) in self.non_empty(node, "scopes, as /robot") {
            let scope_node = scope;
            let scope = self.scope_name(scope);
            if let Some(mistake) = scope.as_deref().and_then(cannot_have_streams) {
                self.yaml.wrong(scope_node, mistake);
            }
            for (name, node) in self.non_empty(node, "its streams") {
                let path = self.stream_name(name);
                if let (Some(scope), Some(path)) = (&scope, &path) {
                    let topic = format!("{scope}{path}");
                    if let Some(first) = topics.get(&topic) {
                        let (file, at) = (self.document.name(), first.span.start);
                        let message = format!(
                            "the stream at {file}:{}:{} has the same topic, {topic}; rename one of them",
                            at.line, at.column
                        );
                        self.yaml.wrong(name, message);
                    } else {
                        topics.insert(topic, name);
                    }
                }
                if let Some(stream) = self.stream(node, scope.as_deref(), path) {
                    streams.push(Arc::new(stream));
                }
            }
        }
        streams
    }

    /// The name of a scope.
    pub(crate) fn scope_name(&mut self, node: &'d Node) -> Option<String> {
        self.yaml.parsed(node, "a scope, as /robot", |text| {
            scope::cannot_be_served(text).map_or_else(|| Ok(text.to_owned()), Err)
        })
    }

    /// The name of a stream, as it follows the scope in the topic.
    fn stream_name(&mut self, node: &'d Node) -> Option<String> {
        self.yaml.parsed(node, "a stream, as microphone", |text| {
            let is_odd = |part: &str| part.is_empty() || part.starts_with('$');
            match text.split('/').any(is_odd) || text.contains(char::is_control) {
                true => Err(format!(
                    "invalid name '{text}' for a stream; write it as microphone or arm/left"
                )),
                false => Ok(format!("/{text}")),
            }
        })
    }

    fn stream(
        &mut self,
        node: &'d Node,
        scope: Option<&str>,
        path: Option<String>,
    ) -> Option<StreamConfig> {
        let mut fields = self
            .yaml
            .fields(node, "run: [PROGRAM, ARGUMENT], frame: line")?;
        let topic_node = fields.optional("ros1-topic");
        let signals = ["naoqi-event", "naoqi-signal"].map(|key| Some((key, fields.optional(key)?)));
        let event_node = fields.optional("http-event");
        let mut messages = signals
            .iter()
            .flatten()
            .map(|(_, node)| *node)
            .chain(topic_node)
            .chain(event_node);
        let message_node = messages.next();
        if let Some(second) = messages.next() {
            let message = "give only one of: ros1-topic, naoqi-event, naoqi-signal, http-event";
            self.yaml.wrong(second, message);
        }
        let frame = match fields.has_one_of(&["run", "shell"]) {
            true => fields.required("frame", "frame: line"),
            false => fields.optional("frame"),
        };
        let framing = frame.and_then(|node| self.framing(node));
        if let (Some(_), Some(node)) = (message_node, frame) {
            let message = "each message is a frame; leave this out";
            self.yaml.wrong(node, message);
        }
        let longest_node = fields.optional("longest");
        let longest = longest_node.and_then(|node| self.frame_size(node));
        if let (Some(node), Some(Framing::Fixed(_))) = (longest_node, framing) {
            let message = "each frame has the same length; leave this out";
            self.yaml.wrong(node, message);
        }
        let latest = fields.optional("latest");
        let latest = latest.and_then(|node| self.yaml.truth(node));
        let rate = fields.optional("rate");
        let interval = rate.and_then(|node| self.rate(node));
        let when_watched = fields.optional("when-watched");
        let why = "subscribers that come and go would start the program too often";
        let when_watched = when_watched.and_then(|node| self.at_least(node, 1, why));
        let signal = signals.into_iter().flatten().next();
        let origin = match (topic_node, signal, event_node) {
            (Some(node), ..) => self
                .ros1_topic(node, &mut fields)
                .map(Arc::new)
                .map(Origin::Topic),
            (None, Some((key, node)), _) => self
                .naoqi_signal(key, node)
                .map(Arc::new)
                .map(Origin::Signal),
            (None, None, Some(node)) => self
                .http_event(node, &mut fields)
                .map(Arc::new)
                .map(Origin::Event),
            (None, None, None) => {
                let program = program::read::read_stream(self, &mut fields);
                program.map(Arc::new).map(Origin::Program)
            }
        };
        let framing = match &origin {
            Some(Origin::Topic(topic)) => Some(topic.framing()),
            Some(Origin::Signal(_) | Origin::Event(_)) => Some(Framing::Json),
            _ => framing,
        };
        fields.finish(&mut self.yaml);
        Some(StreamConfig {
            scope: scope?.to_owned(),
            path: path?,
            origin: origin?,
            framing: framing?,
            longest: longest.unwrap_or(LONGEST),
            latest: latest.unwrap_or_default(),
            interval,
            when_watched,
        })
    }

    fn framing(&mut self, node: &'d Node) -> Option<Framing> {
        let what = "line, json, jpeg, length, or a size, as 3200 bytes";
        let text = self.yaml.text(node, what)?;
        match text.starts_with(|c: char| c.is_ascii_digit()) {
            true => self.frame_size(node).map(Framing::Fixed),
            false => self.yaml.one_of(node, &FRAMINGS),
        }
    }

    fn frame_size(&mut self, node: &'d Node) -> Option<usize> {
        let what = "a size from 1 byte to 16 MiB, as 3200 bytes";
        self.yaml.parsed(node, what, |text| {
            let size = bytes(text).filter(|size| (1..=MOST).contains(size));
            size.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }
}
