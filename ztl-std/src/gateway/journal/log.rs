//! What the lines of a journal mean, over any storage.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::io;
use std::time::Duration;

use tracing::{info, warn};
use ztl_core::{State, TaskId};

use super::line::{Line, Moment, Opened, Reserved, TaskLine, VERSION, Version};
use crate::server::{KEEP, RestoredTask};
use ztl_link::{Entry, Restored};

/// Bytes written before a new file is begun, besides those that it begins with.
const ROTATE: u64 = 1 << 20;
/// Tasks that are carried over to a new file, at most; as many as a server remembers.
const CARRIED: usize = 10_000;
/// The same in bytes of memory.
const CARRIED_BYTES: usize = 64 << 20;
/// Task ids that are reserved at a time, which costs one flush of the disk.
const BLOCK: u32 = 10_000;
/// Warn when fewer task ids than this are left.
const FEW: u32 = 10_000_000;
/// A client is told the id of a task that is undecided for 1.5 s. Its `Start` is written within
/// [`DECIDED`](super::DECIDED) or never sent, so nobody knows the id of a task that its device rejects within
/// this time after its `Start`.
const UNTOLD: Duration = Duration::from_millis(250);
/// Lines that cannot be used of which each is said.
const SAID: usize = 10;
/// Name under which the gateway logs.
const LOG: &str = "gateway";

/// Where a journal lies. What is said to be written survives the end of the process.
pub trait Storage {
    /// Adds whole lines at the end. With `sync` they, and all lines before, survive a power cut.
    ///
    /// # Errors
    /// Those of the operating system. What was written of the lines is then cut off before the next
    /// ones.
    fn add(&mut self, lines: &[u8], sync: bool) -> io::Result<()>;

    /// Keeps only the first `len` bytes: the rest is a line that was not written to its end.
    ///
    /// # Errors
    /// Those of the operating system. It is tried again before the next lines are written.
    fn cut(&mut self, len: u64) -> io::Result<()>;

    /// Puts these lines in the place of all others, entirely or not at all.
    ///
    /// # Errors
    /// Those of the operating system. The others are then still there.
    fn replace(&mut self, lines: &[u8]) -> io::Result<()>;

    /// What somebody else did to what was written, for people: `was removed`.
    fn altered(&self) -> Option<String> {
        None
    }

    /// What it is called, for people.
    fn place(&self) -> String;
}

/// In memory, for tests and simulations.
impl Storage for Vec<u8> {
    fn add(&mut self, lines: &[u8], _sync: bool) -> io::Result<()> {
        self.extend_from_slice(lines);
        Ok(())
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.truncate(usize::try_from(len).unwrap_or(usize::MAX));
        Ok(())
    }

    fn replace(&mut self, lines: &[u8]) -> io::Result<()> {
        self.clear();
        self.add(lines, true)
    }

    fn place(&self) -> String {
        "in memory".to_owned()
    }
}

/// A journal over any storage; the time comes in as an argument.
#[derive(Debug)]
pub struct Log<S> {
    storage: S,
    gateway: u64,
    /// No task id up to this one is given after a restart, 0 for none.
    reserved: u32,
    /// Each line from which something follows is to survive a power cut.
    sync: bool,
    /// The latest line of each task.
    tasks: BTreeMap<TaskId, TaskLine>,
    /// Bytes in the storage.
    len: u64,
    /// When a new file is begun.
    rotate_at: u64,
    /// Whether this start of the gateway is written.
    opened: bool,
    /// Why it cannot be written; said once in the log.
    trouble: Option<String>,
}

impl<S: Storage> Log<S> {
    /// Reads what `storage` holds, `written`, mends it, and notes that a gateway was started: the
    /// one that wrote it before, or else `stranger`. What cannot be used is said in the log.
    pub fn open(storage: S, written: &[u8], now: Moment, stranger: u64) -> Self {
        let mut log = Self {
            storage,
            gateway: stranger,
            reserved: 0,
            sync: false,
            tasks: BTreeMap::new(),
            len: written.len() as u64,
            rotate_at: ROTATE,
            opened: false,
            trouble: None,
        };
        let end = written.iter().rposition(|byte| *byte == b'\n');
        let whole = written.get(..end.map_or(0, |end| end + 1));
        let whole = whole.unwrap_or_default();
        if whole.len() < written.len() {
            let place = log.storage.place();
            let torn = written.len() - whole.len();
            warn!(target: LOG, "Journal {place}: the last line was not written to its end; its {torn} bytes are cut off.");
            log.len = whole.len() as u64;
            if let Err(error) = log.storage.cut(log.len) {
                warn!(target: LOG, "Journal {place}: they cannot be cut off: {error}");
            }
        }
        let clean = log.read(whole);
        log.warn_of_few_ids();
        log.forget(now);
        if !clean {
            // What could not be used stays in the file before.
            log.rotate_or_go_on(now);
        }
        if !log.opened {
            // If that cannot be written, it is said, and tried again with the first task.
            let _ = log.write(now, None);
        }
        log
    }

