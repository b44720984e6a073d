//! A node of a shared line: whether the board at its address is the one that it was.

use std::time::Duration;

use ztl_link::bus::{KnownBoard, LastSearch};

use super::Worker;
use super::update_job::Outcome;
use crate::gateway::rate_limited_log::Severity;
use crate::gateway::seat::Seat;
use crate::gateway::updates::UpdateProblem;
use crate::time::now;

/// How long an update waits after a restart of its board until a search says which board answers. On a line whose nodes are all
/// busy, a search takes longer.
const SEARCH: Duration = Duration::from_secs(10);

impl Worker {
    /// Its place, if it is a node of a shared line.
    pub(super) fn seat(&self) -> Option<&Seat> {
        self.opener.as_ref()?.seat.as_deref()
    }

    /// Why the device takes no tasks: several boards have its address or its id.
    pub(super) fn conflict(&self) -> Option<String> {
        self.seat()?.conflict()
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
        let Some((address, found)) = self
            .seat()
            .map(|seat| (seat.address(), seat.board().search.id))
        else {
            return;
        };
        let text = match self.boards.earlier(found) {
            Some(earlier) => format!(
                ": the board with the id {found:016x} answers at address {address}; the tasks from before are those of the board with the id {earlier:016x}"
            ),
            None => format!(
                ": a board with another start has answered at address {address}: it was reset, or two boards have this address"
            ),
        };
        self.log.log(now(), Severity::Warn, text);
    }

    /// Which board answers in the session of a shared line.
    fn current_board(&mut self, search: &LastSearch) -> Option<KnownBoard> {
        // While the link is lost, no task is known to be astray.
        let device = self.session.device().filter(|_| self.session.is_up());
        let boot = device?.boot;
        let (astray, heard) = (self.session.astray_boots(), self.session.heard());
        let before = self.boards.of_boot(boot);
        let boards = &mut self.boards;
        let current = boards.on_session(now(), (boot, heard), search, &astray);
        if let Some(journal) = self.session.journal_mut() {
            journal.set_board(Some(current.id));
            if current.is_sure && before.is_some_and(|before| !before.is_sure) {
                journal.add_board(boot, current.id);
            }
        }
        if self.boards.waits_for_answer(boot, search) {
            self.session.ping(now());
        }
        if before.is_none() && !current.is_sure {
            // Another board may have come since the last one.
            self.seat()?.want_search();
        }
        Some(current)
    }

    /// Whether the board that answers is the one that is updated, as far as searches say. The update waits until that is known.
    pub(super) fn is_board_of_update(&mut self) -> bool {
        let Some(board) = self.seat().map(Seat::board) else {
            return true;
        };
        let current = self.current_board(&board.search);
        let Some(running) = &mut self.updates.running else {
            return false;
        };
        let Some(current) = current else {
            return false;
        };
        running.waits = !current.is_sure && now() < current.since + SEARCH;
        if running.waits {
            return false;
        }
        let id = format!("{:016x}", current.id);
        let wanted = running.board.get_or_insert_with(|| id.clone());
        if *wanted == id {
            return true;
        }
        let text =
            format!("a board with the id {id} answers instead of the one with the id {wanted}");
        self.end_update_of_other(&text);
        false
    }

    /// Another board has the address of the one that is updated, as this text says.
    pub(super) fn end_update_of_other(&mut self, what: &str) {
        // The next gateway finds out by itself.
        if self.stopping.is_none() {
            let text =
                format!("{what}, which was to be updated; what that one runs is not certain");
            self.end_update(Outcome::Failed(UpdateProblem::Other, text));
        }
    }

    /// Takes what searches have found.
    pub(super) fn check_board(&mut self) {
        let Some(board) = self.seat().map(Seat::board) else {
            return;
        };
        self.current_board(&board.search);
        if self.updates.running.as_ref().is_some_and(|it| it.waits) {
            self.on_update_up();
        }
        if board.searches == self.searches {
            return;
        }
        self.searches = board.searches;
        let alone = board.search.alone && {
            let astray = self.session.astray_boots();
            self.boards.is_known(board.search.id, &astray)
        };
        self.session.handle_search(alone);
        let before = std::mem::replace(&mut self.conflict, board.conflict);
        match self.conflict.clone() {
            Some(conflict) => {
                if board.replaced {
                    let name = &self.name;
                    self.end_update_of_other(&format!("{conflict}, instead of '{name}'"));
                }
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
