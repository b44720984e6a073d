//! The lines of a journal: JSON, each one complete in itself.

use std::time::{Duration, SystemTime};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use ztl_core::link::{LINK_TIMEOUTS, LinkId, Loss};
use ztl_core::{State, TaskId};

use crate::time;
use ztl_link::{Entry, Restored, Sent};

/// The version of the lines that are written, and that are read.
pub(super) const VERSION: u32 = 1;

/// A moment by two clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    /// By the wall clock, which may be set.
    pub wall: SystemTime,
    /// Since the gateway was started, which never goes back.
    pub running: Duration,
}

impl Moment {
    /// Now.
    #[must_use]
    pub fn now() -> Self {
        Self {
            wall: SystemTime::now(),
            running: Duration::from_micros(time::now().as_micros()),
        }
    }

    fn micros(self) -> u64 {
        u64::try_from(self.running.as_micros()).unwrap_or(u64::MAX)
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "lowercase")]
pub(super) enum Line {
    /// A gateway was started, or a new file begun.
    Opened(Opened),
    /// Task ids are about to be given.
    Reserved(Reserved),
    /// A `Start` is about to be sent.
    Start(TaskLine),
    /// The device has said that the task runs.
    Accepted(TaskLine),
    /// The task is about to end.
    Ended(TaskLine),
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Opened {
    #[serde(with = "crate::time::rfc3339")]
    at: SystemTime,
    running_us: u64,
    journal: u32,
    /// Who the gateway is towards its devices. In hexadecimal: JSON's readers have numbers of 53 bits.
    #[serde(with = "hex")]
    pub(super) gateway: u64,
    /// No task id up to this one is given again; 0 when none was given.
    pub(super) last: u32,
    version: String,
    /// The process that writes the journal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    process: Option<u32>,
}

impl Opened {
    pub(super) fn new(now: Moment, gateway: u64, last: u32) -> Self {
        Self {
            at: now.wall,
            running_us: now.micros(),
            journal: VERSION,
            gateway,
            last,
            version: ztl_core::VERSION.to_owned(),
            process: Some(std::process::id()),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Reserved {
    #[serde(with = "crate::time::rfc3339")]
    at: SystemTime,
    running_us: u64,
    /// No task id up to this one is given after a restart.
    pub(super) last: u32,
}

impl Reserved {
    pub(super) fn new(now: Moment, last: u32) -> Self {
        Self {
            at: now.wall,
            running_us: now.micros(),
            last,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct TaskLine {
    #[serde(with = "crate::time::rfc3339")]
    at: SystemTime,
    running_us: u64,
    #[serde(with = "id")]
    pub(super) task: TaskId,
    pub(super) device: String,
    component: String,
    goal: String,
    #[serde(with = "StateName")]
    pub(super) state: State,
    /// The result or the reason; empty before the end.
    pub(super) text: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sent: Option<SentLine>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) client: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct SentLine {
    link: u32,
    boot: u32,
    #[serde(with = "LossName")]
    loss: Loss,
    link_timeout_ms: u64,
}

impl TaskLine {
    pub(super) fn new(
        now: Moment,
        device: &str,
        client: Option<String>,
        task: &Entry<'_>,
        state: State,
        text: &str,
    ) -> Self {
        Self {
            at: now.wall,
            running_us: now.micros(),
            task: task.id,
            device: device.to_owned(),
            component: task.component.to_owned(),
            goal: task.goal.to_owned(),
            state,
            text: text.to_owned(),
            sent: task.sent.map(|sent| SentLine {
                link: sent.link.0,
                boot: sent.boot,
                loss: sent.loss,
                link_timeout_ms: time::millis(sent.link_timeout),
            }),
            client,
        }
    }

    /// Bytes that it takes in memory, about.
    pub(super) fn size(&self) -> usize {
        size_of::<Self>() + self.component.len() + self.goal.len() + self.text.len()
    }

    /// How long ago it was written; zero when the wall clock was set back since.
    pub(super) fn age(&self, now: Moment) -> Duration {
        now.wall.duration_since(self.at).unwrap_or_default()
    }

    /// How long after another line of the same run of the gateway it was written.
    pub(super) fn since(&self, earlier: &Self) -> Duration {
        Duration::from_micros(self.running_us.saturating_sub(earlier.running_us))
    }

    /// What a session takes up; `None` when the task was never sent.
    pub(super) fn restored(&self) -> Option<Restored> {
        let sent = self.sent?;
        Some(Restored {
            id: self.task,
            component: self.component.clone(),
            goal: self.goal.clone(),
            sent: Sent {
                link: LinkId(sent.link),
                boot: sent.boot,
                loss: sent.loss,
                // As a device can have told it.
                link_timeout: Duration::from_millis(sent.link_timeout_ms)
                    .clamp(*LINK_TIMEOUTS.start(), *LINK_TIMEOUTS.end()),
            },
            accepted: self.state == State::Accepted,
        })
    }

    /// What was asked for, as its client wrote it.
    pub(super) fn spec(&self) -> [&str; 3] {
        [&self.device, &self.component, &self.goal]
    }
}

impl Line {
    /// The task that it is about.
    pub(super) fn task(&self) -> Option<TaskId> {
        match self {
            Self::Opened(_) | Self::Reserved(_) => None,
            Self::Start(line) | Self::Accepted(line) | Self::Ended(line) => Some(line.task),
        }
    }

    pub(super) fn put(&self, bytes: &mut Vec<u8>) {
        // Neither can fail: text as keys, and a vector that grows.
        if serde_json::to_writer(&mut *bytes, self).is_ok() {
            bytes.push(b'\n');
        }
    }
}

/// Whether a gateway wrote this, as far as it can be read: a crash may have left half of the first line, or zeros.
pub(super) fn is_journal(written: &[u8]) -> bool {
    const START: &[u8] = br#"{"event":""#;
    let of_ours = |line: &[u8]| {
        let version = || serde_json::from_slice::<Version>(line);
        line.starts_with(START) || version().is_ok_and(|version| version.journal.is_some())
    };
    let zeros = || written.iter().all(|byte| *byte == 0);
    START.starts_with(written) || written.split(|byte| *byte == b'\n').any(of_ours) || zeros()
}

/// The process that wrote a journal last.
pub(super) fn last_process(written: &[u8]) -> Option<u32> {
    let lines = written.rsplit(|byte| *byte == b'\n');
    lines
        .filter_map(|line| serde_json::from_slice::<Line>(line).ok())
        .find_map(|line| match line {
            Line::Opened(opened) => opened.process,
            _ => None,
        })
}

/// Which version a line begins, if it begins one.
#[derive(Deserialize)]
pub(super) struct Version {
    pub(super) journal: Option<u32>,
}

#[derive(Serialize, Deserialize)]
#[serde(remote = "State", rename_all = "UPPERCASE")]
enum StateName {
    Initiated,
    Accepted,
    Rejected,
    Failed,
    Aborted,
    Completed,
}

#[derive(Serialize, Deserialize)]
#[serde(remote = "Loss", rename_all = "lowercase")]
enum LossName {
    Abort,
    Hold,
    #[serde(rename = "carry on")]
    CarryOn,
}

mod hex {
    use super::{Deserialize, Deserializer, Serializer, de};

    pub(super) fn serialize<S: Serializer>(number: &u64, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(&format_args!("{number:016x}"))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<u64, D::Error> {
        let text = String::deserialize(from)?;
        u64::from_str_radix(&text, 16).map_err(de::Error::custom)
    }
}

mod id {
    use super::{Deserialize, Deserializer, Serializer, TaskId, de};

    pub(super) fn serialize<S: Serializer>(id: &TaskId, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_u32(id.get())
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<TaskId, D::Error> {
        let number = u32::deserialize(from)?;
        TaskId::new(number).ok_or_else(|| de::Error::custom("a task id is not 0"))
    }
}
