//! How messages are stored: their encodings and schemas.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};

/// What a channel contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Form {
    /// Events of a run, as `docs/record.md` has them.
    Run,
    /// Events of tasks.
    Task,
    Value,
    /// Text that is not a pickle.
    Text,
    Image,
    Sound,
    Bytes,
}

impl Form {
    pub(crate) const ALL: [Self; 7] = [
        Self::Run,
        Self::Task,
        Self::Value,
        Self::Text,
        Self::Image,
        Self::Sound,
        Self::Bytes,
    ];

    /// The name of its schema, and the schema in JSON; bytes have none. Foxglove knows those of its own by name.
    pub(crate) const fn schema(self) -> Option<(&'static str, &'static str)> {
        match self {
            Self::Run => Some(("ztl.RunEvent", include_str!("schemas/run_event.json"))),
            Self::Task => Some(("ztl.TaskEvent", include_str!("schemas/task_event.json"))),
            Self::Value => Some(("ztl.Value", include_str!("schemas/value.json"))),
            Self::Text => Some(("ztl.Text", include_str!("schemas/text.json"))),
            Self::Image => Some((
                "foxglove.CompressedImage",
                include_str!("schemas/compressed_image.json"),
            )),
            Self::Sound => Some(("foxglove.RawAudio", include_str!("schemas/raw_audio.json"))),
            Self::Bytes => None,
        }
    }

    /// The encoding of its messages.
    pub(crate) const fn encoding(self) -> &'static str {
        match self {
            Self::Bytes => "application/octet-stream",
            _ => "json",
        }
    }

    /// The form of a channel with this schema and encoding.
    pub(crate) fn of(schema: Option<&str>, encoding: &str) -> Option<Self> {
        let is_it = |form: &Self| {
            form.schema().map(|(name, _)| name) == schema && form.encoding() == encoding
        };
        Self::ALL.into_iter().find(is_it)
    }
}

/// A time, as Foxglove's schemas have it.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Stamp {
    pub(crate) sec: u64,
    pub(crate) nsec: u64,
}

impl Stamp {
    pub(crate) const fn of(nanoseconds: u64) -> Self {
        Self {
            sec: nanoseconds / 1_000_000_000,
            nsec: nanoseconds % 1_000_000_000,
        }
    }
}

/// `foxglove.CompressedImage`.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Image {
    pub(crate) timestamp: Stamp,
    pub(crate) frame_id: String,
    pub(crate) format: String,
    pub(crate) data: String,
}

/// `foxglove.RawAudio`.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Sound {
    pub(crate) timestamp: Stamp,
    pub(crate) format: String,
    pub(crate) sample_rate: u32,
    pub(crate) number_of_channels: u32,
    pub(crate) data: String,
}

/// `ztl.Text`.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct ZtlText {
    pub(crate) text: String,
}

pub(crate) fn to_base64(bytes: &[u8]) -> String {
    STANDARD.encode(bytes)
}

pub(crate) fn from_base64(text: &str) -> Option<Vec<u8>> {
    STANDARD.decode(text).ok()
}
