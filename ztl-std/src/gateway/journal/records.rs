//! What journal entries mean, over any storage.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};
use std::io;
use std::sync::Arc;
use std::time::Duration;

use tracing::{info, warn};
use ztl_core::link::LinkId;
use ztl_core::{State, TaskId};

use ztl_link::{Entry, Restored};

use super::entry::{BoardId, JournalEntry, Moment, Opened, Reserved, TaskEntry, VERSION, Version};
use crate::gateway::updates::Note;
use crate::log_targets::GATEWAY;
use crate::server::{KEEP, ReservedIds, RestoredTask};

/// Bytes written to a file, besides its initial content, before a new one is started.
const ROTATE: u64 = 1 << 20;
/// Most tasks that are carried over to a new file; as many as a server keeps.
const CARRIED: usize = 10_000;
/// The same limit in bytes of memory.
const CARRIED_BYTES: usize = 64 << 20;
/// Task ids that are reserved at a time, which needs one sync of the disk.
const BLOCK: u32 = 10_000;
/// How many are reserved at the start. Few, so that a gateway that is started again and again does not use them up.
const FIRST_BLOCK: u32 = 1000;
/// Warn when fewer task ids than this are left.
const FEW: u32 = 10_000_000;
/// A client learns the id of a task that is undecided for 1.5 s. The `Start` is written within 1.2 s
/// ([`DECIDED`](super::DECIDED)) or never sent, so no client knows a task that its device rejects within this
/// time after the `Start`.
const UNTOLD: Duration = Duration::from_millis(250);
/// Unusable lines that are logged one by one.
const LOGGED: usize = 10;

/// An update that the gateway before had not ended when it had restarted the device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::gateway) struct UnendedUpdate {
    pub(in crate::gateway) id: TaskId,
    pub(in crate::gateway) device: String,
    pub(in crate::gateway) goal: String,
    pub(in crate::gateway) note: Note,
    /// How the task that tests it has ended.
    pub(in crate::gateway) tested: Option<Result<(), String>>,
}

/// Stores a journal. What was written successfully survives the end of the process.
pub trait Storage {
    /// Appends lines. With `sync` they, and all lines before, survive a power cut.
    ///
    /// # Errors
    /// The system's error. Partly written lines are cut off before the next ones.
    fn add(&mut self, lines: &[u8], sync: bool) -> io::Result<()>;

    /// Keeps only the first `len` bytes; the rest is an incomplete line.
    ///
    /// # Errors
    /// The system's error. It is tried again before the next lines are written.
    fn cut(&mut self, len: u64) -> io::Result<()>;

    /// Replaces all lines, entirely or not at all.
    ///
    /// # Errors
    /// The system's error. The old lines are still there.
    fn replace(&mut self, lines: &[u8]) -> io::Result<()>;

    /// What something else did to the journal, such as `was removed`.
    fn altered(&self) -> Option<String> {
        None
    }

    /// The storage's name for messages.
    fn place(&self) -> String;
}

/// A journal in memory, for tests and simulations.
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

/// A journal's content and rules, over any storage. The time is an argument.
#[derive(Debug)]
pub struct JournalRecords<S> {
    storage: S,
    gateway: u64,
    /// Task ids up to this one are not assigned after a restart.
    reserved: u32,
    /// Once this one was assigned, more are reserved.
    low: u32,
    ids: Arc<ReservedIds>,
    /// Whether every entry that has an effect must survive a power cut.
    sync: bool,
    /// The latest entry of each task.
    tasks: BTreeMap<TaskId, TaskEntry>,
    /// Bytes in the storage.
    len: u64,
    /// Length at which a new file is started.
    rotate_at: u64,
    /// Whether the start of this gateway is written.
    opened: bool,
    /// Why the journal cannot be written; logged once.
    problem: Option<String>,
}

