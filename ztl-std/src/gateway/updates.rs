//! What clients ask about the firmware of a device, as `ztl firmware` does, and the answers.

use std::fmt;

use serde::{Deserialize, Serialize};
use ztl_core::base64::{Encoder, decode};
use ztl_core::goal;
use ztl_core::link::update::UpdateError;
use ztl_core::sink::Sink as _;
use ztl_link::FirmwareInfo;

/// The component of a device under which its gateway answers requests about firmware. Its goals are the [`UpdateGoal`]s.
pub const UPDATES: &str = "$update";

/// Longest file of an image that a gateway takes, in bytes.
pub const LONGEST_IMAGE: usize = 2 << 20;

/// Longest part of a file in one request, in bytes.
pub const LONGEST_PART: usize = 48 << 10;

/// A request about the firmware of a device, as a goal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpdateGoal {
    /// What runs; the result is a [`RunningFirmware`] in JSON.
    Status,
    /// A part of an image's file: a text that is the same for the same file only, where the part begins, and its bytes in
    /// base64. The first one begins at 0; each further one where the last one ended.
    Part(String, usize, String),
    /// Run the image whose parts were sent; the result is an [`Updated`] in JSON.
    Run(UpdateOptions),
}

/// How to update.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct UpdateOptions {
    /// The text with which the parts of the file were sent.
    pub file: String,
    /// The length of the image's file in bytes.
    pub length: usize,
    /// Whether to end the tasks that run.
    pub now: bool,
    /// Whether the image may be older than what runs.
    pub downgrade: bool,
}

impl UpdateGoal {
    /// A part of a file.
    #[must_use]
    pub fn part(file: &str, offset: usize, bytes: &[u8]) -> Self {
        let mut base64 = Vec::new();
        let mut out = |bytes: &[u8]| base64.extend_from_slice(bytes);
        let mut encoder = Encoder::new(&mut out);
        encoder.put(bytes);
        encoder.finish();
        let base64 = String::from_utf8_lossy(&base64).into_owned();
        Self::Part(file.to_owned(), offset, base64)
    }

    /// The goal's text.
    #[must_use]
    pub fn to_text(&self) -> String {
        let mut text = Vec::new();
        // It has two levels at most.
        let _ = goal::to_sink(self, &mut |bytes: &[u8]| text.extend_from_slice(bytes));
        String::from_utf8_lossy(&text).into_owned()
    }

    /// Reads a goal.
    ///
    /// # Errors
    /// What would be right.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let mut scratch = vec![0; text.len() * 2];
        goal::from_str_with(text, &mut scratch).map_err(|error| {
            format!(
                "{UPDATES} takes status, {{'part': [FILE, OFFSET, BASE64]}} or {{'run': {{'file': FILE, 'length': BYTES, 'now': False, 'downgrade': False}}}}: {error}"
            )
        })
    }
}

/// The bytes of a part; `None` if they are not base64.
pub(super) fn bytes_of(base64: &str) -> Option<Vec<u8>> {
    let mut buffer = vec![0; base64.len()];
    Some(decode(base64.as_bytes(), &mut buffer).ok()?.to_vec())
}

/// The firmware that a device runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunningFirmware {
    /// The board that images must be for.
    pub board: String,
    /// Its version.
    pub version: String,
    /// Whether it was confirmed; if not, it is on trial.
    pub confirmed: bool,
}

impl From<&FirmwareInfo> for RunningFirmware {
    fn from(info: &FirmwareInfo) -> Self {
        Self {
            board: info.board.clone(),
            version: info.version.clone(),
            confirmed: info.confirmed,
        }
    }
}

/// A successful update.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Updated {
    /// The version before.
    pub before: String,
    /// The version that runs now, as it says itself.
    pub after: String,
    /// The version for which the image was signed, if it says another one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signed: Option<String>,
}

