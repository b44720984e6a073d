//! Texts with parts of a received message: `"{feedback.error.positions.0} rad away"`.

use std::sync::Arc;

use ztl_core::goal;
use ztl_ros1::message::{Count, Element, MessageType, Value};
use ztl_yaml::{Node, closest};

use crate::reader::ConfigReader;

/// A text with parts of a message.
#[derive(Debug, Clone)]
pub(crate) struct ShownMessage {
    message: Arc<MessageType>,
    /// A text, and the path of what follows it.
    parts: Vec<(String, Option<String>)>,
}

impl ShownMessage {
    /// The whole message, as the original writes values.
    pub(crate) fn whole(message: &Arc<MessageType>) -> Self {
        Self {
            message: Arc::clone(message),
            parts: vec![(String::new(), Some(String::new()))],
        }
    }

    /// The text for a received message, or why the bytes are not a message of the type.
    pub(crate) fn text(&self, bytes: &[u8]) -> Result<String, String> {
        let value = self.message.decode(bytes);
        let value = value.map_err(|error| format!("malformed {}: {error}", self.message.name()))?;
        let mut text = String::new();
        for (plain, path) in &self.parts {
            text.push_str(plain);
            let Some(path) = path else { continue };
            let part = match path.as_str() {
                "" => Some(&value),
                path => value.at(path),
            };
            // An array may be shorter than expected.
            match part {
                Some(part) => text.push_str(&to_text(part)),
                None => text.push_str("None"),
            }
        }
        Ok(bounded(text))
    }
}

/// The longest result or progress. An answer to a client has at most 1 MiB.
const LONGEST: usize = 1000 << 10;

/// Cuts a text that is too long for an answer, and says so.
pub(super) fn bounded(mut text: String) -> String {
    let found = text.len();
    if found > LONGEST {
        text.truncate(text.floor_char_boundary(LONGEST));
        text.push_str(&format!(
            " … (cut at {} KiB; the whole has {found} bytes)",
            LONGEST >> 10
        ));
    }
    text
}

/// The text of a value, as the original writes values.
pub(super) fn to_text(value: &Value) -> String {
    if let Value::Message(fields) = value
        && fields.is_empty()
    {
        return "None".to_owned();
    }
    let mut bytes = Vec::new();
    match goal::to_sink(value, &mut |part: &[u8]| bytes.extend_from_slice(part)) {
        Ok(()) => String::from_utf8_lossy(&bytes).into_owned(),
        // The original's values have fewer levels than messages may have.
        Err(_) => serde_json::to_string(value).unwrap_or_default(),
    }
}

impl<'d> ConfigReader<'d> {
    /// Reads a text with parts of a message, which `word` stands for.
    pub(crate) fn shown_message(
        &mut self,
        node: &'d Node,
        word: &str,
        message: &Arc<MessageType>,
    ) -> Option<ShownMessage> {
        let what = format!("a text with parts of the {word}, as '{{{word}.x}}'");
        let mut rest = self.yaml.text(node, &what)?;
        let mut parts = Vec::new();
        while let Some((plain, inner)) = rest.split_once('{') {
            let Some((placeholder, after)) = inner.split_once('}') else {
                break;
            };
            let path = placeholder
                .strip_prefix(word)
                .filter(|path| path.is_empty() || path.starts_with('.'));
            let Some(path) = path else {
                let mistake = format!(
                    "unknown placeholder '{{{placeholder}}}'; write '{{{word}}}' or '{{{word}.x}}'"
                );
                self.yaml.wrong(node, mistake);
                return None;
            };
            let path = path.trim_start_matches('.');
            if let Err(mistake) = has(message, path) {
                self.yaml.wrong(node, mistake);
                return None;
            }
            parts.push((plain.to_owned(), Some(path.to_owned())));
            rest = after;
        }
        parts.push((rest.to_owned(), None));
        Some(ShownMessage {
            message: Arc::clone(message),
            parts,
        })
    }
}

/// Whether messages of this type may have a value at this path.
pub(super) fn has(message: &MessageType, path: &str) -> Result<(), String> {
    let (mut message, mut parts) = (
        message,
        path.split('.').filter(|part| !part.is_empty()).peekable(),
    );
    while let Some(part) = parts.next() {
        let Some(field) = message.field(part) else {
            let fields = message.fields().iter().map(|field| &*field.name);
            let help = match closest(part, fields.clone()) {
                Some(field) => format!("did you mean '{field}'?"),
                None if message.fields().is_empty() => "it has no fields".to_owned(),
                None => format!("there are: {}", fields.collect::<Vec<_>>().join(", ")),
            };
            return Err(format!("{} has no field '{part}'; {help}", message.name()));
        };
        if field.count != Count::One
            && let Some(index) = parts.next()
            && index.parse::<usize>().is_err()
        {
            return Err(format!(
                "'{index}' is not an index of {part}, which is {field}"
            ));
        }
        match &field.element {
            Element::Message(inner) => message = inner,
            Element::Primitive(primitive) => {
                return match parts.next() {
                    Some(part) => Err(format!(
                        "{} has no parts, such as '{part}'",
                        primitive.name()
                    )),
                    None => Ok(()),
                };
            }
        }
    }
    Ok(())
}
