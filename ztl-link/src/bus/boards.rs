//! Whether the board that answers at an address is the one that it was (`docs/link.md`, 15.8).

use ztl_core::Instant;

/// What a search has found at an address.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LastSearch {
    /// The id of the board that is served.
    pub id: u64,
    /// Whether the search has found this board alone at the address.
    pub alone: bool,
    /// When the search began.
    pub begun: Instant,
    /// When it ended.
    pub ended: Instant,
}

/// A board, as far as it is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KnownBoard {
    /// Its boot.
    pub boot: u32,
    /// Its id as the last search has found it, which may have ended before this boot.
    pub id: u64,
    /// Whether a search that has begun in this boot has found it.
    pub is_sure: bool,
    /// Since when the boot is known.
    pub since: Instant,
}

/// What is known of the boards at an address: of the one that answers, and of those whose tasks may run.
#[derive(Debug, Clone, Default)]
pub struct Boards {
    seen: Vec<KnownBoard>,
    /// The boot of the session.
    current: Option<u32>,
}

impl Boards {
    /// From the boots and boards in the journal to which tasks without an end were sent.
    #[must_use]
    pub fn of_journal(boards: &[(u32, u64)]) -> Self {
        let mut seen: Vec<KnownBoard> = Vec::new();
        for (boot, id) in boards {
            if !seen.iter().any(|known| known.boot == *boot) {
                seen.push(KnownBoard {
                    boot: *boot,
                    id: *id,
                    is_sure: true,
                    since: Instant::ZERO,
                });
            }
        }
        let current = None;
        Self { seen, current }
    }

    /// The board of this boot, if it is known.
    #[must_use]
    pub fn of_boot(&self, boot: u32) -> Option<KnownBoard> {
        let mut seen = self.seen.iter();
        seen.find(|known| known.boot == boot).copied()
    }

    /// The session with this boot is up, and was heard last at this time; `search` is the last one. `astray` are the other boots
    /// whose tasks may run. Returns the board of the session.
    pub fn on_session(
        &mut self,
        now: Instant,
        (boot, heard): (u32, Instant),
        search: &LastSearch,
        astray: &[u32],
    ) -> KnownBoard {
        let mut current = self.of_boot(boot).unwrap_or(KnownBoard {
            boot,
            id: search.id,
            is_sure: false,
            since: now,
        });
        let in_boot = search.alone && search.begun >= current.since;
        // The board of the session has answered after this search, so it is not another one that has gone since.
        if !current.is_sure && in_boot && heard >= search.ended {
            (current.id, current.is_sure) = (search.id, true);
        }
        self.seen
            .retain(|known| known.boot != boot && astray.contains(&known.boot));
        self.seen.push(current);
        self.current = Some(boot);
        current
    }

    /// Whether the board of this boot is known as soon as it answers a command.
    #[must_use]
    pub fn waits_for_answer(&self, boot: u32, search: &LastSearch) -> bool {
        let known = self.of_boot(boot).filter(|known| !known.is_sure);
        known.is_some_and(|known| search.alone && search.begun >= known.since)
    }

    /// Whether the board that a search has found alone at the address is the one of the session, and the one to which all
    /// tasks of these other boots were sent.
    #[must_use]
    pub fn is_known(&self, found: u64, astray: &[u32]) -> bool {
        let current = self.current.and_then(|boot| self.of_boot(boot));
        // If a boot was over before a search could find it, the search before it counts.
        let mut boots = astray.iter().map(|boot| self.of_boot(*boot));
        current.is_none_or(|known| !known.is_sure || known.id == found)
            && boots.all(|known| known.is_some_and(|known| known.id == found))
    }

