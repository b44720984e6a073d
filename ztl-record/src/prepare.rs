//! From a published message to a stored one.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{SystemTime, UNIX_EPOCH};

use ztl_pickle::{Error, Kind, Pickle, Value};

use crate::form::{Form, Image, Sound, Stamp, ZtlText, to_base64};
use crate::plain::is_plain;
use crate::source::Source;
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

impl SoundFormat {
    /// How long so many bytes last, in nanoseconds.
    pub(crate) fn length(self, bytes: usize) -> u64 {
        let frame = 2 * u64::from(self.channels.max(1));
        let frames = bytes as u64 / frame;
        frames.saturating_mul(1_000_000_000) / u64::from(self.rate.max(1))
    }
}

/// The topic of the events of a run.
pub const RUN: &str = "/$run";

/// How streams are stored that do not say it themselves.
#[derive(Debug, Clone, Default)]
pub struct Formats {
    sounds: BTreeMap<String, SoundFormat>,
    /// The addresses of those who tell of the tasks of a scope.
    tellers: BTreeMap<String, BTreeSet<String>>,
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
    /// Whether it looks like an event of a task that its publisher may not tell of.
    is_foreign_event: bool,
}

impl Message {
    /// An event of a run: its JSON, and the wall clock.
    #[must_use]
    pub fn of_run(json: Vec<u8>, wall: SystemTime) -> Self {
        let made = wall.duration_since(UNIX_EPOCH).ok();
        Self {
            topic: RUN.to_owned(),
            form: Form::Run,
            pickled: false,
            data: Data::Ready(json),
            made: made.and_then(|made| u64::try_from(made.as_nanos()).ok()),
            is_foreign_event: false,
        }
    }

    /// Whether it is stored as a value though it looks like an event of a task, since its publisher is not the one of
    /// the task's server ([`Formats::set_teller`]).
    #[must_use]
    pub const fn is_foreign_event(&self) -> bool {
        self.is_foreign_event
    }
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
        Ok(match self {
            Self::Ready(bytes) => bytes,
            Self::Image(bytes) => serde_json::to_vec(&Image {
                timestamp: Stamp::of(at),
                frame_id: String::new(),
                format: "jpeg".to_owned(),
                data: to_base64(&bytes),
            })?,
            Self::Sound(format, bytes) => serde_json::to_vec(&Sound {
                timestamp: Stamp::of(at.saturating_sub(format.length(bytes.len()))),
                format: "pcm-s16".to_owned(),
                sample_rate: format.rate,
                number_of_channels: format.channels,
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

    /// Says that the publisher with this address tells of the tasks of a scope. If any is known for a scope, only those
    /// are believed.
    pub fn set_teller(&mut self, scope: &str, endpoint: &str) {
        let tellers = self.tellers.entry(scope.to_owned()).or_default();
        tellers.insert(endpoint.to_owned());
    }

    /// Whether a publisher is believed when it tells of the tasks of a scope.
    fn may_tell(&self, source: &Source, scope: &str) -> bool {
        let tellers = self.tellers.get(scope);
        tellers.is_none_or(|tellers| tellers.contains(&source.endpoint))
    }

    /// Prepares a message: finds out what it contains.
    ///
    /// # Errors
    /// If it is a pickle that could run code or exceeds a limit. Other bytes that are not a pickle are stored as text or
    /// bytes.
    pub fn prepare(&self, source: &Source, topic: &str, body: &[u8]) -> Result<Message, Error> {
        match Pickle::read(body) {
            Ok(pickle) => self.pickled(source, topic, body, pickle.value()),
            Err(error @ (Error::Refused(_) | Error::TooLarge { .. })) => Err(error),
            Err(_) => Ok(self.raw(topic, body)),
        }
    }

    fn pickled(
        &self,
        source: &Source,
        topic: &str,
        body: &[u8],
        value: Value<'_>,
    ) -> Result<Message, Error> {
        if let Kind::Bytes(bytes) = value.kind() {
            return Ok(self.bytes(topic, bytes, true));
        }
        let json = value.to_json(LONGEST).ok();
        let is_plain = json.is_some() && is_plain(value);
        let made = TIMES
            .iter()
            .find_map(|name| value.get(name)?.as_f64())
            .and_then(nanoseconds);
        let message = |topic: String, form, data| Message {
            topic,
            form,
            pickled: true,
            data: Data::Ready(data),
            made,
            is_foreign_event: false,
        };
        let scope = match &json {
            Some(json) if is_plain => scope_of_event(topic, json),
            _ => None,
        };
        if let (Some(scope), Some(json)) = (scope, &json)
            && self.may_tell(source, scope)
        {
            let topic = format!("{scope}{}", TASKS.trim_end_matches('/'));
            return Ok(message(topic, Form::Task, json.clone().into_bytes()));
        }
        let data = match (json, is_plain) {
            (Some(json), true) => format!("{{\"value\":{json}}}"),
            (Some(json), false) => {
                format!("{{\"value\":{json},\"pickle\":\"{}\"}}", to_base64(body))
            }
            (None, _) => format!("{{\"pickle\":\"{}\"}}", to_base64(body)),
        };
        Ok(Message {
            is_foreign_event: scope.is_some(),
            ..message(topic.to_owned(), Form::Value, data.into_bytes())
        })
    }

    fn raw(&self, topic: &str, body: &[u8]) -> Message {
        let is_data = body.starts_with(&JPEG) || self.sounds.contains_key(topic);
        match str::from_utf8(body) {
            Ok(text) if !is_data => {
                let text = ZtlText {
                    text: text.to_owned(),
                };
                Message {
                    topic: topic.to_owned(),
                    form: Form::Text,
                    pickled: false,
                    // A struct with one text always has JSON.
                    data: Data::Ready(serde_json::to_vec(&text).unwrap_or_default()),
                    made: None,
                    is_foreign_event: false,
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
            is_foreign_event: false,
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