    /// With `sync` each line from which something follows survives a power cut. Lines that reserve task ids
    /// always do.
    #[must_use]
    pub fn with_sync(mut self, sync: bool) -> Self {
        self.sync = sync;
        self
    }

    /// Who the gateway is towards its devices.
    pub const fn gateway(&self) -> u64 {
        self.gateway
    }

    /// The last task id that may have been given before this start.
    pub const fn last_id(&self) -> Option<TaskId> {
        TaskId::new(self.reserved)
    }

    /// The tasks that have no end, each with its device's name.
    pub fn unended(&self) -> Vec<(String, Restored)> {
        let lines = self.tasks.values().filter(|line| !line.state.is_final());
        let with_device = |line: &TaskLine| line.restored().map(|task| (line.device.clone(), task));
        lines.filter_map(with_device).collect()
    }

    /// The tasks that have ended, as long as they are remembered; each with what was asked for:
    /// device, component, goal.
    pub fn ended(&self, now: Moment) -> Vec<([&str; 3], RestoredTask)> {
        let lines = self.tasks.values().filter(|line| line.state.is_final());
        let ended = |line: &TaskLine| RestoredTask {
            id: line.task,
            payload: String::new(),
            state: line.state,
            text: line.text.clone(),
            ended: Some(line.age(now)),
        };
        lines
            .filter(|line| line.age(now) < KEEP)
            .map(|line| (line.spec(), ended(line)))
            .collect()
    }

    /// Notes that a `Start` is about to be sent.
    ///
    /// # Errors
    /// Why that cannot be written, for people.
    pub fn starting(
        &mut self,
        now: Moment,
        device: &str,
        client: Option<String>,
        task: &Entry<'_>,
    ) -> Result<(), String> {
        let line = TaskLine::new(now, device, client, task, State::Initiated, "");
        self.write(now, Some(Line::Start(line)))
    }

    /// Notes that a device has said that a task runs.
    ///
    /// # Errors
    /// Why that cannot be written, for people.
    pub fn accepted(&mut self, now: Moment, device: &str, task: &Entry<'_>) -> Result<(), String> {
        let client = self.client(task.id);
        let line = TaskLine::new(now, device, client, task, State::Accepted, "");
        self.write(now, Some(Line::Accepted(line)))
    }

    /// Notes that a task is about to end.
    ///
    /// # Errors
    /// Why that cannot be written, for people.
    pub fn ended_as(
        &mut self,
        now: Moment,
        device: &str,
        task: &Entry<'_>,
        (state, text): (State, &str),
    ) -> Result<(), String> {
        let client = self.client(task.id);
        let line = TaskLine::new(now, device, client, task, state, text);
        self.write(now, Some(Line::Ended(line)))
    }

    /// Where it lies.
    pub const fn storage(&self) -> &S {
        &self.storage
    }

    /// The same, to be changed.
    pub const fn storage_mut(&mut self) -> &mut S {
        &mut self.storage
    }

    /// Takes in what was written; says whether all of it could be used.
    fn read(&mut self, written: &[u8]) -> bool {
        let place = self.storage.place();
        let mut useless = 0;
        let mut other_version = false;
        let lines = written.split(|byte| *byte == b'\n');
        for (number, bytes) in (1..).zip(lines).filter(|(_, bytes)| !bytes.is_empty()) {
            let version = serde_json::from_slice::<Version>(bytes);
            if let Ok(Version { journal: Some(it) }) = version {
                other_version = it != VERSION;
                if other_version {
                    useless += 1;
                    warn!(target: LOG, "Journal {place}, line {number}: version {it}, this gateway reads version {VERSION}; skipped from here on.");
                }
            }
            if other_version {
                continue;
            }
            match serde_json::from_slice(bytes) {
                Ok(Line::Opened(opened)) => {
                    self.gateway = opened.gateway;
                    self.reserved = self.reserved.max(opened.last);
                }
                Ok(Line::Reserved(reserved)) => self.reserved = self.reserved.max(reserved.last),
                Ok(Line::Start(line) | Line::Accepted(line)) if line.restored().is_none() => {
                    useless += 1;
                    warn!(target: LOG, "Journal {place}, line {number}: skipped, it does not say to whom the task was sent.");
                }
                Ok(Line::Start(line) | Line::Accepted(line) | Line::Ended(line)) => self.note(line),
                Err(error) => {
                    useless += 1;
                    if useless <= SAID {
                        warn!(target: LOG, "Journal {place}, line {number}: skipped, it cannot be read: {error}");
                    }
                }
            }
        }
        if useless > SAID {
            warn!(target: LOG, "Journal {place}: {useless} lines were skipped in all.");
        }
        useless == 0
    }

    /// Who asked for a task, as its earlier lines say.
    fn client(&self, id: TaskId) -> Option<String> {
        self.tasks.get(&id)?.client.clone()
    }

    /// An end stays what it is.
    fn note(&mut self, line: TaskLine) {
        self.reserved = self.reserved.max(line.task.get());
        match self.tasks.get(&line.task) {
            Some(known) if known.state.is_final() => {}
            // A device that is busy refuses often.
            Some(known) if line.state == State::Rejected && line.since(known) < UNTOLD => {
                self.tasks.remove(&line.task);
            }
            _ => {
                self.tasks.insert(line.task, line);
            }
        }
    }

