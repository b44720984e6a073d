//! Journal entries: one JSON object per line.

use std::time::{Duration, SystemTime};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use ztl_core::link::{LINK_TIMEOUTS, LinkId, Loss};
use ztl_core::{State, TaskId};

use crate::gateway::parameters::PARAMETERS;
use crate::gateway::updates::{Note, UPDATES};
use crate::time;
use ztl_link::{Restored, Sent};

/// The version of the format.
pub(super) const VERSION: u32 = 1;

/// The time by two clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    /// The wall clock, which may be set.
    pub wall: SystemTime,
    /// The monotonic clock: the time since the gateway was started.
    pub running: Duration,
}

impl Moment {
    /// The current time.
    pub(super) fn now() -> Self {
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
pub(super) enum JournalEntry {
    /// A gateway was started, or a new file.
    Opened(Opened),
    /// Task ids are about to be assigned.
    Reserved(Reserved),
    /// A `Start` is about to be sent, or a task of the device itself is taken up.
    Start(TaskEntry),
    /// The device has accepted the task.
    Accepted(TaskEntry),
    /// The task is about to end.
    Ended(TaskEntry),
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Opened {
    #[serde(with = "crate::time::rfc3339")]
    at: SystemTime,
    running_us: u64,
    journal: u32,
    /// The gateway's id, as its devices know it. Hexadecimal, since JSON readers keep only 53 bits.
    #[serde(with = "hex")]
    pub(super) gateway: u64,
    /// Task ids up to this one are not assigned again; 0 if there is none.
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
    /// Task ids up to this one are not assigned after a restart.
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
pub(super) struct TaskEntry {
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
    sent: Option<SentTo>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) client: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct SentTo {
    link: u32,
    boot: u32,
    #[serde(with = "LossName")]
    loss: Loss,
    link_timeout_ms: u64,
    /// The unique id of the board on a shared line.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    board: Option<BoardId>,
}

/// Hexadecimal, since JSON readers keep only 53 bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub(super) struct BoardId(#[serde(with = "hex")] pub(super) u64);

impl TaskEntry {
    pub(super) fn new(
        now: Moment,
        device: &str,
        client: Option<String>,
        task: &ztl_link::Entry<'_>,
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
            sent: task.sent.map(|sent| SentTo {
                link: sent.link.0,
                boot: sent.boot,
                loss: sent.loss,
                link_timeout_ms: time::millis(sent.link_timeout),
                board: None,
            }),
            client,
        }
    }

    /// The same on this board of a shared line.
    pub(super) fn on_board(mut self, board: Option<BoardId>) -> Self {
        if let Some(sent) = &mut self.sent {
            sent.board = board;
        }
        self
    }

    /// The boot of the device, and the board of a shared line.
    pub(super) fn board(&self) -> Option<(u32, BoardId)> {
        let sent = self.sent?;
        Some((sent.boot, sent.board?))
    }

    /// Whether it was sent to this boot, but not to this board.
    pub(super) fn is_of_other(&self, boot: u32, board: BoardId) -> bool {
        let sent = self.sent;
        sent.is_some_and(|sent| sent.boot == boot && sent.board != Some(board))
    }

    /// Whether it is a firmware update, which needs its gateway.
    pub(super) fn is_update(&self) -> bool {
        self.component == UPDATES && self.sent.is_none()
    }

    /// Whether its gateway carried it out by itself.
    pub(super) fn is_own(&self) -> bool {
        self.is_update() || self.component == PARAMETERS && self.sent.is_none()
    }

    /// How it has ended if its gateway has ended before; `None` if another one goes on with it.
    pub(super) fn cut(&self) -> Option<&'static str> {
        match self.spec() {
            _ if !self.is_own() || self.note().is_some() => None,
            [_, PARAMETERS, _] => Some(
                "the gateway ended before the answer: it is unknown whether the device did it; list the parameters to see",
            ),
            [_, _, "status"] => Some("the gateway ended before the answer"),
            _ => Some(
                "failed: the gateway ended during the update; it is not known which firmware the device will run, ztl devices shows it",
            ),
        }
    }

    /// With what another gateway goes on with an update.
    pub(super) fn note(&self) -> Option<Note> {
        let text = Some(&self.text).filter(|_| self.is_update());
        serde_json::from_str(text?).ok()
    }

    /// The end of the same task.
    pub(super) fn ended_as(&self, now: Moment, state: State, text: &str) -> Self {
        Self {
            at: now.wall,
            running_us: now.micros(),
            state,
            text: text.to_owned(),
            ..self.clone()
        }
    }

    /// Approximate bytes in memory.
    pub(super) fn size(&self) -> usize {
        size_of::<Self>() + self.component.len() + self.goal.len() + self.text.len()
    }

    /// Time since it was written; zero if the wall clock was set back since.
    pub(super) fn age(&self, now: Moment) -> Duration {
        now.wall.duration_since(self.at).unwrap_or_default()
    }

    /// Time since an earlier entry of the same process.
    pub(super) fn since(&self, earlier: &Self) -> Duration {
        Duration::from_micros(self.running_us.saturating_sub(earlier.running_us))
    }

    /// What a session resumes; `None` if the task was never sent.
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
                // Within what a device can have sent.
                link_timeout: Duration::from_millis(sent.link_timeout_ms)
                    .clamp(*LINK_TIMEOUTS.start(), *LINK_TIMEOUTS.end()),
            },
            accepted: self.state == State::Accepted,
        })
    }

    /// The boot and the id on the link, if the firmware of the device has started the task itself.
    pub(super) fn own(&self) -> Option<(u32, LinkId)> {
        let sent = self.sent?;
        let link = LinkId(sent.link);
        link.is_local().then_some((sent.boot, link))
    }

    /// The task's specification.
    pub(super) fn spec(&self) -> [&str; 3] {
        [&self.device, &self.component, &self.goal]
    }
}

impl JournalEntry {
    /// The entry's task.
    pub(super) fn task(&self) -> Option<TaskId> {
        match self {
            Self::Opened(_) | Self::Reserved(_) => None,
            Self::Start(entry) | Self::Accepted(entry) | Self::Ended(entry) => Some(entry.task),
        }
    }

    pub(super) fn put(&self, bytes: &mut Vec<u8>) {
        // Cannot fail: keys are text, and the vector grows.
        if serde_json::to_writer(&mut *bytes, self).is_ok() {
            bytes.push(b'\n');
        }
    }
}

/// Whether this is a journal. After a crash it may be half a line or zeros.
pub(super) fn is_journal(written: &[u8]) -> bool {
    const START: &[u8] = br#"{"event":""#;
    let is_entry = |line: &[u8]| {
        let version = || serde_json::from_slice::<Version>(line);
        line.starts_with(START) || version().is_ok_and(|version| version.journal.is_some())
    };
    let zeros = || written.iter().all(|byte| *byte == 0);
    START.starts_with(written) || written.split(|byte| *byte == b'\n').any(is_entry) || zeros()
}

/// The process that wrote a journal last.
pub(super) fn last_process(written: &[u8]) -> Option<u32> {
    let lines = written.rsplit(|byte| *byte == b'\n');
    lines
        .filter_map(|line| serde_json::from_slice::<JournalEntry>(line).ok())
        .find_map(|entry| match entry {
            JournalEntry::Opened(opened) => opened.process,
            _ => None,
        })
}

/// The version in a line that begins a file.
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
