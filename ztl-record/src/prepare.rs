//! From a published message to a stored one.

use std::collections::BTreeMap;

use ztl_pickle::{Error, Kind, Pickle, Value};

use crate::form::{Form, Image, Sound, Stamp, Text, to_base64};
use crate::plain::is_plain;
use crate::task::{TASKS, TaskEvent};

/// How a JPEG begins.
const JPEG: [u8; 3] = [0xff, 0xd8, 0xff];
/// Longest JSON of a value in bytes; a longer value is stored as its pickle alone.
const LONGEST: usize = 64 * 1024;
/// Fields of a value that tell when it was made, in seconds since 1970.
const TIMES: [&str; 3] = ["time", "stamp", "timestamp"];

/// The format of a stream of sound: signed 16-bit samples, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SoundFormat {
    /// Samples a second of each channel.
    pub rate: u32,
    /// How many channels take turns in the samples.
    pub channels: u32,
}

/// How streams are stored that do not say it themselves.
#[derive(Debug, Clone, Default)]
pub struct Formats {
    sounds: BTreeMap<String, SoundFormat>,
}

/// A message that is ready to be written.
#[derive(Debug, Clone)]
pub struct Message {
    pub(crate) topic: String,
    pub(crate) form: Form,
    /// Whether bytes were published in a pickle.
    pub(crate) pickled: bool,
    pub(crate) data: Data,
    /// When it was made, in nanoseconds since 1970, if it says so.
    pub(crate) made: Option<u64>,
}

/// What is stored. Images and sound get their time when they are written.
#[derive(Debug, Clone)]
pub(crate) enum Data {
    Ready(Vec<u8>),
    Image(Vec<u8>),
    Sound(SoundFormat, Vec<u8>),
}

impl Data {
    /// The bytes for the file.
    pub(crate) fn into_bytes(self, at: u64) -> std::io::Result<Vec<u8>> {
        let timestamp = Stamp::of(at);
        Ok(match self {
            Self::Ready(bytes) => bytes,
            Self::Image(bytes) => serde_json::to_vec(&Image {
                timestamp,
                frame_id: String::new(),
                format: "jpeg".to_owned(),
                data: to_base64(&bytes),
            })?,
            Self::Sound(SoundFormat { rate, channels }, bytes) => serde_json::to_vec(&Sound {
                timestamp,
                format: "pcm-s16".to_owned(),
                sample_rate: rate,
                number_of_channels: channels,
                data: to_base64(&bytes),
            })?,
        })
    }
}

impl Formats {
    /// Says that the bytes of a topic are sound.
    pub fn set_sound(&mut self, topic: &str, format: SoundFormat) {
        self.sounds.insert(topic.to_owned(), format);
    }

    /// Prepares a message: finds out what it contains.
    ///
    /// # Errors
    /// If it is a pickle that could run code or exceeds a limit. Other bytes that are not a pickle are stored as text or
    /// bytes.
    pub fn prepare(&self, topic: &str, body: &[u8]) -> Result<Message, Error> {
        match Pickle::read(body) {
            Ok(pickle) => self.pickled(topic, body, pickle.value()),
            Err(error @ (Error::Refused(_) | Error::TooLarge { .. })) => Err(error),
            Err(_) => Ok(self.raw(topic, body)),
        }
    }

    fn pickled(&self, topic: &str, body: &[u8], value: Value<'_>) -> Result<Message, Error> {
        if let Kind::Bytes(bytes) = value.kind() {
            return Ok(self.bytes(topic, bytes, true));
        }
        let json = value.to_json(LONGEST).ok();
        let is_plain = json.is_some() && is_plain(value);
        let made = TIMES
            .iter()
            .find_map(|name| value.get(name)?.as_f64())
            .and_then(nanoseconds);
        let message = |topic: &str, form, data| Message {
            topic: topic.to_owned(),
            form,
            pickled: true,
            data: Data::Ready(data),
            made,
        };
        if let (Some(json), true) = (&json, is_plain)
            && let Some(scope) = scope_of_event(topic, json)
        {
            let topic = format!("{scope}{}", TASKS.trim_end_matches('/'));
            return Ok(message(&topic, Form::Task, json.clone().into_bytes()));
        }
        let data = match (json, is_plain) {
            (Some(json), true) => format!("{{\"value\":{json}}}"),
            (Some(json), false) => {
                format!("{{\"value\":{json},\"pickle\":\"{}\"}}", to_base64(body))
            }
            (None, _) => format!("{{\"pickle\":\"{}\"}}", to_base64(body)),
        };
        Ok(message(topic, Form::Value, data.into_bytes()))
    }

    fn raw(&self, topic: &str, body: &[u8]) -> Message {
        let is_data = body.starts_with(&JPEG) || self.sounds.contains_key(topic);
        match str::from_utf8(body) {
            Ok(text) if !is_data => {
                let text = Text {
                    text: text.to_owned(),
                };
                Message {
                    topic: topic.to_owned(),
                    form: Form::Text,
                    pickled: false,
                    // A struct with one text always has JSON.
                    data: Data::Ready(serde_json::to_vec(&text).unwrap_or_default()),
                    made: None,
                }
            }
            _ => self.bytes(topic, body, false),
        }
    }

    fn bytes(&self, topic: &str, bytes: &[u8], pickled: bool) -> Message {
        let bytes = bytes.to_vec();
        let (form, data) = match self.sounds.get(topic) {
            Some(format) => (Form::Sound, Data::Sound(*format, bytes)),
            None if bytes.starts_with(&JPEG) => (Form::Image, Data::Image(bytes)),
            None => (Form::Bytes, Data::Ready(bytes)),
        };
        Message {
            topic: topic.to_owned(),
            form,
            pickled,
            data,
            made: None,
        }
    }
}

/// The scope of a task event, if the message is one: the topic ends with the id in the value.
fn scope_of_event<'a>(topic: &'a str, json: &str) -> Option<&'a str> {
    let (scope, id) = topic.rsplit_once(TASKS)?;
    let event = TaskEvent::read(scope, &serde_json::from_str(json).ok()?)?;
    (event.id == id).then_some(scope)
}

/// Seconds since 1970 in nanoseconds.
fn nanoseconds(seconds: f64) -> Option<u64> {
    let time = std::time::Duration::try_from_secs_f64(seconds).ok()?;
    u64::try_from(time.as_nanos()).ok()
}