    fn write(&mut self, now: Moment, line: Option<Line>) -> Result<(), String> {
        self.look(now)?;
        if self.len >= self.rotate_at {
            self.rotate_or_go_on(now);
        }
        let mut bytes = Vec::new();
        if !self.opened {
            self.put_opened(now, &mut bytes);
        }
        let mut reserved = self.reserved;
        if let Some(line) = &line {
            if let Some(id) = line.task().filter(|id| id.get() > reserved) {
                reserved = id.get().saturating_add(BLOCK - 1);
                Line::Reserved(Reserved::new(now, reserved)).put(&mut bytes);
            }
            line.put(&mut bytes);
        }
        let needed = matches!(line, Some(Line::Start(_) | Line::Ended(_)));
        let reserves = reserved > self.reserved;
        if let Err(error) = self.storage.add(&bytes, reserves || needed && self.sync) {
            let place = self.storage.place();
            let trouble = format!("the journal {place} cannot be written: {error}");
            return Err(self.in_trouble(trouble));
        }
        if self.trouble.take().is_some() {
            info!(target: LOG, "The journal {} is written again.", self.storage.place());
        }
        self.len += bytes.len() as u64;
        self.opened = true;
        if reserves {
            self.reserved = reserved;
            self.warn_of_few_ids();
        }
        if let Some(Line::Start(line) | Line::Accepted(line) | Line::Ended(line)) = line {
            self.note(line);
        }
        Ok(())
    }

    /// Begins a new file when somebody else altered this one, and says so.
    ///
    /// # Errors
    /// Why no new file can be begun, for people.
    pub fn look(&mut self, now: Moment) -> Result<(), String> {
        let Some(how) = self.storage.altered() else {
            return Ok(());
        };
        let place = self.storage.place();
        if let Err(error) = self.rotate(now) {
            let trouble =
                format!("the journal {place} {how}, and no new file can be begun: {error}");
            return Err(self.in_trouble(trouble));
        }
        warn!(target: LOG, "Journal {place} {how}. A new file with all that is still needed takes its place.");
        Ok(())
    }

    fn in_trouble(&mut self, trouble: String) -> String {
        if self.trouble.as_ref() != Some(&trouble) {
            warn!(target: LOG, "No task is taken: {trouble}");
            self.trouble = Some(trouble.clone());
        }
        trouble
    }

    fn warn_of_few_ids(&self) {
        let left = u32::MAX - self.reserved;
        let place = self.storage.place();
        if left == 0 {
            warn!(target: LOG, "Journal {place}: all task ids are used up. Stop the gateway, move the journal away and start the gateway again.");
        } else if left < FEW {
            let left = match left {
                1 => "1 task id is".to_owned(),
                left => format!("{left} task ids are"),
            };
            warn!(target: LOG, "Journal {place}: only {left} left. Move the journal away while the gateway is stopped and no task runs.");
        }
    }

    fn put_opened(&self, now: Moment, bytes: &mut Vec<u8>) {
        Line::Opened(Opened::new(now, self.gateway, self.reserved)).put(bytes);
    }

    /// Begins a new file with all that is still needed. When that fails, the old one goes on.
    fn rotate_or_go_on(&mut self, now: Moment) {
        if let Err(error) = self.rotate(now) {
            let place = self.storage.place();
            warn!(target: LOG, "Journal {place}: no new file can be begun: {error}");
        }
    }

    fn rotate(&mut self, now: Moment) -> io::Result<()> {
        self.forget(now);
        let mut bytes = Vec::new();
        self.put_opened(now, &mut bytes);
        for line in self.tasks.values().cloned() {
            let line = match line.state {
                State::Initiated => Line::Start(line),
                State::Accepted => Line::Accepted(line),
                _ => Line::Ended(line),
            };
            line.put(&mut bytes);
        }
        let replaced = self.storage.replace(&bytes);
        if replaced.is_ok() {
            self.opened = true;
            self.len = bytes.len() as u64;
        }
        // Whatever its size, a byte is copied about once.
        self.rotate_at = self.len + ROTATE.max(self.len);
        replaced
    }

    /// Forgets ends that are too old, and the oldest of too many.
    fn forget(&mut self, now: Moment) {
        let needed = |line: &TaskLine| !line.state.is_final() || line.age(now) < KEEP;
        self.tasks.retain(|_, line| needed(line));
        let mut bytes: usize = self.tasks.values().map(TaskLine::size).sum();
        if self.tasks.len() <= CARRIED && bytes <= CARRIED_BYTES {
            return;
        }
        let ends = self.tasks.values().filter(|line| line.state.is_final());
        let mut ends: Vec<_> = ends
            .map(|line| (line.age(now), Reverse(line.task)))
            .collect();
        ends.sort();
        while let Some((_, Reverse(oldest))) = ends.pop()
            && (self.tasks.len() > CARRIED || bytes > CARRIED_BYTES)
        {
            bytes -= self.tasks.remove(&oldest).map_or(0, |line| line.size());
        }
    }
}

#[cfg(test)]
mod tests;