impl<S: Storage> JournalRecords<S> {
    /// Reads `written`, the content of `storage`, repairs it, and notes that a gateway was started: the one that
    /// wrote it, or `new_id` if there is none. Unusable lines are logged.
    pub fn open(storage: S, written: &[u8], now: Moment, new_id: u64) -> Self {
        let mut records = Self {
            storage,
            gateway: new_id,
            reserved: 0,
            low: 0,
            ids: Arc::new(ReservedIds::after(TaskId::MAX)),
            sync: false,
            tasks: BTreeMap::new(),
            len: written.len() as u64,
            rotate_at: ROTATE,
            opened: false,
            problem: None,
        };
        let end = written.iter().rposition(|byte| *byte == b'\n');
        let whole = written.get(..end.map_or(0, |end| end + 1));
        let whole = whole.unwrap_or_default();
        if whole.len() < written.len() {
            let place = records.storage.place();
            let torn = written.len() - whole.len();
            warn!(target: GATEWAY, "Journal {place}: the last line was not written to its end; its {torn} bytes are cut off.");
            records.len = whole.len() as u64;
            if let Err(error) = records.storage.cut(records.len) {
                warn!(target: GATEWAY, "Journal {place}: they cannot be cut off: {error}");
            }
        }
        let clean = records.read(whole);
        if records.reserved == 0 {
            // Random, so that an id of another journal names no task of this one.
            records.reserved = ((new_id >> 34) as u32).max(1);
        }
        let given = TaskId::new(records.reserved).unwrap_or(TaskId::MAX);
        records.ids = Arc::new(ReservedIds::after(given));
        records.warn_of_few_ids();
        records.forget(now);
        records.end_cut(now);
        if !clean {
            // The unusable lines stay in the earlier file.
            records.rotate_or_go_on(now);
        }
        if !records.opened || records.low == 0 {
            // A failure is logged, and tried again with the first task.
            let _ = records.write(now, None);
        }
        records
    }

    /// With `sync`, every entry that has an effect survives a power cut. Entries that reserve task ids always do.
    pub(super) fn with_sync(mut self, sync: bool) -> Self {
        self.sync = sync;
        self
    }

    /// The gateway's id, as its devices know it.
    pub const fn gateway(&self) -> u64 {
        self.gateway
    }

    /// The task ids that it reserves.
    pub(super) const fn reserved_ids(&self) -> &Arc<ReservedIds> {
        &self.ids
    }

    /// The tasks without an end, each with its device's name.
    pub fn unended(&self) -> Vec<(String, Restored)> {
        let lines = self.tasks.values().filter(|line| !line.state.is_final());
        let with_device =
            |line: &TaskEntry| line.restored().map(|task| (line.device.clone(), task));
        lines.filter_map(with_device).collect()
    }

    /// The updates without an end with which this gateway goes on.
    pub(super) fn unended_updates(&self) -> Vec<UnendedUpdate> {
        let lines = self.tasks.values().filter(|line| !line.state.is_final());
        lines.filter_map(|line| self.unended_update(line)).collect()
    }

    fn unended_update(&self, line: &TaskEntry) -> Option<UnendedUpdate> {
        let note = line.note()?;
        let test = note.test.and_then(TaskId::new);
        let test = test.and_then(|id| self.tasks.get(&id));
        let cut = |test: &TaskEntry| note.stopped && test.state == State::Aborted;
        let tested = test
            .filter(|test| test.state.is_final() && !cut(test))
            .map(|test| match test.state {
                State::Completed => Ok(()),
                _ => Err(test.text.clone()),
            });
        let [_, _, goal] = line.spec();
        Some(UnendedUpdate {
            id: line.task,
            device: line.device.clone(),
            goal: goal.to_owned(),
            note,
            tested,
        })
    }

    /// The ended tasks that are still kept, each with its device, component and goal.
    pub fn ended(&self, now: Moment) -> Vec<([&str; 3], RestoredTask)> {
        let lines = self.tasks.values().filter(|line| line.state.is_final());
        let ended = |line: &TaskEntry| RestoredTask {
            id: line.task,
            payload: String::new(),
            state: line.state,
            text: line.text.clone(),
            ended: Some(line.age(now)),
            by_device: line.own().is_some(),
        };
        lines
            .filter(|line| line.age(now) < KEEP)
            .map(|line| (line.spec(), ended(line)))
            .collect()
    }