    /// A board to which tasks were sent, if the one that was found is another one.
    #[must_use]
    pub fn earlier(&self, found: u64) -> Option<u64> {
        let mut ids = self.seen.iter().map(|known| known.id);
        ids.find(|id| *id != found)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const BEGIN: Instant = Instant::from_millis(1000);

    /// What a search has found that began and ended so many ms after the beginning.
    fn found(id: u64, begun: u64, ended: u64) -> LastSearch {
        let at = |millis| BEGIN + Duration::from_millis(millis);
        LastSearch {
            id,
            alone: true,
            begun: at(begun),
            ended: at(ended),
        }
    }

    /// A session of this boot is opened, after a search that was over.
    fn opened(boards: &mut Boards, boot: u32, id: u64, astray: &[u32]) -> KnownBoard {
        let early = LastSearch {
            begun: Instant::ZERO,
            ..found(id, 0, 0)
        };
        boards.on_session(BEGIN, (boot, BEGIN), &early, astray)
    }

    /// The same, and a search then finds this board. Returns the id that is known.
    fn session(boards: &mut Boards, boot: u32, id: u64, astray: &[u32]) -> u64 {
        let heard = BEGIN + Duration::from_millis(500);
        opened(boards, boot, id, astray);
        let known = boards.on_session(heard, (boot, heard), &found(id, 100, 200), astray);
        assert!(known.is_sure);
        known.id
    }

    #[test]
    fn a_board_is_known_by_its_id_also_after_a_restart_of_the_gateway() {
        // The journal has a task of boot 7 of board 1; board 9 answers.
        let mut boards = Boards::of_journal(&[(7, 1), (7, 1)]);
        assert_eq!(boards.earlier(9), Some(1));
        assert_eq!(session(&mut boards, 8, 9, &[7]), 9);
        assert!(!boards.is_known(9, &[7]) && !boards.is_known(1, &[7]));
        // That task has ended.
        assert_eq!(session(&mut boards, 8, 9, &[]), 9);
        assert!(boards.is_known(9, &[]));
        assert_eq!(boards.earlier(9), None);
        // Board 1 was reset.
        let mut boards = Boards::of_journal(&[(7, 1)]);
        assert_eq!(session(&mut boards, 8, 1, &[7]), 1);
        assert!(boards.is_known(1, &[7]));
        // A session of a boot that is known keeps its id, whatever a search has found meanwhile.
        assert_eq!(session(&mut boards, 7, 9, &[]), 1);
        // Tasks of two boards: neither of them answers for all.
        let mut boards = Boards::of_journal(&[(7, 1), (8, 9)]);
        assert_eq!(session(&mut boards, 8, 9, &[7]), 9);
        assert!(!boards.is_known(9, &[7]) && !boards.is_known(1, &[7]));
        // A task of which the journal does not have the board.
        let mut boards = Boards::of_journal(&[]);
        session(&mut boards, 8, 9, &[7]);
        assert!(!boards.is_known(9, &[7]));
    }

    #[test]
    fn a_board_that_answered_for_another_one_meanwhile_may_carry_out_tasks_of_its_own() {
        // Board 1 has a task; board 9 answers and gets one; board 1 answers again, in the same boot or after a reset.
        for (boot, astray) in [(7, &[8][..]), (10, &[7, 8])] {
            let mut boards = Boards::default();
            session(&mut boards, 7, 1, &[]);
            session(&mut boards, 8, 9, &[7]);
            session(&mut boards, boot, 1, astray);
            assert!(!boards.is_known(1, astray), "the task of board 9 may run");
            session(&mut boards, boot, 1, &[]);
            assert!(boards.is_known(1, &[]));
        }
        // It got none.
        let mut boards = Boards::default();
        session(&mut boards, 7, 1, &[]);
        session(&mut boards, 8, 9, &[7]);
        session(&mut boards, 10, 1, &[7]);
        assert!(boards.is_known(1, &[7]));
        // A board that is reset before a search can find it is not forgotten.
        let mut boards = Boards::default();
        session(&mut boards, 7, 1, &[]);
        opened(&mut boards, 8, 1, &[7]);
        session(&mut boards, 10, 1, &[7, 8]);
        assert!(boards.is_known(1, &[7, 8]));
        // A board that is reset several times is the same one.
        let mut boards = Boards::default();
        session(&mut boards, 7, 1, &[]);
        session(&mut boards, 8, 1, &[7]);
        session(&mut boards, 9, 1, &[7, 8]);
        assert!(boards.is_known(1, &[7, 8]));
    }

    #[test]
    fn a_board_that_was_exchanged_between_two_searches_is_known_after_the_next_one() {
        let mut boards = Boards::default();
        session(&mut boards, 7, 1, &[]);
        // Board 9 answers; the last search was before it came.
        assert!(!opened(&mut boards, 8, 1, &[]).is_sure);
        let mut after = |search: LastSearch, heard| {
            let heard = BEGIN + Duration::from_millis(heard);
            let known = boards.on_session(heard, (8, heard), &search, &[]);
            (known.id, known.is_sure)
        };
        // The next one began before it came as well, or found two, or has not been followed by an answer.
        let early = LastSearch {
            begun: Instant::ZERO,
            ..found(1, 0, 50)
        };
        assert_eq!(after(early, 60), (1, false));
        let two = LastSearch {
            alone: false,
            ..found(9, 100, 150)
        };
        assert_eq!(after(two, 160), (1, false));
        assert_eq!(after(found(9, 200, 250), 240), (1, false));
        assert_eq!(after(found(9, 200, 250), 260), (9, true));
        // It answers in the same boot, whatever is found.
        assert_eq!(after(found(1, 300, 350), 360), (9, true));
        assert!(boards.is_known(9, &[]) && !boards.is_known(1, &[]));
    }
}
