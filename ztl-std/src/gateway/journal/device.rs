//! A device's access to the journal.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ztl_core::envelope::ClientId;
use ztl_core::link::LinkId;
use ztl_core::{State, TaskId};
use ztl_link::{Entry, SessionJournal};

use super::entry::Moment;
use super::records::{JournalRecords, Storage};
use crate::server::Claim;

/// A task whose `Start` is not journaled within this time after its INIT is rejected. So no client learns the
/// id of a task (after 1.5 s, at a slow device) that the journal does not have.
pub(in crate::gateway) const DECIDED: Duration = Duration::from_millis(1200);

/// The reason of that rejection.
pub(in crate::gateway) const UNWRITTEN: &str = "the journal has not been written for 1.2 s, so the task was not started; is its disk too slow?";

/// The journal's records, shared by its devices.
pub(super) type SharedRecords<S> = Arc<Mutex<JournalRecords<S>>>;

pub(super) fn lock<S>(records: &SharedRecords<S>) -> MutexGuard<'_, JournalRecords<S>> {
    records.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Writes the journal entries of one device's session.
#[derive(Debug)]
pub struct DeviceJournal<S> {
    records: SharedRecords<S>,
    device: String,
    now: fn() -> Moment,
    /// The id of the board that answers, on a shared line.
    board: Option<u64>,
    /// Tasks that are not started yet.
    expected: HashMap<TaskId, Expected>,
}

/// A task that is not started yet.
#[derive(Debug)]
struct Expected {
    /// The client that asked for it, if it identifies itself.
    client: Option<ClientId>,
    claim: Claim,
}

impl<S: Storage> DeviceJournal<S> {
    /// Writes the entries of this device to a journal that devices share.
    pub fn new(records: Arc<Mutex<JournalRecords<S>>>, device: &str, now: fn() -> Moment) -> Self {
        Self {
            records,
            device: device.to_owned(),
            now,
            board: None,
            expected: HashMap::new(),
        }
    }

    /// The boots and boards to which tasks without an end were sent.
    #[must_use]
    pub fn boards(&self) -> Vec<(u32, u64)> {
        lock(&self.records).boards(&self.device)
    }

    /// The board that answers on a shared line, if it is known; tasks are sent to it from now on.
    pub const fn set_board(&mut self, board: Option<u64>) {
        self.board = board;
    }

    /// The tasks that were sent to this boot were sent to the board with this id, which was not known then.
    pub fn add_board(&mut self, boot: u32, board: u64) {
        let mut records = lock(&self.records);
        records.add_board((self.now)(), &self.device, boot, board);
    }

    /// A task is about to be started, unless its server rejects it before it is claimed.
    pub(in crate::gateway) fn expect_start(
        &mut self,
        id: TaskId,
        client: Option<ClientId>,
        claim: Claim,
    ) {
        self.expected.insert(id, Expected { client, claim });
    }

    /// The task was not started.
    pub(in crate::gateway) fn forget(&mut self, id: TaskId) {
        self.expected.remove(&id);
    }

    /// A firmware update has come so far that another gateway can go on with it, with this note.
    ///
    /// # Errors
    /// Why that cannot be written.
    pub(in crate::gateway) fn going_on(
        &mut self,
        task: &Entry<'_>,
        note: &str,
    ) -> Result<(), String> {
        lock(&self.records).accepted((self.now)(), &self.device, task, note)
    }

    fn client(&self, id: TaskId) -> Option<String> {
        let ClientId(bytes) = self.expected.get(&id)?.client?;
        Some(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }
}

impl<S: Storage> SessionJournal for DeviceJournal<S> {
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String> {
        let client = self.client(task.id);
        let (now, board) = ((self.now)(), self.board);
        lock(&self.records).starting(now, &self.device, client, board, task)?;
        // The journal has the client from now on.
        let expected = self.expected.remove(&task.id);
        if expected.is_none_or(|expected| expected.claim.take()) {
            return Ok(());
        }
        // No client knows its id, so this entry may be lost.
        let refused = (State::Rejected, UNWRITTEN);
        let _ = lock(&self.records).ended_as((self.now)(), &self.device, task, refused);
        Err(UNWRITTEN.to_owned())
    }

    fn accepted(&mut self, task: &Entry<'_>) {
        // If this is lost, the task is restored from its `Start`.
        let _ = lock(&self.records).accepted((self.now)(), &self.device, task, "");
    }

    fn ended(&mut self, task: &Entry<'_>, state: State, text: &str) -> Result<(), String> {
        lock(&self.records).ended_as((self.now)(), &self.device, task, (state, text))
    }

    fn latest_own(&self) -> Option<(u32, LinkId)> {
        lock(&self.records).latest_own(&self.device)
    }
}