/// What the journal keeps of an update from the restart of its device on, so that another gateway can test and confirm the new
/// firmware.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::gateway) struct Note {
    /// The device's boot before the restart, and the version that it ran.
    pub(in crate::gateway) boot: u32,
    pub(in crate::gateway) before: String,
    /// The version of the image.
    pub(in crate::gateway) image: String,
    /// The task that tests it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(in crate::gateway) test: Option<u32>,
    /// Whether the gateway has stopped during that task, so that its end as ABORTED says nothing about the firmware.
    #[serde(default, skip_serializing_if = "is_false")]
    pub(in crate::gateway) stopped: bool,
    /// The device's boot on trial and the version that it says, if it may have been confirmed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(in crate::gateway) trial: Option<(u32, String)>,
    /// Whether a client has aborted the update.
    #[serde(default, skip_serializing_if = "is_false")]
    pub(in crate::gateway) aborted: bool,
    /// The id of its board on a shared line, in hexadecimal digits: JSON readers keep only 53 bits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(in crate::gateway) board: Option<String>,
}

const fn is_false(value: &bool) -> bool {
    !*value
}

/// Why an update has failed. The text of a failed task begins with this word and a colon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateProblem {
    /// The file is not an image.
    Manifest,
    /// The image is for another board.
    Board,
    /// The image is older than what runs.
    Older,
    /// The image is longer than the room for it.
    Length,
    /// The signature is wrong.
    Signature,
    /// A task runs, or another update.
    Busy,
    /// The device went back to the firmware before.
    Reverted,
    /// The link, the flash, or another reason.
    Other,
}

impl UpdateProblem {
    const ALL: [(Self, &'static str); 8] = [
        (Self::Manifest, "manifest"),
        (Self::Board, "board"),
        (Self::Older, "older"),
        (Self::Length, "length"),
        (Self::Signature, "signature"),
        (Self::Busy, "busy"),
        (Self::Reverted, "reverted"),
        (Self::Other, "failed"),
    ];

    /// The problem and the text for people of a failed task.
    #[must_use]
    pub fn split(text: &str) -> (Self, &str) {
        let found = text.split_once(": ").and_then(|(word, rest)| {
            let known = Self::ALL.iter().find(|(_, known)| *known == word)?;
            Some((known.0, rest))
        });
        found.unwrap_or((Self::Other, text))
    }
}

impl From<UpdateError> for UpdateProblem {
    fn from(error: UpdateError) -> Self {
        match error {
            UpdateError::Manifest => Self::Manifest,
            UpdateError::Board => Self::Board,
            UpdateError::Older => Self::Older,
            UpdateError::TooLong => Self::Length,
            UpdateError::Signature => Self::Signature,
            _ => Self::Other,
        }
    }
}

impl fmt::Display for UpdateProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = Self::ALL.iter().find(|(known, _)| known == self);
        f.write_str(word.map_or("failed", |(_, word)| word))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn goals_are_read_as_they_are_written() {
        let run = UpdateOptions {
            file: "a".to_owned(),
            length: 70_000,
            now: true,
            downgrade: false,
        };
        for goal in [
            UpdateGoal::Status,
            UpdateGoal::part("a", 48 << 10, &[0, 255, 7, 39]),
            UpdateGoal::Run(run),
        ] {
            assert_eq!(UpdateGoal::parse(&goal.to_text()), Ok(goal));
        }
        let UpdateGoal::Part(_, _, base64) = UpdateGoal::part("", 0, b"ab'\\\"\n") else {
            panic!("a part");
        };
        assert_eq!(bytes_of(&base64).as_deref(), Some(&b"ab'\\\"\n"[..]));
        let wrong = UpdateGoal::parse("erase").expect_err("no such goal");
        assert!(wrong.starts_with("$update takes status"), "{wrong}");
    }

    #[test]
    fn a_problem_is_found_in_the_text_of_its_task() {
        for (problem, _) in UpdateProblem::ALL {
            let text = format!("{problem}: it is so: yes");
            assert_eq!(UpdateProblem::split(&text), (problem, "it is so: yes"));
        }
        let other = UpdateProblem::split("device: gone");
        assert_eq!(other, (UpdateProblem::Other, "device: gone"));
    }
}