    /// The last task that the firmware of a device has started itself: the boot, and its id on the link.
    pub(super) fn latest_own(&self, device: &str) -> Option<(u32, LinkId)> {
        let mut own = self
            .tasks
            .values()
            .rev()
            .filter(|line| line.device == device);
        own.find_map(TaskEntry::own)
    }

    /// The boots and boards to which tasks without an end were sent, of a device on a shared line.
    pub(super) fn boards(&self, device: &str) -> Vec<(u32, u64)> {
        let lines = self.tasks.values().filter(|line| !line.state.is_final());
        let boards = lines.filter(|line| line.device == device);
        let boards = boards.filter_map(TaskEntry::board);
        boards.map(|(boot, BoardId(id))| (boot, id)).collect()
    }

    /// The tasks without an end that were sent to this boot were sent to this board, which was not known then.
    pub(super) fn add_board(&mut self, now: Moment, device: &str, boot: u32, board: u64) {
        let open = self.tasks.values().filter(|line| !line.state.is_final());
        let without =
            open.filter(|line| line.device == device && line.is_of_other(boot, BoardId(board)));
        let with: Vec<TaskEntry> = without
            .map(|line| line.clone().on_board(Some(BoardId(board))))
            .collect();
        for line in with {
            let line = match line.state {
                State::Initiated => JournalEntry::Start(line),
                _ => JournalEntry::Accepted(line),
            };
            // Without it, no search can tell later that the board was reset.
            let _ = self.write(now, Some(line));
        }
    }

    /// A `Start` is about to be sent, on a shared line to the board with this id.
    ///
    /// # Errors
    /// Why that cannot be written.
    pub(super) fn starting(
        &mut self,
        now: Moment,
        device: &str,
        client: Option<String>,
        board: Option<u64>,
        task: &Entry<'_>,
    ) -> Result<(), String> {
        let line = TaskEntry::new(now, device, client, task, State::Initiated, "");
        let line = line.on_board(board.map(BoardId));
        self.write(now, Some(JournalEntry::Start(line)))
    }

    /// A device has accepted a task. Of an update, `text` is the note with which another gateway goes on.
    ///
    /// # Errors
    /// Why that cannot be written.
    pub(super) fn accepted(
        &mut self,
        now: Moment,
        device: &str,
        task: &Entry<'_>,
        text: &str,
    ) -> Result<(), String> {
        let client = self.client(task.id);
        let line = TaskEntry::new(now, device, client, task, State::Accepted, text);
        let line = line.on_board(self.board(task.id));
        self.write(now, Some(JournalEntry::Accepted(line)))
    }

    /// A task is about to end.
    ///
    /// # Errors
    /// Why that cannot be written.
    pub(super) fn ended_as(
        &mut self,
        now: Moment,
        device: &str,
        task: &Entry<'_>,
        (state, text): (State, &str),
    ) -> Result<(), String> {
        let client = self.client(task.id);
        let line = TaskEntry::new(now, device, client, task, state, text);
        let line = line.on_board(self.board(task.id));
        self.write(now, Some(JournalEntry::Ended(line)))
    }

    #[cfg(test)]
    pub(super) const fn storage(&self) -> &S {
        &self.storage
    }

