//! A node of a shared line: whether the board at its address is the one that it was.

use super::Worker;
use crate::gateway::rate_limited_log::Severity;
use crate::gateway::seat::Seat;
use crate::time::now;

/// What the device's thread knows of the boards at its address.
#[derive(Debug, Default)]
pub(in crate::gateway::device) struct Boards {
    /// The boot that the session knows, and the id of its board. While tasks of an earlier boot may run: those of the earlier one.
    known: Option<(u32, u64)>,
    /// Whether the journal has tasks of several boards. No search can tell that all of them were reset.
    several: bool,
    /// How many searches were taken into account.
    searches: u64,
    /// Why the device takes no tasks, although it still has some.
    conflict: Option<String>,
}

impl Boards {
    /// From the boots and boards in the journal to which tasks without an end were sent.
    pub(in crate::gateway::device) fn of_journal(boards: &[(u32, u64)]) -> Self {
        let known = boards.first().copied();
        Self {
            known,
            several: boards
                .iter()
                .any(|(_, id)| Some(*id) != known.map(|it| it.1)),
            ..Self::default()
        }
    }

    /// The session with this boot is up; `found` is the board that a search has found. `astray`: tasks of another boot may
    /// still run. Returns the board of the session.
    fn on_session(&mut self, boot: u32, found: u64, astray: bool) -> u64 {
        if !astray {
            self.several = false;
        }
        match self.known {
            Some((known, id)) if known == boot => return id,
            // Until then it may be another board.
            Some(_) if astray => {}
            _ => self.known = Some((boot, found)),
        }
        found
    }

    /// Whether a board that was found alone at the address is the one to which all tasks were sent.
    fn is_known(&self, found: u64) -> bool {
        !self.several && self.known.is_some_and(|(_, id)| id == found)
    }

    /// The earlier board, if the one that was found is another one.
    fn earlier(&self, found: u64) -> Option<u64> {
        let known = self.known.map(|(_, id)| id);
        known.filter(|known| *known != found)
    }
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
        let Some((address, found)) = self.seat().map(|seat| (seat.address(), seat.board().id))
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

    /// Takes what searches have found.
    pub(super) fn check_board(&mut self) {
        let Some(board) = self.seat().map(Seat::board) else {
            return;
        };
        // While the link is lost, no task is known to be astray.
        let device = self.session.device().filter(|_| self.session.is_up());
        if let Some(boot) = device.map(|device| device.boot) {
            let astray = self.session.has_astray();
            let id = self.boards.on_session(boot, board.id, astray);
            if let Some(journal) = self.session.journal_mut() {
                journal.set_board(id);
            }
        }
        if board.searches == self.boards.searches {
            return;
        }
        self.boards.searches = board.searches;
        let alone = board.alone && self.boards.is_known(board.id);
        self.session.handle_search(alone);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_board_is_known_by_its_id_also_after_a_restart_of_the_gateway() {
        // The journal has a task of boot 7 of board 1; board 9 answers, and is not known while that task may run.
        let mut boards = Boards::of_journal(&[(7, 1), (7, 1)]);
        assert_eq!(boards.earlier(9), Some(1));
        assert_eq!(boards.on_session(8, 9, true), 9);
        assert!(!boards.is_known(9));
        assert!(boards.is_known(1));
        assert_eq!(boards.on_session(8, 9, false), 9);
        assert!(boards.is_known(9));
        assert_eq!(boards.earlier(9), None);
        // Board 1 was reset.
        let mut boards = Boards::of_journal(&[(7, 1)]);
        assert_eq!(boards.on_session(8, 1, true), 1);
        assert!(boards.is_known(1));
        // A session of the board that is known keeps its id, whatever a search has found meanwhile.
        assert_eq!(boards.on_session(7, 9, false), 1);
        // Tasks of two boards: neither of them answers for all.
        let mut boards = Boards::of_journal(&[(7, 1), (8, 9)]);
        assert_eq!(boards.on_session(8, 9, true), 9);
        assert!(!boards.is_known(9) && !boards.is_known(1));
        boards.on_session(8, 9, false);
        assert!(boards.is_known(9));
        // Without tasks, the first board that answers is known.
        let mut boards = Boards::of_journal(&[]);
        assert!(!boards.is_known(9));
        assert_eq!(boards.on_session(8, 9, false), 9);
        assert!(boards.is_known(9));
    }
}
