//! Which boards answer on a shared line, as the gateway finds out.

use ztl_core::Instant;
use ztl_link::bus::{Boards, LastSearch};

use super::gateway::{Gateway, address};
use super::some_node;
use crate::broken;
use crate::broken::ends::link::bus as copy;

/// What the real gateway knows of the boards at an address, or its copy with mutants if one is switched on.
pub(super) enum SomeBoards {
    Real(Boards),
    Copy(copy::Boards),
}

impl SomeBoards {
    fn of_journal(boards: &[(u32, u64)]) -> Self {
        match broken::is_on() {
            true => Self::Copy(copy::Boards::of_journal(boards)),
            false => Self::Real(Boards::of_journal(boards)),
        }
    }

    /// The id of the board, and whether it is certain.
    fn on_session(
        &mut self,
        now: Instant,
        session: (u32, Instant),
        search: LastSearch,
        astray: &[u32],
    ) -> (u64, bool) {
        let LastSearch {
            id,
            alone,
            begun,
            ended,
        } = search;
        let (id, is_sure) = match self {
            Self::Real(boards) => {
                let known = boards.on_session(now, session, &search, astray);
                (known.id, known.is_sure)
            }
            Self::Copy(boards) => {
                let search = copy::LastSearch {
                    id,
                    alone,
                    begun,
                    ended,
                };
                let known = boards.on_session(now, session, &search, astray);
                (known.id, known.is_sure)
            }
        };
        (id, is_sure)
    }

    /// Whether the board of a boot is known.
    fn of_boot(&self, boot: u32) -> Option<bool> {
        match self {
            Self::Real(boards) => boards.of_boot(boot).map(|known| known.is_sure),
            Self::Copy(boards) => boards.of_boot(boot).map(|known| known.is_sure),
        }
    }

    fn waits_for_answer(&self, boot: u32, search: LastSearch) -> bool {
        match self {
            Self::Real(boards) => boards.waits_for_answer(boot, &search),
            Self::Copy(boards) => {
                let known = boards.of_boot(boot).filter(|known| !known.is_sure);
                known.is_some_and(|known| search.alone && search.begun >= known.since)
            }
        }
    }

    fn is_known(&self, found: u64, astray: &[u32]) -> bool {
        match self {
            Self::Real(boards) => boards.is_known(found, astray),
            Self::Copy(boards) => boards.is_known(found, astray),
        }
    }
}

impl Gateway {
    /// From the journal.
    pub(super) fn know_boards(&mut self) {
        for (number, session) in self.sessions.iter_mut().enumerate() {
            let journal = session.journal_mut().as_ref();
            let boards = journal.map(|journal| journal.boards()).unwrap_or_default();
            let boards = SomeBoards::of_journal(&boards);
            // Nodes are served that a search has found.
            let search = LastSearch {
                id: some_node::id(address(number)),
                ..LastSearch::default()
            };
            self.boards.push((boards, search));
        }
    }

    /// A search has ended: the ids that it has found, each with its address.
    pub(super) fn on_search(&mut self, (begun, ended): (Instant, Instant), found: &[(u64, u8)]) {
        let sessions = self.sessions.iter_mut().zip(&mut self.boards);
        for (number, (session, (boards, search))) in sessions.enumerate() {
            let its = |(_, at): &&(u64, u8)| *at == address(number);
            let ids: Vec<u64> = found.iter().filter(its).map(|(id, _)| *id).collect();
            // Of two boards the one that was there before stays the device.
            let stays = ids.is_empty() || ids.contains(&search.id);
            *search = LastSearch {
                id: if stays { search.id } else { ids[0] },
                alone: ids.len() == 1,
                begun,
                ended,
            };
            let astray = session.astray_boots();
            session.handle_search(search.alone && boards.is_known(search.id, &astray));
        }
    }

    /// Takes what searches have found. Returns whether another boot answers somewhere.
    pub(super) fn check_boards(&mut self, now: Instant) -> bool {
        let mut is_new = false;
        for (session, (boards, search)) in self.sessions.iter_mut().zip(&mut self.boards) {
            let up = session.is_up().then(|| session.device()).flatten();
            let Some(boot) = up.map(|device| device.boot) else {
                continue;
            };
            let before = boards.of_boot(boot);
            let session_of = (boot, session.heard());
            let (id, is_sure) =
                boards.on_session(now, session_of, *search, &session.astray_boots());
            if let Some(journal) = session.journal_mut() {
                journal.set_board(Some(id));
                if is_sure && before == Some(false) {
                    journal.add_board(boot, id);
                }
            }
            if boards.waits_for_answer(boot, *search) {
                session.ping(now);
            }
            is_new |= before.is_none() && !is_sure;
        }
        is_new
    }
}