    /// Reads what was written; returns whether all of it could be used.
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
                    warn!(target: GATEWAY, "Journal {place}, line {number}: version {it}, this gateway reads version {VERSION}; skipped from here on.");
                }
            }
            if other_version {
                continue;
            }
            match serde_json::from_slice(bytes) {
                Ok(JournalEntry::Opened(opened)) => {
                    self.gateway = opened.gateway;
                    self.reserved = self.reserved.max(opened.last);
                }
                Ok(JournalEntry::Reserved(reserved)) => {
                    self.reserved = self.reserved.max(reserved.last)
                }
                Ok(JournalEntry::Start(line) | JournalEntry::Accepted(line))
                    if line.restored().is_none() && !line.is_own() =>
                {
                    useless += 1;
                    warn!(target: GATEWAY, "Journal {place}, line {number}: skipped, it does not name the device of the task.");
                }
                Ok(
                    JournalEntry::Start(line)
                    | JournalEntry::Accepted(line)
                    | JournalEntry::Ended(line),
                ) => self.note(line),
                Err(error) => {
                    useless += 1;
                    if useless <= LOGGED {
                        warn!(target: GATEWAY, "Journal {place}, line {number}: skipped, it cannot be read: {error}");
                    }
                }
            }
        }
        if useless > LOGGED {
            warn!(target: GATEWAY, "Journal {place}: {useless} lines were skipped in all.");
        }
        useless == 0
    }

    /// Ends the requests that an earlier gateway was carrying out by itself, but for updates with which this one goes on.
    fn end_cut(&mut self, now: Moment) {
        let open = self.tasks.values().filter(|line| !line.state.is_final());
        let ended = |line: &TaskEntry| Some(line.ended_as(now, State::Failed, line.cut()?));
        let open: Vec<TaskEntry> = open.filter_map(ended).collect();
        for line in open {
            // If it cannot be written, the next start does it.
            let _ = self.write(now, Some(JournalEntry::Ended(line)));
        }
    }

    /// The client in a task's earlier entries.
    fn client(&self, id: TaskId) -> Option<String> {
        self.tasks.get(&id)?.client.clone()
    }

    /// The board in a task's earlier entries.
    fn board(&self, id: TaskId) -> Option<BoardId> {
        Some(self.tasks.get(&id)?.board()?.1)
    }

    /// Takes an entry into memory. A final state never changes.
    fn note(&mut self, line: TaskEntry) {
        self.reserved = self.reserved.max(line.task.get());
        match self.tasks.get(&line.task) {
            Some(known) if known.state.is_final() => {}
            // Forgotten at once, since a busy device rejects often.
            Some(known) if line.state == State::Rejected && line.since(known) < UNTOLD => {
                self.tasks.remove(&line.task);
            }
            _ => {
                self.tasks.insert(line.task, line);
            }
        }
    }

    fn write(&mut self, now: Moment, line: Option<JournalEntry>) -> Result<(), String> {
        self.check_altered(now)?;
        if self.len >= self.rotate_at {
            self.rotate_or_go_on(now);
        }
        let mut bytes = Vec::new();
        if !self.opened {
            self.put_opened(now, &mut bytes);
        }
        let mut reserved = self.reserved;
        let assigned = line.as_ref().and_then(JournalEntry::task);
        let assigned = assigned.map_or(0, TaskId::get).max(self.ids.given());
        if assigned >= self.low && reserved < u32::MAX {
            let block = if self.opened { BLOCK } else { FIRST_BLOCK };
            reserved = assigned.max(reserved).saturating_add(block);
            JournalEntry::Reserved(Reserved::new(now, reserved)).put(&mut bytes);
        }
        if let Some(line) = &line {
            line.put(&mut bytes);
        }
        let needed = match &line {
            Some(JournalEntry::Start(_) | JournalEntry::Ended(_)) => true,
            // The next gateway goes on with an update.
            Some(JournalEntry::Accepted(line)) => line.is_update(),
            _ => false,
        };
        let reserves = reserved > self.reserved;
        if let Err(error) = self.storage.add(&bytes, reserves || needed && self.sync) {
            let place = self.storage.place();
            let problem = format!("the journal {place} cannot be written: {error}");
            return Err(self.not_written(problem));
        }
        if self.problem.take().is_some() {
            info!(target: GATEWAY, "The journal {} is written again.", self.storage.place());
        }
        self.len += bytes.len() as u64;
        self.opened = true;
        if reserves {
            self.low = self.reserved.max(assigned).midpoint(reserved);
            self.reserved = reserved;
            self.ids.reserve(self.low, reserved);
            self.warn_of_few_ids();
        }
        if let Some(
            JournalEntry::Start(line) | JournalEntry::Accepted(line) | JournalEntry::Ended(line),
        ) = line
        {
            self.note(line);
        }
        Ok(())
    }

    /// What is to be done regularly: starts a new file if something else altered this one, writes what could not be
    /// written at the start, and reserves task ids if few are left.
    ///
    /// # Errors
    /// Why that is not possible.
    pub(super) fn check(&mut self, now: Moment) -> Result<(), String> {
        if !self.opened || self.ids.given() >= self.low && self.reserved < u32::MAX {
            return self.write(now, None);
        }
        self.check_altered(now)
    }

    /// Starts a new file if something else altered this one.
    ///
    /// # Errors
    /// Why no new file can be started.
    fn check_altered(&mut self, now: Moment) -> Result<(), String> {
        let Some(how) = self.storage.altered() else {
            return Ok(());
        };
        let place = self.storage.place();
        if let Err(error) = self.rotate(now) {
            let problem =
                format!("the journal {place} {how}, and cannot start a new file: {error}");
            return Err(self.not_written(problem));
        }
        warn!(target: GATEWAY, "Journal {place} {how}. A new file with the entries still needed replaces it.");
        Ok(())
    }

    fn not_written(&mut self, problem: String) -> String {
        if self.problem.as_ref() != Some(&problem) {
            warn!(target: GATEWAY, "No task is accepted: {problem}");
            self.problem = Some(problem.clone());
        }
        problem
    }

    fn warn_of_few_ids(&self) {
        let left = u32::MAX - self.reserved;
        let place = self.storage.place();
        if left == 0 {
            warn!(target: GATEWAY, "Journal {place}: all task ids are used up. Stop the gateway, move the journal away and start the gateway again.");
        } else if left < FEW {
            let left = match left {
                1 => "1 task id is".to_owned(),
                left => format!("{left} task ids are"),
            };
            warn!(target: GATEWAY, "Journal {place}: only {left} left. Move the journal away while the gateway is stopped and no task runs.");
        }
    }

    fn put_opened(&self, now: Moment, bytes: &mut Vec<u8>) {
        JournalEntry::Opened(Opened::new(now, self.gateway, self.reserved)).put(bytes);
    }

    /// Starts a new file with all that is still needed, or continues the old one.
    fn rotate_or_go_on(&mut self, now: Moment) {
        if let Err(error) = self.rotate(now) {
            let place = self.storage.place();
            warn!(target: GATEWAY, "Journal {place}: cannot start a new file: {error}");
        }
    }

    fn rotate(&mut self, now: Moment) -> io::Result<()> {
        self.forget(now);
        let mut bytes = Vec::new();
        self.put_opened(now, &mut bytes);
        for line in self.tasks.values().cloned() {
            let line = match line.state {
                State::Initiated => JournalEntry::Start(line),
                State::Accepted => JournalEntry::Accepted(line),
                _ => JournalEntry::Ended(line),
            };
            line.put(&mut bytes);
        }
        let replaced = self.storage.replace(&bytes);
        if replaced.is_ok() {
            self.opened = true;
            self.len = bytes.len() as u64;
        }
        // At twice the size, so that a byte is copied about once.
        self.rotate_at = self.len + ROTATE.max(self.len);
        replaced
    }

    /// Forgets ends that are too old, and the oldest ones if there are too many.
    fn forget(&mut self, now: Moment) {
        // Without its last task of this kind, a device that still holds it would announce it as a new one.
        let own = self.tasks.values().filter(|line| line.own().is_some());
        let latest: HashMap<String, TaskId> =
            own.map(|line| (line.device.clone(), line.task)).collect();
        let is_latest = |line: &TaskEntry| latest.get(&line.device) == Some(&line.task);
        let needed =
            |line: &TaskEntry| !line.state.is_final() || line.age(now) < KEEP || is_latest(line);
        self.tasks.retain(|_, line| needed(line));
        let mut bytes: usize = self.tasks.values().map(TaskEntry::size).sum();
        if self.tasks.len() <= CARRIED && bytes <= CARRIED_BYTES {
            return;
        }
        let ends = self.tasks.values().filter(|line| line.state.is_final());
        let ends = ends.filter(|line| !is_latest(line));
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
