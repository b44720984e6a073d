//! A node of a shared line: whether the board at its address is the one that it was.

use super::worker::Worker;
use crate::gateway::bus::Seat;
use crate::gateway::rate_limited_log::Severity;
use crate::time::now;

/// What the device's thread knows of the boards at its address.
#[derive(Debug, Default)]
pub(super) struct Boards {
    /// The boot that the session knows, and the id of its board.
    known: Option<(u32, u64)>,
    /// How many searches were taken into account.
    searches: u64,
    /// Why the device takes no tasks, although it still has some.
    conflict: Option<String>,
}

impl Worker {
    /// Why the device takes no tasks: several boards have its address.
    pub(super) fn conflict(&self) -> Option<String> {
        self.seat()?.board().conflict
    }

    /// Which other board answers at the address of this node.
    pub(super) fn other_board(&self) -> Option<String> {
        let seat = self.seat()?;
        let (wanted, found) = (seat.firmware()?, &self.session.device()?.name);
        let address = seat.address();
        (wanted != found)
            .then(|| format!("'{found}' answers at the address {address} of '{wanted}'"))
    }

    /// Another boot has answered while tasks may run.
    pub(super) fn on_other_board(&mut self) {
        let address = self.seat().map_or(0, Seat::address);
        let text = format!(
            ": a board with another start has answered at address {address}: it was reset, or two boards have this address"
        );
        self.log.log(now(), Severity::Warn, text);
    }

    /// Takes what searches have found.
    pub(super) fn check_board(&mut self) {
        let Some(board) = self.seat().map(Seat::board) else {
            return;
        };
        if let Some(boot) = self.session.device().map(|device| device.boot) {
            let is_new = self.boards.known.is_none_or(|(known, _)| known != boot);
            // Until then it may be another board.
            if is_new && (self.boards.known.is_none() || !self.session.has_astray()) {
                self.boards.known = Some((boot, board.id));
            }
        }
        if board.searches == self.boards.searches {
            return;
        }
        self.boards.searches = board.searches;
        let known = self.boards.known.map(|(_, id)| id);
        self.session
            .handle_search(board.alone && known == Some(board.id));
        let before = std::mem::replace(&mut self.boards.conflict, board.conflict);
        match self.boards.conflict.clone() {
            Some(conflict) => {
                self.set_problem(conflict.clone());
                for (task, _) in self.tasks.values() {
                    task.progress(format!("{conflict}; the task may still run"));
                }
            }
            None if before.is_some() && self.session.is_up() => self.on_up(),
            None => {}
        }
    }
}
